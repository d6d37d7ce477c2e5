"""Readers of measured files: sweeps, stress-stretch curves, displacements, and others."""
