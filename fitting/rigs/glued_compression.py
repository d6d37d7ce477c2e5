"""A compressed sample between glued plates, computed with quadratic elements, because the mesh of the torsion rig is
too coarse.

The sample is glued, so it bulges, and the stresses at the rims of the plates are infinite. In this state, the linear
elements of the torsion rig are 20 % too stiff; in pure torsion they are only a few percent too stiff. So the factors R
and S (see below) and the force of the compression are computed with quadratic elements on the mesh of a quarter
cylinder that is fine at the rims. This is done once for each law and strain.

The stress of the oscillation is m = G*/G0 times the elastic stress. The stress of the compression has relaxed to m_inf
times the elastic stress. So the measured modulus is G0 (R m + S m_inf). The factors R and S come from two harmonic
solutions about the compressed state. Other harmonic solutions agree with this formula within 1e-4.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from fitting.rigs.compression import load_steps, too_far
from liverjax.core.struct import replace
from liverjax.laws import Law
from liverjax.mesh import cylinders
from liverjax.mesh.promotion import quadratic
from liverjax.mesh.tetrahedra import with_points

#: Sizes of the cells at the rim of a plate, divided by the shorter of radius and half height. The larger cells are used
#: if a large strain inverts the smaller elements at the rim.
RIMS = (0.1, 0.25)
#: Size of the cells at the rim of a second mesh, divided by their size in the first mesh. Both meshes have the same
#: number of cells.
COARSER = 2.5
#: Order of convergence with the cell size at the rims. Simulations with the sizes 0.25, 0.1 and 0.04 gave an order of
#: 0.74.
ORDER = 0.75
#: Length of the longest cells, divided by the radius. Along the axis, cells may be twice as long.
LARGEST = 0.34
#: Number of corners of the polygon that replaces the circle.
CORNERS = 16


class Glued(NamedTuple):
    """Factors [1] that convert the moduli at rest to the measured moduli of a compressed sample, and the force [N] of
    this sample before relaxation."""

    relaxing: float  # factor R (see the top of this file)
    standing: float  # factor S
    force: float


def glued(radius: float, gap: float, law: Law, strain: float) -> tuple[Glued, Glued]:
    """Return (values, change) for a sample that is compressed by `strain` between glued plates.

    values: factors and force, extrapolated with `ORDER` from the results of two meshes. `ORDER` is low because stresses
    are infinite at the rims. change: extrapolated value minus the value from the finer mesh. This is an estimate of the
    mesh error.

    Args:
        radius: radius of the plates, and of the sample at rest [m].
        gap: height of the compressed sample [m].
        law: law of the sample.
        strain: compression, as a fraction of the height at rest.

    Raises:
        InputError: the simulation does not converge at this compression.
    """
    for rim in RIMS:
        mesh, wider = (_quarter(radius, gap / (1 - strain), rim, coarser) for coarser in (1.0, COARSER))
        fine = _on_mesh(mesh, radius, law, strain)
        # The second mesh has the same connectivity, so the same compiled program is used.
        coarse = None if fine is None else _on_mesh(with_points(mesh, wider.points), radius, law, strain)
        if fine is not None and coarse is not None:
            change = [(a - b) / (COARSER**ORDER - 1) for a, b in zip(fine, coarse, strict=True)]
            return Glued(*(a + d for a, d in zip(fine, change, strict=True))), Glued(*change)
    raise too_far(strain)


def _quarter(radius: float, height: float, rim: float, coarser: float) -> lj.TetMesh:
    """Return the mesh of a quarter of the cylinder. The cells at the rims are `coarser` times as long, but their number
    stays the same."""
    cell = rim * min(radius, height / 2)
    inwards = _wider(cylinders.graded(radius, {0.0: cell}, LARGEST * radius), coarser)
    half = _wider(cylinders.graded(height / 2, {0.0: cell}, 2 * LARGEST * radius), coarser)
    radii, heights = radius - inwards[::-1], np.concatenate([half, height - half[-2::-1]])
    return quadratic(cylinders.sector(radii, heights, CORNERS, CORNERS // 4).mesh)


def _wider(places: np.ndarray, factor: float) -> np.ndarray:
    """Move positions that begin at 0. The position next to 0 moves to `factor` times its distance from 0, and the last
    position does not move."""
    end = places[-1]
    return end * (places / end) ** (1 + np.log(factor) / np.log(places[1] / end))


def _on_mesh(mesh: lj.TetMesh, radius: float, law: Law, strain: float) -> Glued | None:
    """Return the factors R and S and the force from one mesh. Returns None if the run fails."""
    sets = {name: np.asarray(nodes) for name, nodes in mesh.node_sets.items()}
    bottom, top = sets["bottom"], sets["top"]
    # Nodes of the planes y = 0 and x = 0 between the plates, without the axis.
    planes = [np.setdiff1d(sets[name], np.concatenate([bottom, top, sets["axis"]])) for name in ("start", "end")]
    axis = np.setdiff1d(sets["axis"], np.concatenate([bottom, top]))
    height = float(np.ptp(np.asarray(mesh.points)[:, 2]))

    def scene(along: tuple[str, str, str], lift: float, solve: lj.Solve) -> lj.Scene:
        held = [(bottom, "xyz"), *zip((*planes, axis), along, strict=True)]
        return lj.Scene(
            mesh=mesh,
            law=law,
            fixed=tuple(lj.Fixed(nodes=jnp.asarray(nodes), axes=axes) for nodes, axes in held),
            displaced=(lj.Displaced(nodes=jnp.asarray(top), by=jnp.array([0.0, 0.0, lift])),),
            solve=solve,
        )

    solve = lj.Solve(steps=load_steps(strain), tolerance=1e-9, volumetric="element")
    pressed = lj.simulate(scene(("y", "x", "xy"), -strain * height, solve))
    if np.any(np.asarray(pressed.status) != 0):
        return None
    x, force = pressed.positions[-1], 4 * np.asarray(pressed.reactions[-1])[top]
    # In torsion, the nodes of these planes move only along the normals of the planes.
    turned = scene(("xz", "yz", "xyz"), 0.0, lj.Solve(kind="harmonic", volumetric="element"))
    turn = jnp.zeros(x.shape, complex).at[top, :2].set(jnp.stack([-x[top, 1], x[top, 0]], axis=1))
    size = 2 * height * (1 - strain) / (np.pi * radius**4) / float(np.asarray(law.shear_modulus()))

    def seen(stands: float) -> float:
        """Return R + S `stands`: the measured modulus before relaxation (m = 1), divided by G0. `stands` is m_inf.
        Returns NaN if there is no solution."""
        prony = lj.Prony(ratios=jnp.array([1 - stands]), relaxation_times=jnp.array([1.0]))
        moved = lj.harmonic(replace(turned, viscosity=prony), [1.0], jnp.ones(1, complex), x, turn)
        on_plate, at = 4 * np.asarray(moved.reactions[0].real)[top], np.asarray(x)[top]
        torque = np.sum(at[:, 0] * on_plate[:, 1] - at[:, 1] * on_plate[:, 0])
        # The force of the compression keeps its direction when the plate turns. Its contribution is subtracted.
        return size * float(torque - stands * np.sum(at[:, :2] * force[:, :2]))

    much, little = seen(0.8), seen(0.2)
    standing = (much - little) / (0.8 - 0.2)
    if not np.isfinite(standing):
        return None
    return Glued(little - 0.2 * standing, standing, -float(force[:, 2].sum()))
