"""Rest before the load in files of tests in time: the offset that is subtracted, and noise that is none."""

import numpy as np
import pytest
from test_time_tests import SOLID, driven, write

from fitting.fits import time_tests as fits
from fitting.readers.time_tests import read_time_test

pytestmark = pytest.mark.quick_to_compile


def test_an_offset_that_one_row_shows_is_told(tmp_path):
    """An offset of 6 Pa, 5 % of the peak, made the equilibrium modulus a tenth too large, without a message."""
    t = np.concatenate([np.linspace(0, 1, 11), np.geomspace(1.1, 100, 40)])
    strain = 0.05 * np.minimum(t, 1.0)
    rng = np.random.default_rng(3)
    stress = driven(SOLID, t, strain, "relaxation") * (1 + 0.01 * rng.standard_normal(len(t)))
    for offset in (0.0, 6.0, -6.0):
        write(tmp_path / "t.csv", "time_s,strain,stress_Pa", t, strain, stress + offset)
        said = [n for n in read_time_test(tmp_path / "t.csv", "relaxation").notes if "offset of the sensor" in n]
        assert len(said) == (offset != 0)
        assert offset == 0 or said[0].startswith(f"the stress is {offset:g} Pa at 0 s, before the load")


@pytest.mark.parametrize("rows", [3, 4])
def test_the_offset_is_subtracted_with_as_many_rows_at_rest_as_the_note_asks_for(rows, tmp_path):
    """The note asked for three rows before the load. With three, the offset was kept, and the same note came again."""
    t = np.r_[np.linspace(0.3, 1, rows), 1 + np.geomspace(0.1, 100, 40)]
    strain, noise = np.where(t > 1, 0.05, 0.0), 1e-3 * np.random.default_rng(3).standard_normal(len(t))
    write(tmp_path / "t.csv", "time_s,strain,stress_Pa", t, strain, 6 + strain * (500 + 300 * np.exp(-t)) + noise)
    (note,) = [n for n in read_time_test(tmp_path / "t.csv", "relaxation").notes if "offset" in n]
    assert ("or give 4 or more rows at rest" if rows < 4 else "the stress of 3 rows at rest is 6 Pa") in note


@pytest.mark.parametrize(
    ("kind", "offset", "told"),
    [
        pytest.param("relaxation", 10.0, True, marks=pytest.mark.slow),
        pytest.param("relaxation", -6.0, True, marks=pytest.mark.slow),
        ("relaxation", 0.0, False),
        ("creep", 3e-3, True),
    ],
)
def test_what_a_sensor_shows_before_the_load_is_taken_off(tmp_path, kind, offset, told):
    """A standard linear solid, 1000 and 600 Pa, is loaded at 2 s after ten rows at rest. The response scatters by 0.5
    %.
    """
    rng = np.random.default_rng(0)
    t = np.r_[np.arange(0, 2.01, 0.2), 2 + np.geomspace(0.02, 60, 90)]
    s, on = np.clip(t - 2, 0, None), t > 2.0001
    if kind == "relaxation":
        driven, answer, head = 0.1 * on, 0.1 * (600 + 400 * np.exp(-s / 3)), "time_s,strain [1],stress_Pa"
    else:
        creep = 1 / 600 - (1 / 600 - 1 / 1000) * np.exp(-s / 5)  # 5 s = 3 s G0/G_inf
        driven, answer, head = 10.0 * on, 10 * creep, "time_s,stress_Pa,strain [1]"
    answer = on * answer * (1 + 0.005 * rng.standard_normal(len(t))) + offset
    test = read_time_test(write(tmp_path / "t.csv", head, t, driven, answer), kind)
    assert any("this sensor offset is subtracted" in note for note in test.notes) == told
    found = fits.fit(test)
    assert found.modes == 1
    G0, ratio = found.uncertainty.values[0], found.uncertainty.values[1]
    assert abs(G0 / 1000 - 1) < 0.006 and abs(G0 * (1 - ratio) / 600 - 1) < 0.006


def test_noise_in_the_row_at_rest_is_no_offset(tmp_path):
    """It is as large as the noise of the other rows."""
    t = np.concatenate([np.linspace(0, 1, 11), np.geomspace(1.1, 100, 40)])
    strain, rng = 0.05 * np.minimum(t, 1.0), np.random.default_rng(4)
    stress = driven(SOLID, t, strain, "relaxation") + 6.0 * rng.standard_normal(len(t))
    stress[0] = 9.0  # 1.5 deviations, 7 % of the peak
    write(tmp_path / "t.csv", "time_s,strain,stress_Pa", t, strain, stress)
    notes = read_time_test(tmp_path / "t.csv", "relaxation").notes
    assert not any("offset of the sensor" in note for note in notes)


def test_a_steady_cycle_begins_behind_its_load_and_has_no_offset(tmp_path):
    t = np.linspace(0, 3, 151)
    write(tmp_path / "t.csv", "time_s,strain,stress_Pa", t, 0.05 * np.sin(6 * t), 40 * np.sin(6 * t + 0.2))
    notes = read_time_test(tmp_path / "t.csv", "relaxation").notes
    assert not any("offset of the sensor" in note for note in notes)
