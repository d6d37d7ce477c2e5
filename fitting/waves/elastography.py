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


def body_of(field: WaveField, side: int | None = None) -> VoxelBody:
    """The body of elements on the voxels that are measured and in the mask, in parts of at most `side` bricks along
    each side.

    Raises:
        InputError: there are too few such voxels, or the displacements have fewer than three components.
    """
    measured = np.all(np.isfinite(field.displacement), axis=0)
    if not np.any(np.all(measured, axis=-1)):
        raise InputError(
            f"{field.source or 'waves'}: the balance of forces needs three components of the displacement: measure "
            "all three"
        )
    return voxels.voxel_body(field.mask & np.all(measured, axis=-1), field.spacing, field.origin, side)


#: Most bricks along the side of a part. Larger parts would take much longer to factorise; in smaller ones, most of the
#: balance would be lost at their faces.
SIDES = (8, 7, 6)


def body_that_fits(field: WaveField, most_memory: float, most_corners: int | None = None) -> VoxelBody | None:
    """The body in one part, or else in parts as large as possible, whose factor for one frequency needs less than
    `most_memory` [GB]; None: there is none. A body with more corners than `most_corners` is not divided.
    """
    body = body_of(field)
    if gigabytes(body) < most_memory:
        return body
    few = most_corners is None or body.whole.number_of_nodes <= most_corners
    divided = (body_of(field, side) for side in SIDES if few)
    return next((body for body in divided if gigabytes(body) < most_memory), None)


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
    uncertainty (F, R, 2 D) from each of these waves."""
    bias, left = np.zeros(moduli.shape, complex), np.zeros((*moduli.shape, 2 * len(DIRECTIONS)), complex)
    for f, strength in enumerate(waves_of_field(organ.field)):
        known = 0.0
        for r in np.argsort(np.abs(moduli[f])):
            G = moduli[f, r]
            if not abs(G) < ALIKE * known:
                each, weights = plane_wave_biases(G, organ.waves.omega[f], organ, strength)
                known, mean = abs(G), each @ weights
            bias[f, r] = mean * known / abs(G)
            # The error of the mean is the root of the sum of these squares.
            left[f, r] = weights * (each - mean) * known / abs(G)
    return bias, left


def _uniform(m: Matrices, body: VoxelBody, density: float) -> edges.RegionMatrices:
    """The balance of a uniform organ: one region."""
    return edges.region_matrices(m, body, density, np.ones((1, body.mesh.number_of_nodes)))


def problem_of_map(organ: Organ, found: Found, length: float) -> stiffness_map.Course:
    """The input of `stiffness_map.map_of` for a map around the moduli of the whole organ, with this correlation length
    [m]."""
    return stiffness_map.course_of(organ.body, organ.matrices, organ.waves, found.whole.modulus[:, 0], length)


def plane_waves() -> list[tuple[np.ndarray, np.ndarray]]:
    """Direction and polarisation, (3,) each, of 2 D plane shear waves: two along each of `DIRECTIONS`."""
    found = []
    for d in DIRECTIONS:
        n = np.array(d) / np.linalg.norm(d)
        across = np.cross(n, np.eye(3)[int(np.argmin(np.abs(n)))])
        across /= np.linalg.norm(across)
        found += [(n, across), (n, np.cross(n, across))]
    return found


def waves_of_field(field: WaveField) -> np.ndarray:
    """Relative energies (F, 2 D) of `plane_waves` in the displacement.

    A direction has the squared slopes along it, to the power `SHARPNESS`. Its two waves share this in proportion to the
    squared slopes of their components. Slopes along an axis are differences between neighbours, without those of the
    noise.
    """
    waves = plane_waves()
    rows = []
    for u, noise in zip(field.displacement, field.noise, strict=True):
        steep = np.empty((3, 3, 3))  # along an axis, products of the components
        for axis in range(3):
            slope = np.diff(u, axis=axis).reshape(-1, 3)
            slope = slope[np.isfinite(slope).all(axis=1)]
            products = (slope.conj().T @ slope).real / max(len(slope), 1) - 4 * noise**2 * np.eye(3)
            steep[axis] = products / field.spacing[axis] ** 2
        every = np.maximum(np.trace(steep, axis1=1, axis2=2), 0.0)
        along = np.array([n**2 @ every for n, _ in waves]) ** SHARPNESS
        own = np.maximum([np.einsum("a,aij,i,j->", n**2, steep, e, e) for n, e in waves], 0.0).reshape(-1, 2)
        parts = own / np.where(own.sum(axis=1) > 0, own.sum(axis=1), 1.0)[:, None]
        parts[own.sum(axis=1) <= 0] = 0.5
        along = along * parts.ravel()
        rows.append(along / along.sum() if along.sum() > 0 else np.full(len(along), 1 / len(along)))
    return np.array(rows)


def plane_wave_biases(G: complex, omega: float, organ: Organ, strength: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors (2 D,) of the modulus that these elements give for `plane_waves` without noise; and the weights
    (2 D,) of these waves in a common modulus: strength times what a wave tells about it.

    It takes one Gauss-Newton step from the true modulus, in the body of the organ: its edges and holes add to the error
    of the elements.

    Args:
        G: modulus [Pa].
        omega: angular frequency [rad/s].
        organ: its body and density.
        strength: relative energies (2 D,) of the waves. Waves near 0 are left out, with an error and a weight of 0.
    """
    m, X = organ.matrices, np.asarray(organ.body.mesh.points)
    uniform, X = _uniform(m, organ.body, organ.density), X - X.mean(axis=0)
    k, found, told = omega * np.sqrt(organ.density / G), np.zeros(len(strength), complex), np.zeros(len(strength))
    C = uniform.rows(np.array([G]), omega)
    factor = balance.likeliest(C, uniform.pressure, np.zeros(C.shape[1]), 1.0).factor
    for w, (n, across) in enumerate(plane_waves()):
        if not strength[w] > 1e-3:
            continue
        wave = (np.exp(-1j * k * (X @ n))[:, None] * across).ravel()
        q = scipy.linalg.cho_solve_banded((factor, True), C @ wave, check_finite=False)
        slope = uniform.by_moduli(wave - C.conj().T @ q)[:, 0]
        weighted = scipy.linalg.cho_solve_banded((factor, True), slope, check_finite=False)
        told[w] = np.vdot(slope, weighted).real
        found[w] = -np.vdot(slope, q) / (told[w] * G)
    weights = strength * told
    return found, weights / weights.sum()
