"""A body that is pulled by hand in a browser while it moves."""
