"""Rigid shapes: signed distance of points, the gradient of the distance (the normal) and its second derivative.

Points are given relative to the position of the shape. This position is a point of the plane, the centre of a sphere, a
point on the axis of a cylinder, or the tip of a cone. Distances are positive outside the shape. The coordinates x, y, z
of the points are separate arrays of any shape.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Array, Number

#: Names of the shapes in scenes, with the fields that each shape needs.
SHAPES: dict[str, tuple[str, ...]] = {
    "plane": ("axis",),
    "sphere": ("radius",),
    "cylinder": ("radius", "axis"),
    "cone": ("half_angle", "axis"),
}


class Distance(NamedTuple):
    """Signed distance of points, with the first and second derivative of the distance."""

    value: jax.Array  # (…) [m]
    normal: list[jax.Array]  # 3 components (…): gradient of the distance, a unit vector
    bent: list[list[jax.Array]]  # 3 x 3 components (…) [1/m]: second derivative of the distance


def distance(shape: str, y: list[jax.Array], axis: Any, radius: Number, half_angle: Number) -> Distance:
    """Return the signed distance [m] of points from a shape, with its first and second derivative.

    Args:
        shape: one of `SHAPES`.
        y: coordinates x, y, z [m] of the points relative to the position of the shape, three arrays of any shape.
        axis: unit vector (3,): the outward normal of a plane, the axis of a cylinder, or the inward axis of a cone.
        radius: radius [m] of a sphere, a cylinder, or the rounded tip of a cone. The lowest point of the rounded tip is
            at the position of the cone.
        half_angle: angle [rad] between the cone's axis and its side.
    """
    if shape == "plane":
        zero = jnp.zeros_like(y[0])
        along = sum(a * c for a, c in zip(axis, y, strict=True))
        return Distance(along, [a + zero for a in axis], [[zero] * 3 for _ in range(3)])
    if shape == "sphere":
        return _round(y, radius)
    if shape == "cylinder":
        return _round(_normal_to(y, axis), radius, axis)
    return _cone(y, axis, radius, half_angle)


def _normal_to(y: list[jax.Array], axis: Array) -> list[jax.Array]:
    """Return the components of the vectors y perpendicular to the unit vector `axis`."""
    along = sum(a * c for a, c in zip(axis, y, strict=True))
    return [c - along * a for a, c in zip(axis, y, strict=True)]


def _round(y: list[jax.Array], radius: Number, axis: Array | None = None) -> Distance:
    """Return the distance of the points y from a sphere with centre 0, or from a cylinder with an axis through 0.

    For a cylinder, y must contain only the components perpendicular to the axis.
    """
    # At the centre the normal is not defined. The lower bound 1e-30 avoids a division by 0.
    r = jnp.sqrt(jnp.maximum(sum(c * c for c in y), 1e-30))
    n = [c / r for c in y]
    held = [[0.0] * 3 for _ in range(3)] if axis is None else [[a * b for b in axis] for a in axis]
    bent = [[((i == j) - held[i][j] - n[i] * n[j]) / r for j in range(3)] for i in range(3)]
    return Distance(r - radius, n, bent)


def _cone(y: list[jax.Array], axis: jax.Array, radius: Number, half_angle: Number) -> Distance:
    """Return the distance of the points y from the side or the tip of a cone.

    For a rounded tip, this is the distance from a sharp cone that lies deeper inside, minus the radius of the tip.
    """
    c, s = jnp.cos(half_angle), jnp.sin(half_angle)
    y = [v - radius * a for v, a in zip(y, axis, strict=True)]
    along, tip, side = (
        sum(a * v for a, v in zip(axis, y, strict=True)),
        _round(y, radius),
        _round(_normal_to(y, axis), 0.0, axis),
    )
    lateral = Distance(
        c * side.value - s * along - radius,
        [c * n - s * a for n, a in zip(side.normal, axis, strict=True)],
        [[c * b for b in row] for row in side.bent],
    )
    near_tip = s * side.value + c * along < 0
    return jax.tree.map(lambda a, b: jnp.where(near_tip, a, b), tip, lateral)
