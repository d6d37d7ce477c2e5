"""The command for several tests of one tissue."""

import argparse
import json

import numpy as np
import pytest
from conftest import SHARED
from test_together import OMEGA, TIME, TRUTH, WIDE, sweep

from fitting.__main__ import main
from fitting.commands import together as command
from fitting.methods import generalised_maxwell
from liverjax import InputError

pytestmark = pytest.mark.quick_to_compile


def test_each_test_has_the_error_of_its_own_sample_size(tmp_path, capsys):
    """The factor of force over displacement had the fourth power of the radius, as if it was a torque over twist."""
    one = TRUTH._replace(ratios=TRUTH.ratios[1:], relaxation_times=TRUTH.relaxation_times[1:])
    G, small = generalised_maxwell.moduli(one, OMEGA), ["--radius", "0.002", "--height", "0.02"]
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "a.csv", np.column_stack([OMEGA, *G]), delimiter=",", header=head, comments="")
    at = np.append(0.0, TIME / 100)
    measured = 1e-4 * 3 * np.pi * 0.002**2 / 0.02 * 800 * (0.6 + 0.4 * np.exp(-at / 0.1))
    rows = np.column_stack([at, np.full(len(at), 1e-4), measured])
    np.savetxt(tmp_path / "b.csv", rows, delimiter=",", header="time_s,displacement_m,force_N", comments="")
    files = [str(tmp_path / "a.csv"), "--with", str(tmp_path / "b.csv")]
    assert main([*files, *small, "--modes", "1", "--out", str(tmp_path)]) == 0
    assert "(1 to 2 % of a test's moduli)" in capsys.readouterr().out
    shares = json.loads((tmp_path / "fit.json").read_text())["error_shares"]["geometry"]
    force, torque = np.hypot(50e-6 / 0.02, np.array([2, 4]) * 10e-6 / 0.002)
    assert force < shares["equilibrium_modulus"] / 480 < 0.8 * torque  # a torque in both tests: `torque` or more


@pytest.mark.ci
@pytest.mark.draws
def test_the_command_reads_any_test(tmp_path, capsys):
    s, creep_time = sweep(0.01), np.geomspace(1, 100, 20)
    columns = np.column_stack([s.angular_frequency, s.storage, s.loss])
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", columns, delimiter=",", header=head, comments="")
    from fitting.methods.time_response import creep_compliance

    compliance = np.column_stack([creep_time, creep_compliance(TRUTH, creep_time)])
    np.savetxt(tmp_path / "c.csv", compliance, delimiter=",", header="time_s,creep_compliance_1/Pa", comments="")
    arguments = [str(tmp_path / "s.csv"), "--with", str(tmp_path / "c.csv"), "--modes", "2", "--out", str(tmp_path)]
    assert main(arguments) == 0
    content = json.loads((tmp_path / "fit.json").read_text())
    assert [t["test"] for t in content["tests"]] == ["sweep", "creep"] and content["modes"] == 2
    assert np.isclose(content["relaxation_times"][0], 30, rtol=0.02) and (tmp_path / "fit.png").is_file()
    without = content["tests"][1]["standard_errors_without_it"]["relaxation_times"][0]
    assert without is None or without > 3 * content["standard_errors"]["relaxation_times"][0]
    assert "without 1" in capsys.readouterr().out


def test_further_sweeps_lose_the_points_of_the_instrument_too(tmp_path):
    """The inertia is half of G' at the end, and grows with the square of the frequency."""
    G = generalised_maxwell.moduli(TRUTH, WIDE)
    spoiled = G[0] - 0.5 * G[0][-1] * (WIDE / WIDE[-1]) ** 2
    columns = np.column_stack([WIDE, spoiled, G[1]])
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", columns, delimiter=",", header=head, comments="")
    options = argparse.Namespace(radius=None, height=None, min_frequency=None, max_frequency=None, density=None)
    found = command.read_any(options, tmp_path / "s.csv")
    assert len(found.storage) < len(WIDE) and any("mark of the instrument" in n for n in found.notes)
    options.max_frequency = 1e3  # a band that the user gives is kept
    assert len(command.read_any(options, tmp_path / "s.csv").storage) == len(WIDE)
    options.max_frequency = float(WIDE[-6]) / (2 * np.pi)  # it applies to every sweep, but not to predicted tests
    assert len(command.read_any(options, tmp_path / "s.csv").storage) == len(WIDE) - 5
    assert command.read_any(options, tmp_path / "s.csv", whole=True).angular_frequency[-1] > 0.5 * WIDE[-6]
    with pytest.raises(InputError, match=r"no\.csv does not exist: give the file of a test"):
        command.read_any(options, tmp_path / "no.csv")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--method", "torsion"], "remove --method torsion"),
        (["--samples", "1000"], "remove --samples"),
        (["--gap-error", "5e-5", "--height", "0.004"], "remove --gap-error"),
    ],
)
def test_what_a_common_fit_does_not_have_is_refused(more, words, tmp_path, capsys):
    assert main(["a.csv", "--with", "b.csv", *more, "--out", str(tmp_path)]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.slow
def test_polystyrene_in_three_tests(tmp_path, capsys):
    folder = SHARED / "data" / "rheology" / "pyrheo"
    if not folder.is_dir():
        pytest.skip("the measured files are not here")
    first, *others = (folder / f"{kind}_ps160_data.csv" for kind in ("oscillation", "stressrelaxation", "creep"))
    assert main([str(first), "--with", *map(str, others), "--modes", "5", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "fit.json").read_text())
    assert any("do not agree" in w for w in content["warnings"])
    # The sweep and the creep test differ by 40 %. The creep test has nearly all the weight, so the sweep is missed.
    assert 0.3 < max(t["misfit"] for t in content["tests"]) < 0.5


def test_one_measurement_does_not_count_twice(tmp_path, capsys):
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n1,100,10\n2,110,11\n")
    for arguments in (["a.csv", "--with", "b.csv"], ["a.csv", "b.csv"]):
        paths = [str(tmp_path / a) if a.endswith("csv") else a for a in arguments]
        assert main([*paths, "--out", str(tmp_path / "o")]) == 2
        assert "is the same measurement as" in capsys.readouterr().err
    # A copy with another comment was accepted, and the errors were too small.
    (tmp_path / "c.csv").write_text("# a comment\n" + (tmp_path / "a.csv").read_text())
    assert main([str(tmp_path / "a.csv"), "--with", str(tmp_path / "c.csv"), "--out", str(tmp_path / "o")]) == 2
    assert "has the same numbers as" in capsys.readouterr().err
