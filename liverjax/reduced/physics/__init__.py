"""Fluid and supports of reduced models, in addition to the solid."""
