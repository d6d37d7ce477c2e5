"""Which numbers, loads and histories a reduced model was trained for."""

from types import SimpleNamespace

import h5py
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.jobs import reduction
from liverjax.reduced import sampling, training
from liverjax.reduced.files import load_reduced, save_reduced
from liverjax.reduced.model import ReducedModel, other_numbers, parameters_outside, refuse_unseen_numbers
from liverjax.reduced.training import _loads_of_rows, _Runs

pytestmark = pytest.mark.quick_to_compile


def _scene(**changes) -> lj.Scene:
    """A bar of 3 x 1 x 1 cm, held at x = 0, under its weight, a traction and a prescribed motion at x = 3 cm."""
    mesh = lj.shapes.box([0.03, 0.01, 0.01], [3, 1, 1])
    faces = lj.boundary.boundary_triangles(mesh, mesh.node_sets["x_max"])
    body = lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -1.0]))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=800.0, bulk=3000.0),
        body=body,
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["x_max"][:1], by=jnp.array([0.001, 0.0, 0.0])),),
        traction=(lj.Traction(triangles=faces, value=jnp.array([5.0, 0.0, 0.0])),),
        solve=lj.Solve(dt=0.1, steps=2),
    )
    return replace(scene, **changes)


def _with_history(scene: lj.Scene, section: str, history: list) -> lj.Scene:
    """The scene with a history of one of its loads: factors, or vectors in place of the value."""
    timed = {"times": jnp.array([0.0, 0.2]), "history": jnp.array(history)}
    part = getattr(scene, section)
    if section == "body":
        return replace(scene, body=replace(part, **timed))
    if np.ndim(history) == 2:
        timed["by" if section == "displaced" else "value"] = None
    return replace(scene, **{section: (replace(part[0], **timed),)})


def _model(scene: lj.Scene, values: dict) -> ReducedModel:
    """A model without modes, with the training ranges of rows of values."""
    values = {name: np.asarray(value, float) for name, value in values.items()}
    count = len(next(iter(values.values())))
    model = ReducedModel(
        modes=jnp.zeros((1, len(scene.mesh.points), 3)),
        slopes=jnp.zeros((9, 1, 1)),
        weights=jnp.ones(1),
        points=jnp.zeros(1, int),
        ranges={name: jnp.stack([value.min(axis=0), value.max(axis=0)]) for name, value in values.items()},
        loads=_loads_of_rows(scene, _Runs(values, np.zeros((count, 1, 1, 3)), None)),
    )
    return replace(model, others=other_numbers(scene, {name: value[0] for name, value in values.items()}))


VECTORS = [[0.0, 0.0, 0.0], [0.002, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("section", "history", "name"),
    [
        ("body", [0.0, 1.0], r"body\.gravity"),
        ("traction", [0.0, 1.0], r"traction\.0\.value"),
        ("displaced", [0.0, 1.0], r"displaced\.0\.by"),
        ("traction", VECTORS, r"traction\.0\.value"),
        ("displaced", VECTORS, r"displaced\.0\.by"),
    ],
)
def test_the_size_of_a_history_is_checked(section, history, name, tmp_path):
    """Only the number was checked: with a history ten times as large, the stated error was 1/47000 of the true one."""
    scene = _with_history(_scene(), section, history)
    save_reduced(_model(scene, {"body.gravity.2": [-2.0, -0.2]}), tmp_path / "model.h5")
    model = load_reduced(tmp_path / "model.h5")
    other = np.asarray(history)
    refuse_unseen_numbers(model, scene)
    refuse_unseen_numbers(model, _with_history(scene, section, (0.7 * other)[::-1].tolist()))
    for factor in (10.0, -10.0):
        with pytest.raises(lj.InputError, match=f"{name} during the run = .* is outside the training range"):
            refuse_unseen_numbers(model, _with_history(scene, section, (factor * other).tolist()))
    # Models of an earlier version of the program have no values of loads.
    with h5py.File(tmp_path / "model.h5", "a") as file:
        del file["loads"]
    refuse_unseen_numbers(load_reduced(tmp_path / "model.h5"), _with_history(scene, section, (10 * other).tolist()))


def test_a_history_counts_together_with_its_number():
    """The same load may be a large number with a small history."""
    scene = _with_history(_scene(), "body", [0.0, 1.0])
    model = _model(scene, {"body.gravity.2": [-2.0, -0.2]})
    small = lj.with_parameters(scene, {"body.gravity.2": -0.2})
    refuse_unseen_numbers(model, _with_history(small, "body", [0.0, 10.0]))
    assert parameters_outside(model, _with_history(small, "body", [0.0, 20.0])) == ["body.gravity during the run"]
    # Each load is told once.
    assert parameters_outside(model, lj.with_parameters(scene, {"body.gravity.2": -10.0})) == ["body.gravity.2"]
    # Times after the end of the run do not count.
    late = replace(scene.body, times=jnp.array([0.0, 0.2, 9.0]), history=jnp.array([0.0, 1.0, 90.0]))
    refuse_unseen_numbers(model, replace(scene, body=late))
    # A vector in place of a number that was not there.
    bare = replace(scene, body=lj.Body(density=1000.0))
    model = _model(bare, {"law.mu": [700.0, 900.0]})
    with pytest.raises(lj.InputError, match=r"body\.gravity during the run = .* is outside"):
        refuse_unseen_numbers(model, _with_history(bare, "body", [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))


def test_a_tuple_has_the_digest_of_an_array():
    """A tuple was refused with "body.gravity differs", and histories as tuples were compared number by number."""
    scene = _with_history(_scene(), "traction", [0.0, 1.0])
    model = _model(scene, {"law.mu": [700.0, 900.0]})
    given = replace(scene.traction[0], value=(5.0, 0.0, 0.0), times=(0.0, 0.1), history=(0.0, 0.95))
    same = replace(scene, body=replace(scene.body, gravity=(0.0, 0.0, -1.0)), traction=(given,))
    refuse_unseen_numbers(model, same)
    refuse_unseen_numbers(_model(same, {"law.mu": [700.0, 900.0]}), scene)
    with pytest.raises(lj.InputError, match=r"^body\.gravity differs"):
        refuse_unseen_numbers(model, replace(same, body=replace(scene.body, gravity=(0.0, 0.0, -0.9))))


def test_a_number_of_a_region_has_the_name_of_the_scene_file(tmp_path):
    """The name was region.0.law.['mu']. Models with this spelling are still used."""
    scene = replace(_scene(), region=(lj.Region(elements=np.arange(6), law={"mu": 1600.0}),))
    model = _model(scene, {"law.mu": [700.0, 900.0]})
    old = replace(model, others=model.others.replace("region.0.law.mu", "region.0.law.['mu']"))
    assert old.others != model.others
    save_reduced(old, tmp_path / "model.h5")
    again = load_reduced(tmp_path / "model.h5")
    refuse_unseen_numbers(again, scene)
    with pytest.raises(lj.InputError, match=r"^region\.0\.law\.mu differs"):
        refuse_unseen_numbers(again, lj.with_parameters(scene, {"region.0.law.mu": 1700.0}))


@pytest.mark.parametrize("body", [None, lj.Body(density=1000.0, gravity=None)])
def test_a_scene_without_a_trained_load_is_outside(body):
    """The run ended with the message that the parameter is not a number of the scene file."""
    for name, value in (("body.gravity.2", [-2.0, -0.2]), ("body.gravity", [[0.0, 0.0, -2.0], [0.0, 0.0, -0.2]])):
        model, scene = _model(_scene(), {name: value}), replace(_scene(), body=body)
        assert parameters_outside(model, scene) == [name]
        with pytest.raises(lj.InputError, match=f"^the scene has no {name}, .*: add it to the scene"):
            refuse_unseen_numbers(model, scene)


@pytest.mark.slow
def test_a_run_without_a_trained_load_is_estimated(tmp_path):
    """`tried` stopped after the reduced run."""
    scene = replace(_scene(), displaced=(), solve=lj.Solve())
    save_reduced(lj.reduce_scene(scene, {"body.gravity.2": [-2.0, -1.0]}), tmp_path / "model.h5")
    bare = replace(scene, body=None, solve=lj.Solve(reduced=str(tmp_path / "model.h5")))
    assert "Outside of the training range: body.gravity.2" in reduction.tried(bare).sentence


@pytest.mark.parametrize(("integrator", "factor"), [("euler", 1.0), ("newmark", 4.0)])
def test_the_inertia_of_a_step_is_in_the_compliance_of_the_points(integrator, factor):
    """The compliance of a free body was that of statics, which is infinite for rigid motions. The few selected points
    had 14 times the error."""
    moving = lj.Solve(kind="dynamic", integrator=integrator, dt=0.01, steps=2)
    scene = replace(_scene(), fixed=(), displaced=(), solve=moving)
    modes = np.zeros((1, len(scene.mesh.points), 3))
    modes[..., 2] = 1 / np.sqrt(float(jnp.sum(scene.mesh.weights)))  # a translation
    whole = SimpleNamespace(modes=jnp.asarray(modes), number_of_modes=1)
    np.testing.assert_allclose(sampling._reduced_compliance(whole, scene), 0.01**2 / (factor * 1000.0), rtol=1e-6)


def test_a_row_at_rest_is_not_run_first(monkeypatch):
    """The displacement 0 made its relative error infinite."""
    q = np.array([1.0, 0.0, 0.1])[:, None, None] * np.ones((3, 2, 1))
    monkeypatch.setattr(training, "_coordinates_of_rows", lambda *_: (q, np.array([False, False, False])))
    monkeypatch.setattr(training, "correction_at", lambda *_: 0.01 * np.ones((2, 4, 3)))
    model = SimpleNamespace(modes=np.ones((1, 4, 3)), correction="learnt")
    errors = training._errors_of_rows(model, _scene(), {})
    assert errors[1] == 0 and np.argmax(errors) == 2
