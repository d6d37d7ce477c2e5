"""Modes from runs of the full model: proper orthogonal decomposition of their displacements."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.mesh.nodal import nodal_volumes
from liverjax.physics.prescribed import free_degrees
from liverjax.reduced.model import ReducedModel, refuse_unknown_physics, with_all_points
from liverjax.reduced.sampling import sampled
from liverjax.scenes.scene import Scene
from liverjax.simulation.batch import simulate_batch


def reduce_scene(
    scene: Scene,
    rows: Mapping[str, Any],
    tolerance: float = 1e-4,
    most_modes: int = 40,
    point_tolerance: float | None = None,
) -> ReducedModel:
    """A reduced model of a scene, from full runs with the numbers of some rows.

    Args:
        scene: `Scene`.
        rows: dotted names -> one value a run, as of `simulate_batch`.
        tolerance: part of the displacements of these runs that the modes may leave out [1], root of mean squares.
        most_modes: the most modes.
        point_tolerance: part of the reduced forces that the sampled points may leave out [1]; default: `tolerance`.

    Raises:
        InputError: physics that a reduced model has not, a tolerance outside of 0 to 1, no row whose run converged.
    """
    refuse_unknown_physics(scene)
    point_tolerance = tolerance if point_tolerance is None else point_tolerance
    for name, value in (("tolerance", tolerance), ("point_tolerance", point_tolerance)):
        if not 0 < value < 1:
            raise InputError(f"{name} = {value} must be between 0 and 1: give e.g. 1e-4")
    result = simulate_batch(scene, dict(rows)).result
    good = np.all(np.asarray(result.status) == status.CONVERGED, axis=1)
    if not good.any():
        raise InputError(f"none of the {len(good)} runs converged: give smaller loads or steps in the rows")
    values = {name: np.asarray(value, float)[good] for name, value in rows.items()}
    mask = free_degrees(scene.mesh, scene.fixed, scene.displaced)
    u = np.asarray(mask[None, None] * (result.positions[good] - scene.mesh.points[None, None]))
    volumes = np.asarray(nodal_volumes(scene.mesh))
    modes = proper_modes(u.reshape(-1, *u.shape[-2:]), volumes, tolerance)[:most_modes]
    whole = with_all_points(scene, jnp.asarray(modes))
    q = jnp.einsum("rtvc,nvc->rtn", u * volumes[:, None], whole.modes)
    chosen = sampled(whole, scene, values, q, point_tolerance)
    ranges = {name: np.stack([v.min(axis=0), v.max(axis=0)]) for name, v in values.items()}
    return replace(chosen, ranges=jax.tree.map(jnp.asarray, ranges))


def proper_modes(u: np.ndarray, volumes: np.ndarray, tolerance: float) -> np.ndarray:
    """Modes (n, V, 3) that leave out at most `tolerance` of fields u (N, V, 3), in the norm of lumped volumes (V,).

    They come from the eigenvalues of the fields' products (Sirovich 1987), which have half of the digits: the least
    tolerance is 1e-7.
    """
    flat = (u * np.sqrt(volumes)[:, None]).reshape(len(u), -1)
    size, vectors = np.linalg.eigh(flat @ flat.T)
    size, vectors = np.maximum(size[::-1], 0.0), vectors[:, ::-1]
    left = np.sqrt(np.maximum(size.sum() - np.cumsum(size), 0.0) / size.sum())
    n = min(int(np.sum(left > tolerance)) + 1, int(np.sum(size > 1e-14 * size[0])))
    modes = vectors[:, :n].T @ flat
    # Orthonormal to all digits.
    modes = np.linalg.qr(modes.T)[0].T
    return modes.reshape(n, *u.shape[1:]) / np.sqrt(volumes)[:, None]
