"""Histories of loads: the run equals a run whose load has the value of the table at every step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core import history
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.physics.base import Step
from liverjax.physics.loads import Loads
from liverjax.physics.registry import physics_of
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

ROWS = [[0.0, 0.0], [0.1, 1.0], [0.2, 1.0], [0.3, -0.5]]
#: Values of the table at the ends of four steps of 0.08 s.
FACTORS = np.interp([0.08, 0.16, 0.24, 0.32], *np.array(ROWS).T)


def content(**more) -> dict:
    return {
        "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "fixed": [{"where": {"z_max": 0.0}}],
        "solve": {"dt": 0.08, "steps": 4},
    } | more


TOP = {"z_min": 0.1}
LOADS = {
    "gravity": lambda part, rows: {"body": {"density": 1000.0, "gravity": [0.5, 0, part(-3.0)], **rows}},
    "traction": lambda part, rows: {"traction": [{"where": TOP, "value": [part(30.0), 0, part(50.0)], **rows}]},
    "pressure": lambda part, rows: {"traction": [{"where": TOP, "pressure": part(60.0), **rows}]},
    "motion": lambda part, rows: {"displaced": [{"where": TOP, "by": [part(0.01), 0, part(0.02)], **rows}]},
    "springs": lambda part, rows: {
        "support": [{"where": TOP, "normal": part(1e4), "tangential": part(1e3), **rows}],
        "traction": [{"where": {"x_min": 0.1}, "value": [20.0, 0.0, 40.0]}],
    },
}


def test_what_acts_goes_straight_from_the_beginning_of_a_step_to_its_end():
    for load in ("gravity", "traction", "pressure"):
        scene = scene_from(content(**LOADS[load](lambda value: value, {"history": ROWS})))
        plain = scene_from(content(**LOADS[load](lambda value: value, {})))
        mesh = scene.mesh
        step = Step(mesh, mesh.points, 4, 4, 0.08, False, None, None)
        (one,), (whole,) = ([p for p in physics_of(s) if isinstance(p, Loads)] for s in (scene, plain))
        x = mesh.points * 1.1
        found, full = one.freeze(None, step), whole.freeze(None, step)
        for s in (0.0, 0.25, 1.0):
            factor = FACTORS[2] + s * (FACTORS[3] - FACTORS[2])
            exact = np.asarray(factor * full.force(mesh, x, 1.0))
            assert np.allclose(found.force(mesh, x, s), exact, rtol=1e-12, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("load", LOADS)
def test_a_history_of_factors_is_the_load_of_every_step(load):
    rows = [[t, abs(f)] for t, f in ROWS] if load == "springs" else ROWS
    factors = np.interp([0.08, 0.16, 0.24, 0.32], *np.array(rows).T)
    full = LOADS[load](lambda value: value, {"history": rows})
    if load == "gravity":  # the constant part is multiplied by the history too
        full["body"]["gravity"][0] = 0.0
    scene = scene_from(content(**full))
    found = np.asarray(lj.simulate(scene).check().positions)
    for k in (0, 3):
        one = LOADS[load](lambda value, k=k: float(value * factors[k]), {})
        if load == "gravity":
            one["body"]["gravity"][0] = 0.0
        alone = scene_from(content(**one, solve={"steps": 1}))
        exact = np.asarray(lj.simulate(alone).check().positions[-1])
        size = np.abs(exact - np.asarray(scene.mesh.points)).max()
        assert size > 1e-4 and np.abs(found[k] - exact).max() < 1e-6 * size


def test_vectors_files_and_rows_are_the_same(tmp_path):
    rows = [[0.0, 0.0, 0.0, 0.0], [0.3, 0.01, 0.0, 0.02]]
    (tmp_path / "ramp.csv").write_text("time,x,y,z\n" + "\n".join(",".join(map(str, r)) for r in rows) + "\n")
    (tmp_path / "wave.csv").write_text("# a wave\ntime,factor\n0,0\n0.5,2\n")
    both = [
        scene_from(content(displaced=[{"where": TOP, "history": h}]), tmp_path).displaced[0] for h in (rows, "ramp.csv")
    ]
    assert np.array_equal(both[0].history, both[1].history) and both[0].history.shape == (2, 3)
    load = scene_from(content(traction=[{"where": TOP, "pressure": 4.0, "history": "wave.csv"}]), tmp_path).traction[0]
    assert np.array_equal(load.history, [0.0, 2.0]) and load.at(0.25).pressure == 4.0
    vectors = scene_from(content(traction=[{"where": TOP, "history": rows}])).traction[0]
    assert np.allclose(vectors.at(0.15).value, [0.005, 0.0, 0.01])


@pytest.mark.slow
def test_a_dynamic_body_begins_with_the_load_of_the_beginning():
    """A free cube under p(t) = p t/T moves by x = p t^3/(6 T rho h). Newmark's method has this to order dt^2."""
    table = content(
        body={"density": 1000.0},
        traction=[{"where": TOP, "value": [0, 0, 80.0], "history": [[0.0, 0.0], [0.4, 1.0]]}],
        solve={"dt": 0.05, "steps": 8, "kind": "dynamic", "integrator": "newmark"},
        law={"name": "neo_hookean", "mu": 8e5, "bulk": 4e6},
    )
    table.pop("fixed")
    scene = scene_from(table)
    moved = np.asarray(lj.simulate(scene).check().positions[-1] - scene.mesh.points)
    # Average acceleration adds a T dt^2/12 to the integral of a ramp. Lumped masses do not change the centre of mass.
    weights = np.asarray(lj.boundary.nodal_volumes(scene.mesh))
    centre = (weights[:, None] * moved).sum(axis=0) / weights.sum()
    rate = 80.0 / (1000.0 * 0.1) / 0.4
    assert np.allclose(centre, [0.0, 0.0, rate * 0.4**3 / 6 * (1 + 0.5 * (0.05 / 0.4) ** 2)], rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_derivative_by_an_entry_of_a_history():
    scene = scene_from(content(traction=[{"where": TOP, "value": [0, 0, 50.0], "history": ROWS}]))
    top = lj.boundary.select(scene.mesh, TOP)

    def lift(values):
        load = replace(scene.traction[0], history=values)
        return jnp.mean(lj.simulate(replace(scene, traction=(load,))).positions[3, top, 2])

    at = scene.traction[0].history
    by = jax.jacfwd(lift)(at)
    errors = [abs((lift(at.at[3].add(h)) - lift(at.at[3].add(-h))) / (2 * h) / by[3] - 1) for h in (0.5, 1e-3)]
    assert errors[1] < 1e-5 < errors[0] and by[1] == 0


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            {"value": [0, 0, 1.0], "history": [[0, 0], [0, 1]]},
            "traction.0 history must have finite numbers at increasing",
        ),
        ({"value": [0, 0, 1.0], "history": [[0, 0, 1]]}, "traction.0 history has rows of 3 numbers: write"),
        ({"value": [0, 0, 1.0], "history": "none.csv"}, "none.csv cannot be read"),
        ({"pressure": 1.0, "value": [0, 0, 1.0], "history": [[0, 0]]}, "traction.0 needs either value"),
        ({"pressure": 1.0, "history": [[0, 0, 0, 0]]}, "traction.0 has a pressure and a history of vectors: write"),
        ({"history": [[0, 1.0]]}, "traction.0 needs either value"),
    ],
)
def test_bad_histories_are_refused(table, words):
    with pytest.raises(InputError, match=words):
        scene_from(content(traction=[{"where": TOP, **table}]))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty: give a CSV file with columns time,factor or time,x,y,z"),
        (b"# alone\n\n", "is empty"),
        (
            b"time;factor\n0,0;0,5\n1,0;1,0\n",
            "has rows of different lengths: .* separated by commas, with decimal points",
        ),
        (b"time,factor\n0,0\n1\n", "has rows of different lengths"),
        (b"time;factor\n0;1\n1;2\n", "has one column: .* separated by commas"),
        (b"time\tfactor\n0\t1\n1\t2\n", "has one column"),
        (b"\xff\xfe\x00", "is not a text file"),
        (b"time,force\n0,0\n1,1\n", "has the columns"),
        (b"time,factor,factor\n0,0,1\n1,1,0\n", "has two columns factor: remove one"),
        (b"time,factor,x,y,z\n0,0,1,1,1\n1,1,0,0,0\n", "has both time,factor and time,x,y,z: give one"),
        (b"time,factor\n0,zero\n1,1\n", "must have finite numbers"),
        (None, r"cannot be read \(No such file or directory\): give a CSV file with columns"),
    ],
)
def test_files_that_are_no_table_are_one_sentence(tmp_path, content, words):
    file = tmp_path / "h.csv"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError, match=words) as refused:
        history.read_history(file, "traction.0")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("more", [",,", ",note,note"])
def test_further_columns_are_left_out(tmp_path, more):
    file = tmp_path / "h.csv"
    file.write_text(f"time,factor{more}\n0,0,,\n1,2,,\n")
    times, factors = history.read_history(str(file), "traction.0")
    assert times.tolist() == [0, 1] and factors.tolist() == [0, 2]


def test_a_file_of_a_spreadsheet_is_read(tmp_path):
    """The file begins with a byte-order mark and has empty lines."""
    (tmp_path / "h.csv").write_bytes(b"\xef\xbb\xbftime,factor\r\n0,0\r\n\r\n1,2\r\n")
    times, factors = history.read_history(tmp_path / "h.csv", "traction.0")
    assert list(times) == [0, 1] and list(factors) == [0, 2]


def test_a_history_needs_time():
    with pytest.raises(InputError, match="no dt, which a history needs"):
        scene_from(content(traction=[{"where": TOP, "pressure": 1.0, "history": [[0, 0]]}], solve={"steps": 3}))
