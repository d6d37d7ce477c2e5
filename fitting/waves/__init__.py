"""Compute moduli from measured shear waves."""
