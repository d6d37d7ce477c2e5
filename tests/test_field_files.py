"""Tables of displacements: units, other programs, one-line messages for invalid input."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from test_field import SURFACE, _scene, _write

import liverjax as lj
from fitting.__main__ import main
from fitting.fits import field, scene_numbers
from fitting.readers import displacements
from liverjax.core.struct import replace

pytestmark = pytest.mark.quick_to_compile


_BAD = {
    "x,y,z,ux,uy\n0,0,0,1,1": "no column uz",
    "ux,uy,uz\n0,0,0": "either a column node or columns x,y,z",
    "node,ux,uy,uz\n900,0,0,0": "node 900 is not in the mesh",
    "node,ux,uy,uz\n1.5,0,0,0": "node 1.5 is not in the mesh",
    "x,y,z,ux,uy,uz\n60,40,40,0,0,0": "check --unit",
    "x,y,z,ux,uy,uz\n,0,0,0,0,0": "position x,y,z is not finite",
    "node,ux,uy,uz\n1,,,": "no displacement is measured",
    "node,ux,uy,uz\n1,inf,0,0": "row 1 contains an infinite displacement",
    "\ufeffnode,ux,uy,uz\n2,-inf,0,0": "row 1 contains an infinite displacement",
    "node,ux,uy,uz\n1,0,-999,0": "row 1 has uy = -999 m in a body of 0.0",
    "x,y,z,ux,uy,uz" + "\n0.071,0.02,0.02,0,0,0" * 4: "4 of 4 points lie outside of the mesh",
    "node,ux,uy,uz,sd\n1,0,0,0,0": "sd must be positive",
    "node,ux,uy,uz,time\n1,0,0,0,1": "has no dt",
    "node,ux,uy,uz,kind\n1,0,0,0,1": "column 'kind' is not known",
    "node,ux,uy,uz\n5,1e-3,0,O.001\n6,1e-3,,0": "row 1: uz = 'O.001' is not a number; correct this cell, or",
    "node,ux,uy,uz\n# points\n5,1e-3,,0\n\n6,0.001mm,0,0": "row 2: ux = '0.001mm' is not a number",
    "node,ux,uy,uz\n5,1e-3,,0\n6,1e-3,0,0\n5,1e-3,,0\n6,1e-3,0,0": "row 3 repeats row 1 (2 of 4 rows are copies)",
    "x,y,z,ux,ux,uy,uz\n0.01,0.02,0.02,0,0,0,0": "has two columns ux: remove one of them",
    "": "is empty: export the file again",
    "node;ux;uy;uz\n5;1e-3;0;0;7": "row 1 has 5 cells under 4 headings",
}


@pytest.mark.parametrize("content", _BAD)
def test_bad_displacements_are_one_sentence(tmp_path, content, capsys):
    _scene(tmp_path)
    (tmp_path / "u.csv").write_text(content)
    command = ["field", str(tmp_path / "scene.toml"), str(tmp_path / "u.csv"), "--noise", "1e-4"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip()
    assert _BAD[content] in error and "\n" not in error, error


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--noise", "0"], "--noise 0 must be a finite number above 0"),
        ([], "the column sd is missing"),
        (["--noise", "1e-4", "--name", "law.nu"], "not a number of the scene"),
        (["--noise", "1e-4", "--parameters", "law.mu,law.x"], "not a number of the scene"),
        (["--noise", "1e-4", "--name", "body.gravity"], "can multiply only one number"),
        (["--noise", "1e-4", "--unit", "mile"], "--unit 'mile' is not known"),
        (["--noise", "1e-4", "--length", "-1"], "--length -1 must be a finite number above 0"),
        (["--noise", "1e-4", "--parameters", "law.mu", "--sphere"], "--sphere is for maps and cannot be used with"),
        (["--noise", "1e-4", "--parameters", "law.mu", "--iterations", "9"], "--iterations is for maps"),
        (["--noise", "1e-4", "--parameters", "solve.dt"], "solve.dt belongs to the solver, and not to the body"),
    ],
)
def test_bad_options_are_one_sentence(tmp_path, more, words, capsys):
    scene = _scene(tmp_path)
    file = tmp_path / "u.csv"
    np.savetxt(file, [[1, 0, 0, 0]], delimiter=",", header="node,ux,uy,uz", comments="")
    assert scene.mesh.number_of_nodes == len(SURFACE)
    assert main(["field", str(tmp_path / "scene.toml"), str(file), *more, "--out", str(tmp_path / "o")]) == 2
    assert words in capsys.readouterr().err
    assert main(["field", str(tmp_path / "scene.toml"), "--noise", "1"]) == 2


@pytest.mark.parametrize(
    "written",
    [
        "node;UX;UY;UZ\n5;0,001;;-2e-4\n6;0;0,25;1\n",
        "# node,ux,uy,uz\n5,1e-3,,-2e-4\n# no more points\n6,0,0.25,1\n",
        "node\tux\tuy\tuz\n5\t1e-3\tnan\t-2e-4\n6\t0\t0.25\t1\n",
        "node,ux,uy,uz,\n5,1e-3,,-2e-4,\n6,0,0.25,1,\n",
    ],
    ids=["spreadsheet", "savetxt", "tabs", "a separator at the end"],
)
def test_tables_of_displacements_of_other_programs(tmp_path, written):
    (tmp_path / "u.csv").write_text(written)
    found = displacements.read_displacements(tmp_path / "u.csv", _scene(tmp_path), 1e-4, "mm")
    assert found.nodes[:, 0].tolist() == [5, 6] and found.components == 5
    assert np.allclose(found.measured, 1e-3 * np.array([[1e-3, 0, -2e-4], [0, 0.25, 1]]), rtol=1e-14)


def test_noise_that_the_column_sd_replaces_is_told(tmp_path, capsys):
    """--noise had no effect on a file with a column sd, without a note."""
    _scene(tmp_path)
    (tmp_path / "own.csv").write_text("node,ux,uy,uz,sd\n5,1e-3,,0,2e-4\n6,1e-3,0,0,1e-4\n")
    (tmp_path / "none.csv").write_text("node,ux,uy,uz\n5,1e-3,,0\n6,1e-3,0,0\n")
    files = [str(tmp_path / name) for name in ("scene.toml", "own.csv", "scene.toml", "none.csv")]
    given = ["--noise", "1e-4", "--parameters", "law.mu,law.mu", "--out", str(tmp_path / "out")]  # ends before the fit
    assert main(["field", *files, *given]) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("note: ")]
    assert told == [f"note: {files[1]} has a column sd: --noise is not used for this file"]


def test_places_in_another_unit_than_the_displacements_are_refused(tmp_path):
    scene = _scene(tmp_path, mu=1000.0)
    points = np.asarray(scene.mesh.points)
    rows = np.column_stack([points, 1e3 * 1e-3 * points])  # only the displacements in mm
    np.savetxt(tmp_path / "u.csv", rows, delimiter=",", header="x,y,z,ux,uy,uz", comments="")
    with pytest.raises(lj.InputError, match=r"all points lie within .* --unit mm applies to x, y, z and to ux"):
        displacements.read_displacements(tmp_path / "u.csv", scene, 1e-5, "mm")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the error of the (mesh|time step) changes")
@pytest.mark.filterwarnings("ignore:the effect of the mesh error on the fit is unknown")
@pytest.mark.filterwarnings("ignore:residuals of points")
def test_displacements_in_another_unit_are_told(tmp_path, capsys):
    """Displacements that are ten times too large give a tenth of the modulus, with a small error. Only the misfit shows
    it.
    """
    scene = _scene(tmp_path, mu=1000.0)
    _write(tmp_path / "u.csv", scene, 5e-5)
    rows = np.loadtxt(tmp_path / "u.csv", delimiter=",", skiprows=1)
    head = (tmp_path / "u.csv").read_text().splitlines()[0]
    rows[:, [head.split(",").index(name) for name in ("ux", "uy", "uz")]] *= 10
    np.savetxt(tmp_path / "u.csv", rows, delimiter=",", header=head, comments="")
    command = ["field", str(tmp_path / "scene.toml"), str(tmp_path / "u.csv"), "--noise", "5e-5"]
    main([*command, "--parameters", "law.mu", "--out", str(tmp_path / "out")])
    assert "per component, so the fit misses the displacements" in capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "field.json").read_text())
    assert found["chi2_per_component"] > 1.5 and "check the unit (--unit)" in found["warnings"][0]


def test_the_progress_of_an_earlier_map_does_not_stay(tmp_path, monkeypatch, capsys):
    """After Ctrl-C, the file of another map was still there, and --resume refused it."""

    def stopped(*_):
        raise KeyboardInterrupt

    _scene(tmp_path)
    out = tmp_path / "out"
    (tmp_path / "u.csv").write_text("node,ux,uy,uz\n5,1e-3,0,0\n6,1e-3,0,1e-4")
    monkeypatch.setattr(scene_numbers, "with_discretisation_as_noise", lambda problem: (problem, [{}]))
    monkeypatch.setattr(field, "estimate", stopped)
    command = ["field", str(tmp_path / "scene.toml"), str(tmp_path / "u.csv"), "--noise", "5e-5", "--out", str(out)]
    out.mkdir()
    (out / "progress.h5").write_text("another map")
    assert main([*command, "--resume"]) == 130
    assert "stopped; continue with --resume\n" in capsys.readouterr().err
    assert main(command) == 130
    assert capsys.readouterr().err.endswith("\nstopped\n") and not (out / "progress.h5").exists()


def test_scenes_of_two_orders_have_different_meshes(tmp_path):
    """The scenes have as many elements, but not as many nodes. NumPy ended with a traceback."""
    first = _scene(tmp_path)
    _refused_as_other_mesh(first, lj.quadratic(first.mesh))


def _refused_as_other_mesh(first, mesh):
    scenes = first, replace(first, mesh=mesh)
    with pytest.raises(lj.InputError, match="use one mesh in all scenes"):
        field.start_of(scene_numbers.Problem(scenes, ()), "law.mu")


def test_scenes_with_other_nodes_or_other_elements_have_different_meshes(tmp_path):
    """36 elements each, but 24 and 28 nodes: NumPy ended with a traceback. With the same nodes and the elements in
    another order, each element got the modulus of another element.
    """
    first, size = _scene(tmp_path), (0.06, 0.04, 0.04)
    a, b = lj.shapes.box(size, (3, 2, 1)), lj.shapes.box(size, (6, 1, 1))
    assert a.number_of_elements == b.number_of_elements and a.number_of_nodes != b.number_of_nodes
    _refused_as_other_mesh(replace(first, mesh=a), b)
    _refused_as_other_mesh(first, lj.tet_mesh(first.mesh.points, np.asarray(first.mesh.tetrahedra)[::-1]))


@pytest.mark.parametrize("name", ["viscosity.ratios.0", "region.0.law.mu", "body.density"])
def test_a_parameter_without_a_value_per_element_has_no_map(tmp_path, name):
    """The command ended with a traceback, or the error seemed to be one of the scene."""
    scene = _scene(tmp_path)
    prony = lj.Prony(ratios=jnp.array([0.3, 0.2]), relaxation_times=jnp.array([1.0, 0.1]))
    region = lj.Region(elements=jnp.arange(5), law={"mu": 900.0})
    scene = replace(scene, viscosity=prony, region=(region,), solve=replace(scene.solve, dt=0.1))
    with pytest.raises(lj.InputError, match=f"'{name}' cannot have one value per element, so it has no map"):
        field.start_of(scene_numbers.Problem((scene,), ()), name)


def test_a_part_of_a_parameter_is_no_further_parameter(tmp_path, capsys):
    """The later name replaced a part of the earlier one, whose standard error was then very large."""
    _write(tmp_path / "u.csv", _scene(tmp_path), 1e-6)
    files = [str(tmp_path / name) for name in ("scene.toml", "u.csv")]
    assert (
        main(
            ["field", *files, "--parameters", "body.gravity,body.gravity.0", "--noise", "1e-6", "--out", str(tmp_path)]
        )
        == 2
    )
    assert "names body.gravity.0, which is a part of body.gravity" in capsys.readouterr().err


def test_static_displacements_from_a_loaded_shape_are_refused(tmp_path, capsys):
    """All predicted displacements were 0, whatever the parameters."""
    _write(tmp_path / "u.csv", scene := _scene(tmp_path), 1e-6)
    text = (tmp_path / "scene.toml").read_text().replace("[mesh]", '[mesh]\nis = "loaded"')
    (tmp_path / "scene.toml").write_text(text)
    files = [str(tmp_path / name) for name in ("scene.toml", "u.csv")]
    assert scene.points_are != "loaded"
    assert main(["field", *files, "--parameters", "law.mu", "--out", str(tmp_path)]) == 2
    assert "displacements count from this shape" in capsys.readouterr().err
