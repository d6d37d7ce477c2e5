"""Fit hyperelastic laws to strain sweeps. A strain sweep contains moduli that were measured at several strain
amplitudes."""
