"""Error of simulated tests due to their time steps: the estimate against runs with many small steps, and in fits."""

import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from fitting.fits import field, joint, scene_numbers
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.displacements import Displacements
from fitting.rigs import glued
from fitting.rigs.time_steps import change_with_small_steps, order_of_steps
from liverjax.core.struct import replace
from liverjax.physics.rigid_plate import RigidPlate
from liverjax.solvers.problem import StepStatistics

pytestmark = pytest.mark.quick_to_compile


def block(dt: float, steps: int, scheme: str = "exponential", rise: float | None = 0.2, **solve) -> lj.Scene:
    """A viscous block that is pulled by a traction. It rises for 0.2 s; with `rise` None it has no history."""
    mesh = lj.shapes.box((0.02, 0.02, 0.02), (1, 1, 1))
    top = lj.boundary.boundary_triangles(mesh, np.asarray(mesh.node_sets["z_max"]))
    rises = {} if rise is None else {"times": jnp.array([0.0, rise, 9.0]), "history": jnp.array([0.0, 1.0, 1.0])}
    prony = lj.Prony(ratios=jnp.array([0.5]), relaxation_times=jnp.array([0.3]), scheme=scheme)
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=800.0, bulk=2000.0),
        viscosity=prony,
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        traction=(lj.Traction(triangles=top, value=jnp.array([0.0, 0.0, 60.0]), **rises),),
        body=lj.Body(density=1000.0, gravity=jnp.zeros(3)),
        solve=lj.Solve(dt=dt, steps=steps, **solve),
    )


def tops(run: lj.Result) -> jnp.ndarray:
    return run.positions[:, -1, 2]


WAVE = {"kind": "dynamic", "rise": 0.02}


@pytest.mark.ci
@pytest.mark.parametrize(
    ("dt", "options", "order"),
    [
        (0.1, {}, 2),
        # with order 2, the estimate was two thirds of the change
        pytest.param(0.1, {"rise": None}, 1, marks=pytest.mark.slow),
        pytest.param(0.1, {"scheme": "backward_euler"}, 1, marks=pytest.mark.slow),
        pytest.param(0.002, WAVE, 1, marks=pytest.mark.slow),
        pytest.param(0.004, WAVE | {"integrator": "newmark"}, 2, marks=pytest.mark.slow),
    ],
)
def test_the_estimate_is_the_change_with_many_small_steps(dt, options, order):
    scene = block(dt, 6, **options)
    assert order_of_steps(scene) == order
    found = change_with_small_steps(scene, tops)
    fine = lj.simulate(block(dt / 16, 6 * 16, **options)).check().positions[15::16, -1, 2]
    true = np.asarray(fine) - np.asarray(tops(lj.simulate(scene)))
    assert np.abs(true).max() > 1e-7  # of a displacement of 1 mm
    assert np.linalg.norm(found - true) < 0.35 * np.linalg.norm(true)


def test_a_constant_load_has_an_error_of_first_order():
    assert order_of_steps(block(0.1, 6, rise=None)) == 1
    unloaded = replace(block(0.1, 6, rise=None), traction=())
    # Loads and motions whose history begins at once had order 2.
    nodes, times = unloaded.mesh.node_sets["z_max"], jnp.array([0.0, 9.0])
    for begin, order in ((1.0, 1), (0.0, 2)):
        loaded = block(0.1, 6)
        own = replace(loaded.traction[0], times=times, history=jnp.array([begin, 1.0]))
        moved = lj.Displaced(nodes=nodes, times=times, history=1e-4 * jnp.array([[0, 0, begin], [0, 0, 1.0]]))
        plate = RigidPlate(nodes=nodes, times=times, turn=1e-2 * own.history)
        assert order_of_steps(replace(loaded, traction=(own,))) == order
        assert order_of_steps(replace(unloaded, displaced=(moved,))) == order
        assert order_of_steps(replace(unloaded, physics=(plate,))) == order
    assert order_of_steps(unloaded) == order_of_steps(replace(block(0.1, 6, rise=None), viscosity=None)) == 2


def test_readings_may_use_every_field_of_a_run(monkeypatch):
    """Only positions and reactions of the fine run were those at the ends of the coarse steps."""

    def simulated(scene):
        steps, of_steps = scene.solve.steps, np.zeros(scene.solve.steps, int)
        times, moved = scene.solve.dt * np.arange(1, steps + 1), np.zeros((steps, 1, 3))
        statistics = StepStatistics(*[of_steps] * len(StepStatistics._fields))
        parts = {"positions": moved, "reactions": moved, "pressure": np.exp(-times)[:, None]}
        return lj.Result(times=times, status=of_steps, statistics=statistics, **parts)

    monkeypatch.setattr(lj, "simulate", simulated)
    found = change_with_small_steps(block(0.1, 2), lambda run: run.times + run.pressure.max(axis=1))
    assert np.array_equal(found, np.zeros(2))  # the pressure is exact at the ends of all steps


def test_a_run_that_fails_gives_no_estimate():
    scene = block(0.1, 6)
    pulled = replace(scene, traction=tuple(replace(t, value=-1e9 * t.value) for t in scene.traction))
    assert np.all(np.isnan(change_with_small_steps(pulled, tops)))


def with_fine_data(sd: float) -> scene_numbers.Problem:
    """The block in 12 steps, and exact displacements of its top from steps of 1/32."""
    coarse, n = block(0.05, 12, "backward_euler"), 12
    fine = lj.simulate(block(0.05 / 32, 12 * 32, "backward_euler")).check().positions[31::32]
    nodes = np.asarray(coarse.mesh.node_sets["z_max"])
    moved = np.asarray(fine - coarse.mesh.points[None])[:, nodes]
    data = Displacements(
        step=np.repeat(np.arange(n), len(nodes)),
        nodes=np.tile(nodes[:, None], (n, 4)),
        weights=np.tile([[1.0, 0.0, 0.0, 0.0]], (n * len(nodes), 1)),
        measured=moved.reshape(-1, 3),
        sd=np.full((n * len(nodes), 3), sd),
    )
    return scene_numbers.Problem((coarse,), (data,))


@pytest.mark.slow
def test_a_map_states_what_its_time_step_does_to_it():
    """The truth is uniform, and the data come from the same mesh. Without its bias, the map is closer to the truth."""
    problem = with_fine_data(2e-5)
    found = field.estimate(problem, length=0.03, max_iterations=20, modes=5)
    off, left = (np.sqrt(np.mean(m**2)) for m in (found.log_factor, found.log_factor - found.time_step_bias))
    assert off > 0.01 and left < 0.5 * off, (off, left)
    noisy, sizes = scene_numbers.with_discretisation_as_noise(problem)
    true = np.sqrt(np.mean(np.asarray(scene_numbers.misfit(problem, {})[0]) ** 2))
    assert true > 0.1 and abs(sizes[0]["time_step"] - true) < 0.35 * true, (sizes, true)
    error = np.sqrt(sum(size**2 for size in sizes[0].values()))
    np.testing.assert_allclose(noisy.data[0].sd, 2e-5 * np.hypot(1.0, error), rtol=1e-12)


@pytest.mark.slow
def test_a_run_that_fails_is_no_noise():
    """Its mesh error counted as noise, and the data of this scene lost their weight."""
    (scene,), data = with_fine_data(2e-5)
    pulled = replace(scene, traction=tuple(replace(t, value=-1e9 * t.value) for t in scene.traction))
    with pytest.warns(UserWarning, match="the effect of the ") as told:
        same, sizes = scene_numbers.with_discretisation_as_noise(scene_numbers.Problem((pulled,), data))
    assert [str(w.message).split(" on ")[0] for w in told] == [
        "the effect of the mesh error",
        "the effect of the time step",
    ]
    assert sizes == [{}] and np.array_equal(same.data[0].sd, data[0].sd)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the error of the mesh changes")
def test_a_fit_states_what_its_time_step_does_to_the_numbers():
    """The data come from steps of 1/32. Ratio and relaxation time are wrong by more than their standard errors, as
    stated, and a third remains after correction."""
    names = ["viscosity.ratios", "viscosity.relaxation_times"]
    with pytest.warns(UserWarning, match="the error of the time step changes "):
        found = scene_numbers.fit_numbers(with_fine_data(1e-6), names)
    off = found.values - [0.5, 0.3]
    assert np.all(np.abs(off) > 3 * found.standard_errors)
    assert np.all(np.abs(off - found.time_step_bias) < 0.5 * np.abs(off)), (off, found.time_step_bias)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the error of the ")
def test_a_rig_states_what_its_time_step_does_to_the_numbers():
    model = Maxwell(jnp.asarray(800.0), jnp.array([0.4]), jnp.array([0.6]))
    law = lj.laws.NeoHookean(mu=1.0, bulk=20.0)
    viscosity = lj.Prony(ratios=model.ratios, relaxation_times=model.relaxation_times)
    rig = glued.creep(0.01, 0.01, 1.0, 5, 20.0, 0.004)
    fine = glued.creep(0.01, 0.01, 1.0 / 16, 80, 20.0, 0.004)
    rise = {"times": jnp.array([0.0, 1.0, 99.0]), "history": jnp.array([0.0, 1.0, 1.0])}
    scene = replace(fine.scene, traction=tuple(replace(pull, **rise) for pull in fine.scene.traction))
    readings = np.asarray(glued.read(replace(fine, scene=scene), lj.laws.scaled(law, 800.0), viscosity)[0])[15::16]
    found = joint.fit([joint.through("creep", rig, readings, 1e-3 * readings[-1])], model, law)
    off = found.values - np.array([800.0, 0.4, 0.6])
    assert np.all(np.abs(off - found.time_step_bias) < 0.5 * np.abs(off)), (off, found.time_step_bias)
