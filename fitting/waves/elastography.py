"""Compute the moduli of an organ and of its regions from measured waves, and the input for a map of the modulus."""

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
#: DIRECTIONS: the D directions of plane waves, from a voxel to its neighbours. Only one of two opposite directions is
#: used. SHARPNESS: exponent of the weights of the directions. With a large exponent, only directions close to those of
#: the measured waves have a weight.
DIRECTIONS = tuple(n for n in itertools.product((1, 0, -1), repeat=3) if n > (0, 0, 0))
SHARPNESS = 4


#: Minimum difference between the number of equations at one frequency and the number of unknown pressures. The
#: equations must determine two values (storage and loss modulus) from noisy data.
FEWEST_BALANCES = 10


class Organ(NamedTuple):
    """Measured waves of an organ, the elements on the measured voxels, and the matrices of these elements."""

    field: WaveField
    body: VoxelBody
    matrices: Matrices
    waves: MeasuredWaves
    density: float


class Found(NamedTuple):
    """Fitted moduli of an organ at F frequencies, and the relative errors of these moduli that are due to the finite
    elements (mesh bias)."""

    whole: Regions  # fit with one region
    labels: np.ndarray | None  # (R,) label of each region
    parts: Regions | None  # fit with R regions
    mesh_bias: np.ndarray  # (F,) complex mesh bias of `whole`: weighted mean over plane waves
    # (F, 2 D) contribution of each of 2 D plane waves (D directions, two polarisations) to the uncertainty of this mean
    bias_left: np.ndarray
    parts_bias: np.ndarray | None = None  # (F, R) mesh bias of `parts`
    # (F, R, 2 D) contribution of each plane wave to the uncertainty of `parts_bias`
    parts_bias_left: np.ndarray | None = None


def body_of(field: WaveField, side: int | None = None) -> VoxelBody:
    """Return the body of elements on the voxels that are measured and in the mask.

    The body is divided into parts of at most `side` bricks along each axis. If `side` is None, the body is not divided.

    Raises:
        InputError: there are too few such voxels, no voxel is measured at all frequencies, or the displacements have
            fewer than three components.
    """
    measured = field.mask & np.all(np.isfinite(field.displacement), axis=-1)  # (F, nx, ny, nz)
    always = np.all(measured, axis=0)
    if not np.any(always):
        name = field.source or "waves"
        if np.all(np.any(measured, axis=(1, 2, 3))):
            raise InputError(
                f"{name}: no voxel is measured at all frequencies; fit each frequency separately, from its own file"
            )
        raise InputError(f"{name}: the balance of forces needs three components of the displacement; measure all three")
    return voxels.voxel_body(always, field.spacing, field.origin, side)


#: Maximum numbers of bricks along the side of a part, which are tried in this order. The factorisation of larger parts
#: would need much more time. In smaller parts, most of the equations would be lost at the faces between the parts.
SIDES = (8, 7, 6)


def body_that_fits(field: WaveField, most_memory: float, most_corners: int | None = None) -> VoxelBody | None:
    """Return the undivided body if its matrix factor for one frequency needs less than `most_memory` [GB].

    Otherwise return the divided body with the largest parts that need less than this memory. Return None if no division
    is small enough. A body with more corners than `most_corners` is not divided.
    """
    body = body_of(field)
    if gigabytes(body) < most_memory:
        return body
    few = most_corners is None or body.whole.number_of_nodes <= most_corners
    divided = (body_of(field, side) for side in SIDES if few)
    return next((body for body in divided if gigabytes(body) < most_memory), None)


#: A note is given if gaps within the organ leave less than this fraction of the bricks.
GAPS = 0.8


def notes_on_gaps(field: WaveField) -> list[str]:
    """Return a note if many elements are missing because voxels within the organ have no displacement or are not in the
    mask. An element exists only if all 27 voxels of its brick are measured and in the mask."""
    inside = field.mask & np.isfinite(field.displacement).all(axis=(0, 4))
    whole = scipy.ndimage.binary_fill_holes(inside)
    left, most = voxels.number_of_bricks(inside), voxels.number_of_bricks(whole)
    if not left < GAPS * most:
        return []
    return [
        f"{int((whole & ~inside).sum())} voxels within the organ have no displacement or are not in the mask, so only "
        f"{100 * left / most:.2g} % of the elements are left: to reduce the errors, interpolate single missing voxels "
        "from their neighbours"
    ]


#: A note is given if this fraction of the voxels, or more, lies in outer layers without elements.
LEFT_OUT = 0.1


def notes_on_layers(field: WaveField) -> list[str]:
    """Return a note if many voxels lie behind the last brick along an axis. A brick is two voxel spacings long. So if
    the number of voxels is even, the last voxel is in no brick."""
    inside = field.mask & np.isfinite(field.displacement).all(axis=(0, 4))
    box = scipy.ndimage.find_objects(inside.astype(int))[0]
    odd = tuple(slice(0, n - 1 + n % 2) for n in inside[box].shape)
    every, kept = int(inside.sum()), int(inside[box][odd].sum())
    axes = [f"{axis} ({n} voxels)" for axis, n in zip("xyz", inside[box].shape, strict=True) if n % 2 == 0]
    if every - kept < LEFT_OUT * every:
        return []
    return [
        f"{every - kept} of {every} voxels are in outer layers without elements. An element needs 3 voxels along an "
        f"axis and shares the last voxel with the next element, so the last layer along {', '.join(axes)} is ignored: "
        "measure an odd number of voxels along these axes"
    ]


def organ_of(field: WaveField, body: VoxelBody, density: float) -> Organ:
    """Return the measured waves of a field together with the body and its matrices. `density` is in kg/m^3. The typical
    modulus of the matrices is a rough modulus of the whole organ."""
    motion = field.displacement[(slice(None), *body.voxel.T)]
    omega = 2 * np.pi * field.frequencies
    waves = MeasuredWaves(omega, motion.reshape(len(omega), -1), np.maximum(field.noise, 1e-9 * np.abs(motion).max()))
    m = balance.matrices(body, density)
    if m.balances < FEWEST_BALANCES:
        raise InputError(
            f"the {len(body.voxel)} measured voxels of the mask give {max(0, m.balances)} equations more than unknown "
            f"pressures. At least {FEWEST_BALANCES} are needed: give a larger mask or a smaller --stride"
        )
    length = float(np.ptp(body.mesh.points, axis=0).max())
    typical = regions.first_modulus(m, waves, density, float(np.min(field.spacing)), length)
    return Organ(field, body, balance.with_typical(m, typical), waves, density)


def regions_of(
    organ: Organ,
    progress: Callable[[int, float], None] = lambda k, cost: None,
    keep: Keep = lambda name, find: find(),
) -> Found:
    """Fit the modulus of the whole organ, and the moduli of its regions if labels are given.

    `keep` stores the results in a file (see `kept_regions.kept_in`); by default nothing is stored.
    """
    m, waves, body = organ.matrices, organ.waves, organ.body

    def of_whole() -> Regions:
        start, uniform = np.array([m.typical * (1 + regions.LOSS * 1j)]), _uniform(m, body, organ.density)
        return regions.moduli_of_regions(uniform, waves, start, progress, body.voxel)

    whole = keep("whole", of_whole)
    bias, left = (each[:, 0] for each in _biases(organ, whole.modulus))
    labels = organ.field.labels
    if labels is None:
        return Found(whole, None, None, bias, left)
    known = np.unique(labels[tuple(body.voxel.T)])

    def of_parts() -> Regions:
        moved = edge_places.moved_edges(labels, body, known) if len(known) > 1 else None
        matrices = edges.region_matrices(m, body, organ.density, edge_places.places(labels, body, known), moved)
        found = np.where(whole.converged, whole.modulus[:, 0], m.typical * (1 + regions.LOSS * 1j))
        start = np.repeat(found[:, None], len(known), axis=1)
        return regions.moduli_of_regions(matrices, waves, start, progress, body.voxel)

    parts = keep("parts", of_parts)
    return Found(whole, known, parts, bias, left, *_biases(organ, parts.modulus))


#: The mesh bias is nearly proportional to the square of the wave number, so nearly inversely proportional to the
#: modulus. Therefore the bias that was computed for one modulus is scaled and used for moduli that are larger by less
#: than this factor.
ALIKE = 1.15


def _biases(organ: Organ, moduli: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh bias (relative error due to the finite elements) of the moduli (F, R) of R regions at F
    frequencies, and the uncertainty of this bias.

    The result is (mean, left): mean (F, R) is the mean bias over plane waves; left (F, R, 2 D) contains the
    contribution of each of these waves to the uncertainty of the mean.
    """
    bias, left = np.zeros(moduli.shape, complex), np.zeros((*moduli.shape, 2 * len(DIRECTIONS)), complex)
    for f, strength in enumerate(waves_of_field(organ.field)):
        known = 0.0
        for r in np.argsort(np.abs(moduli[f])):
            G = moduli[f, r]
            if not abs(G) < ALIKE * known:
                each, weights = plane_wave_biases(G, organ.waves.omega[f], organ, strength)
                known, mean = abs(G), each @ weights
            bias[f, r] = mean * known / abs(G)
            # The squares of these contributions add up to the square of the uncertainty of the mean.
            left[f, r] = weights * (each - mean) * known / abs(G)
    return bias, left


def _uniform(m: Matrices, body: VoxelBody, density: float) -> edges.RegionMatrices:
    """Return the matrices of a uniform organ, which has one region."""
    return edges.region_matrices(m, body, density, np.ones((1, body.mesh.number_of_nodes)))


def problem_of_map(organ: Organ, found: Found, length: float) -> stiffness_map.Course:
    """Return the input of `stiffness_map.map_of`, for a map relative to the moduli of the whole organ. `length` [m]:
    correlation length of the prior."""
    return stiffness_map.course_of(organ.body, organ.matrices, organ.waves, found.whole.modulus[:, 0], length)


def plane_waves() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return direction (3,) and polarisation (3,) of 2 D plane shear waves: two polarisations for each of
    `DIRECTIONS`."""
    found = []
    for d in DIRECTIONS:
        n = np.array(d) / np.linalg.norm(d)
        across = np.cross(n, np.eye(3)[int(np.argmin(np.abs(n)))])
        across /= np.linalg.norm(across)
        found += [(n, across), (n, np.cross(n, across))]
    return found


def waves_of_field(field: WaveField) -> np.ndarray:
    """Return the relative energies (F, 2 D) of the 2 D `plane_waves` in the displacement, at F frequencies. The sum at
    each frequency is 1. Only voxels in the mask are used.

    The energy of a direction n is (sum over the axes a of n_a^2 times the mean squared derivative along axis a) to the
    power `SHARPNESS`. This energy is divided between the two waves of this direction, in proportion to the squared
    derivatives of the displacement along their polarisations. Derivatives are differences between neighbours, and the
    contribution of the noise is subtracted.
    """
    waves = plane_waves()
    rows = []
    for whole, noise in zip(field.displacement, field.noise, strict=True):
        u = np.where(field.mask[..., None], whole, np.nan)
        steep = np.empty((3, 3, 3))  # mean products of the derivatives of two components, for each axis
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
    """Return the relative errors (2 D,) of the moduli that are fitted to each of `plane_waves` without noise, and
    weights (2 D,) of these waves.

    The errors are due to the finite elements. A weight is the energy of a wave times the information about the modulus
    in this wave. The weighted mean of the errors is the error of one modulus that is fitted to all waves.

    Each error is computed as one Gauss-Newton step that begins at the true modulus. The step is computed for the
    elements of the organ, because the surface and the holes of the body increase the error.

    Args:
        G: modulus [Pa].
        omega: angular frequency [rad/s].
        organ: the body and its density are used.
        strength: relative energies (2 D,) of the waves. Waves with an energy near 0 get an error and a weight of 0.
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
