"""Phase velocity and attenuation of shear waves: formulas, files, and fits together with other tests."""

import json
from types import SimpleNamespace

import mpmath
import numpy as np
import pytest

from fitting.__main__ import main
from fitting.commands import sweep as sweep_command
from fitting.commands import together as together_command
from fitting.fits.honesty import common_factor
from fitting.fits.together import common_fit, doubts, measured_tests
from fitting.fits.together.measured_tests import ResolvedBand, resolved_by
from fitting.fits.together.residuals_of_tests import criterion_of_all
from fitting.fits.viscoelastic import FLUID, Kind
from fitting.methods import generalised_maxwell
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.rheometer import read_sweep
from fitting.waves import dispersion, shear_waves
from fitting.waves.dispersion import Dispersion
from liverjax import InputError

pytestmark = pytest.mark.quick_to_compile

TRUTH = Maxwell(np.float64(3000.0), np.array([0.4, 0.3]), np.array([0.3, 0.002]))
LOW, HIGH = np.geomspace(0.6, 60, 15), 2 * np.pi * np.linspace(60, 500, 12)


def test_the_formulas_are_those_of_the_complex_wave_number():
    """Compare with k = omega sqrt(rho / G*), computed with 50 digits."""
    mpmath.mp.dps = 50
    for storage, loss, omega in ((3000.0, 800.0, 400.0), (3000.0, 1e-9, 400.0), (10.0, 5e3, 1e5)):
        k = omega * mpmath.sqrt(1000 / mpmath.mpc(storage, loss))
        velocity, attenuation = shear_waves.velocity_and_attenuation(storage, loss, omega, 1000.0)
        assert np.isclose(velocity, float(omega / k.real), rtol=1e-14)
        assert np.isclose(attenuation, float(-k.imag), rtol=1e-14)
        back = shear_waves.moduli_of(velocity, attenuation, omega, 1000.0)
        # Where the loss is larger, G' is a difference of squares.
        assert np.allclose(back, (storage, loss), rtol=0, atol=1e-14 * abs(complex(storage, loss)))


def waves(noise: float, attenuation: bool = True) -> Dispersion:
    c, a = shear_waves.velocity_and_attenuation(*generalised_maxwell.moduli(TRUTH, HIGH), HIGH, 1060.0)
    factor = 1 + noise * np.random.default_rng(3).standard_normal((2, len(HIGH)))
    return Dispersion(HIGH, c * factor[0], a * factor[1] if attenuation else None, 1060.0, source="waves.csv")


def test_an_attenuation_with_more_noise_than_the_velocity_has_less_weight():
    """Both had the same relative noise, and 80 % of the 95 % intervals contained the truth."""
    c, a = shear_waves.velocity_and_attenuation(*generalised_maxwell.moduli(TRUTH, HIGH), HIGH, 1060.0)
    found = {0.02: [], 0.16: []}
    for seed in range(40):
        noise = np.random.default_rng(seed).standard_normal((2, len(HIGH)))
        for size, factors in found.items():
            own = Dispersion(HIGH, c * (1 + 0.02 * noise[0]), a * (1 + size * noise[1]), 1060.0)
            scales = own.scales / dispersion.smooth_curve(HIGH, own.velocity)[0]
            factors.append(scales[len(HIGH)] * own.velocity[0] / dispersion.smooth_curve(HIGH, own.attenuation)[0])
    assert np.median(found[0.02]) == pytest.approx(1.0, rel=0.1) and 4 < np.median(found[0.16]) < 16


def sweep(noise: float) -> Sweep:
    factor = 1 + noise * np.random.default_rng(4).standard_normal((2, len(LOW)))
    G = generalised_maxwell.moduli(TRUTH, LOW)
    return Sweep(LOW, G[0] * factor[0], G[1] * factor[1], source="sweep.csv")


def test_given_deviations_do_not_hide_the_other_test():
    """In the first round, a sweep with standard deviations had 33 times too much weight. The search then ended at a
    minimum that missed the waves by 66 %, with G0 wrong by 28 % (43 of its standard errors)."""
    truth = Maxwell(np.float64(3000.0), np.array([0.2, 0.3, 0.3]), np.array([0.8, 0.03, 0.001]))
    low, high = 2 * np.pi * np.geomspace(10**-1.5, 10, 16), 2 * np.pi * np.array([50.0, 80, 120, 180, 250, 350])
    rng, G = np.random.default_rng(2), np.array(generalised_maxwell.moduli(truth, low))
    noisy = G * (1 + 0.02 * rng.standard_normal((2, 16)))
    c, a = shear_waves.velocity_and_attenuation(*generalised_maxwell.moduli(truth, high), high, 1060.0)
    factor = 1 + 0.02 * rng.standard_normal((2, 6))
    tests = [Sweep(low, *noisy, *(0.02 * G), source="s"), Dispersion(high, c * factor[0], a * factor[1], 1060.0)]
    found = common_fit.fit(tests, 3)
    assert max(share.misfit for share in found.shares) < 0.04
    assert abs(found.model.shear_modulus - 3000) < 4 * found.uncertainty.standard_errors[0]


@pytest.mark.parametrize("attenuation", [True, False])
def test_waves_add_the_short_time_that_the_sweep_does_not_see(attenuation):
    found = common_fit.fit([sweep(0.01), waves(0.01, attenuation)], 2)
    u = found.uncertainty
    assert found.converged
    assert np.all(np.abs(u.values - [3000, 0.4, 0.3, 0.3, 0.002]) < 4 * u.standard_errors)
    without_sweep, without_waves = (s.errors_without for s in found.shares)
    assert without_waves[4] > 5 * u.standard_errors[4] and without_sweep[3] > 5 * u.standard_errors[3]
    assert [s.points for s in found.shares] == [30, 24 if attenuation else 12]


def test_a_better_fit_whose_parameters_are_not_determined_is_told(tmp_path, capsys):
    """The velocities need a second mode, which they do not determine. One mode gave G0 = 3415 ± 56 for 4500 Pa."""
    low, high = 2 * np.pi * np.geomspace(0.5, 30, 14), 2 * np.pi * np.array([50, 70, 100, 140, 200, 280, 400.0])
    truth = Maxwell(np.float64(4500.0), np.array([4 / 9, 1 / 3]), np.array([2e-3, 3e-4]))
    rng = np.random.default_rng(7)
    c, _ = shear_waves.velocity_and_attenuation(*generalised_maxwell.moduli(truth, high), high, 1060.0)
    G = [np.asarray(each) * (1 + 0.01 * rng.standard_normal(14)) for each in generalised_maxwell.moduli(truth, low)]
    test = Dispersion(high, np.asarray(c) * (1 + 0.01 * rng.standard_normal(7)), None, 1060.0)
    found = common_fit.fit([Sweep(low, *G), test])
    assert found.modes == 1 and found.model.shear_modulus < 4000
    (told,) = (w for w in found.warnings if w.startswith("2 modes follow the tests better than 1"))
    assert "The stated errors do not contain this difference" in told


def test_a_determined_solid_beside_a_fluid_is_told():
    """A warning said that the tests do not determine the parameters of this solid."""
    tests = [sweep(0.01), waves(0.01)]
    band = ResolvedBand(resolved_by(tests))
    solid, fluid = (common_fit._one_test(tests, band, n, kind) for n, kind in ((2, Kind()), (1, FLUID)))
    points = sum(s.points for s in fluid.shares)
    factor = np.exp((criterion_of_all(solid) - 5 - criterion_of_all(fluid)) / (2 * points))
    fluid = fluid._replace(shares=[s._replace(noise=s.noise * factor) for s in fluid.shares])
    assert common_fit._able(solid, band) and criterion_of_all(fluid) == pytest.approx(criterion_of_all(solid) - 5)
    told = common_fit._told_of_all(solid, [solid, fluid], band).warnings
    assert any("prony_fluid explains the data about as well as prony (criterion 5 lower" in w for w in told)
    told = common_fit._told_of_all(fluid, [solid, fluid._replace(converged=False)], band).warnings
    assert not any("about as well" in w for w in told)  # the solid is not better
    fluid = fluid._replace(shares=[s._replace(noise=s.noise * np.exp(5 / points)) for s in fluid.shares])
    told = common_fit._told_of_all(fluid, [solid, fluid], band).warnings
    assert any("prony explains the data about as well as prony_fluid (criterion 5 lower" in w for w in told)
    assert not any("do not determine all of their parameters" in w for w in told)


def test_a_file_of_waves_alone_names_the_option(tmp_path):
    (tmp_path / "w.csv").write_text("frequency_Hz,phase_velocity_m/s\n50,1.5\n60,1.6\n70,1.7\n")
    with pytest.raises(InputError, match=r"shear waves belong to a sweep \(SWEEP --with this file\)"):
        read_sweep(tmp_path / "w.csv")


@pytest.mark.draws
def test_the_command_reads_waves_and_writes_waves(tmp_path):
    s, w = sweep(0.01), waves(0.01)
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", np.column_stack([LOW, s.storage, s.loss]), delimiter=",", header=head, comments="")
    table = np.column_stack([HIGH / (2 * np.pi), 100 * w.velocity, 20 / np.log(10) * w.attenuation / 100])
    head = "frequency (Hz);phase velocity (cm/s);attenuation (dB/cm)"
    np.savetxt(tmp_path / "w.csv", table[::-1], delimiter=";", header=head, comments="# ultrasound\n", fmt="%.12g")
    read = dispersion.read_dispersion(tmp_path / "w.csv", 1060.0)
    assert np.allclose([read.angular_frequency, read.velocity, read.attenuation], [HIGH, w.velocity, w.attenuation])
    arguments = [str(tmp_path / "s.csv"), "--with", str(tmp_path / "w.csv"), "--modes", "2", "--out", str(tmp_path)]
    assert main(arguments) == 0
    content = json.loads((tmp_path / "fit.json").read_text())
    assert [t["test"] for t in content["tests"]] == ["sweep", "dispersion"] and (tmp_path / "fit.png").is_file()
    told = content["shear_waves"]
    ours = np.interp(100.0, told["frequency_Hz"], told["phase_velocity_m_s"])
    c, _ = shear_waves.velocity_and_attenuation(
        *generalised_maxwell.moduli(TRUTH, np.array([200 * np.pi])), 200 * np.pi, 1060.0
    )
    assert np.isclose(ours, c[0], rtol=0.01)  # between two of four points per decade


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frequency_Hz,phase_velocity_m/s\n50,1.5\n60,x\n70,1.7\n", "line 3"),
        ("frequency_Hz,phase_velocity_m/s\n50,1.5\n60,-1.6\n70,1.7\n", "velocity -1.6 must be"),
        ("frequency_Hz,phase_velocity_m/s\n50,1.5\n60,1.6\n", "2 rows"),
        ("frequency_Hz,phase_velocity_furlong\n50,1.5\n60,1.6\n70,1.7\n", "unit 'furlong' of velocity"),
        ("frequency_Hz,storage_modulus_Pa\n50,1.5\n", "no header names"),
        (
            "frequency_Hz,speed [m/s],velocity [m/s]\n50,1,2\n",
            "columns 2, 3 may all contain velocity; keep one of these",
        ),
    ],
)
def test_bad_files_are_refused(tmp_path, text, words):
    (tmp_path / "w.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        dispersion.read_dispersion(tmp_path / "w.csv")


@pytest.mark.parametrize(
    "head",
    [
        "frequency [Hz],velocity SD [m/s],velocity mean [m/s]",
        "frequency_Hz,phase_velocity_error_m/s,phase_velocity_m/s",
        '"frequency (Hz)","shear wave speed standard deviation (m/s)","shear wave speed (m/s)"',
    ],
)
def test_a_column_of_errors_is_not_the_velocity(tmp_path, head):
    """The first column whose heading begins with the velocity was read, so the velocity was its own deviation."""
    (tmp_path / "w.csv").write_text(f"{head}\n50,0.1,1.5\n60,0.1,1.6\n70,0.1,1.7\n")
    np.testing.assert_allclose(dispersion.read_dispersion(tmp_path / "w.csv").velocity, [1.5, 1.6, 1.7])


@pytest.mark.parametrize(
    ("heading", "factor"), [("frequency", 2 * np.pi), ("angular_frequency", 1.0), ("angular_frequency_Hz", 2 * np.pi)]
)
def test_the_heading_of_the_frequency_alone_gives_its_unit(tmp_path, heading, factor):
    """A column of angles made 50 Hz to 50 rad/s, without a message."""
    (tmp_path / "w.csv").write_text(f"{heading},velocity,angular_position\n50,1.5,9\n60,1.6,9\n70,1.7,9\n")
    found = dispersion.read_dispersion(tmp_path / "w.csv", 1000.0)
    assert np.allclose(found.angular_frequency, factor * np.array([50.0, 60.0, 70.0]))


def test_the_structure_of_velocities_and_attenuations_is_tested_separately():
    """Residuals of the attenuation that change sign in every row hid a structured misfit of the velocity."""
    own = waves(0.0)
    signs = np.concatenate([np.repeat([1.0, -1.0], 6), np.tile([1.0, -1.0], 6)])
    solution = SimpleNamespace(residuals=signs, jacobian=np.zeros((len(signs), 1)))
    share = SimpleNamespace(points=len(signs), noise=0.01)
    fitted = [own.measured * (1 + 0.01 * signs)]
    fit = SimpleNamespace(tests=[own], fitted=fitted, solution=solution, shares=[share])
    (told,) = doubts.structured(fit)
    assert "waves.csv (velocity): the residuals change sign only 1 times in 12 values" in told


def test_the_inertia_that_stays_in_the_sweeps_is_told_beside_waves(capsys):
    """With shear waves, --density without --height left the inertia in the sweep without a note."""
    tests = [sweep(0.0), waves(0.0)]
    assert together_command.without_sample_inertia(tests, 1060.0, None) == tests
    assert "--density without --height subtracts no inertia" in capsys.readouterr().err


def test_waves_have_no_error_of_a_sample_size():
    """The waves had the error of a sample between plates. So sizes seemed to explain too large factors."""
    w = waves(0.003)
    stiffer = w._replace(velocity=np.sqrt(1.03) * w.velocity, attenuation=w.attenuation / np.sqrt(1.03))
    fit = common_fit.fit([sweep(0.003), stiffer], 2)
    sizes = together_command.errors_of_sizes(SimpleNamespace(radius=None, height=None), fit.tests)
    assert sizes[0] > 0.01 and sizes[1] == 0.0
    (told,) = common_factor.told(fit, sizes)
    assert "all moduli of waves.csv are 1.03" in told and "made at another temperature" in told
    assert "errors in the sizes of the samples explain" in common_factor.told(fit, sizes[0])[0]


def test_waves_are_cut_to_the_band_as_sweeps_are():
    w = waves(0.0)
    cut = dispersion.in_band(w, None, HIGH[5] / (2 * np.pi))
    assert np.array_equal(cut.angular_frequency, HIGH[:6]) and np.array_equal(cut.velocity, w.velocity[:6])
    assert "6 waves outside" in cut.notes[-1] and dispersion.in_band(w, 0.0, None) is w
    with pytest.raises(InputError, match="only 2 frequencies are between"):
        dispersion.in_band(w, None, HIGH[1] / (2 * np.pi))


def test_errors_of_waves_are_relative_to_smooth_curves():
    """With errors relative to each measured value, velocities that are low by chance would have too much weight."""
    assert np.allclose(waves(0.0).scales, waves(0.0).measured, rtol=1e-3)
    noisy, exact = (waves(noise, attenuation=False) for noise in (0.2, 0.0))
    off = [np.std(np.log(scales / exact.measured)) for scales in (noisy.scales, noisy.measured)]
    assert off[0] < 0.7 * off[1]
    assert np.array_equal(measured_tests.reported_numbers(noisy)[2], noisy.scales)


def test_the_density_of_a_common_fit_needs_no_height():
    """The default method was given explicitly. It raised an error about the height, which it does not need."""
    options = sweep_command.parser("fitting").parse_args(
        ["sweep.csv", "--with", "waves.csv", "--density", "1060", "--method", "closed-form"]
    )
    assert sweep_command._check(options) is None  # no error


def test_copies_of_all_rows_are_left_out(tmp_path):
    """Each copy counted as a measurement, and the residuals looked structured. An equal row alone may be a repeat."""
    rows = "50,1.5\n60,1.6\n70,1.7\n80,1.8\n"
    for text, number in ((rows, 4), (2 * rows, 4), (rows.replace("\n", "\n50,1.5\n", 1), 5)):
        (tmp_path / "w.csv").write_text("frequency_Hz,velocity_m/s\n" + text)
        found = dispersion.read_dispersion(tmp_path / "w.csv", 1000.0)
        assert len(found.velocity) == number
        assert len(found.notes) == (text == 2 * rows) and all("4 of 8 rows are ignored" in n for n in found.notes)


def test_a_second_sheet_is_not_read_as_rows_of_waves(tmp_path):
    """A workbook is read as such a text. The second sheet made the file unreadable."""
    rows = "".join(f"{50 * k}\t{1.5 + 0.1 * k}\n" for k in range(1, 6))
    text = f"[step]\nwaves\nfrequency_Hz\tphase_velocity_m/s\n{rows}\n[step]\nnotes\nsee page 12\n\n[step]\nSheet3\n"
    (tmp_path / "waves.txt").write_text(text)
    found = dispersion.read_dispersion(tmp_path / "waves.txt", 1000.0)
    assert len(found.velocity) == 5
    assert found.notes == ("only the first table is read, not the sheets or steps below it: 'notes'",)
