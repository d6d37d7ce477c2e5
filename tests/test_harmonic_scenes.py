"""Scenes of harmonic motion from files: allowed settings, and one-line messages for invalid input."""

import json

import h5py
import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from test_harmonic import FILE, slab

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core.struct import replace
from liverjax.waves.harmonic import largest_in_period

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.ci
def test_scene_files(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    scene.write_text(FILE + "frequencies = [40.0, 60.0]\n")
    out = ["--out", str(tmp_path / "out")]
    assert main(["simulate", str(scene), *out, "--vtu", "--mesh-error"]) == 0
    assert "60 Hz: largest displacement" in capsys.readouterr().out
    expected = lj.harmonic(lj.load_scene(scene))
    with h5py.File(tmp_path / "out" / "result.h5") as file:
        assert np.array_equal(file["displacement"][()], expected.displacement)
        assert file["mesh_error/displacement"].shape == expected.displacement.shape
        assert file["mesh_error/reactions"].shape == expected.reactions.shape
    shown = meshio.read(tmp_path / "out" / "vtu" / "frequency_002.vtu").point_data["displacement_imaginary"]
    assert np.array_equal(shown, np.asarray(expected.displacement[1]).imag)
    # The motion is about the last state of a transient run, stretched by 10 %.
    still = FILE.split("[[displaced]]")[0]
    pulled = "[[fixed]]\nwhere = {x_max = 0.0}\n[[displaced]]\nwhere = {x_min = 0.03}\nby = [0.003, 0.0, 0.0]\n"
    (tmp_path / "still.toml").write_text(still + pulled)
    assert main(["simulate", str(tmp_path / "still.toml"), "--out", str(tmp_path / "still")]) == 0
    assert main(["simulate", str(scene), *out, "--about", str(tmp_path / "still" / "result.h5")]) == 0
    assert "relaxed body" not in capsys.readouterr().out
    with h5py.File(tmp_path / "out" / "result.h5") as file, h5py.File(tmp_path / "still" / "result.h5") as state:
        about = lj.harmonic(lj.load_scene(scene), about=state["positions"][-1])
        assert np.array_equal(file["displacement"][()], about.displacement)
    assert np.abs(about.displacement - expected.displacement).max() > 1e-7
    with h5py.File(tmp_path / "still" / "result.h5", "a") as file:
        file.attrs["status"] = [1]
    assert main(["simulate", str(scene), *out, "--about", str(tmp_path / "still" / "result.h5")]) == 2
    assert "the last step of this run is" in capsys.readouterr().err


def test_the_run_about_which_a_body_oscillates_is_not_replaced(tmp_path, monkeypatch, capsys):
    """With the default --out, the waves replaced the static run, and the exit code was 0."""
    (tmp_path / "scene.toml").write_text(FILE + "frequencies = [40.0]\n")
    (tmp_path / "result.h5").write_text("static run")
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "scene.toml", "--about", "result.h5"]) == 2
    assert "--about result.h5 would be replaced by the results: give another --out" in capsys.readouterr().err
    assert (tmp_path / "result.h5").read_text() == "static run"


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "told"), [(0.1, True), (1e4, False)])
def test_a_run_that_has_not_rested_is_told(tmp_path, capsys, seconds, told):
    """Four fifths of the stiffness relax in 100 s, so the forces after 0.1 s are five times those at rest."""
    viscous = FILE.split("[[displaced]]")[0] + "[viscosity]\nratios = [0.8]\nrelaxation_times = [100.0]\n"
    pulled = "[[fixed]]\nwhere = {x_max = 0.0}\n[[displaced]]\nwhere = {x_min = 0.03}\nby = [0.003, 0.0, 0.0]\n"
    (tmp_path / "pull.toml").write_text(f"{viscous}{pulled}history = [[0, 0], [0.1, 1]]\n[solve]\ndt = {seconds}\n")
    (tmp_path / "waves.toml").write_text(
        viscous + "[[displaced]]\nwhere = {x_max = 0.0}\nby = [0.0, 1e-5, 0.0]\n"
        '[solve]\nkind = "harmonic"\nfrequencies = [40.0]\n'
    )
    assert main(["simulate", str(tmp_path / "pull.toml"), "--out", str(tmp_path)]) == 0
    about = ["--about", str(tmp_path / "result.h5"), "--out", str(tmp_path / "out")]
    assert main(["simulate", str(tmp_path / "waves.toml"), *about]) == 0
    assert ("the forces of the relaxed body differ from the forces of the run" in capsys.readouterr().out) == told
    with h5py.File(tmp_path / "out" / "result.h5") as file:
        assert len(json.loads(file.attrs["warnings"])) == told


HEAVY = FILE.replace("density = 1000.0", "density = 1000.0\ngravity = [-3.0, 0.0, 0.0]") + "frequencies = [40.0]\n"


@pytest.mark.slow
def test_a_scene_file_with_gravity_moves_about_its_state_of_rest(tmp_path):
    (tmp_path / "scene.toml").write_text(HEAVY)
    assert main(["simulate", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "out")]) == 0
    still = FILE.split("[[displaced]]")[0].replace("density = 1000.0", "density = 1000.0\ngravity = [-3.0, 0.0, 0.0]")
    still += "[[fixed]]\nwhere = {x_max = 0.0}\n"
    (tmp_path / "still.toml").write_text(still)
    rest = lj.simulate(lj.load_scene(tmp_path / "still.toml")).check().positions[-1]
    expected = lj.harmonic(lj.load_scene(tmp_path / "scene.toml"), about=rest).displacement
    with h5py.File(tmp_path / "out" / "result.h5") as file:
        found = file["displacement"][()]
    # The bound is Newton's tolerance of 1e-8. Without the state, the motion is different.
    assert np.allclose(found, expected, rtol=1e-5, atol=1e-10)
    scene = lj.load_scene(tmp_path / "scene.toml")
    bare = lj.harmonic(scene, about=scene.mesh.points).displacement
    assert np.abs(bare - expected).max() > 1e-3 * np.abs(expected).max()
    # Python gives the same result as the command line.
    assert np.allclose(lj.harmonic(scene).displacement, expected, rtol=1e-5, atol=1e-10)


@pytest.mark.slow
def test_gravity_has_a_derivative_through_the_state_of_rest(tmp_path):
    (tmp_path / "scene.toml").write_text(HEAVY)
    scene = lj.load_scene(tmp_path / "scene.toml")
    sharp = replace(scene, solve=replace(scene.solve, tolerance=1e-12))

    @jax.jit
    def moved(g):
        body = replace(scene.body, gravity=g * jnp.array([-1.0, 0.0, 0.0]))
        return jnp.sum(jnp.abs(lj.harmonic(replace(sharp, body=body)).displacement) ** 2)

    slope, h = jax.grad(moved)(3.0), 1e-3
    assert np.isclose(slope, (moved(3.0 + h) - moved(3.0 - h)) / (2 * h), rtol=1e-6)


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ("[[support]]\nwhere = {x_max = 0.0}\nnormal = 1e3\nhistory = [[0, 0], [1, 1]]\n", "support.0.history cannot"),
        (
            "[[obstacle]]\nshape = 'plane'\nposition = [0.05, 0, 0]\naxis = [-1, 0, 0]\nby = [-0.03, 0, 0]\n",
            "obstacle.0.by cannot be used with kind = 'harmonic'",
        ),
        ("", "body.history cannot be used with kind = 'harmonic'"),
    ],
)
def test_what_moves_in_time_is_no_harmonic_motion(tmp_path, capsys, part, words):
    scene, text = tmp_path / "scene.toml", FILE + "frequencies = [60.0]\n"
    heavy = "density = 1000.0\nhistory = [[0, 0, 0, -9.81], [1, 0, 0, -9.81]]"
    scene.write_text(text + part if part else text.replace("density = 1000.0", heavy))
    assert main(["simulate", str(scene), "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err


def test_a_heavy_body_under_a_pressed_obstacle_is_no_harmonic_motion(tmp_path, capsys):
    """The run under gravity came first, and its message demanded a time step."""
    heavy = FILE.replace("density = 1000.0", "density = 1000.0\ngravity = [0.0, 0.0, -9.81]")
    pressed = "[[obstacle]]\nshape = 'plane'\nposition = [0, 0, 0.01]\naxis = [0, 0, -1]\nforce = [0, 0, -0.01]\n"
    scene = tmp_path / "scene.toml"
    scene.write_text(heavy + "frequencies = [60.0]\n" + pressed)
    assert main(["simulate", str(scene), "--out", str(tmp_path / "out")]) == 2
    assert "friction and pressed obstacles cannot be used in harmonic motion" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "more", "words"),
    [
        ("", [], "can be used only together with frequencies"),
        ("frequencies = 60.0\n", [], "must be a list"),
        ("frequencies = []\n", [], "frequencies = [] contains no frequency"),
        ('frequencies = [60.0]\nreduced = "model.h5"\n', [], "reduced cannot be used with kind = 'harmonic'"),
        ("frequencies = [-60.0]\n", [], "frequencies"),
        ("frequencies = [60.0]\n", ["--png"], "--png cannot be used with [solve] kind = 'harmonic'"),
        ("frequencies = [60.0]\n", ["--every", "0"], "--every cannot be used with [solve] kind = 'harmonic'"),
        ("frequencies = [60.0]\ndt = 0.01\n", [], "[solve] dt cannot be used with [solve] kind = 'harmonic'"),
        ('frequencies = [60.0]\nnewton = "one_step"\n', [], "newton = 'one_step' has no effect with kind"),
        ('frequencies = [60.0]\nrobust = "projected"\n', [], "robust = 'projected' has no effect with kind"),
        ("frequencies = [60.0]\n", ["--about", "none.h5"], "none.h5 does not exist"),
        ("frequencies = [60.0]\n", ["--about", __file__], "contains no positions"),
    ],
)
def test_bad_scene_files_are_refused(tmp_path, capsys, line, more, words):
    scene = tmp_path / "scene.toml"
    scene.write_text(FILE + line)
    assert main(["simulate", str(scene), "--out", str(tmp_path / "out"), *more]) == 2
    assert words in capsys.readouterr().err


def test_a_file_in_the_place_of_the_folder_vtu_is_found_before_the_computation(tmp_path, monkeypatch, capsys):
    """The command ended with a traceback after the computation."""
    monkeypatch.setattr("liverjax.jobs.waves.solved_waves", lambda *_: pytest.fail("the computation begins"))
    (tmp_path / "scene.toml").write_text(FILE + "frequencies = [60.0]\n")
    (tmp_path / "vtu").write_text("")
    assert main(["simulate", str(tmp_path / "scene.toml"), "--vtu", "--out", str(tmp_path)]) == 2
    assert "contains a file vtu, but a folder vtu is needed" in capsys.readouterr().err


def test_runs_in_time_refuse_a_harmonic_scene():
    scene = slab(2, 1)
    with pytest.raises(lj.InputError, match=r"call lj\.harmonic"):
        lj.simulate(replace(scene, solve=lj.Solve(kind="harmonic", frequencies=jnp.array([60.0]))))
    with pytest.raises(lj.InputError, match="needs frequencies_Hz"):
        lj.harmonic(scene)


def test_the_largest_displacement_is_one_that_a_node_reaches():
    """On a circle the displacement always has the size of the radius. The norm of the amplitude is sqrt(2) times it."""
    rng = np.random.default_rng(0)
    u = np.concatenate([rng.normal(size=(4, 3)) + 1j * rng.normal(size=(4, 3)), [[2.0, 2.0j, 0.0], [3.0j, 4.0j, 0.0]]])
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 2001))[:, None, None]
    reached = np.linalg.norm((turn * u).real, axis=2).max(axis=0)
    np.testing.assert_allclose(largest_in_period(u), reached, rtol=1e-5)
    np.testing.assert_allclose(reached[-2:], [2.0, 5.0], rtol=1e-5)


def test_a_motion_without_an_amplitude_is_refused():
    """It ended in a traceback of JAX."""
    scene = slab(2, 1)
    times = jnp.array([0.0, 1.0])
    way = {"times": times, "history": jnp.array([[0.0, 0.0, 0.0], [1e-4, 0.0, 0.0]])}
    moved = replace(scene, displaced=(replace(scene.displaced[0], by=None, **way), *scene.displaced[1:]))
    with pytest.raises(lj.InputError, match=r"displaced\.0 has a history but no amplitude: give by, or the argument"):
        lj.harmonic(moved, [10.0])
    given = jnp.zeros(scene.mesh.points.shape).at[scene.displaced[0].nodes, 0].set(1e-4)
    found, expected = (lj.harmonic(own, [10.0], motion=given).displacement for own in (moved, scene))
    assert np.array_equal(found, expected)
