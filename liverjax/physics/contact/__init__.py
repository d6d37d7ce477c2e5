"""Contact of the body's surface with rigid obstacles."""
