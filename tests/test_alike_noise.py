"""Standard errors of parameters if the noise of neighbouring points is correlated."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.fits import scene_numbers
from fitting.methods.estimate import estimated
from fitting.methods.least_squares import Solution
from fitting.methods.noise.alike_noise import alike_noise, along_rows
from fitting.readers.displacements import Displacements
from fitting.reports import field_report

pytestmark = pytest.mark.quick_to_compile


def points(n: int = 150, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, [0.06, 0.04, 0.03], (n, 3))


def smoothed(X: np.ndarray, width: float) -> np.ndarray:
    """Return a square root of the covariance of noise smoothed by a Gaussian filter. The fit assumes another
    covariance.
    """
    d = np.linalg.norm(X[:, None] - X[None], axis=-1)
    C = np.exp(-(d**2) / (4 * width**2)) + 1e-9 * np.eye(len(X))
    return np.linalg.cholesky(C)


def fields(X: np.ndarray) -> np.ndarray:
    """Return derivatives (3 n, 2) of displacements with respect to two parameters: a stretch and a variable shear."""
    one = np.stack([X[:, 0], -0.4 * X[:, 1], -0.4 * X[:, 2]], axis=1)
    two = np.stack([X[:, 1] * np.sin(60 * X[:, 0]), 0 * X[:, 0], X[:, 0] ** 2 / 0.06], axis=1)
    return np.stack([one.ravel(), two.ravel()], axis=1) / 1e-3


def fitted(noise: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    u = np.linalg.lstsq(J, noise, rcond=None)[0]
    return u, noise - J @ u


@pytest.mark.parametrize(
    "width", [pytest.param(0.004, marks=pytest.mark.slow), 0.01, pytest.param(0.03, marks=pytest.mark.slow)]
)
def test_errors_of_smoothed_noise_are_right(width):
    """Errors under the assumption of independent noise are several times too small. With these errors, the intervals
    contained 95 to 99 % of 120 numbers at four widths.
    """
    X = points()
    J, L = fields(X), smoothed(X, width)
    places, group = np.repeat(X, 3, axis=0), np.tile(np.arange(3), len(X))
    plain = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    z, z_plain = [], []
    for seed in range(24):
        noise = (L @ np.random.default_rng(seed).standard_normal((len(X), 3))).ravel()
        u, r = fitted(noise, J)
        found = alike_noise(places, group, r, J)
        assert found is not None
        z.append(u / np.linalg.norm(found.root, axis=1))
        z_plain.append(u / plain)
    rms, rms_plain = (float(np.sqrt(np.mean(np.square(v)))) for v in (z, z_plain))
    # The rms of 48 numbers has an error of a tenth. Matérn's function decays more slowly than the correlation of this
    # noise, so the errors are up to 1.5 times too large. Much smoother noise than this function would be estimated too
    # small, but synthetic data do not contain such noise.
    assert 0.5 < rms < 1.3 and rms_plain > 2, (rms, rms_plain)


@pytest.mark.slow
def test_independent_noise_is_left_alone():
    X, seen = points(), 0
    J, places, group = fields(X), np.repeat(X, 3, axis=0), np.tile(np.arange(3), len(X))
    for seed in range(40):
        _, r = fitted(np.random.default_rng(seed).standard_normal(3 * len(X)), J)
        seen += alike_noise(places, group, r, J) is not None
    assert seen <= 1


def test_noise_alike_in_part_and_many_points():
    """Half of the variance is correlated, and there are more points than are used to estimate the correlation
    length.
    """
    X = points(900)
    J, L = fields(X), smoothed(X, 0.006)
    rng = np.random.default_rng(0)
    noise = np.sqrt(0.5) * (L @ rng.standard_normal((900, 3)) + rng.standard_normal((900, 3))).ravel()
    places, group = np.repeat(X, 3, axis=0), np.tile(np.arange(3), 900)
    found = alike_noise(places, group, fitted(noise, J)[1], J)
    assert found is not None and 0.25 < found.part < 0.95 and 0.003 < found.length < 0.03
    C = 0.5 * (L @ L.T + np.eye(900))
    inverse = np.linalg.pinv(J)
    exact = np.sqrt(np.diag(sum(inverse[:, k::3] @ C @ inverse[:, k::3].T for k in range(3))))
    assert np.all(np.abs(np.log(np.linalg.norm(found.root, axis=1) / exact)) < np.log(1.6))


@pytest.mark.parametrize("case", ["one place", "few"])
def test_too_little_to_tell(case):
    X = points(4 if case == "few" else 30)
    X = X if case == "few" else np.tile(X[:1], (30, 1))
    J = np.random.default_rng(0).standard_normal((len(X), 2))
    assert alike_noise(X, np.zeros(len(X)), np.random.default_rng(1).standard_normal(len(X)), J) is None


def test_unknowns_that_few_groups_show_and_points_of_two_rows():
    """One parameter acts in one step only, which is not among the chosen groups. Then each point has two rows in a
    step.
    """
    X = points(40)
    L, rng = smoothed(X, 0.01), np.random.default_rng(1)
    steps = 20
    noise = (L @ rng.standard_normal((40, steps))).T.ravel()
    places, group = np.tile(X, (steps, 1)), np.repeat(np.arange(steps), 40)
    J = np.stack([np.tile(X[:, 0], steps), np.tile(X[:, 1], steps) * (group == 2)], axis=1)
    assert alike_noise(places, group, fitted(noise, J)[1], J) is not None
    twice = np.repeat(np.arange(len(J)), 2)
    r = fitted(noise, J)[1][twice] + 0.3 * rng.standard_normal(2 * len(J))
    assert alike_noise(places[twice], group[twice], r, J[twice]) is not None


@pytest.mark.slow
def test_one_wrong_point_is_no_shared_noise():
    """One of 150 points has 30 times the noise. Such data were taken for correlated noise in a quarter of the cases."""
    X, seen = points(), 0
    J, places, group = fields(X), np.repeat(X, 3, axis=0), np.tile(np.arange(3), len(X))
    for seed in range(30):
        noise = np.random.default_rng(seed).standard_normal((len(X), 3))
        noise[seed] *= 30
        seen += alike_noise(places, group, fitted(noise.ravel(), J)[1], J) is not None
    assert seen <= 2, seen


def test_as_many_residuals_as_unknowns_that_they_show():
    """Three points in thirty steps, and 36 parameters that all act in the chosen groups: no residual is left to
    test.
    """
    rng = np.random.default_rng(0)
    places, group = np.tile(rng.normal(size=(3, 3)), (30, 1)), np.repeat(np.arange(30), 3)
    J = rng.normal(size=(90, 36))
    assert alike_noise(places, group, fitted(rng.normal(size=90), J)[1], J) is None


def test_two_series_that_drift_are_seen_and_white_ones_are_not():
    """Two curves of 30 points are fitted with a modulus and an exponent. Noise of the stretch is also in the
    derivatives.
    """
    x = np.linspace(0.02, 0.5, 30)
    seen = {"white": 0, "drift": 0, "stretch": 0}
    for seed in range(20):
        for kind in seen:
            rng = np.random.default_rng(seed)
            at = np.concatenate([x, x]) + (0.003 * rng.normal(size=60) if kind == "stretch" else 0.0)
            J = np.stack([at, at**3 * np.repeat([1.0, 2.0], 30)], axis=1)
            noise = rng.normal(size=60)
            if kind == "drift":
                for k in range(1, 60):
                    noise[k] = noise[k] if k == 30 else 0.95 * noise[k - 1] + 0.3 * noise[k]
            if kind == "stretch":  # the stress belongs to the true stretch, but is stored at the measured one
                noise = (np.stack([np.tile(x, 2), np.tile(x, 2) ** 3 * np.repeat([1.0, 2.0], 30)], axis=1) - J) @ [
                    50,
                    200,
                ]
                noise += 0.05 * rng.normal(size=60)
            r = fitted(noise, J)[1]
            found = along_rows([30, 30], r, J, float(np.sqrt(r @ r / 58)), np.linalg.pinv(J))
            seen[kind] += found is not None
    assert seen["white"] <= 1 and seen["stretch"] <= 1 and seen["drift"] >= 16, seen


def test_the_warning_about_correlated_noise_is_in_the_report():
    """The warning was printed, but field.json did not contain it."""
    X = points()
    n, J, noise = len(X), fields(X), np.random.default_rng(1).standard_normal((len(X), 3))
    u, r = fitted((smoothed(X, 0.01) @ noise).ravel(), J)
    corner = np.eye(4)[np.zeros(n, int)]
    data = Displacements(
        np.zeros(n, int), np.arange(n)[:, None].repeat(4, 1), corner, np.zeros((n, 3)), np.ones((n, 3))
    )
    problem = SimpleNamespace(scenes=(SimpleNamespace(mesh=SimpleNamespace(points=X)),), data=(data,))
    minimum = Solution(jnp.asarray(u), r, J, r @ r / 2, 1, 0.0, True)
    estimate = estimated(("a", "b"), lambda u: u, minimum, 3 * n)
    with pytest.warns(UserWarning, match="residuals of points") as told:
        found = scene_numbers._of_alike_noise(problem, lambda u: u, minimum, estimate)
    assert str(told[0].message) in field_report.of_numbers(found)["warnings"]
    assert np.allclose(np.linalg.norm(found.root, axis=1), found.standard_errors)  # also with the larger errors
    wide = estimate._replace(standard_errors=found.standard_errors * [2.0, 0.5])
    with pytest.warns(UserWarning, match="residuals of points"):
        found = scene_numbers._of_alike_noise(problem, lambda u: u, minimum, wide)
    assert np.allclose(np.linalg.norm(found.root, axis=1), found.standard_errors)
