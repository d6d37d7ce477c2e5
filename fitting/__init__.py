"""Identification of material parameters from measurements, on top of `liverjax`."""

from types import ModuleType

from liverjax.core import addresses  # 64-bit mode and the check of the jax release come first


def __getattr__(name: str) -> ModuleType:
    return addresses.moved_module("fitting", name)
