"""A body in a browser that the user can pull while it moves."""
