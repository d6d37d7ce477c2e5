"""An organ and its waves: moduli of the whole organ and of its regions, and the input of a map."""

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
#: Directions of plane waves: from a voxel to its neighbours, and only one of two opposite directions. SHARPNESS:
#: exponent with which the weight of directions falls that differ from the directions of the measured waves.
DIRECTIONS = tuple(n for n in itertools.product((1, 0, -1), repeat=3) if n > (0, 0, 0))
SHARPNESS = 4


#: Minimum number of equations of one frequency, after subtraction of the unknown pressures. Two values (storage and
#: loss) must be found from noisy data.
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

    whole: Regions  # with one region
    labels: np.ndarray | None  # (R,) of the regions
    parts: Regions | None
    mesh_bias: np.ndarray  # (F,) complex, relative: from plane waves, with the modulus of the whole
    bias_left: np.ndarray  # (F, D) uncertainty of this mean, from each direction of these waves
    parts_bias: np.ndarray | None = None  # (F, R) the same, with the moduli of the regions
    parts_bias_left: np.ndarray | None = None  # (F, R, D)


def body_of(field: WaveField) -> VoxelBody:
    """The body of elements on the voxels that are measured and in the mask.

    Raises:
        InputError: there are too few such voxels, or the displacements have fewer than three components.
    """
    measured = np.all(np.isfinite(field.displacement), axis=0)
    if not np.any(np.all(measured, axis=-1)):
        raise InputError(
            f"{field.source or 'waves'}: the balance of forces needs three components of the displacement: measure "
            "all three"
        )
    return voxels.voxel_body(field.mask & np.all(measured, axis=-1), field.spacing, field.origin)


#: If gaps within the organ leave less than this part of the bricks, a note is given.
GAPS = 0.8


def notes_on_gaps(field: WaveField) -> list[str]:
    """A note if voxels without displacement within the organ remove many elements: each brick needs all its 27
    voxels."""
    inside = field.mask & np.isfinite(field.displacement).all(axis=(0, 4))
    whole = scipy.ndimage.binary_fill_holes(inside)
    left, most = voxels.number_of_bricks(inside), voxels.number_of_bricks(whole)
    if not left < GAPS * most:
        return []
    return [
        f"{int((whole & ~inside).sum())} voxels within the organ have no displacement or are not in the mask, and "
        f"{100 * left / most:.2g} % of its elements are left: fill single gaps from their neighbours to get smaller "
        "errors"
    ]


#: If more than this part of the voxels lies in last layers without elements, a note is given.
LEFT_OUT = 0.1


def notes_on_layers(field: WaveField) -> list[str]:
    """A note if many voxels lie beyond the last brick along an axis: a brick is two voxel steps long."""
    inside = field.mask & np.isfinite(field.displacement).all(axis=(0, 4))
    box = scipy.ndimage.find_objects(inside.astype(int))[0]
    odd = tuple(slice(0, n - 1 + n % 2) for n in inside[box].shape)
    every, kept = int(inside.sum()), int(inside[box][odd].sum())
    axes = [f"{axis} ({n} voxels)" for axis, n in zip("xyz", inside[box].shape, strict=True) if n % 2 == 0]
    if every - kept < LEFT_OUT * every:
        return []
    return [
        f"{every - kept} of {every} voxels are in no element. An element takes 3 voxels along an axis and shares the "
        f"last one with the next element, so the last layer along {', '.join(axes)} is left out: measure an odd "
        "number of voxels"
    ]


def organ_of(field: WaveField, body: VoxelBody, density: float) -> Organ:
    """The organ of a field, with the equations of its body. `density` is in kg/m^3."""
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
    """Moduli of the whole organ, and of its regions if labels are given. `keep`: see `kept_regions.kept_in`."""
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


#: The bias is in proportion to the square of the wave number. So moduli within this factor of each other use the same
#: plane waves.
ALIKE = 1.15


def _biases(organ: Organ, moduli: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative error (F, R) that the elements cause in moduli (F, R): its mean over plane waves, and the remaining
    uncertainty (F, R, D) from each direction."""
    bias, left = np.zeros(moduli.shape, complex), np.zeros((*moduli.shape, len(DIRECTIONS)), complex)
    for f, weights in enumerate(directions_of_waves(organ.field)):
        known = 0.0
        for r in np.argsort(np.abs(moduli[f])):
            G = moduli[f, r]
            if not abs(G) < ALIKE * known:
                each, known = plane_wave_biases(G, organ.waves.omega[f], organ, weights), abs(G)
            bias[f, r] = each @ weights * known / abs(G)
            # Each direction that counts has one wave. The error of the mean is the root of the sum of these squares.
            left[f, r] = weights * (each - each @ weights) * known / abs(G)
    return bias, left


def _uniform(m: Matrices, body: VoxelBody, density: float) -> edges.RegionMatrices:
    """The balance of a uniform organ: one region."""
    return edges.region_matrices(m, body, density, np.ones((1, body.mesh.number_of_nodes)))


def problem_of_map(organ: Organ, found: Found, length: float) -> stiffness_map.Course:
    """The input of `stiffness_map.map_of` for a map around the moduli of the whole organ, with this correlation length
    [m]."""
    return stiffness_map.course_of(organ.body, organ.matrices, organ.waves, found.whole.modulus[:, 0], length)


def directions_of_waves(field: WaveField) -> np.ndarray:
    """Weights (F, D) of plane waves along `DIRECTIONS`: the squared slopes of the displacement along them, to the power
    `SHARPNESS`.

    The slopes along each axis are differences between neighbours. The contribution of the noise is subtracted.
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
    """Relative errors (D,) of the modulus that these elements give for plane waves without noise along `DIRECTIONS`.

    It takes one Gauss-Newton step from the true modulus, in the body of the organ: its edges and holes add to the error
    of the elements.

    Args:
        G: modulus [Pa].
        omega: angular frequency [rad/s].
        organ: its body and density.
        weights: weights of the directions (D,). Directions with a weight near 0 are left out, with an error of 0.
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
