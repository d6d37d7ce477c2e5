"""Points of reduced models: which are chosen, what they weigh and the solves with them."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import every_motion
from test_reduced import _bar

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.mesh.nodal import nodal_volumes
from liverjax.physics.prescribed import free_degrees
from liverjax.reduced import sampling, training
from liverjax.reduced.model import (
    with_all_points,
)
from liverjax.reduced.sampling import MOST_STATES, Coordinates, nonnegative_weights, sampled, states_of
from liverjax.reduced.step import _updated
from liverjax.reduced.tangent import ReducedTangent, in_single_precision, solved_by_tangent, tangent_matrix

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.parametrize("order", [1, 2])
def test_the_compliance_of_the_selection_of_points_has_regions(order):
    """The changes of the law in regions were not used, so motions were up to ten times too large in a stiff region."""
    scene, stiff = _bar((3, 1, 1), order), np.arange(9)
    mu = jnp.full(scene.mesh.number_of_elements, 800.0).at[stiff].set(8000.0)
    scene = replace(scene, region=(lj.Region(elements=stiff, law={"mu": 8000.0}),))
    modes = SimpleNamespace(modes=every_motion(scene), number_of_modes=len(every_motion(scene)))
    found = sampling._reduced_compliance(modes, scene)
    same = replace(scene, region=(), law=replace(scene.law, mu=scene.mesh.at_points(mu)))
    np.testing.assert_allclose(found, sampling._reduced_compliance(modes, same), rtol=1e-9)


@pytest.mark.parametrize("runs", [1, 8, MOST_STATES // 2 + 1, 3 * MOST_STATES])
def test_states_of_all_times_are_sampled(runs):
    """With many runs each gives few states. These are from all times, not only from the first step."""
    found = states_of(runs, 24)
    times = np.concatenate([times for _, times in found])
    assert len(times) <= MOST_STATES and times.min() >= 0 and times.max() < 24
    assert len({r for r, _ in found}) == min(runs, MOST_STATES)
    thirds = np.bincount(times // 8, minlength=3) / len(times)
    assert np.all(thirds > 0.25)  # a third each, apart from a few at the ends


def test_weights_give_all_forces_and_are_few():
    rng = np.random.default_rng(0)
    G = rng.normal(size=(40, 6)) @ rng.normal(size=(6, 200))
    xi = nonnegative_weights(G, np.ones(200), 1e-8)
    assert np.all(xi >= 0) and np.count_nonzero(xi) <= 7
    assert np.allclose(G @ xi, G.sum(axis=1), rtol=0, atol=1e-8 * np.abs(G).sum(axis=1).max())
    with pytest.raises(lj.InputError, match="no state of the training runs has a motion with finite stresses"):
        nonnegative_weights(G[:0], np.ones(200), 1e-8)


def test_an_inverse_follows_the_forces_and_stays_symmetric_and_positive():
    rng = np.random.default_rng(7)
    half, moved = rng.normal(size=(6, 6)), rng.normal(size=6)
    inverse, stiffness = np.eye(6), half @ half.T + np.eye(6)
    change = stiffness @ moved
    found = np.asarray(_updated(jnp.asarray(inverse), jnp.asarray(moved), jnp.asarray(change)))
    # The secant condition holds up to rounding. The update is positive for positive work (Dennis, Schnabel 1983,
    # theorem 9.2.1).
    assert np.allclose(found @ change, moved, rtol=0, atol=1e-12 * np.abs(moved).max())
    assert np.array_equal(found, found.T) and np.linalg.eigvalsh(found)[0] > 0
    assert np.array_equal(_updated(jnp.asarray(inverse), jnp.asarray(moved), -jnp.asarray(change)), inverse)
    assert np.array_equal(_updated(jnp.asarray(inverse), jnp.zeros(6), jnp.zeros(6)), inverse)


@pytest.mark.parametrize("small", [1e-1, 1e-9])
def test_solves_are_exact_though_the_inverse_is_near(small):
    """This holds also if single precision loses a small eigenvalue of the matrix."""
    rng, n, S = np.random.default_rng(2), 8, 20
    half, slopes = rng.normal(size=(9, 9, S)), rng.normal(size=(9, S, n))
    slopes[..., -1] = slopes[..., 0] + np.sqrt(small) * slopes[..., -1]
    moduli = jnp.asarray(np.einsum("iks,jks->ijs", half, half))
    b = jnp.asarray(rng.normal(size=n))

    def both(stiffer):
        K = ReducedTangent(jnp.asarray(slopes), stiffer * moduli, jnp.zeros((n, n)))
        return solved_by_tangent(K, in_single_precision(K.slopes), b), tangent_matrix(K)

    (x, K), (change, _) = jax.jit(lambda one: jax.jvp(both, (one,), (one,)))(jnp.ones(()))
    exact = np.linalg.solve(K, b)
    # Rounding times the condition number, which is some thousands over the small number.
    limit = 1e-12 / small * np.abs(exact).max()
    assert np.allclose(x, exact, rtol=0, atol=limit)
    assert np.allclose(change, -exact, rtol=0, atol=limit)


@pytest.mark.ci
def test_points_of_a_body_that_is_only_moved():
    """Without a load the forces cancel, so states were divided by roundoff or were regarded as at rest."""
    scene = replace(_bar((2, 1, 1)), body=None)
    end = jnp.asarray(lj.boundary.select(scene.mesh, {"x_min": 0.03}, None, "displaced"))
    scene = replace(scene, displaced=(lj.Displaced(nodes=end, by=jnp.array([0.003, 0.0, 0.002])),))
    values = {"displaced.0.by": np.array([[0.003, 0, 0.002], [0.001, 0, 0.003], [0.002, 0.002, 0], [-0.002, 0.001, 0]])}
    u = np.asarray(lj.simulate_batch(scene, values).result.positions) - np.asarray(scene.mesh.points)
    u = u * np.asarray(free_degrees(scene.mesh, scene.fixed, scene.displaced))
    volumes = np.asarray(nodal_volumes(scene.mesh))
    whole = with_all_points(scene, jnp.asarray(training.proper_modes(u[:, 0], volumes, 1e-8)))
    q = jnp.einsum("rtvc,nvc->rtn", u * volumes[:, None], whole.modes)
    model = sampled(whole, scene, values, Coordinates(q, None), 1e-8)
    compliance = sampling._reduced_compliance(whole, scene)
    for by, own in zip(values["displaced.0.by"], q, strict=True):
        moved = lj.with_parameters(scene, {"displaced.0.by": by})
        forces, _ = sampling._contributions(model, moved, (own, None), jnp.arange(1))
        motion = compliance @ np.asarray(forces[0]).sum(axis=1)  # of the forces that do not cancel
        assert np.linalg.norm(motion) < 1e-7 * np.linalg.norm(own)
