"""Files of laboratories: sweeps, stress-stretch curves, displacements."""
