"""Read files of measurements: sweeps, stress-stretch curves, displacements, and others."""
