"""Agreement of the comparison solvers in experiments with the package: a wrong rival would prove nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from experiments.benchmarks.baselines import corotational, critical_step, explicit, linear, precomputed
from experiments.chapter import assembly_rivals
from experiments.pages import equal_error
from liverjax.core.struct import replace

pytestmark = pytest.mark.quick_to_compile


def _bar(gravity: float = 0.05, **solve) -> lj.Scene:
    """A clamped bar of 72 tetrahedra that starts to sag under a small weight, by 0.1 % of its length."""
    mesh = lj.shapes.box((0.03, 0.02, 0.02), (3, 2, 2))
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=770.0, bulk=2000.0, volumetric="simo"),
        body=lj.Body(density=1060.0, gravity=jnp.array([0.0, 0.0, -gravity])),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        solve=lj.Solve(kind="dynamic", tolerance=1e-9, **solve),
    )


def _moved(scene: lj.Scene, x: jax.Array) -> np.ndarray:
    return np.asarray(x) - np.asarray(scene.mesh.points)


@pytest.mark.slow
@pytest.mark.parametrize("prony", [None, lj.Prony(ratios=jnp.array([0.5]), relaxation_times=jnp.array([0.01]))])
def test_explicit_dynamics_agrees_with_newmark(prony):
    """Both are of second order, so their difference falls by a factor of four if the step is halved."""
    seconds, apart = 0.06, []
    for steps in (100, 200):
        dt = seconds / steps
        scene = replace(_bar(dt=dt, steps=steps, integrator="newmark", newton_iterations=25), viscosity=prony)
        ours = _moved(scene, lj.simulate(scene).check().positions[-1])
        theirs = _moved(scene, explicit(scene, dt, steps, steps)[-1])
        apart.append(np.abs(ours - theirs).max() / np.abs(ours).max())
    assert apart[1] < 2e-2
    assert np.log2(apart[0] / apart[1]) == pytest.approx(2, abs=0.3)


@pytest.mark.slow
def test_explicit_dynamics_is_stable_just_below_its_critical_step():
    """With 1.1 times the critical step, the displacement grows without bound."""
    scene = _bar(dt=1.0)
    limit = float(critical_step(scene))
    below, above = (_moved(scene, explicit(scene, f * limit, 400, 400)[-1]) for f in (0.95, 1.1))
    assert np.abs(below).max() < 1e-3
    assert not np.abs(above).max() < 1.0


BODIES = {
    "corotational": lambda scene: corotational(scene, 0.02, 5),
    "linear": lambda scene: linear(scene, precomputed(scene, 0.02), 0.02, 5),
}


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["euler", "newmark"])
@pytest.mark.parametrize("body", BODIES)
def test_linear_bodies_agree_with_ours_where_strains_are_small(body, integrator):
    """All use the same steps. Their differences are of second order in the strain."""
    apart = []
    for gravity in (0.05, 0.1):
        scene = _bar(gravity, dt=0.02, steps=5, integrator=integrator)
        ours = _moved(scene, lj.simulate(scene).check().positions[-1])
        apart.append(np.abs(ours - _moved(scene, BODIES[body](scene)[-1])).max())
    assert apart[1] < 2e-2 * np.abs(ours).max()
    assert np.log2(apart[1] / apart[0]) == pytest.approx(2, abs=0.3)


@pytest.mark.ci
@pytest.mark.parametrize("name", [pytest.param("mooney_rivlin", marks=pytest.mark.slow), "arruda_boyce"])
@pytest.mark.parametrize(
    "way", [*(pytest.param(way, marks=pytest.mark.slow) for way in ("chapter", "standard")), "autodiff"]
)
def test_rivals_of_the_assembly_are_right_with_and_without_their_parts_written(way, name):
    """The sums have some hundred products that cancel to a few digits. The bound is 1e-12 of the Hessian's largest
    entry.
    """
    mesh, law = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1)), lj.laws.typical(name)
    x = mesh.points + 0.05 * jnp.asarray(np.random.default_rng(0).standard_normal(mesh.points.shape))
    force, hessians = assembly_rivals.vmapped(mesh, law, x)
    exact = np.stack(assembly_rivals.entries_of(hessians))
    for write in (False, True):
        f, K = getattr(assembly_rivals, way)(mesh, law, x, write=write)
        assert np.abs(np.stack(K) - exact).max() < 1e-12 * np.abs(exact).max()
        assert np.abs(f - force).max() < 1e-12 * np.abs(force).max()


def test_the_run_time_at_an_error_lies_between_two_runs():
    """For order 2 and a run time proportional to the steps, the interpolation between two runs is exact."""
    runs = [{"dt": dt, "error": 4 * dt**2, "run_s": 0.3 / dt} for dt in (0.3, 0.1, 0.01)]
    dt, seconds = equal_error.at_error([{"dt": 0.6, "error": None, "run_s": 1.0}, *runs], 0.01)
    assert dt == pytest.approx(0.05) and seconds == pytest.approx(6.0)
    assert equal_error.at_error(runs, 1.0) == (0.3, 1.0)
    assert equal_error.at_error(runs, 1e-5) is None
