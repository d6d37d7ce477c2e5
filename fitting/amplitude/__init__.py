"""Fit hyperelastic laws to strain sweeps, which are measured moduli as a function of the strain amplitude."""
