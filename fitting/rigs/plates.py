"""The sample between the plates of a rheometer (together called the rig): its mesh, and the coordinates of its motion.

The coordinates are the displacements u of the free nodes, the lift (axial displacement) of the top plate, and the arc
length of the plate's rotation, arc = radius * angle.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, static, struct
from liverjax.mesh import shapes
from liverjax.mesh.tetrahedra import TetMesh, tet_mesh

#: Radius and height [m] from section 5.3 of the book chapter. Section 5.2 prints 41 mm instead of 4 mm +- 1 mm (at
#: 41 mm, the sample would be in resonance within the band).
RADIUS, HEIGHT = 0.010, 0.004


@struct
class Rig:
    """A sample between two plates. The nodes of the bottom plate come first, then the free nodes, then the nodes of the
    top plate."""

    mesh: TetMesh = param("m", "the sample")
    radius: Number = param("m", "plate radius")
    height: Number = param("m", "gap")
    density: Number | None = param("kg/m^3", "None: the run has no inertia, and no velocities are stored", default=None)
    bottom: int = static(about="number of nodes on the fixed plate")
    top: int = static(about="number of nodes on the turning plate")
    held: jax.Array | None = param(
        "m", "positions (V, 3) of the compressed sample; None: not compressed (`compression`)", default=None
    )
    meshless: jax.Array | None = param(
        "1",
        "factors R and S (2,) of `glued_compression`, corrected for the error of the mesh; None: unknown",
        default=None,
    )
    free_height: bool = static(default=False, about="the top plate also moves along the axis, without axial force")


def cell_size_for(radius: float, height: float) -> float:
    """Return the default cell size [m], which gives 100 to 400 nodes for any shape. `geometry_factor` removes the error
    of such a mesh at small strain."""
    return max((math.pi * radius**2 * height / 100) ** (1 / 3), radius / 6, height / 12)


def linear_cell_for(radius: float, height: float) -> float:
    """Return a cell size [m] that gives about 100 nodes. This is enough for small strain without inertia, because the
    bias (`geometry_factor`) is then the whole error of the mesh.

    The remaining relative error is proportional to the strain, and much smaller than the strain. At a strain of 1e-3,
    the moduli differ by about 1e-5 (relative) from those with `cell_size_for`
    (experiments/benchmarks/torsion_speed.py).
    """
    return max((math.pi * radius**2 * height / 30) ** (1 / 3), radius / 4, height / 8)


def make_rig(
    radius: float = RADIUS,
    height: float = HEIGHT,
    cell_size: float | None = None,
    free_height: bool = False,
    density: float | None = None,
) -> Rig:
    """Return a rig with a generated mesh of the cylinder.

    Args:
        radius, height: size of the sample [m].
        cell_size: edge length of the mesh [m]; default `cell_size_for`.
        free_height: the top plate may rise (Poynting effect); otherwise the gap is fixed.
        density: density [kg/m^3]; None: without inertia.

    Raises:
        InputError: a length is not positive.
    """
    for name, value in (("radius", radius), ("height", height)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} = {value} must be positive: give the plate {name} in metres")
    mesh = shapes.cylinder(radius, height, cell_size or cell_size_for(radius, height))
    return rig_from_mesh(mesh, radius, height, free_height, density)


def rig_from_mesh(
    mesh: TetMesh, radius: float, height: float, free_height: bool = False, density: float | None = None
) -> Rig:
    """Return a rig with the given mesh. The axis of the mesh must be z, and the plates are its lowest and highest
    planes."""
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    z = points[:, 2]
    near = 1e-9 * (z.max() - z.min())
    plate = np.where(z < z.min() + near, 0, np.where(z > z.max() - near, 2, 1))
    order = np.argsort(plate, kind="stable")
    number = np.argsort(order)
    return Rig(
        mesh=tet_mesh(points[order], number[tets]),
        radius=radius,
        height=height,
        density=density,
        bottom=int((plate == 0).sum()),
        top=int((plate == 2).sum()),
        free_height=free_height,
    )


def sample_positions(rig: Rig, u: jax.Array, lift: Number, angle: Number) -> jax.Array:
    """Return the positions (V, 3) [m] for displacements u of the free nodes, and lift and angle of the top plate."""
    X = rig.mesh.points if rig.held is None else rig.held
    n = X.shape[0] - rig.top
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y, z = X[n:].T
    top = jnp.stack([c * x - s * y, s * x + c * y, z + lift], axis=-1)
    return jnp.concatenate([X[: rig.bottom], X[rig.bottom : n] + u.reshape(-1, 3), top])


def work_conjugates(rig: Rig, x: jax.Array, f: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the forces [N] that are work-conjugate to (u, lift, arc): nodal forces, axial force, torque / radius."""
    n = x.shape[0] - rig.top
    top, force = x[n:], f[n:]
    torque = jnp.sum(top[:, 0] * force[:, 1] - top[:, 1] * force[:, 0])
    return f[rig.bottom : n].ravel(), jnp.sum(force[:, 2]), torque / rig.radius


def coordinates(rig: Rig, q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Split the vector q of all coordinates into displacements u [m], lift [m] and angle [rad]."""
    if rig.free_height:
        return q[:-2], q[-2], q[-1] / rig.radius
    return q[:-1], jnp.zeros((), q.dtype), q[-1] / rig.radius


def packed(rig: Rig, u: jax.Array, axial: jax.Array, arc: jax.Array) -> jax.Array:
    """Join displacements u, lift (`axial`) and arc into the vector of all coordinates. Or join the three forces that
    are work-conjugate to these coordinates."""
    return jnp.concatenate([u, axial[None], arc[None]] if rig.free_height else [u, arc[None]])


def rest_height(rig: Rig) -> jax.Array:
    """Return the height of the sample [m] before the compression."""
    z = rig.mesh.points[:, 2]
    return jnp.max(z) - jnp.min(z)


def number_of_coordinates(rig: Rig) -> int:
    """Return the number of coordinates of the rig."""
    return 3 * (rig.mesh.number_of_nodes - rig.top - rig.bottom) + 1 + rig.free_height
