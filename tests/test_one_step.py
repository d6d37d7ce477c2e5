"""One linear solve per step, the chapter's scheme: `newton = "one_step"`."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg

import liverjax as lj
from fitting.fits import scene_numbers
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.jobs.sweep import _failures
from liverjax.physics.elastic_support import ElasticSupport

pytestmark = pytest.mark.quick_to_compile

LAW = lj.laws.NeoHookean(mu=770.0, bulk=2200.0)


def hanging(**solve) -> lj.Scene:
    """A block under gravity."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
    weight = lj.Body(density=1060.0, gravity=jnp.array([0.0, 0.0, -2.0]))
    return lj.Scene(
        mesh=mesh,
        law=LAW,
        body=weight,
        fixed=(lj.Fixed(nodes=jnp.asarray(lj.boundary.select(mesh, {"z_max": 0.0}))),),
        solve=lj.Solve(**solve),
    )


@pytest.mark.ci
def test_one_step_of_newton_is_the_chapters_scheme():
    scene = hanging(kind="dynamic", dt=0.01, steps=5, newton="one_step")
    one, full = lj.simulate(scene), lj.simulate(replace(scene, solve=replace(scene.solve, newton="converged"))).check()
    assert np.all(np.asarray(one.statistics.iterations) == 1)
    moved = np.abs(np.asarray(full.positions[-1] - scene.mesh.points)).max()
    assert 0 < np.abs(np.asarray(one.positions - full.positions)).max() < 0.05 * moved
    # The old spelling, one iteration, is the same scheme.
    counted = lj.simulate(replace(scene, solve=replace(scene.solve, newton="converged", newton_iterations=1)))
    assert np.array_equal(counted.positions, one.positions)


@pytest.mark.slow
def test_one_step_of_newton_says_when_its_residual_is_above_the_tolerance():
    scene = hanging(steps=1, newton="one_step")
    large = lj.simulate(scene)
    assert float(large.statistics.residual[0]) > 1e-3 and int(large.status[0]) == status.ONE_STEP
    with pytest.raises(RuntimeError, match="one_step"):
        large.check()
    loose = lj.simulate(replace(scene, solve=replace(scene.solve, tolerance=0.5)))
    assert int(loose.status[0]) == status.CONVERGED


@pytest.mark.ci
def test_one_step_of_newton_solves_to_the_tolerance_asked_for():
    """With a millionth of the weight the body is linear, so only the error of the linear solve remains."""
    scene = hanging(steps=1, newton="one_step", tolerance=1e-9)
    light = replace(scene, body=replace(scene.body, gravity=1e-9 * scene.body.gravity))
    # The linear solve has a residual of 0.3 of the tolerance. Quadratic terms of the motion are 1e-9 of 1e-1.
    assert float(lj.simulate(light).statistics.residual[0]) < 1e-9


@pytest.mark.slow
def test_one_step_of_newton_takes_the_regularised_stiffness():
    """The chapter's own scheme (4.1.2 iii) is compared with a sparse solve of the assembled matrix, from a compressed
    state.
    """
    scene = hanging(steps=1, newton="one_step", robust="regularised", tolerance=1e-9)
    mesh, law = scene.mesh, scene.law
    x = np.array(mesh.points) * np.array([1.0, 1.0, 0.7])
    mass = scene.body.density * np.asarray(lj.boundary.nodal_volumes(mesh))
    load = mass[:, None] * np.asarray(scene.body.gravity) - np.asarray(lj.mjed.internal_force(mesh, law, jnp.array(x)))
    K = lj.mjed.stiffness_matrix(mesh, law, jnp.array(x), regularised=True).tocsr()
    free = np.setdiff1d(np.arange(len(x)), np.asarray(scene.fixed[0].nodes))
    degrees = (3 * free[:, None] + np.arange(3)).ravel()
    expected = x.copy()
    expected[free] += scipy.sparse.linalg.spsolve(K[degrees][:, degrees].tocsc(), load[free].ravel()).reshape(-1, 3)
    found = lj.simulate(scene, start=jnp.array(x)).positions[0]
    # Fixed nodes are at their reference positions, as the bottom is in both.
    assert np.abs(np.asarray(found) - expected).max() < 1e-7 * np.abs(expected - x).max()
    plain = lj.simulate(replace(scene, solve=replace(scene.solve, robust="off")), start=jnp.array(x)).positions[0]
    assert np.abs(np.asarray(plain) - expected).max() > 1e-3 * np.abs(expected - x).max()


def test_a_sweep_reports_a_failure_rather_than_one_step():
    """The code of one step is the largest code, so it hid steps that were not finite."""
    rows = SimpleNamespace(numbers=np.array([3, 5, 7]))
    codes = np.array([[8, 2, 8], [0, 8, 0], [0, 0, 0]])
    assert _failures(rows, codes) == {3: status.NOT_FINITE, 5: status.ONE_STEP}


@pytest.mark.ci
def test_a_dynamic_step_of_one_solve_has_the_loads_and_motions_at_its_end():
    """They acted one step late. The motions are small, so one solve is exact."""
    scene, times = hanging(kind="dynamic", dt=0.01, steps=2, newton="one_step"), jnp.array([0.0, 0.02])
    side = lj.boundary.boundary_triangles(scene.mesh, scene.mesh.node_sets["x_max"])
    wall = ElasticSupport(triangles=side, normal=1e4, times=times, history=jnp.array([[0.0, 0, 0], [1e-7, 0, 0]]))
    pull = lj.Traction(triangles=side, value=jnp.array([0.0, 1e-3, 0.0]), times=times, history=jnp.array([0.0, 1.0]))
    still = replace(scene.body, gravity=jnp.zeros(3))
    run = lj.simulate(replace(scene, body=still, physics=(wall,), traction=(pull,)))
    assert np.all(np.abs(np.asarray(run.positions[0] - scene.mesh.points)).max(axis=0)[:2] > 1e-9)
    assert np.asarray(run.statistics.residual).max() < 1e-3


def test_the_most_severe_code_is_not_the_largest(monkeypatch):
    """The largest code of a fit's run was reported, so one step hid steps that were not finite or that stalled."""
    codes = np.array([[8, 1, 0], [5, 2, 4], [0, 8, 0], [0, 0, 0]])
    expected = [status.STALLED, status.NOT_FINITE, status.ONE_STEP, status.CONVERGED]
    assert jax.jit(lambda c: status.most_severe(c, axis=1))(codes).tolist() == expected
    assert sorted(status.SEVERITY) == sorted(status.ADVICE)
    run = SimpleNamespace(status=jnp.array([8, 2]), positions=None)
    monkeypatch.setattr(scene_numbers.lj, "simulate", lambda scene, store: run)
    monkeypatch.setattr(scene_numbers, "weighted_differences", lambda *_: jnp.zeros(1))
    problem = scene_numbers.Problem((hanging(),), (None,))
    assert scene_numbers.misfit(problem, {})[1].tolist() == [status.NOT_FINITE]
