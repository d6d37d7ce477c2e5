"""Directions of a material: fibre directions, and three orthogonal axes (fibre, sheet and normal)."""

import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers
from liverjax.tensors.matrices import IDENTITY, Matrix, Vector, add, cross, dot, scale, transpose, unit


def components(direction: Numbers | None, like: Number) -> Vector:
    """Normalise a direction (3,), or one direction per element (E, 3), and return its three components.

    The result has the precision of `like`. If `like` is an array, its last axis has one entry per element.
    """
    direction = jnp.asarray(direction, jnp.result_type(like))
    shape, elements = direction.shape, jnp.shape(like)
    if shape[-1:] != (3,) or (len(shape) > 1 and elements and shape[-2] != elements[-1]):
        raise InputError(
            f"a fibre or sheet direction has shape {shape}: give shape (3,), or one row of 3 per element, shape "
            f"{(*elements, 3)}"
        )
    return unit(tuple(direction[..., i] for i in range(3)))


def orthogonal_axes(fibre: Numbers | None, sheet: Numbers | None, like: Number) -> Matrix:
    """Return the matrix with the columns fibre, sheet (made orthogonal to the fibre) and normal.

    `fibre` and `sheet` have the form that `components` accepts. If `fibre` is None, the coordinate axes are returned.
    """
    if fibre is None:
        return IDENTITY
    f, s = components(fibre, like), components(sheet, like)
    s = unit(add(s, scale(-dot(f, s), f)))
    return transpose((f, s, cross(f, s)))
