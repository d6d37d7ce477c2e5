"""Reduced models: the full model in other coordinates, their structure, their error, and unsupported scenes."""

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import every_motion, moves_as_full

import liverjax as lj
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.reduced import estimate, training
from liverjax.reduced.correction import Learnt, learnt_correction, stated_at
from liverjax.reduced.model import (
    as_matrix,
    refuse_unknown_physics,
    refuse_unseen_numbers,
    solid_at_points,
    with_all_points,
)
from liverjax.reduced.sampling import Coordinates, sampled

pytestmark = pytest.mark.quick_to_compile

PRONY = lj.Prony(ratios=jnp.array([0.3, 0.2]), relaxation_times=jnp.array([0.3, 0.03]))
MOVING = lj.Solve(kind="dynamic", integrator="newmark", dt=0.05, steps=3)


def _bar(cells: tuple, order: int = 1, **changes) -> lj.Scene:
    """A bar of 3 x 1 x 1 cm fixed at x = 0 under its weight."""
    mesh = lj.shapes.box([0.03, 0.01, 0.01], list(cells))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    held = jnp.asarray(lj.boundary.select(mesh, {"x_max": 0.0}, None, "fixed"))
    law = lj.laws.NeoHookean(mu=800.0, bulk=3000.0)
    body = lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -1.0]))
    return lj.Scene(mesh=mesh, law=law, fixed=(lj.Fixed(nodes=held),), body=body, **changes)


@pytest.mark.slow
def test_the_error_of_a_body_that_is_about_to_buckle():
    """The stiffness of the shape at rest gave an error of 0.2 %, where the true error was 4 %."""
    mesh = lj.shapes.box([0.1, 0.02, 0.02], [6, 1, 1])
    faces = lj.boundary.boundary_triangles(mesh, mesh.node_sets["x_max"])
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=750.0, bulk=2200.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        traction=(lj.Traction(triangles=faces, value=jnp.array([-45.0, 0.0, -0.2])),),
        solve=lj.Solve(steps=4),
    )
    model = lj.reduce_scene(scene, {"traction.0.value.0": np.linspace(-45, 0, 8)}, 1e-4)
    pressed = lj.with_parameters(scene, {"traction.0.value.0": -55.0})
    run = lj.simulate_reduced(model, pressed)
    away = np.asarray(lj.reduced_positions(model, pressed, run) - lj.simulate(pressed).check().positions)
    true = np.linalg.norm(away, axis=-1).max()
    assert 0.5 < float(lj.reduced_error(model, pressed, run).error.max()) / true < 2


@pytest.mark.parametrize("factor", [np.nan, 0.0, -1.0])
def test_a_reduced_run_that_failed_has_no_small_error(factor):
    """The deformed body may have no stiffness that can be factorised."""
    scene, r = _bar((3, 1, 1)), np.ones((16, 3))
    assert estimate._softening(scene, r, factor * scene.mesh.points) == np.inf


@pytest.mark.ci
def test_a_reduced_step_that_stalled_is_not_called_inverted():
    """The code of inverted elements says that equilibrium was reached, and was given without equilibrium too."""
    scene = _bar((1, 1, 1), solve=lj.Solve(newton_iterations=2))
    scene = replace(scene, body=lj.Body(density=1000.0, gravity=jnp.array([-2000.0, 0.0, 500.0])))
    model = with_all_points(scene, every_motion(scene))
    found = lj.simulate_reduced(model, scene)
    F = jnp.eye(3).reshape(9, 1) + model.slopes @ found.coordinates[0]
    assert np.linalg.det(np.moveaxis(np.asarray(F).reshape(3, 3, -1), -1, 0)).min() < 0
    assert float(found.residual[0]) > scene.solve.tolerance and found.status.tolist() == [status.STALLED]


@pytest.mark.ci
def test_failed_training_runs_are_told():
    scene = _bar((3, 1, 1), solve=lj.Solve(newton_iterations=8))
    with pytest.warns(UserWarning, match=r"1 of 3 training runs failed .*body.gravity.2 = -300"):
        lj.reduce_scene(scene, {"body.gravity.2": [-0.1, -0.2, -300.0]})


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_all_motions_and_all_points_are_the_full_model(order):
    # The reduced model computes the same numbers in another way: dense matrices, memory and inertia of coordinates.
    scene = _bar((1, 1, 1), order, viscosity=PRONY, solve=MOVING)
    moves_as_full(scene)


@pytest.mark.slow
def test_prescribed_motion_and_histories_are_those_of_the_full_model():
    scene = _bar((1, 1, 1), viscosity=PRONY, solve=lj.Solve(dt=0.1, steps=2))
    end = jnp.asarray(lj.boundary.select(scene.mesh, {"x_min": 0.03}, None, "displaced"))
    body = replace(scene.body, times=jnp.array([0.0, 0.2]), history=jnp.array([1.0, 0.5]))
    scene = replace(scene, displaced=(lj.Displaced(nodes=end[:2], by=jnp.array([0.004, 0.0, 0.002])),), body=body)
    model = with_all_points(scene, every_motion(scene))
    x = lj.reduced_positions(model, scene, lj.simulate_reduced(model, scene))
    assert np.abs(x - lj.simulate(scene).check().positions).max() < 1e-5 * 0.004


def test_a_reduced_run_needs_the_time_and_the_mass_of_the_full_run():
    """Without a time step, a history counted as its value at time 0, and without a mass the body had no inertia."""
    still = replace(_bar((1, 1, 1), solve=lj.Solve(steps=3)), body=None)
    end = jnp.asarray(lj.boundary.select(still.mesh, {"x_min": 0.03}, None, "displaced"))
    moved = lj.Displaced(nodes=end, by=jnp.array([0.01, 0.0, 0.0]))
    given = replace(moved, times=jnp.arange(4.0), history=jnp.array([0.0, 1.0, 2.0, 3.0]))
    for scene, changes, words in (
        (replace(still, displaced=(moved,)), {"displaced": (given,)}, "has no dt, which a history needs"),
        (_bar((1, 1, 1), solve=MOVING), {"body": None}, "kind = 'dynamic' needs mass"),
    ):
        model = with_all_points(scene, every_motion(scene))
        with pytest.raises(lj.InputError, match=words):
            lj.simulate_reduced(model, replace(scene, **changes))


@pytest.mark.slow
def test_a_body_that_is_only_moved_converges():
    # Without a load the forces of the points cancel at the solution, so their sum is no scale for a comparison.
    scene = replace(_bar((2, 1, 1)), body=None)
    end = jnp.asarray(lj.boundary.select(scene.mesh, {"x_min": 0.03}, None, "displaced"))
    scene = replace(scene, displaced=(lj.Displaced(nodes=end, by=jnp.array([0.003, 0.0, 0.002])),))
    model = with_all_points(scene, every_motion(scene))
    found = lj.simulate_reduced(model, scene)
    assert not np.any(found.status) and np.all(found.iterations < 25)
    x = lj.reduced_positions(model, scene, found)
    assert np.abs(x - lj.simulate(scene).check().positions).max() < 1e-5 * 0.003


#: Values between and beyond those of the training.
UNSEEN = {"law.mu": [850.0, 640.0], "body.gravity": [[0.5, -1.0, -4.0], [0.0, 3.0, 2.0]]}


@pytest.fixture(scope="module")
def trained() -> tuple:
    """A viscous bar in motion, its reduced model of few runs, and positions of full runs with other values."""
    scene = _bar((4, 1, 1), viscosity=PRONY, solve=MOVING)
    rng = np.random.default_rng(1)
    down = rng.uniform(-5.0, -2.0, 8)
    gravity = np.stack([rng.uniform(-2, 2, 8), rng.uniform(-2, 2, 8), down], axis=1)
    rows = {"law.mu": rng.uniform(700.0, 1000.0, 8), "body.gravity": gravity}
    # Full runs with other values are in the batch of the training, so they share its program.
    numbers = {name: np.concatenate([value, UNSEEN[name]]) for name, value in rows.items()}
    batch = lj.simulate_batch(scene, numbers)
    with pytest.MonkeyPatch.context() as patch:
        first = replace(batch, result=jax.tree.map(lambda a: a[:8], batch.result))
        patch.setattr(training, "simulate_batch", lambda *_: first)
        model = lj.reduce_scene(scene, rows, most_modes=5, point_tolerance=1e-3)
    assert not np.any(batch.result.status)
    return scene, model, batch.result.positions[8:]


@pytest.mark.ci
def test_the_reduced_force_is_the_gradient_of_the_reduced_energy(trained):
    scene, model, *_ = trained
    assert np.all(np.asarray(model.weights) > 0) and len(model.points) < scene.mesh.weights.size
    # One row of the least squares keeps the volume.
    assert float(model.weights.sum()) == pytest.approx(float(scene.mesh.volumes.sum()), rel=1e-6)
    law = solid_at_points(model, scene).law
    rest = jnp.eye(3).reshape(9, 1)

    def energy(q):
        F = as_matrix(rest + model.slopes @ q)
        return jnp.sum(model.weights * law.strain_energy(law.measures(F)))

    # A static step with only this force ends at q, so the force of the run is the derivative of this energy.
    static = replace(scene, viscosity=None, solve=lj.Solve())
    own = replace(model, identity=lj.reduced_identity(static))
    q = lj.simulate_reduced(own, static).coordinates[-1]
    load = jnp.tensordot(model.modes, jnp.asarray(_weight(static)), axes=2)
    assert np.allclose(jax.grad(energy)(q), load, rtol=0, atol=1e-8 * np.linalg.norm(load))


def _weight(scene: lj.Scene) -> np.ndarray:
    per_node = np.zeros(len(scene.mesh.points))
    np.add.at(per_node, np.asarray(scene.mesh.tetrahedra), np.asarray(scene.mesh.volumes)[:, None] / 4)
    return 1000.0 * per_node[:, None] * np.asarray(scene.body.gravity)


@pytest.mark.ci
def test_a_state_that_is_inside_out_or_at_rest_has_no_say_in_the_points(trained):
    scene, model, *_ = trained
    whole, mu = with_all_points(scene, model.modes), 800.0
    q = lj.simulate_reduced(model, scene).coordinates
    # Mirrored elements, for which this law has no force, and a body that has not moved.
    bad = jnp.stack([jnp.zeros_like(q[0]), -1e3 * q[1], 1e3 * q[2]])
    alone = sampled(whole, scene, {"law.mu": np.array([mu])}, Coordinates(q[None], None), 1e-3)
    both = Coordinates(jnp.stack([q, bad]), None)
    beside = sampled(whole, scene, {"law.mu": np.array([mu, mu])}, both, 1e-3)
    assert len(alone.points) > 1
    assert np.array_equal(alone.points, beside.points) and np.allclose(alone.weights, beside.weights, rtol=1e-9)


def test_the_error_is_stated(trained):
    scene, model, truths = trained
    bare = replace(model, correction=None)
    for k, (mu, full) in enumerate(zip(UNSEEN["law.mu"], truths, strict=True)):
        own = lj.with_parameters(scene, {name: value[k] for name, value in UNSEEN.items()})
        for m in (bare, model):
            found = lj.simulate_reduced(m, own)
            error = lj.reduced_error(m, own, found).error
            true = np.linalg.norm(lj.reduced_positions(m, own, found) - full, axis=-1).max(axis=1)
            assert true.max() > 1e-6  # five modes are not exact, so there is an error
            assert np.all(true < 2 * error)
            # The second run is far outside the training range, where the correction is wrong. Its error may be
            # overestimated.
            assert np.all(error < (2 if m is bare or mu == 850.0 else 5) * true)


def _missing(q: np.ndarray, fields: np.ndarray) -> np.ndarray:
    """Return a polynomial of degree two in coordinates and their rates, dt = 0.1."""
    rates = np.diff(q, axis=1, prepend=0.0) / 0.1
    parts = np.stack([0.3 * q[..., 0] - 0.1 * q[..., 2], 2.0 * q[..., 0] * q[..., 1] - 0.01 * rates[..., 1]], axis=-1)
    return np.tensordot(parts, fields, axes=1)


@pytest.mark.ci
def test_a_body_at_rest_converges_and_has_no_error_to_state(trained):
    scene, model, *_ = trained
    still = lj.with_parameters(scene, {"body.gravity": jnp.zeros(3)})
    found = lj.simulate_reduced(model, still)
    # Without loads, only rounding of the forces remains.
    assert not np.any(found.status) and np.all(found.iterations < 5)
    rng = np.random.default_rng(6)
    q, fields = rng.normal(size=(20, 4, 3)), rng.normal(size=(2, 7, 3))
    learnt = learnt_correction(Learnt(q, _missing(q, fields), np.ones(20), np.ones(7), 0.1))

    def stated(size):
        return jnp.sum(stated_at(learnt, size * q[0], jnp.zeros((4, 7, 3)), 0.1))

    assert stated(0.0) == 0 and jax.grad(stated)(0.0) == 0


@pytest.mark.ci
def test_a_model_of_the_first_rows_is_kept_if_all_later_runs_fail(monkeypatch):
    """The four runs that converged were lost, with the message that none of the 2 runs converged."""
    monkeypatch.setattr(training, "_model_of", lambda scene, runs, *settings: runs)
    monkeypatch.setattr(training, "_errors_of_rows", lambda model, scene, rows: np.arange(4.0))
    scene = _bar((3, 1, 1), solve=lj.Solve(newton_iterations=8))
    g = [-0.1, -0.2, -0.15, -0.25, -300.0, -310.0, -320.0, -330.0]
    with pytest.warns(UserWarning, match="2 of 2 training runs failed"):
        runs = lj.reduce_scene(scene, {"body.gravity.2": g}, runs=6)
    assert runs.values["body.gravity.2"].tolist() == g[:4] and len(runs.u) == 4


def test_rows_with_other_meshes_are_refused():
    """The modes were computed from positions minus the positions of another mesh."""
    scene = _bar((3, 1, 1))
    points = np.asarray(scene.mesh.points)
    with pytest.raises(lj.InputError, match=r"remove the column mesh\.points"):
        lj.reduce_scene(scene, {"mesh.points": np.stack([points, 1.1 * points])})


@pytest.mark.slow
def test_rows_of_the_largest_stated_errors_are_run():
    """Some parameter sets are close to each other, others are far away. The far ones are run, so their range is
    known.
    """
    scene = _bar((3, 1, 1), solve=lj.Solve(steps=2))
    rng = np.random.default_rng(5)
    near = np.stack([np.zeros(20), np.zeros(20), rng.uniform(-1.0, -0.5, 20)], axis=1)
    far = np.stack([np.zeros(6), rng.uniform(3.0, 4.0, 6), np.zeros(6)], axis=1)
    rows = {"body.gravity": np.concatenate([near[:8], near[8:], far])}
    model = lj.reduce_scene(scene, rows, most_modes=4, runs=12)
    low, high = np.asarray(model.ranges["body.gravity"])
    assert high[1] > 3.0 and low[2] < -0.5


@pytest.mark.slow
def test_the_bias_of_identified_numbers_is_stated(trained):
    """The data are a full run with known parameters. The reduced model fits them, and one more full run gives
    the bias.
    """
    scene, model, *_ = trained
    model, true = replace(model, correction=None), np.array([800.0, 0.35])
    names = ("law.mu", "viscosity.ratios.0")

    def positions(numbers):
        own = lj.with_parameters(scene, dict(zip(names, numbers, strict=True)))
        return lj.reduced_positions(model, own, lj.simulate_reduced(model, own))

    data = lj.simulate(lj.with_parameters(scene, dict(zip(names, true, strict=True)))).check().positions
    both = jax.jit(lambda p: (positions(p), jax.jacfwd(positions)(p)))
    p = jnp.asarray(true * [1.1, 0.9])
    for _ in range(6):
        x, J = both(p)
        p = p - jnp.linalg.lstsq(J.reshape(-1, 2) * jnp.asarray(true)[None], jnp.ravel(x - data))[0] * true
    bias = lj.reduced_bias(model, scene, dict(zip(names, p, strict=True)), lambda x: x)
    off = np.asarray(p) - true
    assert np.all(np.abs(off) > 1e-3 * true)  # five modes are too stiff, so there is a bias
    assert np.all(np.abs(off - [float(bias[name]) for name in names]) < 0.2 * np.abs(off))


@pytest.mark.slow
def test_derivatives_and_lanes(trained):
    scene, model, *_ = trained
    scene = replace(scene, solve=replace(scene.solve, tolerance=1e-11))  # differences of runs need exact runs

    def tip(mu):
        own = lj.with_parameters(scene, {"law.mu": mu, "viscosity.ratios.0": mu / 3000.0})
        return lj.reduced_positions(model, own, lj.simulate_reduced(model, own))[-1, -1, 2]

    found = jax.grad(tip)(800.0)
    assert found == pytest.approx(float(jax.jacfwd(tip)(800.0)), rel=1e-10)
    steps = 800.0 * 10.0 ** -np.arange(1, 8)
    lanes = jax.jit(jax.vmap(tip))(jnp.concatenate([800.0 + steps, 800.0 - steps]))
    errors = np.abs((lanes[:7] - lanes[7:]) / (2 * steps) / found - 1)
    # Second order, then the run's tolerance: the curve falls and rises.
    assert errors.min() < 1e-7 and errors[0] > 1e3 * errors.min() and errors[-1] > errors.min()
    second = (jax.grad(tip)(800.1) - jax.grad(tip)(799.9)) / 0.2
    assert jax.hessian(tip)(800.0) == pytest.approx(float(second), rel=1e-5)


def test_errors_are_not_stated_for_numbers_that_no_row_has_shown(trained, tmp_path):
    """Under a load along another axis, the stated error was a hundredth of the true one."""
    scene, model, *_ = trained
    q, V = np.random.default_rng(6).normal(size=(12, 6, 3)), len(scene.mesh.points)
    fields = np.ones((2, V, 3)) * np.arange(2)[:, None, None]
    learnt = learnt_correction(Learnt(q, _missing(q, fields), np.ones(12), np.ones(V), 0.1))
    lj.save_reduced(replace(model, correction=learnt), tmp_path / "model.h5")
    model = lj.load_reduced(tmp_path / "model.h5")
    low, high = (float(bound) for bound in model.ranges["law.mu"])
    inside = {"body.gravity": np.mean(model.ranges["body.gravity"], axis=0)}
    for value in (high + 0.09 * (high - low), low - 0.09 * (high - low)):
        refuse_unseen_numbers(model, lj.with_parameters(scene, inside | {"law.mu": value}))

    def refused(numbers: dict, sentence: str) -> None:
        with pytest.raises(lj.InputError, match=sentence):
            lj.stated_error(model, lj.with_parameters(scene, inside | numbers), None)

    for value in (high + 0.11 * (high - low), low - 0.11 * (high - low)):
        refused(
            {"law.mu": value},
            "law.mu = .* is outside the training range .* by more than 10% of its width.* use lj.reduced_error",
        )
    refused({"body.gravity": np.array([0.0, 9.0, -3.0])}, "body.gravity = .* is outside the training range")
    refused({"body.density": 2000.0}, "body.density differs from the training")
    refused({"viscosity.relaxation_times": 0.1 + PRONY.relaxation_times}, "relaxation_times differs from the training")
    own = lj.with_parameters(scene, inside)
    for changed, sentence in (
        ({"integrator": "euler"}, "solve.integrator = euler, but the reduced model was trained with newmark"),
        ({"steps": 2 * scene.solve.steps}, "solve.dt x solve.steps = .* so the error of the model is unknown"),
    ):
        with pytest.raises(lj.InputError, match=sentence):
            lj.stated_error(model, replace(own, solve=replace(own.solve, **changed)), None)
    refuse_unseen_numbers(model, replace(own, solve=replace(own.solve, dt=0.5 * own.solve.dt)))
    with pytest.raises(lj.InputError, match="remove the column solve"):
        lj.reduce_scene(scene, {"solve.dt": [0.01, 0.02]})
    # Traced values are unknown.
    jax.eval_shape(lambda dt: refuse_unseen_numbers(model, replace(own, solve=replace(own.solve, dt=dt))), own.solve.dt)
    jax.eval_shape(lambda density: refuse_unseen_numbers(model, _heavier(scene, density)), 2000.0)


def _heavier(scene, density):
    return lj.with_parameters(scene, {"body.density": density})


@pytest.mark.ci
def test_without_the_correction_its_size_is_the_stated_error(trained):
    """If the correction is right, it is the error of the motion without correction."""
    scene, model, *_ = trained
    scene = lj.with_parameters(scene, {name: np.mean(bounds, axis=0) for name, bounds in model.ranges.items()})
    found, V = lj.simulate_reduced(model, scene), len(scene.mesh.points)
    rng = np.random.default_rng(6)
    q, fields = rng.normal(size=(40, 6, model.number_of_modes)), rng.normal(size=(2, V, 3))
    model = replace(model, correction=learnt_correction(Learnt(q, _missing(q, fields), np.ones(40), np.ones(V), 0.1)))
    plain, moved = (lj.reduced_positions(model, scene, found, corrected) for corrected in (False, True))
    assert np.array_equal(plain, lj.reduced_positions(replace(model, correction=None), scene, found))
    farthest = np.linalg.norm(moved - plain, axis=-1).max(axis=1)
    stated = lj.stated_error(model, scene, found, corrected=False)
    assert farthest.max() > 0 and np.allclose(stated, np.maximum.accumulate(farthest), rtol=1e-12)


def test_another_scene_and_other_physics_are_refused(trained, tmp_path):
    scene, model, *_ = trained
    q = np.random.default_rng(6).normal(size=(12, 6, 3))
    V = len(scene.mesh.points)
    fields = np.ones((2, V, 3)) * np.arange(2)[:, None, None]
    model = replace(model, correction=learnt_correction(Learnt(q, _missing(q, fields), np.ones(12), np.ones(V), 0.1)))
    lj.save_reduced(model, tmp_path / "model.h5")
    again = lj.load_reduced(tmp_path / "model.h5")
    assert again.identity == model.identity and np.array_equal(again.slopes, model.slopes)
    assert np.array_equal(again.correction.statement, model.correction.statement)
    assert again.correction.products == model.correction.products
    bare = replace(model, correction=None)
    with pytest.raises(lj.InputError, match="has no correction"):
        lj.stated_error(bare, scene, lj.simulate_reduced(bare, scene))
    with pytest.raises(lj.InputError, match=r"runs = 3 must be from 6 to 9 \(the number of rows\)"):
        lj.reduce_scene(scene, {"law.mu": np.linspace(700, 900, 9)}, runs=3)
    with pytest.raises(lj.InputError, match=r"was made for scene .* run python -m liverjax reduce"):
        lj.simulate_reduced(again, _bar((1, 1, 1)))
    with pytest.raises(lj.InputError, match="was made for scene"):
        porous = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-5)
        lj.simulate_reduced(again, replace(scene, porosity=porous))
    with pytest.raises(lj.InputError, match=r"newton = 'one_step' .* does not work in reduced models"):
        lj.simulate_reduced(again, replace(scene, solve=replace(scene.solve, newton="one_step")))
    with pytest.raises(lj.InputError, match="does not exist: make a reduced model"):
        lj.load_reduced(tmp_path / "none.h5")
    with pytest.raises(lj.InputError, match="between 0 and 1"):
        lj.reduce_scene(scene, {"law.mu": [800.0]}, tolerance=2.0)


def test_foreign_and_damaged_files_are_one_sentence(trained, tmp_path):
    _, model, _ = trained
    (tmp_path / "text.h5").write_text("no HDF5")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["positions"] = np.zeros((2, 3))
    with h5py.File(tmp_path / "groups.h5", "w") as file:
        for name in ("modes", "slopes", "weights", "points"):
            file.create_group(name)
    for name in ("text", "foreign", "groups"):
        with pytest.raises(lj.InputError, match=rf"{name}.h5 is not a reduced model"):
            lj.load_reduced(tmp_path / f"{name}.h5")
    q = np.random.default_rng(6).normal(size=(12, 6, 3))
    fields = np.ones((2, 7, 3)) * np.arange(2)[:, None, None]
    learnt = learnt_correction(Learnt(q, _missing(q, fields), np.ones(12), np.ones(7), 0.1))
    learnt = replace(learnt, fields=jnp.zeros((len(learnt.fields), model.modes.shape[1], 3)))
    whole = replace(model, correction=learnt)
    lj.save_reduced(whole, tmp_path / "whole.h5")
    lj.load_reduced(tmp_path / "whole.h5")
    damaged = {
        "slopes has shape": replace(whole, weights=whole.weights[:-1]),
        "points has shape": replace(whole, points=whole.points[1:]),
        r"ranges of law.mu has shape \(3,\), not \(2,\)": replace(whole, ranges={"law.mu": jnp.ones(3)}),
        "modes has values that are not finite": replace(whole, modes=whole.modes.at[0, 0, 0].set(jnp.nan)),
        "inverse has shape": replace(whole, correction=replace(learnt, inverse=learnt.inverse[1:])),
    }
    for sentence, spoiled in damaged.items():
        lj.save_reduced(spoiled, tmp_path / "spoiled.h5")
        with pytest.raises(lj.InputError, match=rf"spoiled.h5 is damaged: {sentence}"):
            lj.load_reduced(tmp_path / "spoiled.h5")
    # A part of a file, as an interrupted copy leaves it.
    (tmp_path / "short.h5").write_bytes((tmp_path / "whole.h5").read_bytes()[:3000])
    with pytest.raises(lj.InputError, match="is not a reduced model"):
        lj.load_reduced(tmp_path / "short.h5")


@pytest.mark.slow
def test_a_stiff_lesion_is_identified_through_a_reduced_model():
    """The modulus of a region is identified from a full run. One more full run gives the bias of the result."""
    scene = _bar((4, 2, 2), solve=lj.Solve(steps=2))
    middle = np.asarray(scene.mesh.points)[np.asarray(scene.mesh.tetrahedra)].mean(axis=1)
    inside = jnp.asarray(np.flatnonzero(np.abs(middle[:, 0] - 0.01) < 0.005))
    scene = replace(scene, region=(lj.Region(elements=inside, law={"mu": 2000.0}),))
    name, rng, true = "region.0.law.mu", np.random.default_rng(9), 2600.0
    rows = {name: np.linspace(1000.0, 4000.0, 8), "law.mu": rng.uniform(700.0, 900.0, 8)}
    model = replace(lj.reduce_scene(scene, rows, most_modes=3), correction=None)

    def positions(mu):
        own = lj.with_parameters(scene, {name: mu})
        return lj.reduced_positions(model, own, lj.simulate_reduced(model, own))

    data = lj.simulate(lj.with_parameters(scene, {name: true})).check().positions
    both, mu = jax.jit(lambda mu: (positions(mu), jax.jacfwd(positions)(mu))), 1500.0
    for _ in range(12):
        x, J = both(mu)
        mu = mu - float(jnp.vdot(J, x - data) / jnp.vdot(J, J))
    off = mu - true
    bias = float(lj.reduced_bias(model, scene, {name: mu}, lambda x: x)[name])
    assert 1e-4 * true < abs(off) < 0.2 * true
    assert abs(off - bias) < 0.2 * abs(off)


def test_settings_mean_the_same_in_reduced_models():
    """One iteration was accepted, which means one_step. On linear elements "auto" was refused, which means element."""
    scene = _bar((1, 1, 1))
    refuse_unknown_physics(replace(scene, solve=lj.Solve(volumetric="auto")))
    with pytest.raises(lj.InputError, match=r"newton_iterations = 1\) does not work in reduced models"):
        refuse_unknown_physics(replace(scene, solve=lj.Solve(newton_iterations=1)))
