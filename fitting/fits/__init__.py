"""The fits: sweeps, curves, several tests, maps of stiffness, numbers of scenes."""
