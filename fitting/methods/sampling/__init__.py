"""Sampling of a posterior density, and a check whether there are enough samples."""
