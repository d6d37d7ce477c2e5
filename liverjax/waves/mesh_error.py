"""Estimate of the mesh error of harmonic motion. The same problem is solved again with shape functions of the next
higher order, or on a refined mesh."""

from functools import partial

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, replace, struct
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.scenes.by_element import by_element
from liverjax.scenes.enriched import enriched
from liverjax.scenes.refined import REFINED, Within, can_be_refined, on_refined_mesh
from liverjax.scenes.scene import Scene
from liverjax.simulation.automatic import form_of_volumes
from liverjax.solvers.point_matrix import restricted
from liverjax.waves.harmonic import Harmonic, harmonic
from liverjax.waves.pressures import AtRest, mixed_at_rest
from liverjax.waves.rest import under_its_weight


@struct
class HarmonicError:
    """Estimated errors of the amplitudes at F frequencies: the amplitudes on an infinitely fine mesh minus the computed
    amplitudes."""

    displacement: jax.Array = param("m", "complex (F, V, 3)")
    reactions: jax.Array = param("N", "complex (F, V, 3); add the errors over the nodes of each support")
    pressure: jax.Array | None = param(
        "Pa", "complex (F, V), pressure of the fluid; None without fluid, or if the error is unknown", default=None
    )


def harmonic_mesh_error(
    scene: Scene,
    found: Harmonic,
    factors: Number | None = None,
    about: jax.Array | None = None,
    motion: Number | None = None,
) -> jax.Array:
    """Return the estimated mesh error of the displacements at F frequencies, complex (F, V, 3) [m].

    The arguments are the same as for `harmonic_errors`, which also returns the errors of reactions and pressures.
    """
    return harmonic_errors(scene, found, factors, about, motion).displacement


def harmonic_errors(
    scene: Scene,
    found: Harmonic,
    factors: Number | None = None,
    about: jax.Array | None = None,
    motion: Number | None = None,
) -> HarmonicError:
    """Estimate the errors of the amplitudes that are due to the mesh.

    Linear elements are replaced by quadratic elements, and quadratic elements by cubic elements. The new problem has
    about eight times (linear elements) or three times (quadratic elements) as many unknowns, so it takes longer. If
    there are too few elements per wavelength, the phase of the motion is wrong, and the error is as large as the
    motion. The pressures of a fluid are linear in all elements. So a scene with a fluid is solved again, if possible,
    on a mesh where every element is divided into eight. Then the estimated error is 4/3 of the change of the result.

    Args:
        scene, factors, about, motion: the arguments of the call of `harmonic`.
        found: the result of `harmonic`.

    Raises:
        InputError: the mesh of the scene is not the mesh of the result, or `harmonic` cannot be used for the scene.
    """
    nodes = scene.mesh.number_of_nodes
    if found.displacement.shape[1] != nodes:
        raise InputError(
            f"the result has {found.displacement.shape[1]} nodes, but the scene has {nodes}: give the scene of the "
            "result"
        )
    about = under_its_weight(scene) if about is None else about
    finer = scene.porosity is not None and can_be_refined(scene)
    rich, within = on_refined_mesh(scene) if finer else (_richer_elements(scene), None)
    of_all_nodes = partial(_padded, rich.mesh, within)
    motion = None if motion is None else of_all_nodes(jnp.asarray(motion, complex))
    state = None if about is None else _with_own_stress(scene, jnp.asarray(about), of_all_nodes(jnp.asarray(about)))
    if within is not None and factors is not None and jnp.ndim(factors) == 2:
        factors = jnp.repeat(jnp.asarray(factors), 8, axis=1)  # for the eight parts of every element
    try:
        more = harmonic(rich, found.frequencies_Hz, factors, state, motion)
    except InputError as e:
        raise InputError(f"the mesh error cannot be estimated with richer elements: {e}") from None
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
        # Cubic elements do not lock. If the pressures of quadratic elements are unknowns, they stay unknowns. Otherwise
        # the estimate would also contain the effect of another volumetric formulation, and be a third too small.
        volumetric = "mixed" if form_of_volumes(scene) == "mixed" else "element"
        return replace(rich, solve=replace(rich.solve, volumetric=volumetric))
    if scene.solve.volumetric == "nodal":
        # "auto" chooses "mixed" if the laws allow it, otherwise "element".
        return replace(rich, solve=replace(rich.solve, volumetric="auto"))
    return rich


def _with_own_stress(scene: Scene, about: jax.Array, of_all_nodes: jax.Array) -> jax.Array | AtRest:
    """Return the state of rest for the richer elements: the positions of all their nodes and, if the elements of the
    scene are mixed and linear, also the stress of these elements.

    At the same positions, mixed quadratic elements would have other pressures, because only mixed linear elements have
    a stabilisation term.
    """
    if scene.mesh.order > 1 or scene.porosity is not None or form_of_volumes(scene) != "mixed":
        return of_all_nodes
    return AtRest(of_all_nodes, mixed_at_rest(by_element(scene), about))


def _on_nodes(mesh: TetMesh, rich: TetMesh, within: Within | None, forces: jax.Array) -> jax.Array:
    """Return the forces (F, V, 3) [N] on the nodes of the original mesh, at F frequencies. They are equivalent to
    `forces` [N] on the nodes of the mesh `rich`."""
    nodes = mesh.number_of_nodes
    if within is not None:
        return jax.vmap(lambda f: within.forces(f, nodes))(forces)
    if mesh.order > 1:
        return forces[:, :nodes]
    # The force at a node in the middle of an edge is divided equally between the two ends of the edge.
    columns = jnp.moveaxis(forces, 1, -1)
    return jnp.moveaxis(jax.vmap(jax.vmap(lambda f: restricted(rich, f)))(columns), -1, 1)


def _padded(rich: TetMesh, within: Within | None, x: jax.Array) -> jax.Array:
    """Return the coefficients, on the mesh `rich`, of the nodal field x (…, V, 3) of the original mesh."""
    if within is not None:
        return jnp.moveaxis(within.field(jnp.moveaxis(x, -2, 0)), 0, -2)
    if rich.order == 2:
        return jnp.swapaxes(on_middles(rich, jnp.swapaxes(x, -1, -2)), -1, -2)
    new = jnp.zeros((*x.shape[:-2], rich.number_of_nodes - x.shape[-2], 3), x.dtype)
    return jnp.concatenate([x, new], axis=-2)
