"""Strain sweeps: moduli that change with the strain amplitude, and the hyperelastic law that explains them."""
