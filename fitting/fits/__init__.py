"""Fits of frequency sweeps, stress-stretch curves, several tests together, stiffness maps and parameters of scenes."""
