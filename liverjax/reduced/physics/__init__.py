"""Physics of reduced models in addition to the solid: fluid and supports."""
