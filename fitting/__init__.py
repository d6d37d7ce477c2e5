"""Identification of material parameters from measurements, on top of `liverjax`."""

from types import ModuleType

from liverjax.core import addresses  # first import: it sets 64-bit mode and checks the version of JAX


def __getattr__(name: str) -> ModuleType:
    return addresses.moved_module("fitting", name)
