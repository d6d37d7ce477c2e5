"""Identification of material parameters from measurements, on top of `liverjax`."""

from types import ModuleType

from liverjax.core import addresses  # imported first: sets 64-bit mode and checks the jax release


def __getattr__(name: str) -> ModuleType:
    return addresses.moved_module("fitting", name)
