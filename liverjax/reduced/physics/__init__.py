"""Forces in reduced models in addition to the stress of the solid: pressures of a fluid, and supports."""
