"""The command lines: files, exit codes, and one-line messages for unusable input."""

import argparse
import errno
import importlib
import json
import os
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ROOT

from fitting.__main__ import main
from fitting.commands import shared_options, waves
from fitting.fits import sample_inertia, samples, viscoelastic
from fitting.fits.families import springpots_in_time
from liverjax.__main__ import main as liverjax_main
from liverjax.commands import exit_codes
from liverjax.commands.arguments import with_joined_numbers
from liverjax.core.errors import InputError

pytestmark = pytest.mark.quick_to_compile

PORCINE = ROOT / "data" / "porcine_liver_frequency_sweep.csv"
LION = ROOT / "data" / "lions_mane_frequency_sweep.csv"


def _contract(content: dict, modes: int) -> None:
    names = "shear_modulus equilibrium_modulus ratios relaxation_times standard_errors correlation modes method"
    names += " mean_relative_error max_relative_error warnings run_time_s compile_time_s versions"
    assert set(names.split()) <= set(content)
    assert content["modes"] == modes == len(content["ratios"]) == len(content["relaxation_times"])
    assert content["relaxation_times"] == sorted(content["relaxation_times"], reverse=True)
    errors = content["standard_errors"]
    assert set(errors) == {"shear_modulus", "equilibrium_modulus", "ratios", "relaxation_times"}
    assert np.shape(content["correlation"]) == (2 * modes + 1, 2 * modes + 1)
    G0, g = content["shear_modulus"], content["ratios"]
    assert np.isclose(content["equilibrium_modulus"], G0 * (1 - sum(g)))
    assert {"jax", "numpy", "liverjax"} <= set(content["versions"])


@pytest.mark.ci
@pytest.mark.draws
def test_main_job_as_a_new_user(tmp_path):
    """Run the README's command on the model-implied sweep: through the simulation, with the closed form for
    comparison.
    """
    run = subprocess.run(
        [sys.executable, "-m", "fitting", str(PORCINE), "--out", str(tmp_path / "fit")],
        env=os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"},  # users run with all optimisations
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    content = json.loads((tmp_path / "fit" / "fit.json").read_text())
    _contract(content, 2)
    assert content["method"] == "torsion" and content["closed_form"]["method"] == "closed-form"
    values = [content["shear_modulus"], *content["ratios"], *content["relaxation_times"]]
    assert np.allclose(values, [770, 0.235, 0.333, 0.27, 0.03], rtol=5e-3)
    assert "closed-form" in run.stdout and "torsion" in run.stdout and "Traceback" not in run.stderr
    assert "%|" not in run.stderr  # no progress bar if the output is not a terminal
    assert (tmp_path / "fit" / "fit.png").stat().st_size > 10_000
    with h5py.File(tmp_path / "fit" / "fit.h5") as file:
        assert file["torsion/covariance"].shape == (5, 5)
        assert file["data/storage"].attrs["unit"] == "Pa"


def test_closed_form_on_measured_data(tmp_path, capsys):
    code = main([str(LION), "--method", "closed-form", "--profile", "--out", str(tmp_path)])
    assert code == 0
    content = json.loads((tmp_path / "fit.json").read_text())
    _contract(content, content["modes"])
    assert content["method"] == "closed-form" and content["profile_intervals_95"]
    assert "(profile likelihood, closed form): " in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.core
def test_bfgs_option(tmp_path):
    code = main(
        [str(PORCINE), "--method", "closed-form", "--modes", "2", "--optimizer", "bfgs", "--out", str(tmp_path)]
    )
    assert code == 0
    assert np.isclose(json.loads((tmp_path / "fit.json").read_text())["shear_modulus"], 770, rtol=1e-4)


def test_unconverged_fit_exits_1_and_keeps_its_best_point(tmp_path, monkeypatch, capsys):
    from fitting.fits import viscoelastic
    from fitting.methods import least_squares

    few = viscoelastic.from_starts
    monkeypatch.setattr(least_squares, "LONGER", 1)
    monkeypatch.setattr(viscoelastic, "from_starts", lambda *a: few(*a, max_iterations=1))
    assert main([str(PORCINE), "--method", "closed-form", "--modes", "2", "--out", str(tmp_path)]) == 1
    content = json.loads((tmp_path / "fit.json").read_text())
    assert content["converged"] is False and content["shear_modulus"] > 0
    assert "did not converge" in content["warnings"][0]
    assert "not converged" in capsys.readouterr().out


@pytest.mark.parametrize("density", [None, 1060.0])
def test_the_density_of_the_command_reaches_the_rig(density, tmp_path, monkeypatch):
    from fitting.rigs import torsion

    class Seen(Exception):
        pass

    def make_rig(*_, density=0.0, **__):
        raise Seen(density)

    monkeypatch.setattr(torsion, "make_rig", make_rig)
    given = [] if density is None else ["--density", str(density)]
    with pytest.raises(Seen) as seen:
        main([str(PORCINE), "--modes", "1", *given, "--out", str(tmp_path)])
    assert seen.value.args == (density,)


HEADER = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n"
BAD = {
    "no file": (None, [], "does not exist"),
    "column": ("frequency_Hz,storage_modulus_Pa\n1,2\n2,3\n", [], "no column for loss"),
    "nan": (HEADER + "1,300,30\n2,nan,40\n", [], "is empty"),
    "negative loss": (HEADER + "1,300,30\n2,310,-40\n", [], "is not positive"),
    "too many modes": (HEADER + "1,300,30\n2,310,40\n3,320,50\n", ["--modes", "3"], "use at most --modes 2"),
    "zero modes": (HEADER + "1,300,30\n2,310,40\n", ["--modes", "0"], "at least 1"),
    "exchanged": (HEADER + "0.1,30,300\n1,60,400\n10,90,500\n", [], "the two columns are exchanged"),
    "law": (HEADER + "1,300,30\n2,310,40\n", ["--law", "neohookean"], "did you mean neo_hookean"),
    "radius in mm": (HEADER + "1,300,30\n2,310,40\n", ["--radius", "4"], "give e.g. --radius 0.004"),
    "radius": (HEADER + "1,300,30\n2,310,40\n", ["--radius", "-1"], "--radius -1.0 cannot be"),
    "height in mm": (HEADER + "1,300,30\n2,310,40\n", ["--height", "nan"], "--height nan cannot be"),
    "gap error": (HEADER + "1,300,30\n2,310,40\n", ["--gap-error", "-1e-5"], "--gap-error -1e-05"),
    "density": (HEADER + "1,300,30\n2,310,40\n", ["--density", "1.06"], "give e.g. --density 1060"),
    "density without height": (
        HEADER + "1,300,30\n2,310,40\n",
        ["--density", "1060", "--method", "closed-form"],
        "--density 1060 needs --height too",
    ),
    "table": (HEADER + "1,300,30\n2,310,40\n", ["--table", "liver"], "--table liver is no table of the file"),
    "steps": (HEADER + "1,300,30\n2,310,40\n", ["--steps", "1"], "--steps 1 is out of range"),
}


def test_the_closed_form_takes_the_inertia_of_the_sample_off(tmp_path, capsys):
    """A mode of 100 Pa in parallel with a spring of 900 Pa, 10 mm high. At 100 rad/s the sample's inertia reduces the
    measured modulus by more than a third.
    """
    omega = np.geomspace(1.0, 100.0, 12)
    G = 900.0 + 100.0 * 1j * omega * 0.05 / (1 + 1j * omega * 0.05)
    seen = sample_inertia.shown(G, omega, 1060.0, 0.01)
    rows = np.column_stack([omega, seen.real, seen.imag])
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", rows, "%.12g", ",", header=head, comments="")
    more = ["--density", "1060", "--height", "0.01", "--method", "closed-form", "--out", str(tmp_path)]
    assert main([str(tmp_path / "s.csv"), *more]) == 0
    assert "the inertia of the sample, 10 mm high, is subtracted" in capsys.readouterr().err
    found = json.loads((tmp_path / "fit.json").read_text())
    assert seen.real[-1] < 0.8 * G.real[-1]
    assert np.isclose(found["equilibrium_modulus"], 900, rtol=1e-6) and np.isclose(
        found["shear_modulus"], 1000, rtol=1e-6
    )


@pytest.mark.slow
def test_points_that_the_inertia_of_the_sample_bends_are_kept_if_it_is_known(tmp_path, capsys):
    """Before the inertia of the sample was subtracted, these points were left out as affected by the instrument."""
    hertz = np.logspace(-1.7, 1.5, 33)
    tau, part, rng = np.array([0.02, 0.4, 8.0]), np.array([0.3, 0.25, 0.2]), np.random.default_rng(0)
    iwt = 2j * np.pi * hertz[:, None] * tau
    G = 2000 * (0.25 + (part * iwt / (1 + iwt)).sum(axis=1))
    seen = sample_inertia.shown(G, 2 * np.pi * hertz, 1060.0, 0.006)
    noise = 1 + 0.005 * rng.normal(size=(2, 33))
    rows = np.column_stack([hertz, seen.real * noise[0], seen.imag * noise[1]])
    head = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", rows, "%.12g", ",", header=head, comments="")
    command = [str(tmp_path / "s.csv"), "--method", "closed-form", "--height", "0.006", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "which is the mark of the instrument" in capsys.readouterr().err
    assert main([*command, "--density", "1060"]) == 0
    told = capsys.readouterr().err
    assert "mark of the instrument" not in told and "the inertia of the sample, 6 mm high" in told
    assert np.isclose(json.loads((tmp_path / "fit.json").read_text())["shear_modulus"], 2000, rtol=0.02)


@pytest.mark.parametrize("name", BAD)
def test_unusable_input_exits_2_with_one_sentence(name, tmp_path, capsys):
    text, options, sentence = BAD[name]
    path = tmp_path / "sweep.csv"
    if text is not None:
        path.write_text(text)
    assert main([str(path), *options, "--out", str(tmp_path / "fit")]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("note")]
    assert len(lines) == 1 and lines[0].startswith("error: ") and sentence in lines[0]
    assert not (tmp_path / "fit").exists()


def test_output_folder_that_is_a_file(tmp_path, capsys):
    (tmp_path / "fit").write_text("mine")
    assert main([str(PORCINE), "--out", str(tmp_path / "fit")]) == 2
    assert "is a file" in capsys.readouterr().err
    assert main([str(PORCINE), "--out", str(tmp_path / "fit" / "deeper")]) == 2
    assert "name a folder that can be written" in capsys.readouterr().err
    (tmp_path / "out" / "fit.h5").mkdir(parents=True)
    assert main([str(PORCINE), "--out", str(tmp_path / "out")]) == 2
    assert "contains a folder fit.h5" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "option", "name"),
    [
        *((command, "--cards", "cards") for command in ("sweep", "relaxation", "samples", "together")),
        *((command, "--samples=100", "posterior.csv") for command in ("sweep", "relaxation")),
        ("sweep", "--report", "report.pdf"),
    ],
)
def test_results_that_cannot_be_written_are_found_before_the_fit(command, option, name, tmp_path, monkeypatch, capsys):
    """The whole fit was computed, and then the command ended with a traceback."""

    def computed(*_):
        raise AssertionError("the fit begins")

    for fit in (viscoelastic, "choose_modes"), (springpots_in_time, "choose_in_time"), (samples, "fit"):
        monkeypatch.setattr(*fit, computed)
    monkeypatch.setattr(springpots_in_time, "choose_together", computed)
    (tmp_path / "test.csv").write_text("time_s,modulus_Pa\n1,900\n2,800\n3,750\n4,730\n")
    files = {
        "sweep": [str(PORCINE)],
        "relaxation": ["relaxation", str(tmp_path / "test.csv")],
        "samples": [str(PORCINE), str(LION)],
        "together": [str(PORCINE), "--with", str(tmp_path / "test.csv")],
    }
    if name == "cards":
        (tmp_path / name).write_text("")
    else:
        (tmp_path / name).mkdir()
    assert main([*files[command], option, "--out", str(tmp_path)]) == 2
    kind = "file" if name == "cards" else "folder"
    assert f"contains a {kind} {name}" in capsys.readouterr().err


def test_files_of_an_earlier_run_are_found_by_pattern(tmp_path, capsys):
    """waves writes a sweep for each region. The regions of a second run may be others."""
    for name in ("sweep_1.csv", "sweep_whole.csv"):
        (tmp_path / name).write_text("")
    begin = max(f.stat().st_mtime for f in tmp_path.iterdir()) + 1
    exit_codes._tell_of_earlier_files(waves.parser("waves").parse_args(["x.npz", "--out", str(tmp_path)]), begin)
    assert f"note: sweep_1.csv, sweep_whole.csv in {tmp_path} are from an earlier run" in capsys.readouterr().err


def test_what_an_earlier_run_left_is_told(tmp_path, capsys):
    given = [str(PORCINE), "--method", "closed-form", "--modes", "2", "--out", str(tmp_path)]
    assert main([*given, "--cards"]) == 0 and "earlier run" not in capsys.readouterr().err
    assert main(given) == 0
    assert capsys.readouterr().err.endswith(f"note: cards in {tmp_path} is from an earlier run\n")


@pytest.mark.core
@pytest.mark.parametrize("module", ["fitting", "liverjax"])
def test_help(module):
    run = subprocess.run([sys.executable, "-m", module, "--help"], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0 and "usage" in run.stdout


@pytest.mark.core
def test_installed_command_is_the_one_of_the_module():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    module, name = scripts["liverjax"].split(":")
    assert getattr(importlib.import_module(module), name) is liverjax_main


COMMANDS = ["simulate", "sweep", "design", "laws", "check", "plot", "fit", "fit curves", "fit field"]


@pytest.mark.core
@pytest.mark.parametrize("name", COMMANDS)
def test_help_names_the_command_as_it_was_called(name, capsys):
    for program, prog in (("liverjax", {}), ("python -m liverjax", {"prog": "python -m liverjax"})):
        with pytest.raises(SystemExit) as stopped:
            liverjax_main([*name.split(), "--help"], **prog)
        assert stopped.value.code == 0
        assert capsys.readouterr().out.startswith(f"usage: {program} {name} [-h]")


@pytest.mark.core
def test_fit_under_the_one_name_is_the_fit(tmp_path, capsys):
    assert liverjax_main(["fit", str(tmp_path / "none.csv")]) == main([str(tmp_path / "none.csv")]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == second and first.startswith("error: ")
    given = ["--method", "closed-form", "--modes", "2", "--out", str(tmp_path)]
    assert liverjax_main(["fit", str(PORCINE), *given]) == 0
    assert np.isclose(json.loads((tmp_path / "fit.json").read_text())["shear_modulus"], 770, rtol=1e-4)


def test_ctrl_c_is_one_word_and_exit_code_130(monkeypatch, capsys):
    from fitting.readers import rheometer

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(rheometer, "read_sweep", stopped)
    assert main([str(PORCINE)]) == 130
    assert capsys.readouterr().err == "stopped\n"


_KEEPING = [
    [main, ["field", "scene.toml", "u.csv", "--out", "out"], "out/progress.h5"],
    [main, ["waves", "u.npz", "--out", "out"], "out/progress_of_regions.h5"],
    [liverjax_main, ["simulate", "scene.toml", "--out", "out"], "out/result.h5.parts/part_000000.h5"],
    [liverjax_main, ["sweep", "scene.toml", "rows.csv"], "rows.h5.parts/part_000000.h5"],
]


@pytest.mark.parametrize("number", [None, errno.ENOSPC, errno.EFBIG])
@pytest.mark.parametrize("command, arguments, file", _KEEPING)
def test_resume_is_named_if_there_is_a_file_to_continue_from(
    command, arguments, file, number, tmp_path, monkeypatch, capsys
):
    """Ctrl-C named --resume also if nothing was kept. A full disk did not name it, and the repeated command was
    refused."""

    age = 0

    def ended(options):
        if not options.resume and options.out != Path("none"):
            Path(file).parent.mkdir(parents=True, exist_ok=True)
            Path(file).write_text("")
            os.utime(file, 2 * (time.time() - age,))
        raise KeyboardInterrupt if number is None else OSError(number, "")

    module = f"{'fitting' if command is main else 'liverjax'}.commands.{arguments[0]}"
    monkeypatch.setattr(importlib.import_module(module), "run", ended)
    monkeypatch.chdir(tmp_path)
    for more, age_of_file, named in (
        (["--out", "none"], 0, False),
        ([], 0, True),
        ([], 100, False),
        (["--resume"], 100, True),
    ):
        age = age_of_file
        assert command([*arguments, *more]) == (2 if number else 130)
        assert ("with --resume" in capsys.readouterr().err) == named


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_closed_pipe_does_not_end_a_command(name, tmp_path, monkeypatch):
    """The command ended at its next line of text with exit code 0, and its files were not written."""
    reader, writer = os.pipe()
    os.close(reader)

    def run(_):
        print("note", file=getattr(sys, name))
        (tmp_path / "result.txt").write_text("written")
        print("more", file=getattr(sys, name))
        return 1

    with os.fdopen(writer, "w", buffering=1) as pipe:
        monkeypatch.setattr(sys, name, pipe)
        assert exit_codes.exit_code(run, argparse.Namespace()) == 1
    assert (tmp_path / "result.txt").read_text() == "written"


def test_after_ctrl_c_a_command_does_not_wait_for_computations():
    """JAX may compute in another thread. The process waited for this thread, and then crashed in a call of Python."""
    code = (
        "import sys, threading, time\nfrom liverjax.commands.exit_codes import end_if_stopped\n"
        "threading.Thread(target=time.sleep, args=(60,)).start()\nprint('written')\nend_if_stopped(int(sys.argv[1]))"
    )
    ended = subprocess.run([sys.executable, "-c", code, "130"], capture_output=True, text=True, timeout=50, check=False)
    assert ended.returncode == 130 and ended.stdout == "written\n"


def test_laws_lists_every_parameter(capsys):
    assert liverjax_main(["laws"]) == 0
    out = capsys.readouterr().out
    assert "arruda_boyce" in out and "chain_length" in out and "[Pa]  > 0" in out


@pytest.mark.ci
def test_a_run_in_single_precision_writes_its_files(tmp_path):
    """A scene in single precision keeps its mesh in double precision. Combined values have the precision of the
    mesh.
    """
    scene = tmp_path / "scene.toml"
    scene.write_text(
        """
        mesh = {shape = "box", size = [0.1, 0.1, 0.1], cells = [2, 2, 2]}
        law = {name = "neo_hookean", mu = 800.0, bulk = 4000.0}
        body = {density = 1000.0, gravity = [0.0, 0.0, -3.0]}
        support = [{where = {z_max = 0.0}, normal = 1e5, tangential = 1e5}]
        obstacle = [{shape = "plane", position = [0.1, 0.0, 0.0], axis = [-1.0, 0.0, 0.0]}]
        solve = {precision = "float32", tolerance = 1e-4}
        """
    )
    options = ["--vtu", "--reactions", "--fields", "cauchy_stress"]
    assert liverjax_main(["simulate", str(scene), "--out", str(tmp_path), *options]) == 0
    with h5py.File(tmp_path / "result.h5") as file:
        assert file["positions"].dtype == np.float32
    # The support carries the weight, up to the tolerance of the run.
    lines = (tmp_path / "reactions.csv").read_text().splitlines()
    last = dict(zip(lines[0].split(","), lines[-1].split(","), strict=True))
    assert np.isclose(float(last["support.0.z_N"]), 3.0, rtol=1e-3)


@pytest.mark.ci
def test_numbers_with_exponents_are_values_and_an_unknown_backend_is_no_matter(tmp_path):
    """argparse took `--gap-error -1e-5` for an unknown option; a wrong MPLBACKEND ended in a traceback."""
    command = [sys.executable, "-m", "fitting", str(PORCINE), "--method", "closed-form", "--out", str(tmp_path)]
    env = os.environ | {"MPLBACKEND": "nonsense"}
    run = subprocess.run([*command, "--modes", "2"], env=env, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0 and "Traceback" not in run.stderr and (tmp_path / "fit.png").is_file()
    assert with_joined_numbers(["a", "--b", "-1e-5", "--c", "-2.5E+3", "-1", "--d"]) == [
        "a",
        "--b=-1e-5",
        "--c=-2.5E+3",
        "-1",
        "--d",
    ]


@pytest.mark.slow
def test_a_terminal_without_the_letter_and_a_full_disk(tmp_path):
    """Both cases ended in tracebacks after the fit. The first one failed before the files of --cards were written."""
    command = [sys.executable, "-m", "fitting", str(PORCINE), "--method", "closed-form", "--out", str(tmp_path)]
    env = os.environ | {"PYTHONIOENCODING": "ascii"}
    run = subprocess.run([*command, "--cards"], env=env, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0 and "Traceback" not in run.stderr and "770 ? " in run.stdout
    assert (tmp_path / "cards").is_dir()
    told = subprocess.run([*command[:3], "curves", "--help"], env=env, cwd=ROOT, capture_output=True, text=True)
    assert told.returncode == 0 and "Traceback" not in told.stderr
    if not Path("/dev/full").exists():
        return
    with open("/dev/full", "w") as full:
        run = subprocess.run(command, env=env, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert run.returncode == 2 and "No space left on device" in run.stderr and "Traceback" not in run.stderr


HEADER_IN_RAD = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"


def test_the_inertia_of_the_sample_is_taken_off_the_predicted_sweep_too(tmp_path, capsys):
    """The sweep of the same sample was "predicted within 4.3 %", because its moduli contained the inertia."""
    omega, rng = np.geomspace(1.0, 100.0, 12), np.random.default_rng(0)
    seen = sample_inertia.shown(900.0 + 100.0j * omega * 0.05 / (1 + 1j * omega * 0.05), omega, 1060.0, 0.01)
    for name in ("a.csv", "b.csv"):
        moduli = np.stack([seen.real, seen.imag]) * (1 + 0.005 * rng.standard_normal((2, 12)))
        rows = np.vstack([omega, moduli]).T
        np.savetxt(tmp_path / name, rows, "%.12g", ",", header=HEADER_IN_RAD, comments="")
    more = ["--density", "1060", "--height", "0.01", "--method", "closed-form", "--out", str(tmp_path)]
    assert main([str(tmp_path / "a.csv"), *more, "--predict", str(tmp_path / "b.csv")]) == 0
    shown = capsys.readouterr()
    assert float(shown.out.split("predicted within ")[1].split()[0]) < 1
    assert "note: b.csv: the inertia of the sample, 10 mm high, is subtracted" in shown.err


@pytest.mark.parametrize(("method", "kept"), [("torsion", 25), ("closed-form", 21)])
def test_the_torsion_knows_the_height_when_points_are_left_out(tmp_path, method, kept):
    """The fit subtracts the inertia of a sample with the default height. Four points were left out before, because
    their moduli contained this inertia."""
    omega = 2 * np.pi * np.geomspace(0.1, 60, 25)
    part, tau = np.array([0.3, 0.25, 0.2]), np.array([0.02, 0.4, 8.0])
    G = 2000 * (0.25 + (part * 1j * omega[:, None] * tau / (1 + 1j * omega[:, None] * tau)).sum(axis=1))
    seen = sample_inertia.shown(G, omega, 1060.0, 0.004)
    rows = np.column_stack([omega, seen.real, seen.imag])
    np.savetxt(tmp_path / "s.csv", rows, "%.12g", ",", header=HEADER_IN_RAD, comments="")
    none = dict.fromkeys(("table", "min_frequency", "max_frequency", "radius", "height"))
    options = argparse.Namespace(**none, density=1060.0, method=method)
    assert len(shared_options.usable_sweep(options, tmp_path / "s.csv").storage) == kept


def test_the_data_of_a_described_test_are_not_replaced(tmp_path):
    """Only the TOML file was an input."""
    (tmp_path / "posterior.csv").write_text("time,displacement,force\n")
    (tmp_path / "test.toml").write_text("test = 'sphere'\ndata = 'posterior.csv'\nlist = [['\\u0000'], 1]\n")
    options = argparse.Namespace(out=tmp_path, samples=10, cards=False)
    with pytest.raises(InputError, match=r"posterior\.csv would be replaced"):
        shared_options.prepare_outputs(options, ("fit.json",), [tmp_path / "test.toml"])
