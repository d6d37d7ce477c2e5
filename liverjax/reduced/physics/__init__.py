"""What acts in reduced models besides the solid: fluid and supports."""
