"""The rise of the load in relaxation and creep: a small first movement, a straight ramp at irregular times, and noise
in its first row."""

import json

import numpy as np
import pytest
from test_time_tests import SOLID, driven, write

from fitting.__main__ import main
from fitting.fits import time_tests as fits
from fitting.readers.checks.scattering_load import without_scatter
from fitting.readers.time_tests import TimeTest, read_time_test

pytestmark = pytest.mark.quick_to_compile

TRUE = [900, 0.3, 0.4, 5, 0.2]
HEAD = "time_s,strain [1],stress_Pa"


@pytest.mark.parametrize("toe", [[0.01], [0.01, 0.02, 0.03]])
def test_a_small_movement_before_a_step_is_no_traceback(tmp_path, capsys, toe):
    """The strain moves by a quarter of a percent of its height before it jumps. With a step in place of the jump, the
    load began after the first responses: a traceback."""
    t = np.concatenate([[0.0], toe, toe[-1] + 0.01 + np.append(0.0, np.geomspace(0.01, 60, 60))])
    strain = np.concatenate([[0.0], 5e-5 * np.arange(1, len(toe) + 1) / len(toe), np.full(61, 0.02)])
    stress = driven(SOLID, t, strain, "relaxation")
    stress = stress * (1 + 0.002 * np.random.default_rng(0).standard_normal(len(t)))
    assert main(["relaxation", str(write(tmp_path / "t.csv", HEAD, t, strain, stress)), "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "fit.json").read_text())
    assert abs(found["shear_modulus"] - 900) < 2 * found["total_errors"]["shear_modulus"]
    assert "If the change was a step at" in capsys.readouterr().err


@pytest.mark.ci
def test_a_straight_ramp_at_irregular_times_has_no_jump_and_no_scatter(tmp_path):
    """Rows at random times in a linear ramp: half of such files had a jump, or a scatter of their strain."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        t = np.sort(np.concatenate([[0.0], rng.uniform(0, 1, 12), [1.0], np.geomspace(1.01, 60, 30)]))
        strain = 0.02 * np.minimum(t, 1.0)
        file = write(tmp_path / "t.csv", HEAD, t, strain, driven(SOLID, t, strain, "relaxation"))
        test = read_time_test(file, "relaxation")
        assert not len(test.jumps) and not any("scatters" in note for note in test.notes)
        assert np.allclose(test.driven, strain, rtol=1e-6)


def test_a_jump_beside_a_short_interval_is_found():
    """The overshoot of 2 % takes a hundredth of the time of the jump: its rate is high, and its change is small."""
    time = np.array([0.0, 1.0, 1.1, 1.101, 1.2, 1.3, 1.4, 1.5])
    strain = np.array([0.0, 0.0, 1.0, 0.98, 0.98, 0.98, 0.98, 0.98])
    assert list(TimeTest("relaxation", time, strain, strain, time > 0).jumps) == [2]


@pytest.mark.ci
@pytest.mark.parametrize("seed", range(3))
def test_a_response_of_pure_noise_does_not_set_the_starts_of_a_fit(seed):
    """In creep at 100 Hz, the response in the first row of the ramp was noise: an apparent modulus of a sixth of the
    true one. All starting points had one mode less, and the fit ended with G0 = 734 or 459 Pa."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(3001)
    stress = 20 * np.clip((t - 4.9999) / 0.05, 0, 1)
    strain = driven(SOLID, t, stress, "creep")
    strain = strain + 5e-4 * strain.max() * rng.standard_normal(len(t))
    strain[500] = 1e-3 * strain.max()  # three standard deviations
    test = TimeTest("creep", t, stress, strain, (t > 5.0 - 1e-9))
    found = fits.fit(test)
    assert found.modes == 2 and np.allclose(found.uncertainty.values, TRUE, rtol=0.05)


@pytest.mark.parametrize("rows", [(0, 0.5, 1, 2, 5, 10), (0, 1, 2, 5, 10), (0, 1, 2, 3, 5, 10), (0, 0.1, 1, 3, 10)])
def test_a_ramp_in_few_rows_is_no_scatter(rows):
    """The corners of the ramp counted as scatter of 17 %. The strain became 0, then 0.9 times its true value."""
    t = np.array(rows, float)
    end = 3.0 if 3 in rows and 2 in rows else t[2] if t[1] > 0.1 else 0.1
    strain = 0.05 * np.minimum(t / end, 1)
    held, notes = without_scatter(t, strain, "strain")
    assert not notes and np.array_equal(held, strain)
    scattered = strain * (1 + 2e-3 * np.array([0, 0, 1, -1, 1, -1]))[: len(t)] if end == 1 else strain
    assert np.allclose(without_scatter(t, scattered, "strain")[0], strain, rtol=3e-3)


@pytest.mark.parametrize(("seconds", "load"), [(10.0, 1.0), (0.03, 0.01), (0.03, 1e-6)])
def test_a_straight_ramp_is_found_in_any_units(seconds, load):
    """The search had absolute tolerances, in seconds and in the square of the load. A ramp of 1.5 ms was found in 1 of
    20 tests, and in the others each of its readings counted as a step."""
    t = np.linspace(0, 1, 1001)
    ramp = np.clip((t - 0.2) / 0.05, 0, 1)
    for seed in range(3):
        scatter = 0.005 * np.random.default_rng(seed).standard_normal(len(t))
        held, notes = without_scatter(seconds * t, load * (ramp + scatter), "strain")
        assert "a linear ramp from" in notes[0] and np.abs(held / load - ramp).max() < 0.01
