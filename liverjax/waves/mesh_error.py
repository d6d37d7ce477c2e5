"""Mesh error of harmonic motion: the same problem is solved again in the next richer space of functions."""

from functools import partial

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, replace, struct
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.scenes.enriched import enriched
from liverjax.scenes.refined import REFINED, Within, can_be_refined, on_refined_mesh
from liverjax.scenes.scene import Scene
from liverjax.solvers.point_matrix import restricted
from liverjax.waves.harmonic import Harmonic, harmonic
from liverjax.waves.rest import under_its_weight


@struct
class HarmonicError:
    """Estimated error of amplitudes: the difference that an infinitely fine mesh would add."""

    displacement: jax.Array = param("m", "complex (F, V, 3)")
    reactions: jax.Array = param("N", "complex (F, V, 3); sums over the nodes of a support count")
    pressure: jax.Array | None = param(
        "Pa", "complex (F, V), of a fluid; None: no fluid, or its pressures' error is not known", default=None
    )


def harmonic_mesh_error(
    scene: Scene,
    found: Harmonic,
    factors: Number | None = None,
    about: jax.Array | None = None,
    motion: Number | None = None,
) -> jax.Array:
    """Estimated error of displacements, complex (F, V, 3) [m]. `harmonic_errors` also gives the error of reactions."""
    return harmonic_errors(scene, found, factors, about, motion).displacement


def harmonic_errors(
    scene: Scene,
    found: Harmonic,
    factors: Number | None = None,
    about: jax.Array | None = None,
    motion: Number | None = None,
) -> HarmonicError:
    """Estimated error of amplitudes that the mesh causes.

    Linear elements are replaced by quadratic ones, and quadratic elements by cubic ones. With too few elements per wave
    the phase is wrong, and the error is as large as the motion. The mesh has then eight (quadratic: three) times the
    unknowns, with a corresponding cost. The pressures of a fluid are linear in all elements. With a fluid, the scene is
    therefore solved again on a mesh in which every element is cut into eight, and the estimate is 4/3 of the change.

    Args:
        scene, factors, about, motion: as in `harmonic`.
        found: result of `harmonic`.

    Raises:
        InputError: a scene with another mesh, and what `harmonic` refuses.
    """
    nodes = scene.mesh.number_of_nodes
    if found.displacement.shape[1] != nodes:
        raise InputError(
            f"the result has {found.displacement.shape[1]} nodes, the scene {nodes}: give the scene of the result"
        )
    about = under_its_weight(scene) if about is None else about
    finer = scene.porosity is not None and can_be_refined(scene)
    rich, within = on_refined_mesh(scene) if finer else (_richer_elements(scene), None)
    of_all_nodes = partial(_padded, rich.mesh, within)
    motion = None if motion is None else of_all_nodes(jnp.asarray(motion, complex))
    about = None if about is None else of_all_nodes(jnp.asarray(about))
    more = harmonic(rich, found.frequencies_Hz, factors, about, motion)
    force = _on_nodes(scene.mesh, rich.mesh, within, more.reactions)
    factor = 1.0 if within is None else REFINED
    pressure = None
    if within is not None and more.pressure is not None and found.pressure is not None:
        pressure = factor * (more.pressure[:, :nodes] - found.pressure)
    return HarmonicError(
        displacement=factor * (more.displacement[:, :nodes] - found.displacement),
        reactions=factor * (force - found.reactions),
        pressure=pressure,
    )


def _richer_elements(scene: Scene) -> Scene:
    rich = enriched(scene)
    if rich.mesh.order == 3:
        # Cubic elements do not lock.
        return replace(rich, solve=replace(rich.solve, volumetric="element"))
    if scene.solve.volumetric == "nodal":
        return replace(rich, solve=replace(rich.solve, volumetric="mixed"))
    return rich


def _on_nodes(mesh: TetMesh, rich: TetMesh, within: Within | None, forces: jax.Array) -> jax.Array:
    """Forces (F, V, 3) on the nodes of the run, from those on the richer functions."""
    nodes = mesh.number_of_nodes
    if within is not None:
        return jax.vmap(lambda f: within.forces(f, nodes))(forces)
    if mesh.order > 1:
        return forces[:, :nodes]
    # The force of a quadratic function belongs to the two linear ones that it refines, half to each.
    columns = jnp.moveaxis(forces, 1, -1)
    return jnp.moveaxis(jax.vmap(jax.vmap(lambda f: restricted(rich, f)))(columns), -1, 1)


def _padded(rich: TetMesh, within: Within | None, x: jax.Array) -> jax.Array:
    """The field x (…, V, 3) in the richer space."""
    if within is not None:
        return jnp.moveaxis(within.field(jnp.moveaxis(x, -2, 0)), 0, -2)
    if rich.order == 2:
        return jnp.swapaxes(on_middles(rich, jnp.swapaxes(x, -1, -2)), -1, -2)
    new = jnp.zeros((*x.shape[:-2], rich.number_of_nodes - x.shape[-2], 3), x.dtype)
    return jnp.concatenate([x, new], axis=-2)
