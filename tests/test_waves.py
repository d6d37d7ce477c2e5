"""Elastography: waves on voxels, the balance of forces, regions, maps and the command."""

import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse

from fitting.reports.waves import cautions
from fitting.waves import (
    balance,
    direct_inversion,
    elastography,
    regions,
    stiffness_map,
    voxels,
    wave_field,
)
from fitting.waves.files import components

pytestmark = pytest.mark.quick_to_compile

H, DENSITY = 2e-3, 1000.0
HERTZ = np.array([60.0, 100.0])
#: Direction, polarisation and amplitude [m] of plane shear waves.
PLANE = (((0.6, 0, 0.8), (0.8, 0, -0.6), 1e-5), ((0, 1, 0), (0, 0, 1), 5e-6), ((-0.6, 0.8, 0), (0, 0, 1), 7e-6))


def modulus(hertz):
    """Return the modulus of a Kelvin-Voigt solid [Pa]."""
    return 3000 + 2j * np.pi * hertz * 1.0


def plane_waves(shape, noise=0.0, seed=0, **more):
    """Return waves of the closed form on voxels."""
    X = np.stack(np.meshgrid(*[np.arange(n) * H for n in shape], indexing="ij"), axis=-1)
    k = 2 * np.pi * HERTZ * np.sqrt(DENSITY / modulus(HERTZ))
    U = [sum(a * np.exp(-1j * one * (X @ np.array(n)))[..., None] * np.array(p) for n, p, a in PLANE) for one in k]
    rng = np.random.default_rng(seed)
    U = np.array(U) + noise * (rng.normal(size=(2, *shape, 3)) + 1j * rng.normal(size=(2, *shape, 3)))
    given = {"labels": None, "noise": np.full(2, max(noise, 1e-12))} | more
    return wave_field.WaveField(HERTZ, U, np.full(3, H), np.zeros(3), np.ones(shape, bool), **given)


def organ(shape=(7, 7, 9), **more):
    field = plane_waves(shape, **more)
    return elastography.organ_of(field, elastography.body_of(field), DENSITY)


@pytest.fixture(scope="module")
def small():
    return organ(noise=3e-7)


def test_every_voxel_is_a_node_and_the_volume_is_that_of_the_box():
    body = voxels.voxel_body(np.ones((5, 7, 9), bool), np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.0, 0.0]))
    assert body.mesh.number_of_nodes == 5 * 7 * 9 and body.inner.sum() == 3 * 5 * 7
    assert np.asarray(body.linear.volumes).min() > 0
    assert np.asarray(body.linear.volumes).sum() == pytest.approx(4 * 12 * 24)
    np.testing.assert_allclose(body.mesh.points, body.voxel * [1.0, 2.0, 3.0] + [0.5, 0, 0], atol=1e-12)
    linear = body.linear.points @ np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(
        voxels.on_all_nodes(body, np.asarray(linear)), body.mesh.points @ np.array([1.0, -2.0, 0.5]), atol=1e-12
    )


def test_a_hole_in_the_mask_takes_away_its_bricks_and_their_inner_nodes():
    mask = np.ones((7, 7, 7), bool)
    mask[0, 0, 0] = False
    body = voxels.voxel_body(mask, np.ones(3))
    assert np.asarray(body.linear.volumes).sum() == pytest.approx(6**3 - 8)
    whole = voxels.voxel_body(np.ones((7, 7, 7), bool), np.ones(3))
    # the inner nodes of the removed brick
    assert whole.inner.sum() - body.inner.sum() == 2**3


@pytest.mark.ci
def test_the_block_solver_is_that_of_the_whole_matrix(small):
    m = small.matrices
    found = balance.balanced(
        m, np.full(m.rows.shape[-1], 3000 + 400j), small.waves.omega[0], small.waves.motion[0], 1.0
    )
    band = found.factor
    L = sum(np.diag(band[k, : band.shape[1] - k], -k) for k in range(len(band)))
    J = balance.by_modulus(m, found.motion)[:, :7].tocsc()
    np.testing.assert_allclose(found.whitened(J), np.linalg.solve(L, J.toarray()), rtol=1e-9, atol=1e-12)


def test_the_likeliest_motion_obeys_the_balance_up_to_a_pressure(small):
    """For the most probable motion, C u = - B p: the remaining forces are the gradient of a pressure."""
    m, w = small.matrices, small.waves
    G = np.full(m.rows.shape[-1], modulus(60.0))
    found = balance.balanced(m, G, w.omega[0], w.motion[0], w.sd[0])
    left = balance.rows_of_balance(m, G, w.omega[0]) @ found.motion
    inner = balance._in_order(small.body)
    rows = np.full(3 * len(small.body.inner), -1)
    rows[inner] = np.arange(len(inner))
    B = balance._forces_of_pressures(small.body, rows[m.unknowns], len(inner)).toarray()
    p = np.linalg.lstsq(B, left, rcond=None)[0]
    assert np.linalg.norm(left - B @ p) < 1e-8 * np.linalg.norm(left)


def test_the_gradient_by_the_modulus_is_the_difference(small):
    """Re(q^H C' u) / sd^2 is the derivative of chi^2 / 2. Differences have a V-shaped error: h^2 above,
    rounding below.
    """
    m, w = small.matrices, small.waves
    one = np.ones(m.rows.shape[-1])

    def half(G):
        return 0.5 * balance.balanced(m, G * one, w.omega[1], w.motion[1], w.sd[1]).chi2

    here = balance.balanced(m, 3400 * one, w.omega[1], w.motion[1], w.sd[1])
    slope = float(np.real(np.vdot(here.multipliers, balance.by_modulus(m, here.motion) @ one)) / w.sd[1] ** 2)
    errors = [abs((half(3400 + h) - half(3400 - h)) / (2 * h) / slope - 1) for h in (100.0, 10.0, 1.0)]
    assert errors[0] / errors[1] > 50 and errors[2] < 1e-5


def test_moduli_of_plane_waves_within_their_errors(small, verified):
    """Closed form with 2 % of noise: storage and loss are exact within three standard errors plus the stated voxel
    error.
    """
    found = elastography.regions_of(small)
    G, e = found.whole.modulus[:, 0], found.whole.standard_errors[:, 0].real
    off = G * (1 - found.mesh_bias) - modulus(HERTZ)
    assert np.all(found.whole.converged) and np.all(found.whole.chi2 / found.whole.components < 1.3)
    share = np.abs(found.mesh_bias * G)  # a mean over directions; these waves have particular ones
    assert np.all(np.abs(off.real) < 3 * e + share) and np.all(np.abs(off.imag) < 3 * e + share)
    allowed = float((3 * e + share)[1] * np.sqrt(2) / abs(G[1]))  # real and imaginary part
    verified(
        "complex modulus from plane waves on voxels, 100 Hz, 2 % noise", "closed form", abs(off[1] / G[1]), allowed
    )


@pytest.mark.ci
def test_noise_does_not_pull_the_modulus_down_and_the_errors_are_right():
    """Forty measurements with 5 % of noise: (found - true) / error has mean 0 and deviation 1."""
    first = organ((7, 7, 7), noise=5e-7)
    clean = plane_waves((7, 7, 7)).displacement[(slice(None), *first.body.voxel.T)].reshape(2, -1)
    alone = elastography._uniform(first.matrices, first.body, DENSITY)
    exact = regions.moduli_of_regions(alone, first.waves._replace(motion=clean), np.array([modulus(100.0)]))
    rng, pulls = np.random.default_rng(1), []
    for _ in range(20):
        noise = 5e-7 * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape))
        found = regions.moduli_of_regions(alone, first.waves._replace(motion=clean + noise), exact.modulus[0])
        d = (found.modulus - exact.modulus) / np.sqrt(found.covariance[:, 0, 0])[:, None]
        pulls += [*d.real.ravel(), *d.imag.ravel()]
    pulls = np.array(pulls)  # 80 numbers: their mean scatters by 0.11, their deviation by 0.08
    assert abs(pulls.mean()) < 0.4 and 0.75 < pulls.std() < 1.3


def test_the_direct_inversion_has_the_error_of_its_stencil_and_noise_lowers_it():
    """Second differences of a wave are smaller by (k h)^2 / 12 along each axis, and so are curls. So G is larger."""
    field = plane_waves((11, 11, 11))
    axis = np.exp(-1j * 2 * np.pi * HERTZ * np.sqrt(DENSITY / modulus(HERTZ)) * H * np.arange(11)[:, None])  # (11, F)
    U = np.zeros_like(field.displacement)
    U[..., 0] = 1e-5 * axis.T[:, None, None, :]
    field = field._replace(displacement=U)
    G = direct_inversion.invert(field, DENSITY, smoothing=0.0)[:, 5, 5, 5]
    kh = 2 * np.pi * HERTZ * np.sqrt(DENSITY / modulus(HERTZ)) * H
    np.testing.assert_allclose(G / modulus(HERTZ), kh**2 / (2 - 2 * np.cos(kh)), rtol=1e-6)
    rng = np.random.default_rng(0)
    noisy = U + 3e-7 * (rng.normal(size=U.shape) + 1j * rng.normal(size=U.shape))
    low = direct_inversion.invert(field._replace(displacement=noisy), DENSITY, smoothing=0.0)
    assert np.nanmedian(low[0].real) < 0.7 * modulus(60.0).real


def test_the_noise_of_the_data_is_found():
    field = plane_waves((15, 15, 15), noise=4e-7)
    np.testing.assert_allclose(wave_field.noise_of(field), 4e-7, rtol=0.1)


def test_a_component_that_is_zero_everywhere_does_not_lower_the_noise():
    """A third of the differences were exact zeros, and the noise was half as large."""
    rng, shape = np.random.default_rng(0), (1, 11, 11, 11, 3)
    field, U = plane_waves((11, 11, 11)), 1e-7 * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
    U[..., 2] = 0
    one = field._replace(frequencies=HERTZ[:1], displacement=U)
    np.testing.assert_allclose(wave_field.noise_of(one), 1e-7, rtol=0.1)
    real = one._replace(displacement=U.real + 0j)
    np.testing.assert_allclose(wave_field.noise_of(real), 1e-7, rtol=0.1)
    assert np.isnan(wave_field.noise_of(one._replace(displacement=0 * U)))


def test_means_of_voxels_keep_the_modulus_and_lower_the_noise():
    field = plane_waves((14, 14, 14), noise=1e-7)
    half = wave_field.coarsened(field, 2)
    assert half.mask.shape == (7, 7, 7) and half.spacing[0] == pytest.approx(2 * H)
    np.testing.assert_allclose(half.noise, 1e-7 / np.sqrt(8))
    np.testing.assert_allclose(half.origin, H / 2)
    assert half.displacement[0, 1, 2, 3, 0] == pytest.approx(field.displacement[0, 2:4, 4:6, 6:8, 0].mean())


def test_labels_of_means_stay_in_their_place():
    grid = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), axis=-1)
    labels = np.where(np.linalg.norm(grid - [11.0, 12.0, 10.0], axis=-1) < 7, 3, 1)
    half = wave_field.coarsened(plane_waves((24, 24, 24), labels=labels), 2).labels
    fine, coarse = (np.argwhere(own == 3).mean(axis=0) for own in (labels, half))
    np.testing.assert_allclose(2 * coarse + 0.5, fine, atol=0.15)
    assert abs(8 * np.sum(half == 3) / np.sum(labels == 3) - 1) < 0.05


def test_changes_over_a_slope_are_those_of_a_linear_field():
    """The change is taken over the length, or over the side of a brick if this is longer."""
    spacing = np.array([1e-3, 2e-3, 3e-3])
    body = voxels.voxel_body(np.ones((7, 7, 9), bool), spacing)
    a = np.array([3.0, -2.0, 5.0 + 1j])
    field = np.asarray(body.linear.points) @ a + 7
    slopes = voxels.changes_over_slopes(body, voxels.mean_of_corners(body), 0.005)
    for D, expected in zip(slopes, a * [0.005, 0.005, 0.006], strict=True):
        np.testing.assert_allclose(D @ field, expected, rtol=1e-9)


def test_a_field_that_the_data_do_not_see_is_not_in_the_map(small):
    """Its sign alternates along each axis, so its mean is 0 in every element. Beside a step from 3 to 5 kPa, the map
    contained such a field: errors of up to 15 %, also far away from the step."""
    course = stiffness_map.course_of(small.body, small.matrices, small.waves, modulus(HERTZ), 0.01)
    levels = np.zeros(course.exponents[0].shape[1] - course.corners)
    alternating = (-1.0) ** (small.body.voxel[: course.corners] // 2).sum(axis=1)
    unseen, uniform = np.append(alternating, levels), np.append(np.ones(course.corners), levels)
    assert all(np.abs(own @ unseen).max() < 1e-12 for own in course.exponents)
    np.testing.assert_allclose(course.by_frequency(unseen), 0, atol=1e-12)
    np.testing.assert_allclose(course.by_frequency(uniform), 1, rtol=1e-12)


def test_samples_of_the_map_scatter_as_its_deviations_say():
    """With 400 samples the deviation is known to 3.5 %. It contains the posterior and the error of position."""
    own = organ(noise=5e-7)
    course = stiffness_map.course_of(own.body, own.matrices, own.waves, 1.3 * modulus(HERTZ), 0.01)
    drawn = stiffness_map.map_of(course, draws=400)
    scatter = np.std(drawn.draws.real, axis=0), np.std(drawn.draws.imag, axis=0)
    for own_sd, sd in zip(scatter, (drawn.sd.real, drawn.sd.imag), strict=True):
        assert 0.93 < np.median(own_sd / sd) < 1.07
    assert np.all(drawn.sd.real > drawn.posterior_sd) and np.all(drawn.sd.imag > drawn.posterior_sd)


@pytest.mark.parametrize("wrong", [(1.3, 1.0), (1.0, 1.3)])
def test_a_map_finds_the_ratio_of_its_frequencies(wrong):
    """The ratio of the starting moduli was kept. At the lower frequency, the errors were 35 % and 20 %."""
    own = organ(noise=5e-7)
    course = stiffness_map.course_of(own.body, own.matrices, own.waves, np.array(wrong) * modulus(HERTZ), 0.01)
    drawn = stiffness_map.map_of(course, draws=400)
    off = np.abs(np.mean(drawn.modulus.real, axis=1) / modulus(HERTZ).real - 1)
    assert np.all(off < 0.05), off
    for part, sd in ((drawn.draws.real, drawn.sd.real), (drawn.draws.imag, drawn.sd.imag)):
        assert np.all(np.abs(np.median(np.std(part, axis=0) / sd, axis=1) - 1) < 0.07)
    assert drawn.exponent.shape == drawn.sd.shape == drawn.modulus.shape == (2, course.corners)


def test_deviations_of_a_modulus_are_those_of_samples():
    rng = np.random.default_rng(0)
    G, sd = np.array([3000 + 900j, 3000 + 0j]), np.array([0.03 + 0.01j, 0.02 + 0.05j])
    samples = G * np.exp(sd.real * rng.normal(size=(20000, 2)) + 1j * sd.imag * rng.normal(size=(20000, 2)))
    found = stiffness_map.sd_of_modulus(G, sd)
    np.testing.assert_allclose(found.real, samples.real.std(axis=0), rtol=0.03)
    np.testing.assert_allclose(found.imag, samples.imag.std(axis=0), rtol=0.03)


@pytest.mark.ci
@pytest.mark.parametrize("axis", [0, *(pytest.param(axis, marks=pytest.mark.slow) for axis in (1, 2))])
def test_the_error_of_long_voxels_is_that_of_the_waves_that_cross_them(axis):
    """Voxels are twice as long along the direction of the wave as across it. The estimate is the wave's error for each
    axis.
    """
    spacing, shape = np.full(3, H), np.full(3, 7)
    spacing[axis] *= 2
    X = np.stack(np.meshgrid(*[np.arange(n) * h for n, h in zip(shape, spacing, strict=True)], indexing="ij"), axis=-1)
    k = 2 * np.pi * HERTZ * np.sqrt(DENSITY / modulus(HERTZ))
    across = np.eye(3)[(axis + 1) % 3]
    U = np.array([1e-5 * np.exp(-1j * one * X[..., axis])[..., None] * across for one in k])
    noise = np.full(2, 1e-12)
    field = wave_field.WaveField(HERTZ, U, spacing, np.zeros(3), np.ones(shape, bool), None, noise)
    found = elastography.regions_of(elastography.organ_of(field, elastography.body_of(field), DENSITY))
    error = found.whole.modulus[:, 0] / modulus(HERTZ) - 1
    assert np.all(np.abs(error) > 0.005)
    # The patch of the estimate is as small as this body, but its edges are at other positions in the wave.
    assert np.all(np.abs(found.mesh_bias - error) < 0.25 * np.abs(error))


@pytest.mark.ci
def test_each_region_has_the_error_of_waves_of_its_own_length():
    """A soft region is beside a stiff one. The estimate with the modulus of the whole organ was a sixth of its
    error.
    """
    field = plane_waves((9, 9, 9), noise=4e-7)
    organ, G = elastography.organ_of(field, elastography.body_of(field), DENSITY), modulus(HERTZ)[0]
    bias, left = elastography._biases(organ, np.array([[G, 4 * G, 1.1 * G, 2 * G]] * len(HERTZ)))
    strength = elastography.waves_of_field(field)
    for r, factor in ((0, 1), (1, 4), (2, 1.1), (3, 2)):
        own, weights = elastography.plane_wave_biases(factor * G, 2 * np.pi * HERTZ[0], organ, strength[0])
        exact = own @ weights
        # A region with a similar modulus uses the waves of the other. The error goes with the square of the wave
        # number, so it is known to a quarter, which is the accuracy of this estimate.
        assert abs(bias[0, r] - exact) < (1e-12 if r != 2 else 0.25) * abs(exact)
        assert left[0, r].shape == (2 * len(elastography.DIRECTIONS),)
    assert abs(bias[0, 0] - bias[0, 1]) > 0.1 * abs(bias[0, 0])


@pytest.mark.parametrize(
    ("layers", "seed"),
    [(5, 0), (3, 0), *(pytest.param(*own, marks=pytest.mark.slow) for own in ((5, 1), (5, 2), (3, 1)))],
)
def test_the_error_of_the_voxels_of_a_thin_slab_is_known(layers, seed):
    """The slab is one or two bricks thick, with six waves of any polarisation (12 seeds).

    In two bricks, one polarisation per direction and equal weights missed the error by 0.8 of its size on average; now
    it is 0.3. In one brick they missed it by 0.17, and both polarisations with equal weights by 0.12; now it is 0.017.
    """
    rng, sizes = np.random.default_rng(seed), np.array([2e-3, 2.2e-3, 1.8e-3])
    G = 2500 + 1600j
    X = np.stack(
        np.meshgrid(*[n * s for n, s in zip(map(np.arange, (9, 9, layers)), sizes, strict=True)], indexing="ij"), -1
    )
    X = X - X.mean(axis=(0, 1, 2))
    k, u = 2 * np.pi * 90.0 * np.sqrt(DENSITY / G), 0.0
    for _ in range(6):
        n, p = rng.normal(size=(2, 3))
        n /= np.linalg.norm(n)
        p = np.cross(n, p) / np.linalg.norm(np.cross(n, p))
        u = u + 1e-5 * (rng.normal() + 1j * rng.normal()) * np.exp(-1j * k * (X @ n))[..., None] * p
    whole = np.ones((9, 9, layers), bool)
    field = wave_field.WaveField(np.array([90.0]), u[None], sizes, np.zeros(3), whole, None, np.array([1e-9]))
    found = elastography.regions_of(elastography.organ_of(field, elastography.body_of(field), DENSITY))
    error = found.whole.modulus[0, 0] / G - 1
    assert abs(found.mesh_bias[0] - error) < (0.6 * abs(error) if layers == 5 else 0.05)


def _waves_of_many_directions(shape, seed):
    """Return eight plane waves at 75 Hz in 3000 + 900i Pa (1, nx, ny, nz, 3), with a root mean square of 1e-5 m."""
    rng, k = np.random.default_rng(seed), 2 * np.pi * 75.0 * np.sqrt(DENSITY / (3000 + 900j))
    X = np.stack(np.meshgrid(*[2e-3 * (np.arange(n) - n / 2) for n in shape], indexing="ij"), axis=-1)
    U = np.zeros((*shape, 3), complex)
    for _ in range(8):
        n = rng.normal(size=3)
        n /= np.linalg.norm(n)
        across = rng.normal(size=3) + 1j * rng.normal(size=3)
        across -= n * (n @ across)
        U += np.exp(-1j * k * (X @ n))[..., None] * across / np.linalg.norm(across)
    return 1e-5 * U[None] / np.sqrt(np.mean(np.abs(U) ** 2))


def _found_in(U):
    inside, none = np.isfinite(U[0, ..., 0]), np.zeros(1)
    field = wave_field.WaveField(np.array([75.0]), U, np.full(3, 2e-3), np.zeros(3), inside, None, none)
    field = field._replace(noise=wave_field.noise_of(field))
    own = elastography.organ_of(field, elastography.body_of(field), DENSITY)
    return own, elastography.regions_of(own)


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.0, 0.7])
def test_errors_of_smoothed_noise_hold_the_truth(width):
    """Noise of 2 % is smoothed by a Gaussian filter of 0.7 voxels. Stated errors were a third of the true ones, without
    a message. Two thirds of the moduli were wrong by more than two of them.
    """
    off = []
    for seed in range(3):
        U, rng = _waves_of_many_directions((11, 11, 9), seed), np.random.default_rng(seed)
        noise = rng.normal(size=U.shape) + 1j * rng.normal(size=U.shape)
        if width:
            noise = scipy.ndimage.gaussian_filter(noise, (0, width, width, width, 0), mode="wrap")
        own, found = _found_in(U + noise * 2e-7 / np.sqrt(np.mean(np.abs(noise) ** 2)))
        G, error = found.whole.modulus[0, 0], found.whole.standard_errors[0, 0]
        z = G * (1 - found.mesh_bias[0]) - (3000 + 900j)
        off += [z.real / error.real, z.imag / error.imag]
        told = any("voxels are correlated" in s for s in cautions.cautions_of_elastography(own, found, None))
        factor = found.whole.noise_factor[0, 0]
        assert told == bool(width) and (factor > 3 if width else factor < 1.2)
    assert np.sqrt(np.mean(np.square(off))) < 1.8  # six numbers: 1 with a deviation of 0.29


@pytest.mark.ci
def test_a_hole_in_the_mask_is_in_the_mesh_bias():
    """Without noise, the elements alone cause an error of 0.15 %, and with a hole 1.2 %. Half of it is found. The
    measured waves are a sum whose parts add up at the hole; the estimate treats each wave separately.
    """
    U = _waves_of_many_directions((11, 11, 9), 10)
    U[0, 3:6, 3:6, 2:5] = np.nan
    _, found = _found_in(U)
    error = found.whole.modulus[0, 0] / (3000 + 900j) - 1
    assert abs(error) > 0.004 and abs(found.mesh_bias[0] - error) < 0.6 * abs(error)


def test_the_direct_inversion_leaves_out_what_the_edge_smooths():
    """Without noise, every voxel with a value is within the error of its differences, (k h)^2 / 12 on each axis."""
    field = plane_waves((17, 17, 17))
    G = direct_inversion.invert(field, DENSITY)
    assert np.isfinite(G[0]).sum() == 7**3
    worst = np.nanmax(np.abs(G / modulus(HERTZ)[:, None, None, None] - 1), axis=(1, 2, 3))
    assert np.all(worst < 0.5 * (np.abs(2 * np.pi * HERTZ * np.sqrt(DENSITY / modulus(HERTZ)) * H) ** 2))


def test_moduli_that_long_waves_leave_open_have_an_interval_of_their_own(small):
    """Waves that are long relative to the organ determine 1/G. 10376 ± 3820 Pa was stated for 30,000, wrong by five
    errors.
    """
    found = elastography.regions_of(small)
    G, e = 10376.0, 3820.0

    def told(error):
        own = found.whole._replace(
            modulus=np.full((2, 1), G + 0j), covariance=np.tile(error**2 * np.eye(2), (2, 1, 1)), correlations=()
        )
        own = own._replace(chi2=np.full(2, float(own.components)))
        return cautions._of_long_waves(60.0, found._replace(whole=own), 0)

    (sentence,) = told(e)
    low, high = 1 / (1 / G + 2 * e / G**2), 1 / (1 / G - 2 * e / G**2)
    assert f"is {low:.3g} Pa to {high:.3g} Pa (95 %)" in sentence and high > 30000
    assert "to any value above" in told(0.6 * G)[0] and "to any value above" in told(1.5 * G)[0] and not told(0.1 * G)


def test_the_air_around_the_organ_has_no_waves():
    """Noise outside the mask changed the directions of the waves, and so the mesh bias, by half."""
    field, inside = plane_waves((9, 9, 11)), np.zeros((9, 9, 11), bool)
    inside[:7, :7, :9] = True
    noise = 1e-5 * np.random.default_rng(0).normal(size=field.displacement.shape)
    outside = ~inside[None, ..., None]
    noisy, empty = (np.where(outside, other, field.displacement) for other in (noise, np.nan))
    fields = [field._replace(mask=inside, displacement=own) for own in (noisy, empty)]
    np.testing.assert_array_equal(*(elastography.waves_of_field(own) for own in fields))
    np.testing.assert_array_equal(*(components._central_differences(own) for own in fields))


def test_waves_of_the_other_sign_are_told(small):
    """Conjugate waves, with exp(-i omega t), have the modulus of a solid that gains energy."""
    field = small.field._replace(displacement=np.conj(small.field.displacement))
    other = elastography.organ_of(field, elastography.body_of(field), DENSITY)
    assert not cautions._sign(small, elastography.regions_of(small))
    (told,) = cautions._sign(other, elastography.regions_of(other))
    assert "loss modulus is negative at 60 Hz, 100 Hz" in told and "complex conjugate" in told
    # One modulus for two materials may have any loss, so those of the regions count.
    found = elastography.regions_of(small)
    uniform = found.whole._replace(modulus=np.conj(found.whole.modulus))
    assert not cautions._sign(small, found._replace(whole=uniform, parts=found.whole, labels=np.array([1])))


def test_a_body_in_parts_has_the_same_elements_and_keeps_faces_out_of_the_balance():
    mask = np.ones((13, 9, 7), bool)
    mask[0, 0, 0] = False
    one, parts = (voxels.voxel_body(mask, np.full(3, 1e-3), side=side) for side in (None, 3))
    assert one.part.max() == 0 and parts.part.max() + 1 == 2 * 2 * 1
    assert np.array_equal(parts.whole.tetrahedra, one.linear.tetrahedra)
    points = np.asarray(parts.linear.points)[np.asarray(parts.linear.tetrahedra)]
    assert np.array_equal(points, np.asarray(one.linear.points)[np.asarray(one.linear.tetrahedra)])
    assert np.array_equal(np.asarray(parts.whole.points)[parts.corner], np.asarray(parts.linear.points))
    # The parts meet at voxels 6 and 4. There both have nodes, and neither has a balance equation.
    assert np.array_equal(np.unique(parts.voxel, axis=0), np.unique(one.voxel, axis=0))
    inside, all_inside = (set(map(tuple, b.voxel[b.inner])) for b in (parts, one))
    assert inside == {v for v in all_inside if v[0] != 6 and v[1] != 4}
    m = balance.matrices(parts, DENSITY)
    assert 0.7 < 16e-9 * m.pressure.size / balance.gigabytes(parts) <= 1  # slices along the longest side of a part
    columns = [set(m.pattern[rows].indices) for rows in m.parts]
    assert len(columns) == 4 and sum(map(len, columns)) == len(set().union(*columns))
    field = np.arange(one.whole.number_of_nodes) + 0.5
    at = dict(zip(map(tuple, one.voxel), voxels.on_all_nodes(one, field), strict=True))
    values = voxels.on_all_nodes(parts, field)
    assert all(at[tuple(v)] == value for v, value in zip(parts.voxel, values, strict=True))


@pytest.mark.slow
def test_moduli_and_errors_of_a_body_in_parts():
    """The errors include that parts share the noise of their common voxels."""
    apart, shared = [], []
    for seed in range(8):
        field = plane_waves((17, 13, 9), noise=1e-6, seed=seed)
        found = elastography.regions_of(elastography.organ_of(field, elastography.body_of(field, 4), DENSITY))
        own = found.whole
        error = own.modulus[:, 0] - modulus(HERTZ) * (1 + found.mesh_bias)
        apart += [*(error.real / own.standard_errors[:, 0].real), *(error.imag / own.standard_errors[:, 0].imag)]
        shared += [each.enlarged[0] for each in own.correlations if not each.seen]
    assert 0.7 < np.sqrt(np.mean(np.square(apart))) < 1.4
    assert len(shared) > 8 and 1.02 < np.mean(shared) < 1.05  # below 1 if only one of two nodes on a voxel counted


def test_blocks_that_are_not_coupled_have_the_factor_of_the_whole():
    rng, A = np.random.default_rng(0), np.zeros((11, 11), complex)
    for a, b in ((0, 4), (4, 5), (5, 11)):
        own = rng.normal(size=(b - a, b - a)) + 1j * rng.normal(size=(b - a, b - a))
        A[a:b, a:b] = own @ own.conj().T + np.eye(b - a)
    A[6, 5] = A[5, 6] = 0  # neighbours without a coupling, in one block
    band = balance.by_diagonals(scipy.sparse.csr_array(A))
    L = np.linalg.cholesky(A)
    found = balance._factor_of_blocks(band)
    assert np.allclose(found, balance.by_diagonals(scipy.sparse.csr_array(L + np.tril(L, -1).conj().T)), atol=1e-14)
    assert [balance._coupled_across(balance.by_diagonals(scipy.sparse.csr_array(A)), k) for k in (3, 4, 5, 8)] == [
        False,
        False,
        True,
        True,
    ]
