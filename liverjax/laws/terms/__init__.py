"""Stress and stiffness at one deformation gradient, with one module for each kind of law."""
