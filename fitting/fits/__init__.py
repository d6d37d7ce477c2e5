"""The fits: sweeps, curves, several tests, stiffness maps, parameters of scenes."""
