"""Fits of sweeps, curves, several tests, stiffness maps and parameters of scenes."""
