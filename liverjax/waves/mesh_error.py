"""Error of harmonic motion by its mesh: the same problem is solved in the next richer space of functions."""

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, replace, struct
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.scenes.enriched import enriched
from liverjax.scenes.scene import Scene
from liverjax.solvers.point_matrix import restricted
from liverjax.waves.harmonic import Harmonic, harmonic
from liverjax.waves.rest import under_its_weight


@struct
class HarmonicError:
    """Estimated error of amplitudes: what an infinitely fine mesh would add."""

    displacement: jax.Array = param("m", "complex (F, V, 3)")
    reactions: jax.Array = param("N", "complex (F, V, 3); sums over the nodes of a support count")


def harmonic_mesh_error(
    scene: Scene,
    found: Harmonic,
    factors: Number | None = None,
    about: jax.Array | None = None,
    motion: Number | None = None,
) -> jax.Array:
    """Estimated error of displacements, complex (F, V, 3) [m]; `harmonic_errors` gives that of reactions too."""
    return harmonic_errors(scene, found, factors, about, motion).displacement


def harmonic_errors(
    scene: Scene,
    found: Harmonic,
    factors: Number | None = None,
    about: jax.Array | None = None,
    motion: Number | None = None,
) -> HarmonicError:
    """Estimated error of amplitudes by the mesh.

    A result of linear elements is solved again with quadratic ones, and one of quadratic elements with cubic ones. With
    too few elements per wave the phase is wrong, and the error is as large as the motion. The cost is that of a mesh
    with eight (quadratic: three) times the unknowns. Pressures of a fluid stay linear: their own error is left out.

    Args:
        scene, factors, about, motion: as in `harmonic`.
        found: result of `harmonic`.

    Raises:
        InputError: a scene of another mesh, and what `harmonic` refuses.
    """
    nodes = scene.mesh.number_of_nodes
    if found.displacement.shape[1] != nodes:
        raise InputError(
            f"the result has {found.displacement.shape[1]} nodes, the scene {nodes}: give the scene of the result"
        )
    about = under_its_weight(scene) if about is None else about
    rich = enriched(scene)
    if rich.mesh.order == 3:
        # Cubic elements do not lock.
        rich = replace(rich, solve=replace(rich.solve, volumetric="element"))
    elif scene.solve.volumetric == "nodal":
        rich = replace(rich, solve=replace(rich.solve, volumetric="mixed"))
    if motion is not None:
        motion = _padded(rich.mesh, jnp.asarray(motion, complex))
    if about is not None:
        about = _padded(rich.mesh, jnp.asarray(about))
    more = harmonic(rich, found.frequencies_Hz, factors, about, motion)
    force = more.reactions[:, :nodes]
    if scene.mesh.order == 1:
        # The force of a quadratic function belongs to the two linear ones that it refines, half to each.
        columns = jnp.moveaxis(more.reactions, 1, -1)
        force = jnp.moveaxis(jax.vmap(jax.vmap(lambda f: restricted(rich.mesh, f)))(columns), -1, 1)
    return HarmonicError(
        displacement=more.displacement[:, :nodes] - found.displacement, reactions=force - found.reactions
    )


def _padded(rich: TetMesh, x: jax.Array) -> jax.Array:
    """The field x (…, V, 3) in the richer space."""
    if rich.order == 2:
        return jnp.swapaxes(on_middles(rich, jnp.swapaxes(x, -1, -2)), -1, -2)
    new = jnp.zeros((*x.shape[:-2], rich.number_of_nodes - x.shape[-2], 3), x.dtype)
    return jnp.concatenate([x, new], axis=-2)
