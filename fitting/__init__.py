"""Identification of material parameters from measurements, on top of `liverjax`."""

import liverjax  # noqa: F401  (64-bit mode and the check of the jax release come first)
