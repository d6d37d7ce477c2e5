"""Stress and stiffness at one deformation gradient, one module per kind of law."""
