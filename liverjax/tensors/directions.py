"""Directions of a material: fibres, and the axes of fibre and sheet."""

import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers
from liverjax.tensors.matrices import IDENTITY, Matrix, Vector, add, cross, dot, scale, transpose, unit


def components(direction: Numbers | None, like: Number) -> Vector:
    """A direction (3,), or one per element (E, 3), as the components of a unit vector in the precision of `like`."""
    direction = jnp.asarray(direction, jnp.result_type(like))
    shape, elements = direction.shape, jnp.shape(like)
    if shape[-1:] != (3,) or (len(shape) > 1 and elements and shape[-2] != elements[-1]):
        raise InputError(f"a direction has shape {shape}: give (3,) or one row of 3 per element, {(*elements, 3)}")
    return unit(tuple(direction[..., i] for i in range(3)))


def orthogonal_axes(fibre: Numbers | None, sheet: Numbers | None, like: Number) -> Matrix:
    """Columns fibre, sheet (made orthogonal to the fibre) and normal; without a fibre the coordinate axes.

    The directions have the form that `components` accepts.
    """
    if fibre is None:
        return IDENTITY
    f, s = components(fibre, like), components(sheet, like)
    s = unit(add(s, scale(-dot(f, s), f)))
    return transpose((f, s, cross(f, s)))
