"""The learnt correction of reduced models and the errors that it states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_reduced import _missing

from liverjax.reduced.correction import Learnt, _least_squares, correction_at, learnt_correction, stated_at

pytestmark = pytest.mark.quick_to_compile


def test_a_polynomial_of_the_coordinates_is_learnt():
    rng = np.random.default_rng(3)
    volumes, fields = rng.uniform(0.5, 2.0, 7), rng.normal(size=(2, 7, 3))
    q, new = (np.cumsum(rng.normal(size=(n, 6, 3)), axis=1) for n in (40, 5))
    moved = np.abs(q).max(axis=(1, 2))
    found = learnt_correction(Learnt(q, _missing(q, fields), moved, volumes, 0.1))
    assert found is not None and found.products > 0
    for own, exact in zip(new, _missing(new, fields), strict=True):
        # The ridge of 1e-6 causes an error of about this size.
        assert np.abs(correction_at(found, jnp.asarray(own), 0.1) - exact).max() < 1e-4 * np.abs(exact).max()
        assert float(stated_at(found, jnp.asarray(own), jnp.asarray(exact), 0.1).max()) < 1e-3 * np.abs(exact).max()
    noise = rng.normal(size=(40, 6, 7, 3))
    # Noise that does not depend on the coordinates is not corrected, nor what only a few runs show.
    assert learnt_correction(Learnt(q, noise, moved, volumes, 0.1)) is None
    assert learnt_correction(Learnt(q[:5], _missing(q[:5], fields), moved[:5], volumes, 0.1)) is None


def test_differences_count_in_proportion_to_the_motion_of_their_run():
    rng = np.random.default_rng(8)
    A, parts, moved = rng.normal(size=(20, 5, 4)), rng.normal(size=(20, 5, 3)), np.geomspace(1e-3, 1.0, 20)
    factors, _ = _least_squares(A, parts, moved, np.arange(20) % 4).without()
    by_motion = moved[:, None, None]
    exact = np.linalg.lstsq((A / by_motion).reshape(100, 4), (parts / by_motion).reshape(100, 3), rcond=None)[0]
    # The ridge of 1e-6 causes an error of about this size.
    assert np.allclose(factors, exact, rtol=0, atol=1e-4 * np.abs(exact).max())


def test_stated_errors_are_right_as_often_as_those_of_runs_left_out():
    """A cubic term is not in a polynomial of degree two, so an error remains. The runs have different amplitudes."""
    rng = np.random.default_rng(4)
    volumes, fields = np.ones(7), rng.normal(size=(1, 7, 3))
    q, new = (rng.uniform(-1.0, 1.0, (n, 6, 2)) * rng.uniform(0.5, 1.0, (n, 1, 1)) for n in (80, 200))
    exact = [np.tensordot(a[..., :1] + 0.3 * a[..., :1] ** 3, fields, axes=1) for a in (q, new)]
    moved = [np.linalg.norm(a, axis=-1).max(axis=(1, 2)) for a in exact]
    found = learnt_correction(Learnt(q, exact[0], moved[0], volumes, None))
    corrected = jax.jit(jax.vmap(lambda own: correction_at(found, own, None)))(jnp.asarray(new))
    true = np.linalg.norm(corrected - exact[1], axis=-1).max(axis=(1, 2))
    stated = jax.jit(jax.vmap(lambda q, u: stated_at(found, q, u, None)))(jnp.asarray(new), jnp.asarray(exact[1]))
    within = lambda ratios: float(np.mean(np.abs(np.log(ratios)) < np.log(2)))  # noqa: E731
    told, seen = within(np.asarray(found.ratios)), within(np.asarray(stated)[:, -1] / true)
    assert told > 0.5
    # Binomial: three standard deviations of both, for 80 runs left out and 200 new ones.
    spread = told * (1 - told) * (1 / 80 + 1 / 200)
    assert abs(seen - told) < 3 * np.sqrt(spread) + 1 / 80
