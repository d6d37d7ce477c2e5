"""File formats of waves, and unwrapping of phases."""
