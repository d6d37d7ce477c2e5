"""Batches and sweeps: equal to single runs for every strategy, with several devices, kills and resumed runs."""

import os
import resource
import subprocess
import sys
import time
from types import SimpleNamespace

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.commands.sweep import OUTPUTS
from liverjax.core import status
from liverjax.jobs import resumable_parts, sweep
from liverjax.simulation.batch import strategy_for
from liverjax.simulation.run import Result

pytestmark = pytest.mark.quick_to_compile

SCENE = """
[mesh]
shape = "box"
size = [0.1, 0.1, 0.1]
cells = [2, 2, 2]
[law]
name = "neo_hookean"
mu = 770.0
bulk = 2200.0
[body]
density = 1060.0
gravity = [0.0, 0.0, -9.81]
[[fixed]]
where = {z_min = 0.1}
[solve]
steps = 2
"""
ROWS = 7
TABLE = "# made for a test\nlaw.mu, body.density\n" + "".join(f"{700 + 20 * k}, {1000 + 10 * k}\n" for k in range(ROWS))


@pytest.fixture
def files(tmp_path):
    """A scene file and a table."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "rows.csv").write_text(TABLE)
    return tmp_path


def command(files, *more: str) -> list[str]:
    """Return the arguments of a sweep of these files."""
    return ["sweep", str(files / "scene.toml"), str(files / "rows.csv"), "--chunk", "2", *more]


def content(file) -> dict[str, bytes]:
    """Return the bytes of every dataset."""
    with h5py.File(file) as out:
        return {name: value[()].tobytes() for name, value in out.items()}


@pytest.mark.ci
def test_a_batch_is_the_loop_and_a_lane_that_fails_spoils_no_other(files):
    scene = lj.load_scene(files / "scene.toml")
    density = jnp.array([1000.0, 1e12, 1100.0])  # the second body falls too far for every law
    batch = lj.simulate_batch(scene, {"body.density": density})
    assert batch.strategy == ("map" if jax.default_backend() == "cpu" else "vmap") and batch.devices == 1
    codes = np.asarray(batch.result.status)
    assert (codes[[0, 2]] == status.CONVERGED).all() and (codes[1] != status.CONVERGED).any()
    for k in (0, 2):
        alone = lj.simulate(lj.with_parameters(scene, {"body.density": density[k]})).positions
        assert np.abs(np.asarray(batch.result.positions[k] - alone)).max() < 1e-12


def test_lanes_go_one_after_another_on_a_cpu_only():
    assert strategy_for("cpu") == "map" and strategy_for("cuda") == "vmap"


@pytest.mark.slow
def test_gradient_of_a_batch_mean(files):
    scene = lj.with_parameters(lj.load_scene(files / "scene.toml"), {"solve.tolerance": 1e-11})

    @jax.jit
    @jax.value_and_grad
    def mean(scale):
        values = {"law.mu": scale * jnp.array([700.0, 800.0]), "body.density": jnp.array([1000.0, 1100.0])}
        return jnp.mean(lj.simulate_batch(scene, values).result.positions[:, -1, :, 2])

    h = 1e-4
    difference = (mean(1 + h)[0] - mean(1 - h)[0]) / (2 * h)
    assert np.isclose(difference, mean(1.0)[1], rtol=1e-6)


@pytest.mark.parametrize(
    "values, sentence",
    [
        ({}, "needs parameters"),
        ({"law.mu": 700.0}, "law.mu has no list of values"),
        ({"law.mu": [1.0, 2.0], "law.bulk": [1.0]}, "law.bulk has 1 values, but law.mu has 2: give equal numbers"),
        ({"law.nu": [1.0]}, "did you mean law.mu"),
    ],
)
def test_unusable_batches_are_refused(files, values, sentence):
    with pytest.raises(lj.InputError, match=sentence):
        lj.simulate_batch(lj.load_scene(files / "scene.toml"), values)


@pytest.mark.core
def test_a_sweep_holds_the_rows_of_single_runs(files):
    more = ("--store", "final_positions", "largest_displacement", "final_reactions", "--probe", "0", "3")
    assert main(command(files, *more)) == 0
    scene = lj.load_scene(files / "scene.toml")
    with h5py.File(files / "rows.h5") as out:
        assert out["parameters"].attrs["names"].tolist() == ["law.mu", "body.density"]
        for k in (0, ROWS - 1):
            values = dict(zip(("law.mu", "body.density"), out["parameters"][k], strict=True))
            result = lj.simulate(lj.with_parameters(scene, values))
            moved = np.linalg.norm(np.asarray(result.positions) - np.asarray(scene.mesh.points), axis=-1).max()
            assert np.abs(out["final_positions"][k] - np.asarray(result.positions[-1])).max() < 1e-12
            assert np.abs(out["probes"][k] - np.asarray(result.positions[:, [0, 3]])).max() < 1e-12
            assert np.isclose(out["largest_displacement"][k], moved, rtol=1e-9)
        assert out["status"].shape == (ROWS, 2) and not out["status"][:].any()
        assert not (files / "rows.h5.parts").exists()


@pytest.mark.slow
def test_rows_of_a_loaded_mesh_are_measured_from_their_own_shapes(files):
    """Each body is given in its loaded shape, so each run has a separate reference shape."""
    (files / "scene.toml").write_text(SCENE.replace("[mesh]", '[mesh]\nis = "loaded"'))
    (files / "rows.csv").write_text("law.mu\n700\n1400\n2000\n")
    assert main(command(files, "--store", "largest_displacement", "final_positions")) == 0
    scene = lj.load_scene(files / "scene.toml")
    with h5py.File(files / "rows.h5") as out:
        assert out["reference"].shape == (3, 27, 3) and out["reference"].attrs["unit"] == "m"
        for k, mu in enumerate((700.0, 1400.0, 2000.0)):
            own = np.asarray(lj.unloaded(lj.with_parameters(scene, {"law.mu": mu})).scene.mesh.points)
            moved = np.linalg.norm(np.asarray(scene.mesh.points) - own, axis=1).max()
            # Both end in the given shape, up to Newton's tolerance.
            assert np.abs(out["reference"][k] - own).max() < 1e-6 * moved
            assert np.isclose(out["largest_displacement"][k], moved, rtol=1e-6)
            assert np.abs(out["final_positions"][k] - np.asarray(scene.mesh.points)).max() < 1e-6 * moved
    table = sweep.read_sweep(files / "scene.toml", files / "rows.csv", chunk=2)
    assert "reference" in table.identity["outputs"]


@pytest.mark.slow
def test_resumed_results_have_the_same_bytes(files):
    assert main(command(files, "--out", str(files / "whole.h5"))) == 0
    table = sweep.read_sweep(files / "scene.toml", files / "rows.csv", chunk=2)

    class Stopped(Exception):
        pass

    def stop(_):
        raise Stopped

    out = files / "stopped.h5"
    with pytest.raises(Stopped):
        sweep.run(table, out, report=stop)  # stops after the first chunk
    assert not out.exists()
    assert main(command(files, "--out", str(out))) == 2  # unfinished: the message asks for --resume
    (files / "stopped.h5.parts" / "part_000001.123").write_bytes(b"half a chunk")
    assert main(command(files, "--out", str(out), "--resume")) == 0
    assert content(out) == content(files / "whole.h5")
    assert sweep.run(table, out, resume=True).computed == 0  # all chunks are present


@pytest.mark.ci
def test_killed_and_resumed(files):
    """The process is killed by signal 9 after the first chunk."""
    whole, out = files / "whole.h5", files / "killed.h5"
    assert main(command(files, "--out", str(whole))) == 0
    call = [sys.executable, "-m", "liverjax", *command(files, "--out", str(out), "--resume")]
    run = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not list(files.glob("killed.h5.parts/part_*.h5")) and run.poll() is None:
        time.sleep(0.001)
    run.kill()
    run.wait()
    part = min(files.glob("killed.h5.parts/part_*.h5"))
    part.write_bytes(part.read_bytes()[:-500])  # as if the disk had lost the end of the file
    assert main(command(files, "--out", str(out), "--resume")) == 0
    assert content(out) == content(whole)


@pytest.mark.slow
def test_two_devices_find_the_same(files):
    """This runs in a separate process, because the number of devices is fixed at the start."""
    assert main(command(files, "--out", str(files / "one.h5"))) == 0
    call = [sys.executable, "-m", "liverjax", *command(files, "--out", str(files / "two.h5"), "--devices", "2")]
    subprocess.run(call, check=True, capture_output=True, timeout=300)
    with h5py.File(files / "one.h5") as one, h5py.File(files / "two.h5") as two:
        assert np.abs(one["final_positions"][:] - two["final_positions"][:]).max() < 1e-12


def test_several_processes_share_a_sweep(files):
    assert main(command(files, "--out", str(files / "whole.h5"))) == 0
    table = sweep.read_sweep(files / "scene.toml", files / "rows.csv", chunk=2)
    out = files / "shared.h5"
    first = sweep.run(table, out, process=(0, 2))
    assert first.file is None and first.computed == 4 and not out.exists()
    second = sweep.run(table, out, process=(1, 2))
    assert second.file == out and second.computed == 3
    assert content(out) == content(files / "whole.h5")


@pytest.mark.ci
def test_failed_rows_are_listed_and_run_again_alone(files, capsys):
    (files / "rows.csv").write_text("law.mu,body.density\n700,1000\n700,1e12\n720,1000\n")
    assert main(command(files)) == 1
    said = capsys.readouterr()
    assert "1 failed" in said.out and "failed: row 2: " in said.err and "again, use --rows 2 --out" in said.err
    assert main(command(files, "--rows", "3", "--out", str(files / "again.h5"))) == 0
    with h5py.File(files / "rows.h5") as all_rows, h5py.File(files / "again.h5") as again:
        assert again["row"][:].tolist() == [3] and np.allclose(again["parameters"][0], all_rows["parameters"][2])
        assert np.abs(again["final_positions"][0] - all_rows["final_positions"][2]).max() < 1e-12


def test_failed_rows_are_told_by_the_process_that_comes_last(files, monkeypatch):
    """Another process joins the parts after this process has finished its last chunk and before it tries to
    join them.
    """
    (files / "rows.csv").write_text("law.mu,body.density\n700,1000\n700,1e12\n720,1000\n")
    table, out = sweep.read_sweep(files / "scene.toml", files / "rows.csv", chunk=2), files / "rows.h5"

    def joined_before(sweep_now, file, folder, computed):
        join(sweep_now, file, folder, computed)
        folder.mkdir()
        return join(sweep_now, file, folder, computed)

    join = sweep._joined
    monkeypatch.setattr(sweep, "_joined", joined_before)
    done = sweep.run(table, out)
    assert done.file == out and list(done.failed) == [2] and done.computed == 3


@pytest.mark.slow
def test_rows_that_end_crushed_are_told(files, capsys):
    """A cube between walls is compressed to a tenth. The runs converged, and only `simulate` gave a warning."""
    walls = '[[fixed]]\nwhere = {z_min = -1.0, z_max = 0.099}\naxes = "xy"\n'
    pressed = '[[displaced]]\nwhere = {z_max = 0.0}\nby = [0.0, 0.0, 0.01]\naxes = "z"\n'
    (files / "scene.toml").write_text(SCENE.replace("[solve]\nsteps = 2", f"{walls}{pressed}[solve]\nsteps = 6"))
    (files / "rows.csv").write_text("displaced.0.by.2\n0.01\n0.09\n0.02\n")
    words = command(files, "--out", str(files / "rows.h5"))
    assert main(words) == 0
    told = capsys.readouterr().err
    assert "at the end of 1 run (row 2; worst" in told and "worst: row 2, J = 0" in told
    with h5py.File(files / "rows.h5") as found:
        J = found["volume_ratios"][:]
    assert np.allclose(J[:, 0], [0.9, 0.1, 0.8], rtol=0.1) and np.all(J[:, 0] < J[:, 1])
    assert main([*words, "--resume"]) == 0 and "worst: row 2" in capsys.readouterr().err


#: Parts that a row may change, in addition to the cube.
PARTS = """
[[obstacle]]
shape = "plane"
position = [0, 0, 0.1]
axis = [0, 0, -1]
by = [0, 0, -0.01]
[[vessel]]
line = [[0.02, 0.05, 0.0], [0.05, 0.05, 0.1]]
radius = 3e-3
wall = 5e-4
[vessel.law]
name = "neo_hookean"
mu = 1e5
[[ligament]]
where = {z_min = 0.1}
to = [0.05, 0.05, 0.15]
stiffness = 20.0
pre_tension = 0.05
"""


@pytest.mark.parametrize(
    "column, value, words",
    [
        ("obstacle.0.axis.2", -2.0, "of length 1"),
        ("obstacle.0.position.2", 0.05, "the obstacle overlaps the body by 0.05 m"),
        ("vessel.0.wall", 0.005, "thicker than the radius"),
        ("obstacle.0.radius", 0.02, "has no effect on a plane"),
        # A fibre is at least 5 cm long. At 20 N/m times that, its rest length is zero.
        ("ligament.0.pre_tension", 50.0, "must be below 1 N"),
    ],
)
def test_rows_are_checked_as_the_scene_is(files, column, value, words):
    (files / "scene.toml").write_text(SCENE.replace("z_min = 0.1", "z_max = 0.0") + PARTS)
    good = lj.load_scene(files / "scene.toml")
    (files / "rows.csv").write_text(f"{column}\n{float(lj.scenes.scene.numbers_at(good, column))}\n{value}\n")
    with pytest.raises(lj.InputError, match=f"row 2: {column[:10]}.*{words}"):
        sweep.read_sweep(files / "scene.toml", files / "rows.csv")


#: Supports, a motion and a history that a row may change.
OTHER_PARTS = """
[[support]]
where = {x_max = 0.0}
normal = 1e3
[[support]]
where = {y_max = 0.0}
sliding = true
[[displaced]]
where = {y_max = 0.0, x_min = 0.1, z_max = 0.05}
by = [0.001, 0.0, 0.0]
[[traction]]
where = {z_max = 0.0}
value = [0.0, 0.0, 1.0]
history = [[0, 0], [0.1, 1]]
"""


@pytest.mark.parametrize(
    "column, good, bad, words",
    [
        ("support.0.stiffness", 0.0, 50.0, "has no effect: for springs on a surface give normal"),
        ("displaced.0.by.1", 0.0, 0.01, "displaced.0 moves node .* out of the plane of support.1"),
        ("traction.0.times.1", 0.1, -0.1, "increasing times"),
    ],
)
def test_rows_are_refused_that_a_scene_file_may_not_have(files, column, good, bad, words):
    (files / "scene.toml").write_text(SCENE.replace("steps = 2", "steps = 2\ndt = 0.1") + OTHER_PARTS)
    (files / "rows.csv").write_text(f"{column}\n{good}\n{bad}\n")
    with pytest.raises(lj.InputError, match=f"row 2: .*{words}"):
        sweep.read_sweep(files / "scene.toml", files / "rows.csv")
    (files / "rows.csv").write_text("suport.0.normal\n1.0\n")
    with pytest.raises(lj.InputError, match="did you mean support"):
        sweep.read_sweep(files / "scene.toml", files / "rows.csv")


def test_a_batch_refuses_times_that_do_not_increase(files):
    """All sets after the first one were checked only for bounds. Such a run ended with status 0."""
    (files / "scene.toml").write_text(SCENE.replace("steps = 2", "steps = 2\ndt = 0.1") + OTHER_PARTS)
    scene = lj.load_scene(files / "scene.toml")
    with pytest.raises(
        lj.InputError, match=r"parameter set 1 \(counted from 0\): traction.0 history .* increasing times"
    ):
        lj.simulate_batch(scene, {"traction.0.times.1": jnp.array([0.1, -0.1])})


def test_check_of_a_batch_names_run_and_step():
    """The place in the table of runs and steps was given as the number of a step, here 4."""
    codes = np.full((3, 2), status.CONVERGED)
    codes[1, 1] = status.INVERTED
    batch = Result(times=None, positions=None, reactions=None, status=codes, statistics=None)
    with pytest.raises(RuntimeError, match=r"^run 1 \(counted from 0\), step 2: "):
        batch.check()


def test_rows_that_nothing_holds_are_refused(files):
    """Fibres of 5 cm and more support the body. With a larger rest length they are slack."""
    own = PARTS[PARTS.index("[[ligament]]") :].replace("pre_tension = 0.05", "rest_length = 0.04")
    loose = SCENE.replace("z_min = 0.1", "x_max = 0.0") + own
    (files / "scene.toml").write_text(loose.replace("[solve]", 'axes = "xy"\n[solve]'))
    (files / "rows.csv").write_text("ligament.0.rest_length\n0.04\n0.2\n")
    with pytest.raises(lj.InputError, match="row 2: the supports do not prevent every rigid motion of the body"):
        sweep.read_sweep(files / "scene.toml", files / "rows.csv")
    (files / "scene.toml").write_text(loose)  # fixed along z too
    assert len(sweep.read_sweep(files / "scene.toml", files / "rows.csv").rows) == 2


def test_what_cannot_be_resumed_is_refused(files, capsys):
    table = sweep.read_sweep(files / "scene.toml", files / "rows.csv", chunk=2)
    out = files / "rows.h5"
    sweep.run(table, out, process=(0, 2))
    with resumable_parts.locked(out.with_name("rows.h5.parts") / "lock_0"):
        assert main(command(files, "--resume")) == 2
    assert "in use by another process" in capsys.readouterr().err
    (files / "rows.csv").write_text(TABLE.replace("700", "701"))
    assert main(command(files, "--resume")) == 2
    assert "another sweep (not the same parameters)" in capsys.readouterr().err
    (files / "rows.csv").write_text(TABLE)
    (files / "scene.toml").write_text(SCENE.replace("2200", "2300"))
    assert main(command(files, "--resume")) == 2
    assert "another sweep (not the same scene)" in capsys.readouterr().err
    (files / "scene.toml").write_text(SCENE)
    assert main(command(files, "--resume")) == 0  # nothing was lost
    assert main(command(files)) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["sweep", *command(files)[1:3], "--out", str(files)]) == 2
    assert "is a folder: name a file" in capsys.readouterr().err


@pytest.mark.parametrize(
    "table, sentence",
    [
        ("law.mu\n", "has no rows"),
        ("law.mu,law.mu\n1,2\n", "has two columns law.mu"),
        ("law.mu\n1,2\n", "row 1 has 2 values for 1 names"),
        ("law.mu;law.bulk\n700;2000\n", "semicolons between its cells"),
        ("law.mu\tlaw.bulk\n700\t2000\n", "tabs between its cells"),
        ("law.mu\n1\nx\n", "row 2, law.mu = 'x' is not a finite number"),
        ("law.mu\n1_000\n", "row 1, law.mu = '1_000' is not a finite number"),
        ("body.gravity.2,body.gravity.02\n0.01,0.02\n", "'02' is not a name or index here"),
        ("law.mu\nnan\n", "row 1, law.mu = 'nan' is not a finite number"),
        ("law.mu\n700\n-1\n", "row 2: .*mu = -1"),
        ("law.nu\n700\n", "did you mean law.mu?"),
        ("mu\n700\n", "did you mean law.mu?"),
        ("Law.mu\n700\n", "did you mean law.mu?"),
        ("law.mu [Pa]\n700\n", "did you mean law.mu?"),
        ("law.mu,\n700,\n", "column 2 has no name"),
        ("mesh.points\n700\n", "'mesh.points' would change the mesh"),
        ("mesh.points.0.1\n700\n", "which is the same in all runs of a sweep: remove this column"),
        ("mesh.cells.0\n3\n", "'mesh.cells.0' would change the mesh"),
        ("solve.reduced_tolerance\n0.1\n", "has no effect, because a sweep uses no reduced model"),
        ("fixed.0.nodes.0\n3\n", "is not a number of the scene file"),
        ("solve.tolerance\n0.1\n0\n", "row 2: .*tolerance = 0.0 must be above 0"),
    ],
)
def test_unusable_tables_are_refused(files, table, sentence):
    (files / "rows.csv").write_text(table)
    with pytest.raises(lj.InputError, match=sentence):
        sweep.read_sweep(files / "scene.toml", files / "rows.csv")


@pytest.mark.slow
def test_writes_that_fail_keep_what_was_computed(processor, files):
    """A limit on the size of files causes the same failing write as a full disk."""
    table = sweep.read_sweep(files / "scene.toml", files / "rows.csv", chunk=2)
    out = files / "rows.h5"
    sweep.run(table, out, process=(0, 2))  # every second chunk
    finished = sorted(files.glob("rows.h5.parts/part_*"))
    most = finished[0].stat().st_size - 1
    call = [sys.executable, "-m", "liverjax", *command(files, "--resume")]
    small = {**os.environ, "JAX_COMPILATION_CACHE_DIR": ""}  # JAX would write into this folder

    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    run = subprocess.run(call, capture_output=True, text=True, timeout=300, preexec_fn=limited, env=small)
    assert run.returncode == 1 and len(run.stderr.splitlines()) == 1
    assert "(File too large). Finished chunks are kept: continue with --resume" in run.stderr
    assert sorted(files.glob("rows.h5.parts/part_*")) == finished and len(finished) == 2
    assert main(command(files, "--resume")) == 0


def test_no_room_for_the_joined_file_keeps_the_parts(files, monkeypatch, capsys):
    monkeypatch.setattr(sweep.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    assert main(command(files)) == 1
    assert "(No space left on device). Finished chunks are kept: continue with --resume" in capsys.readouterr().err
    monkeypatch.undo()
    assert main(command(files, "--resume")) == 0


@pytest.mark.slow
def test_a_row_that_iterations_do_not_solve_is_factorised(files):
    """All rows share one program, in which their values are unknown. A nearly incompressible body failed, with a force
    12 times too large.
    """
    pull = "[[displaced]]\nwhere = {z_max = 0.0}\nby = [0.0, 0.0, -0.01]\n"
    (files / "pull.toml").write_text(SCENE + pull)
    (files / "stiff.csv").write_text("law.bulk\n7700\n7.7e6\n")
    table = sweep.read_sweep(files / "pull.toml", files / "stiff.csv", ("final_reactions",))
    assert table.scene.solve.linear_solver == "direct"
    assert not sweep.run(table, files / "stiff.h5").failed
    (files / "soft.csv").write_text("law.bulk\n7700\n8800\n")
    assert sweep.read_sweep(files / "pull.toml", files / "soft.csv").scene.solve.linear_solver == "auto"


def test_unusable_options_are_refused(files, capsys):
    for given, sentence in (
        (("--devices", "0"), "--devices 0 must be"),
        (("--distributed", "x", "two"), "give HOST:PORT"),
        (("--distributed", "localhost:abc", "1", "0"), "localhost:abc is not HOST:PORT"),
        (("--distributed", "localhost", "1", "0"), "localhost is not HOST:PORT"),
        (("--distributed", "localhost:1234", "0", "0"), "the number of processes must be above 0"),
    ):
        assert main(command(files, *given)) == 2
        assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("solve", "words"),
    [
        ('kind = "harmonic"\nfrequencies = [20.0]', "kind = 'harmonic' cannot be used in a sweep"),
        ('reduced = "model.h5"', "model.h5' cannot be used in a sweep"),
    ],
)
def test_scenes_that_are_not_swept_are_refused_before_a_file_is_written(files, solve, words, capsys):
    scene = SCENE.split("[solve]")[0] + f"[solve]\n{solve}\n"
    (files / "other.toml").write_text(scene)
    (files / "mu.csv").write_text("law.mu\n700\n800\n")
    ask = ["sweep", str(files / "other.toml"), str(files / "mu.csv"), "--out", str(files / "other.h5")]
    assert main(ask) == 2 and words in capsys.readouterr().err and not list(files.glob("other.h5*"))


def test_one_table_stands_for_a_list_of_one(files):
    one_law = SCENE.replace("[law]", "[[law]]").replace("770.0", "770")
    (files / "scene.toml").write_text(one_law + "[traction]\nwhere = {z_max = 0.0}\npressure = 4.0\n")
    (files / "rows.csv").write_text("traction.0.pressure,law.mu\n5,2\n")
    table = sweep.read_sweep(files / "scene.toml", files / "rows.csv")
    changed = lj.with_parameters(table.scene, dict(zip(table.names, table.rows[0].tolist(), strict=True)))
    assert changed.traction[0].pressure == 5.0 and changed.law.mu == 2.0


def test_the_help_names_every_output():
    assert tuple(sweep.OUTPUTS) == OUTPUTS
