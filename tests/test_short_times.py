"""Uncertainty of G0 in relaxation and creep tests: relaxation before the first measured point."""

import json

import numpy as np
import pytest

from fitting.__main__ import main
from fitting.fits import time_tests
from fitting.fits.honesty import total_error
from fitting.fits.honesty.short_times import MISSING, with_short_times
from fitting.readers.time_tests import Sample, read_time_test

FIRST = 0.01


def fitted(tmp_path, G, last=100.0, points=50, modes="auto"):
    """Return a fit of stresses G [Pa] after a step, from `FIRST` on, with the uncertainty due to short times."""
    time = np.geomspace(FIRST, last, points)
    rows = "\n".join(f"{t:.8g},{g:.10g}" for t, g in zip(time, G(time), strict=True))
    (tmp_path / "r.csv").write_text(f"time_s,relaxation_modulus_Pa\n{rows}\n")
    test = read_time_test(tmp_path / "r.csv", "relaxation", Sample(None, None), 0.0, 0.0)
    return with_short_times(time_tests.fit(test, modes), test)


def noise(size):
    return 1 + 0.005 * np.random.default_rng(0).normal(size=size)


def test_a_slow_mode_hides_nothing(tmp_path):
    """The only relaxation time is a hundred times the first point. G0 is the true one, and there is no warning."""
    fit = fitted(tmp_path, lambda t: (400 + 800 * np.exp(-t)) * noise(len(t)))
    assert fit.model.shear_modulus == pytest.approx(1200, rel=0.01)
    assert MISSING not in fit.details and not any("G0" in w for w in fit.warnings)


def test_a_power_law_has_no_bound(tmp_path):
    """The stress t^-0.2 grows without bound towards the load. G0 of the modes had a stated error of 3 %."""
    fit = fitted(tmp_path, lambda t: 800 * t**-0.2 * noise(len(t)))
    assert any("is unknown which part relaxed before 0.01 s" in w for w in fit.warnings)


def test_what_a_stretched_exponential_lost_before_its_record_is_in_the_total_error(tmp_path):
    """The stress is exp(-(t/0.3)^0.5), so G0 is 1200 Pa. The modes find less."""
    fit = fitted(tmp_path, lambda t: 200 + 1000 * np.exp(-np.sqrt(t / 0.3)), modes=5)
    lost = 1200 - float(fit.model.shear_modulus)
    assert 0.3 * lost < fit.details[MISSING] < 3 * lost, (lost, fit.details[MISSING])
    assert total_error.error_shares(fit)["short_times"]["shear_modulus"] == fit.details[MISSING]
    assert any("G0 may be" in w for w in fit.warnings)


def test_the_command_says_where_the_answers_begin(tmp_path, capsys):
    """For a wide record this note was missing."""
    fitted(tmp_path, lambda t: (400 + 800 * np.exp(-t)) * noise(len(t)), last=1000.0)
    assert main(["relaxation", str(tmp_path / "r.csv"), "--modes", "1", "--out", str(tmp_path)]) == 0
    assert "begin 0.01 s after the load" in capsys.readouterr().err
    assert "short_times" not in json.loads((tmp_path / "fit.json").read_text())["error_shares"]


def test_a_creep_test_has_no_stress_that_falls(tmp_path):
    """The message must name the relaxation modulus that follows from the compliance."""
    time = np.geomspace(FIRST, 100.0, 50)
    rows = "\n".join(f"{t:.8g},{J:.10g}" for t, J in zip(time, time**0.2 / 800 * noise(50), strict=True))
    (tmp_path / "c.csv").write_text(f"time_s,creep_compliance_1/Pa\n{rows}\n")
    test = read_time_test(tmp_path / "c.csv", "creep", Sample(None, None), 0.0, 0.0)
    said = [w for w in with_short_times(time_tests.fit(test, "auto"), test).warnings if "is unknown which part" in w]
    assert len(said) == 1 and said[0].startswith("the relaxation modulus falls by")
