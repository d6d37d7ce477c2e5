"""Shear waves in a material, and the moduli that follow from them."""
