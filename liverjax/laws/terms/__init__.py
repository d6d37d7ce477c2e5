"""Stress and stiffness of one deformation gradient, by kind of law."""
