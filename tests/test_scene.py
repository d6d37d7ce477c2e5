"""Scene files: their content, one-line messages for invalid input, output of the command."""

import json
import re
import tomllib

import h5py
import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core.struct import replace
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

SCENE = """
[mesh]
shape = "box"
size = [100, 100, 100]
cells = [2, 2, 2]
unit = "mm"

[[law]]
name = "neo_hookean"
mu = 500.0
bulk = 2200.0
[[law]]
name = "ogden"
mu = [200.0, -30.0]
alpha = [2.0, -4.0]
bulk = 100.0

[viscosity]
ratios = [0.235, 0.333]
relaxation_times = [0.27, 0.03]

[body]
density = 1060.0
gravity = [0, 0, -9.81]

[[fixed]]
where = {z_max = 0.0}
[[fixed]]
set = "x_min"
axes = "x"
[[displaced]]
where = {z_min = 0.1, x_min = 0.05}
history = "ramp.csv"
[[traction]]
where = {y_max = 0.0}
value = [0, 10.0, 0]

[solve]
kind = "static"
steps = 3
dt = 0.05
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with the scene and its history."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "ramp.csv").write_text("time,x,y,z\n0,0,0,0\n0.15,0.01,0,0.02\n")
    return tmp_path


def test_a_scene_file_says_what_it_says(folder):
    scene = lj.load_scene(folder / "scene.toml")
    assert scene.mesh.number_of_nodes == 27 and np.isclose(np.asarray(scene.mesh.points).max(), 0.1)
    assert isinstance(scene.law, lj.laws.Sum) and scene.law.laws[1].alpha == (2.0, -4.0)
    assert len(scene.fixed[0].nodes) == 9 and scene.fixed[1].axes == "x"
    assert len(scene.displaced[0].nodes) == 6 and scene.displaced[0].history.shape == (2, 3)
    assert len(scene.traction[0].triangles) == 8
    assert scene.solve.steps == 3 and scene.solve.dt == 0.05


def test_a_byte_order_mark_is_no_part_of_a_scene(folder):
    """Some Windows editors write this mark at the beginning of a file."""
    text = (folder / "scene.toml").read_text()
    (folder / "marked.toml").write_text(text, encoding="utf-8-sig")
    assert lj.load_scene(folder / "marked.toml").solve.steps == 3


def test_parameters_by_the_files_own_names(folder):
    scene = lj.load_scene(folder / "scene.toml")
    changed = lj.with_parameters(
        scene,
        {
            "law.0.mu": 800.0,
            "law.1.alpha.0": 3.0,
            "viscosity.relaxation_times": (0.3, 0.02),
            "viscosity.ratios.0": 0.1,
            "body.density": 1000.0,
            "traction.0.value": (0.0, 5.0, 0.0),
            "solve.dt": 0.1,
        },
    )
    assert changed.law.laws[0].mu == 800.0 and changed.law.laws[1].alpha == (3.0, -4.0)
    assert np.allclose(changed.viscosity.relaxation_times, [0.3, 0.02])
    assert np.allclose(changed.viscosity.ratios, [0.1, 0.333])
    assert changed.body.density == 1000.0 and changed.solve.dt == 0.1
    assert jax.tree.structure(changed) == jax.tree.structure(scene)  # nothing is compiled again
    for name, near in (
        ("law.0.mew", "mu"),
        ("viscosty.ratios", "viscosity"),
        ("law.5.mu", "is not a name or index here"),
    ):
        with pytest.raises(lj.InputError, match=near):
            lj.with_parameters(scene, {name: 1.0})


@pytest.mark.draws
@pytest.mark.core
def test_command_leaves_hdf5_vtu_and_a_picture(folder, capsys):
    out, text = folder / "out", (folder / "scene.toml").read_text()
    mesh, one, other = text.split("[[law]]")  # one law compiles in half of the time
    (folder / "one_law.toml").write_text(f"{mesh}[law]{one}[viscosity]{other.split('[viscosity]')[1]}")
    assert main(["simulate", str(folder / "one_law.toml"), "--out", str(out), "--vtu", "--png"]) == 0
    text = capsys.readouterr().out
    assert "27 nodes, 48 tetrahedra, 3 steps" in text and "residual" in text and "compile" in text
    with h5py.File(out / "result.h5") as file:
        assert file["positions"].shape == file["reactions"].shape == (3, 27, 3)
        assert np.allclose(file["times"], [0.05, 0.1, 0.15])
        assert file["reference"].shape == (27, 3) and file["tetrahedra"].shape == (48, 4)
        assert np.all(file.attrs["status"] == 0) and file.attrs["run_time_s"] > 0
        assert tomllib.loads(file.attrs["scene"])["body"]["density"] == 1060.0
        assert "jax" in json.loads(file.attrs["versions"])
        last = file["positions"][-1] - file["reference"][:]
    moved = lj.load_scene(folder / "scene.toml").displaced[0].nodes
    assert np.allclose(last[np.asarray(moved)], [0.01, 0.0, 0.02])
    series = json.loads((out / "vtu" / "result.vtu.series").read_text())["files"]
    assert [e["time"] for e in series] == pytest.approx([0.05, 0.1, 0.15])
    assert np.allclose(meshio.read(out / "vtu" / series[-1]["name"]).point_data["displacement"], last)
    assert (out / "result.png").stat().st_size > 10_000


@pytest.mark.ci
def test_a_failed_step_is_exit_code_1_and_keeps_what_was_computed(tmp_path, capsys):
    text = (
        SCENE.split("[viscosity]")[0].split("[[law]]")[0]
        + """
[law]
name = "neo_hookean_compressible"
mu = 770.0
lame_lambda = 2000.0
[[fixed]]
where = {z_max = 0.0}
[[displaced]]
where = {z_min = 0.1}
by = [0.0, 0.0, -0.15]
[solve]
steps = 2
"""
    )
    (tmp_path / "scene.toml").write_text(text)
    assert main(["simulate", str(tmp_path / "scene.toml"), "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "failed: step 2" in error and "Traceback" not in error
    with h5py.File(tmp_path / "result.h5") as file:
        assert np.isfinite(file["positions"][:]).all()
        assert file.attrs["status"][0] == 0 and file.attrs["status"][1] != 0


#: A change of the scene's dictionary -> part of the message.
REFUSED = {
    "no mesh": (lambda c: c.pop("mesh"), r"no \[mesh\]"),
    "unknown section": (lambda c: c.update(bodey={}), "did you mean body"),
    "unknown key": (lambda c: c["solve"].update(stps=3), "did you mean steps"),
    "unknown law": (lambda c: c["law"][0].update(name="neo_hokean"), "did you mean neo_hookean"),
    "parameter out of bounds": (lambda c: c["law"][0].update(mu=-1.0), "must be above 0"),
    "unknown unit": (lambda c: c["mesh"].update(unit="inch"), "use one of m, cm"),
    "two meshes": (lambda c: c["mesh"].update(file="a.vtu"), "either file"),
    "where meets nothing": (lambda c: c["fixed"][0].update(where={"z_max": -1.0}), "selects no node"),
    "unknown where": (lambda c: c["fixed"][0].update(where={"zmax": 0.0}), "did you mean z_max"),
    "place beyond numbers": (lambda c: c["fixed"][0].update(where={"z_max": 10**400}), "is not a length"),
    "unknown set": (lambda c: c["fixed"][1].update(set="vena_cava"), "no node set 'vena_cava'"),
    "ratios add up": (lambda c: c["viscosity"].update(ratios=[0.5, 0.6]), "less than 1"),
    "viscosity without dt": (lambda c: c["solve"].pop("dt"), "no dt, which viscosity needs"),
    "clamp and motion": (lambda c: c["fixed"].append({"where": {"z_min": 0.1}}), "both prescribe node"),
    "by and history": (lambda c: c["displaced"][0].update(by=[0, 0, 0]), "give the columns time,factor"),
    "short vector": (lambda c: c["body"].update(gravity=[0, 0]), "list of 3 numbers"),
    "no density": (lambda c: c["body"].pop("density"), "needs density"),
    "text for a number": (lambda c: c["body"].update(density="1060"), "not a number"),
    "steps": (lambda c: c["solve"].update(steps=0), "whole number above 0"),
    "kind": (lambda c: c["solve"].update(kind="quasistatic"), "use static or dynamic"),
    "loose body": (lambda c: (c.pop("fixed"), c.pop("displaced")), "do not prevent every rigid motion of the body"),
    "no triangle": (
        lambda c: c["traction"][0].update(where={"y_max": 0.0, "x_max": 0.0}),
        "no triangle of the boundary",
    ),
    "steps without end": (lambda c: c["solve"].update(steps=10**24), "solve.steps must be at most 2147483647"),
    "hundreds of digits": (lambda c: c["law"][0].update(mu=10**400), "hundreds of digits"),
    "text in a history": (
        lambda c: c["displaced"][0].update(history=[["0", "0", "0", "0"]]),
        "is not a table of numbers",
    ),
    "an empty obstacle": (
        lambda c: c.update(obstacle=[{}]),
        "obstacle.0 contains only where or set: also give shape, position",
    ),
    "history is missing": (lambda c: c["displaced"][0].update(history="none.csv"), "cannot be read"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_scenes_are_refused_in_one_sentence(case, folder):
    change, sentence = REFUSED[case]
    content = tomllib.loads(SCENE)
    change(content)
    with pytest.raises(lj.InputError, match=sentence) as caught:
        scene_from(content, folder)
    assert "\n" not in str(caught.value)


def test_a_hinge_is_not_enough():
    content = {
        "mesh": {"shape": "box", "size": [1, 1, 1], "cells": [1, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 1.0, "bulk": 10.0},
        "fixed": [{"where": {"z_max": 0.0, "x_max": 0.0}}],
    }
    with pytest.raises(lj.InputError, match="do not prevent every rigid motion"):
        scene_from(content)
    content["fixed"].append({"where": {"z_min": 1.0, "x_min": 1.0}, "axes": "z"})
    scene_from(content)


def test_a_piece_that_hangs_on_doubled_nodes_is_told_so():
    """Two adjacent boxes have separate nodes in their common face. The advice "add [[fixed]]" would split the body."""
    box = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    points, tets = np.asarray(box.points), np.asarray(box.tetrahedra)
    both = lj.tet_mesh(
        np.concatenate([points, points + np.array([1.0, 0.0, 0.0])]), np.concatenate([tets, tets + len(points)])
    )
    low = np.flatnonzero(np.asarray(both.points)[:, 0] == 0)
    held = (lj.Fixed(nodes=jnp.asarray(low)),)
    scene = lj.Scene(mesh=both, law=lj.laws.NeoHookean(mu=1.0, bulk=10.0), fixed=held)
    with pytest.raises(lj.InputError, match="merge the 4 nodes that coincide with another node "):
        lj.check_scene(scene)


@pytest.mark.parametrize("text", [b"[mesh", b"\xff\xfe\x00", None])
def test_files_that_are_no_scenes(text, tmp_path, capsys):
    file = tmp_path / "scene.toml"
    file.mkdir() if text is None else file.write_bytes(text)
    assert main(["simulate", str(file)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1


@pytest.mark.ci
def test_a_mesh_file_with_sets_and_units(tmp_path):
    mesh = lj.shapes.box((100.0, 100.0, 100.0), (2, 2, 2))
    lj.write_mesh(tmp_path / "cube.vtu", mesh)
    content = {
        "mesh": {"file": "cube.vtu", "unit": "mm"},
        "law": {"name": "neo_hookean", "mu": 770.0, "bulk": 2200.0},
        "fixed": [{"set": "z_min"}],
        "displaced": [{"set": "z_max", "by": [0.0, 0.0, 0.01]}],
    }
    scene = scene_from(content, tmp_path)
    result = lj.simulate(scene).check()
    assert np.isclose(float(jnp.max(result.positions[-1])), 0.11)


def test_scenes_made_in_python_are_refused_alike():
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1.0, bulk=10.0), fixed=(lj.Fixed(nodes=jnp.arange(4)),))
    triangles = jnp.array([[0, 1, 3]])
    for change, sentence in (
        ({"solve": lj.Solve(kind="Dynamic")}, "kind = 'Dynamic' is not known"),
        ({"solve": lj.Solve(precision="single")}, "precision = 'single' is not known"),
        ({"traction": (lj.Traction(triangles=triangles),)}, "either value"),
        ({"traction": (lj.Traction(triangles=triangles, pressure=jnp.ones(3)),)}, "shape"),
        ({"displaced": (lj.Displaced(nodes=jnp.array([7])),)}, "either 'by'"),
    ):
        with pytest.raises(lj.InputError, match=re.escape(sentence)):
            lj.simulate(replace(scene, **change))


def test_a_body_that_cannot_move_is_pointed_out():
    """The most probable mistake with `where` is to fix z >= 0 where the lowest face is meant."""
    content = {
        "mesh": {"shape": "box", "size": [0.01, 0.01, 0.01], "cells": [1, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 770.0, "bulk": 2200.0},
        "fixed": [{"where": {"z_min": 0.0}}],
    }
    with pytest.warns(UserWarning, match="nothing can move"):
        scene_from(content)
    scene_from(content | {"fixed": [{"where": {"z_max": 0.0}}]})


@pytest.mark.slow
def test_density_is_one_number_or_one_a_node():
    """A density may have one value per node. A body of two halves has the weight of both; other shapes raise an
    error.
    """
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 3))  # 16 nodes, 18 elements
    scene = lj.Scene(
        mesh=mesh, law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0), fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),)
    )
    share = np.asarray(lj.boundary.nodal_volumes(mesh))
    density = np.where(np.asarray(mesh.points)[:, 2] > 0.05, 500.0, 1000.0)

    def of(density, gravity=(0.0, 0.0, -9.81)):
        return replace(scene, body=lj.Body(density=density, gravity=gravity))

    held = np.asarray(lj.simulate(of(density)).check().reactions)[-1, :, 2].sum()
    # The internal forces add up to zero, so the support carries the weight, up to the tolerance of the forces.
    assert np.isclose(held, 9.81 * (density * share).sum(), rtol=1e-7)
    for body, sentence in (
        (
            of(np.full(mesh.number_of_elements, 1000.0)),
            "[body] density has shape (18,): give one number or one per node (16,)",
        ),
        (of(np.full((len(share), 1), 1000.0)), "[body] density has shape (16, 1)"),
        (of(1000.0, (0.0, -9.81)), "[body] gravity has shape (2,): give three numbers in m/s^2"),
    ):
        for refused in (lj.simulate, lj.check_scene):
            with pytest.raises(lj.InputError, match=re.escape(sentence)):
                refused(body)


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [
        ({"fixed": np.arange(9)}, "fixed is of type ndarray: give a tuple that contains an lj.Fixed"),
        ({"fixed": (np.arange(9),)}, "fixed.0 is of type ndarray: give an lj.Fixed"),
        ({"law": "neo_hookean"}, "law is of type str: give a law of lj.laws"),
        ({"viscosity": {"ratios": [0.5]}}, "viscosity is of type dict: give an lj.Prony"),
        ({"physics": (3.0,)}, "physics.0 is of type float: give a physics object, such as lj.Obstacle"),
    ],
)
def test_parts_of_another_type_are_refused(parts, sentence):
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (2, 2, 2))
    given = {"mesh": mesh, "law": lj.laws.NeoHookean(mu=1.0, bulk=10.0)} | parts
    for run in (lj.simulate, lambda scene: lj.harmonic(scene, [60.0])):
        with pytest.raises(lj.InputError) as refused:
            run(lj.Scene(**given))
        assert str(refused.value) == sentence
