"""Points at which the inertia of the instrument shows, in fits that include the error of this inertia."""

import json

import numpy as np
import pytest

from fitting.__main__ import main
from fitting.fits import samples
from fitting.methods import generalised_maxwell
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep, without_inertia

pytestmark = pytest.mark.quick_to_compile


def sweep_with_raw_phase(off: float, hook: float = 0.0) -> Sweep:
    """A sweep of three modes, G0 1500 Pa, whose subtracted inertia is too large by the fraction `off`. `hook`: another
    error of G' at the end of the band, in Pa."""
    omega = 2 * np.pi * np.geomspace(0.1, 30, 26)
    share = 226000 * (omega / omega[-1]) ** 2  # [Pa] 160 times the modulus
    truth = Maxwell(np.float64(1500.0), np.array([0.2, 0.8 / 3, 1 / 3]), np.array([1.0, 0.1, 0.01]))
    noise = 1 + 0.01 * np.random.default_rng(1).standard_normal((2, 26))
    storage, loss = np.stack(generalised_maxwell.moduli(truth, omega)) * noise
    raw = storage - share + 1j * loss
    return Sweep(omega, storage + off * share + hook * (omega / omega[-1]) ** 12, loss, raw={"phase": np.angle(raw)})


def fit_of_command(s: Sweep, folder, *more: str) -> dict:
    """Write the sweep with its raw phase, fit it with the command, and return the content of fit.json."""
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa,raw_phase_deg"
    columns = np.column_stack([*s[:3], np.degrees(s.raw["phase"])])
    np.savetxt(folder / "s.csv", columns, delimiter=",", header=head, comments="")
    assert main([str(folder / "s.csv"), "--method", "closed-form", "--out", str(folder), *more]) == 0
    return json.loads((folder / "fit.json").read_text())


@pytest.mark.parametrize(("off", "more"), [(0.02, ()), (0.04, ("--max-frequency", "31"))])
def test_points_that_determine_the_inertia_are_kept(off, more, tmp_path):
    """An inertia that was 2 % too large made G' rise at the last points. These points were excluded, and G0 was
    1219 ± 75 Pa. With 4 % and --max-frequency, the sweep was refused, because no Maxwell model describes it."""
    found = fit_of_command(sweep_with_raw_phase(off), tmp_path, *more)
    told, G0 = found["details"]["instrument"], found["shear_modulus"]
    assert told["inertia_off_by"] == pytest.approx(-off / (1 + off), abs=3 * told["standard_error"])
    assert not told["moves_with_the_band"] and abs(G0 - 1500) < 10


def test_points_with_another_mark_are_still_excluded(tmp_path, capsys):
    """The error of the inertia grows as frequency^2 and cannot explain a term that grows as frequency^12."""
    found = fit_of_command(sweep_with_raw_phase(0.0, 200000.0), tmp_path)
    assert "which is the mark of the instrument" in capsys.readouterr().err
    assert abs(found["shear_modulus"] - 1500) < 100


def test_samples_with_a_wrong_inertia_are_not_refused_before_the_correction():
    """The moduli before the correction were refused, because no Maxwell model describes them."""
    every = [sweep_with_raw_phase(off) for off in (0.0, 0.04)]
    every = [without_inertia(s) for s in every]
    found = samples.fit(every, modes=3)
    assert all(abs(fit.uncertainty.values[0] - 1500) < 15 for fit in found.fits)
