"""An organ and its waves: moduli of the whole and of its regions, and the input of a map."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.ndimage

from fitting.waves import balance, edge_places, edges, regions, stiffness_map, voxels
from fitting.waves.balance import Matrices, gigabytes
from fitting.waves.kept_regions import Keep
from fitting.waves.regions import MeasuredWaves, Regions
from fitting.waves.voxels import VoxelBody
from fitting.waves.wave_field import WaveField
from liverjax.core.errors import InputError

__all__ = ["Found", "Organ", "body_of", "gigabytes", "organ_of", "plane_wave_biases", "problem_of_map", "regions_of"]
#: Directions of plane waves: to a voxel's neighbours, of two opposite ones the first. And how sharply waves along other
#: directions than the data's count for less.
DIRECTIONS = tuple(n for n in itertools.product((1, 0, -1), repeat=3) if n > (0, 0, 0))
SHARPNESS = 4


#: Fewest equations of one frequency that are left beside the pressures: there are two numbers to find, and noise.
FEWEST_BALANCES = 10


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
    bias_left: np.ndarray  # (F, D) how each direction of these waves adds to the uncertainty of this mean
    parts_bias: np.ndarray | None = None  # (F, R) the same with the moduli of the regions
    parts_bias_left: np.ndarray | None = None  # (F, R, D)


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


#: Part of the bricks that gaps within the organ must leave, or it is told.
GAPS = 0.8


def notes_on_gaps(field: WaveField) -> list[str]:
    """A note if voxels without displacement within the organ take many elements away: each needs all its 27 voxels."""
    inside = field.mask & np.isfinite(field.displacement).all(axis=(0, 4))
    whole = scipy.ndimage.binary_fill_holes(inside)
    left, most = voxels.number_of_bricks(inside), voxels.number_of_bricks(whole)
    if not left < GAPS * most:
        return []
    return [
        f"{int((whole & ~inside).sum())} voxels within the organ have no displacement or are not in the mask, and "
        f"{100 * left / most:.2g} % of its elements are left: fill single gaps from their neighbours, and errors "
        "become smaller"
    ]


#: Part of the voxels that may lie in a last layer without elements before it is told.
LEFT_OUT = 0.1


def notes_on_layers(field: WaveField) -> list[str]:
    """A note if many voxels lie beyond the last brick along an axis: a brick takes two steps of a voxel."""
    inside = field.mask & np.isfinite(field.displacement).all(axis=(0, 4))
    box = scipy.ndimage.find_objects(inside.astype(int))[0]
    odd = tuple(slice(0, n - 1 + n % 2) for n in inside[box].shape)
    every, kept = int(inside.sum()), int(inside[box][odd].sum())
    axes = [f"{axis} ({n} voxels)" for axis, n in zip("xyz", inside[box].shape, strict=True) if n % 2 == 0]
    if every - kept < LEFT_OUT * every:
        return []
    return [
        f"{every - kept} of {every} voxels are in no element, which takes 3 voxels along an axis and shares the last "
        f"with the next: the last layer along {', '.join(axes)} is left out; measure an odd number of voxels"
    ]


def organ_of(field: WaveField, body: VoxelBody, density: float) -> Organ:
    """The organ of a field, with the equations of its body; density in kg/m^3."""
    motion = field.displacement[(slice(None), *body.voxel.T)]
    omega = 2 * np.pi * field.frequencies
    waves = MeasuredWaves(omega, motion.reshape(len(omega), -1), np.maximum(field.noise, 1e-9 * np.abs(motion).max()))
    m = balance.matrices(body, density)
    if m.balances < FEWEST_BALANCES:
        raise InputError(
            f"the {len(body.voxel)} measured voxels of the mask give {max(0, m.balances)} equations beside the unknown "
            f"pressures: waves need at least {FEWEST_BALANCES}; give a larger mask or a smaller --stride"
        )
    return Organ(field, body, m, waves, density)


def regions_of(
    organ: Organ,
    progress: Callable[[int, float], None] = lambda k, cost: None,
    keep: Keep = lambda name, find: find(),
) -> Found:
    """Moduli of the whole organ, and of its regions if labels are given; `keep` as from `kept_regions.kept_in`."""
    m, waves, body = organ.matrices, organ.waves, organ.body

    def of_whole() -> Regions:
        start, uniform = np.array([regions.first_modulus(m, waves)]), _uniform(m, body, organ.density)
        return regions.moduli_of_regions(uniform, waves, start, progress, body.voxel)

    whole = keep("whole", of_whole)
    bias, left = (each[:, 0] for each in _biases(organ, whole.modulus))
    labels = organ.field.labels
    if labels is None:
        return Found(whole, None, None, bias, left)
    known = np.unique(labels[tuple(body.voxel.T)])

    def of_parts() -> Regions:
        each = [edge_places.places(labels, body, known, farther) for farther in (0.0, edge_places.FARTHER)]
        matrices = edges.region_matrices(m, body, organ.density, *each[: len(known)])
        start = np.full(len(known), whole.modulus[0, 0])
        return regions.moduli_of_regions(matrices, waves, start, progress, body.voxel)

    parts = keep("parts", of_parts)
    return Found(whole, known, parts, bias, left, *_biases(organ, parts.modulus))


#: Moduli within this factor of each other share the waves of their bias, which goes with the square of the wave number.
ALIKE = 1.15


def _biases(organ: Organ, moduli: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative error (F, R) of moduli (F, R) by the elements: a mean over waves, and what is left of it (F, R, D)."""
    bias, left = np.zeros(moduli.shape, complex), np.zeros((*moduli.shape, len(DIRECTIONS)), complex)
    for f, weights in enumerate(directions_of_waves(organ.field)):
        known = 0.0
        for r in np.argsort(np.abs(moduli[f])):
            G = moduli[f, r]
            if not abs(G) < ALIKE * known:
                each, known = plane_wave_biases(G, organ.waves.omega[f], organ, weights), abs(G)
            bias[f, r] = each @ weights * known / abs(G)
            # As many waves as directions that count: their mean is known to the root of the sum of these squares.
            left[f, r] = weights * (each - each @ weights) * known / abs(G)
    return bias, left


def _uniform(m: Matrices, body: VoxelBody, density: float) -> edges.RegionMatrices:
    """The balance of one region."""
    return edges.region_matrices(m, body, density, np.ones((1, body.mesh.number_of_nodes)))


def problem_of_map(organ: Organ, found: Found, length: float) -> stiffness_map.Course:
    """Input of `stiffness_map.map_of`: a map about the moduli of the whole, with this correlation length [m]."""
    return stiffness_map.course_of(organ.body, organ.matrices, organ.waves, found.whole.modulus[:, 0], length)


def directions_of_waves(field: WaveField) -> np.ndarray:
    """Weights (F, D) of plane waves along `DIRECTIONS`: the squares of the displacement's slopes along them, sharpened.

    The slopes along each axis are those between neighbours, without what the noise adds to them.
    """
    n = np.array([np.array(d) / np.linalg.norm(d) for d in DIRECTIONS])
    rows = []
    for u, noise in zip(field.displacement, field.noise, strict=True):
        steep = np.empty(3)
        for axis in range(3):
            slope = np.diff(u, axis=axis)
            steep[axis] = (np.nanmean(np.abs(slope) ** 2) - 4 * noise**2) / field.spacing[axis] ** 2
        steep = np.maximum(np.nan_to_num(steep), 0.0)
        along = (n**2 @ steep) ** SHARPNESS
        rows.append(along / along.sum() if along.sum() > 0 else np.full(len(n), 1 / len(n)))
    return np.array(rows)


def plane_wave_biases(G: complex, omega: float, organ: Organ, weights: np.ndarray) -> np.ndarray:
    """Relative errors (D,) of the modulus that these elements find in plane waves without noise along `DIRECTIONS`.

    One step of Gauss-Newton from the true modulus, in the organ's own body: edges and holes add to the error of the
    elements.

    Args:
        G: modulus [Pa].
        omega: angular frequency [rad/s].
        organ: its body and density.
        weights: of the directions (D,); those that do not count are left out, with an error of 0.
    """
    m, X = organ.matrices, np.asarray(organ.body.mesh.points)
    uniform, X = _uniform(m, organ.body, organ.density), X - X.mean(axis=0)
    k, found = omega * np.sqrt(organ.density / G), np.zeros(len(DIRECTIONS), complex)
    C = uniform.rows(np.array([G]), omega)
    factor = balance.likeliest(C, uniform.pressure, np.zeros(C.shape[1]), 1.0).factor
    for d in np.flatnonzero(weights > 1e-3):
        n = np.array(DIRECTIONS[d]) / np.linalg.norm(DIRECTIONS[d])
        across = np.cross(n, np.eye(3)[int(np.argmin(np.abs(n)))])
        wave = (np.exp(-1j * k * (X @ n))[:, None] * across / np.linalg.norm(across)).ravel()
        q = scipy.linalg.cho_solve_banded((factor, True), C @ wave, check_finite=False)
        slope = uniform.by_moduli(wave - C.conj().T @ q)[:, 0]
        weighted = scipy.linalg.cho_solve_banded((factor, True), slope, check_finite=False)
        found[d] = -np.vdot(slope, q) / (np.vdot(slope, weighted).real * G)
    return found
