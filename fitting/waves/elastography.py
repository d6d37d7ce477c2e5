"""An organ and its waves: moduli of the whole and of its regions, and the input of a map."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fitting.waves import balance, edge_places, edges, regions, stiffness_map, voxels
from fitting.waves.balance import Matrices, gigabytes
from fitting.waves.regions import MeasuredWaves, Regions
from fitting.waves.voxels import VoxelBody
from fitting.waves.wave_field import WaveField
from liverjax.core.errors import InputError

__all__ = ["Found", "Organ", "body_of", "gigabytes", "organ_of", "plane_wave_bias", "problem_of_map", "regions_of"]
#: Directions and polarisations of plane waves, and how many of a voxel's 26 neighbours lie in such directions.
DIRECTIONS = (((0, 0, 1), (1, 0, 0), 6), ((1, 0, 1), (1, 0, -1), 12), ((1, 1, 1), (1, -1, 0), 8))


class Organ(NamedTuple):
    """The body of the measured voxels."""

    field: WaveField
    body: VoxelBody
    matrices: Matrices
    waves: MeasuredWaves
    density: float


class Found(NamedTuple):
    """Moduli of an organ."""

    whole: Regions  # of one region
    labels: np.ndarray | None  # (R,) of the regions
    parts: Regions | None
    mesh_bias: np.ndarray  # (F,) complex, relative: from plane waves with the modulus of the whole


def body_of(field: WaveField) -> VoxelBody:
    """Elements of the voxels that are measured and in the mask.

    Raises:
        InputError: too few such voxels, or displacements of fewer than three components.
    """
    measured = np.all(np.isfinite(field.displacement), axis=0)
    if not np.any(np.all(measured, axis=-1)):
        raise InputError(
            f"{field.source or 'waves'}: a balance of forces needs three components of the displacement: measure all"
        )
    return voxels.voxel_body(field.mask & np.all(measured, axis=-1), field.spacing, field.origin)


def organ_of(field: WaveField, body: VoxelBody, density: float) -> Organ:
    """The organ of a field, with the equations of its body; density in kg/m^3."""
    motion = field.displacement[(slice(None), *body.voxel.T)]
    omega = 2 * np.pi * field.frequencies
    waves = MeasuredWaves(omega, motion.reshape(len(omega), -1), np.maximum(field.noise, 1e-9 * np.abs(motion).max()))
    return Organ(field, body, balance.matrices(body, density), waves, density)


def regions_of(organ: Organ, progress: Callable[[int, float], None] = lambda k, cost: None) -> Found:
    """Moduli of the whole organ, and of its regions if labels are given."""
    m, waves, body = organ.matrices, organ.waves, organ.body
    start = regions.first_modulus(m, waves)
    whole = regions.moduli_of_regions(_uniform(m, body, organ.density), waves, np.array([start]), progress)
    bias = np.array([plane_wave_bias(G, w, organ) for G, w in zip(whole.modulus[:, 0], waves.omega, strict=True)])
    labels = organ.field.labels
    if labels is None:
        return Found(whole, None, None, bias)
    known = np.unique(labels[tuple(body.voxel.T)])
    each = [edge_places.places(labels, body, known, farther) for farther in (0.0, edge_places.FARTHER)]
    matrices = edges.region_matrices(m, body, organ.density, *each[: len(known)])
    parts = regions.moduli_of_regions(matrices, waves, np.full(len(known), whole.modulus[0, 0]), progress)
    return Found(whole, known, parts, bias)


def _uniform(m: Matrices, body: VoxelBody, density: float) -> edges.RegionMatrices:
    """The balance of one region."""
    return edges.region_matrices(m, body, density, np.ones((1, body.mesh.number_of_nodes)))


def problem_of_map(organ: Organ, found: Found, length: float) -> stiffness_map.Course:
    """Input of `stiffness_map.map_of`: a map about the moduli of the whole, with this correlation length [m]."""
    return stiffness_map.course_of(organ.body, organ.matrices, organ.waves, found.whole.modulus[:, 0], length)


def plane_wave_bias(G: complex, omega: float, organ: Organ) -> complex:
    """Relative error of the modulus that these elements find in plane waves without noise; a mean over directions."""
    spacing, density = organ.field.spacing, organ.density
    body = voxels.voxel_body(np.ones((7, 7, 7), bool), spacing)
    uniform, X = _uniform(balance.matrices(body, density), body, density), np.asarray(body.mesh.points)
    k, total, weight = omega * np.sqrt(density / G), 0j, 0
    for along, across, count in DIRECTIONS:
        n, a = (np.array(v) / np.linalg.norm(v) for v in (along, across))
        d = (np.exp(-1j * k * (X @ n))[:, None] * a).ravel()
        waves = MeasuredWaves(np.array([omega]), d[None], np.array([1e-3]))
        own = regions.moduli_of_regions(uniform, waves, np.array([G]))
        total, weight = total + count * (own.modulus[0, 0] / G - 1), weight + count
    return total / weight
