"""Show a moving body in a browser, where the user can pull the body with the mouse."""
