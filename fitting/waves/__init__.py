"""Shear waves: what a material does to them, and what they say of a material."""
