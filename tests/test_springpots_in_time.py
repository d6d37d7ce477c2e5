"""Springpot models of relaxation and creep tests and of several tests, against inverse Laplace transforms by mpmath."""

import json
import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.optimize
from conftest import SHARED
from test_models import FORMULAS, TRUTHS

from fitting.__main__ import main
from fitting.fits import posterior
from fitting.fits import time_tests as time_fits
from fitting.fits.families import springpots_in_time
from fitting.fits.together import common_fit
from fitting.methods import generalised_maxwell, springpots, time_response
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers import time_tests
from fitting.readers.frequency_sweep import Sweep

pytestmark = pytest.mark.quick_to_compile

CASES = {model.name: model for model in springpots.FRACTIONAL}
TIMES = np.geomspace(0.1, 1000, 25)


def logit(p: float) -> float:
    return float(np.log(p / (1 - p)))


def places(name: str) -> np.ndarray:
    """Return the six numbers of the code (reference 1 rad/s) for the literature's parameters."""
    v = TRUTHS[name]
    u = np.zeros(springpots.SIZE)
    if name == "fractional_zener":
        e, m, tau, a = v
        u[[0, 2, 3, 4]] = np.log(e), np.log(m) + a * np.log(tau), logit(a), np.log(m)
    elif name == "fractional_maxwell":
        pot, a, other, b = v
        u[[2, 3, 4, 5]] = np.log(pot), logit(a), np.log(other), logit(b / a)
    elif name == "fractional_parallel":
        other, b, pot, a = v
        u[[0, 1, 2, 3]] = np.log(other), logit(b / a), np.log(pot), logit(a)
    else:
        u[[2, 3]] = np.log(v[-2]), logit(v[-1])
        u[0] = np.log(v[0]) if len(v) == 3 else 0.0
    return u


def inverse_laplace(name: str, creep: bool, times: np.ndarray = TIMES) -> np.ndarray:
    """Return G(t) [Pa] or J(t) [1/Pa] after a step, which are Mittag-Leffler functions, by Talbot's contour."""

    def transformed(s):
        G = FORMULAS[name](s, *TRUTHS[name])
        return 1 / (s * G) if creep else G / s

    return np.array([float(mpmath.invertlaplace(transformed, t, method="talbot")) for t in times])


@pytest.mark.parametrize("name", CASES)
def test_the_modes_of_a_springpot_answer_as_mittag_leffler_functions(name):
    times = springpots.times_of_modes(TIMES[0], TIMES[-1])
    made = springpots.as_modes(jnp.asarray(places(name)), CASES[name].switches, jnp.asarray(times), 1.0)
    model = Maxwell(*(np.asarray(v) for v in made))
    # The trapezium rule converges exponentially. The rest comes from the spectrum beyond its ends.
    few = TIMES[::4]
    assert np.allclose(time_response.relaxation_modulus(model, few), inverse_laplace(name, False, few), rtol=5e-4)
    assert np.allclose(time_response.creep_compliance(model, few), inverse_laplace(name, True, few), rtol=5e-4)
    omega = 1 / few[::-1]
    storage, loss = generalised_maxwell.moduli(model, omega)
    assert np.allclose(storage + 1j * loss, FORMULAS[name](1j * omega, *TRUTHS[name]), rtol=5e-4)


@pytest.mark.slow
def test_a_relaxation_test_gives_the_numbers_of_a_springpot_model_back(tmp_path, capsys):
    answer = inverse_laplace("fractional_zener", False) * (1 + 0.005 * np.random.default_rng(0).standard_normal(25))
    rows = [f"{t:.12g},{g:.12g}" for t, g in zip(TIMES, answer, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["time_s,relaxation_modulus_Pa", *rows]) + "\n")
    assert main(["relaxation", str(tmp_path / "a.csv"), "--model", "auto", "--out", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out" / "fit.json").read_text())
    # Long after the step only the end of the model shows. tau = 0.05 s is before the first point, so two numbers are
    # free.
    tried = {row["model"]: row for row in content["details"]["tried"]}
    assert set(CASES) < set(tried) and content["mean_relative_error"] < 0.006
    assert tried["fractional_zener"]["above_the_lowest"] < 10 and "Prony modes" in capsys.readouterr().out
    own = content["parameters"]["equilibrium_modulus"]
    assert abs(own["value"] - 300) < 4 * own["standard_error"] < 60


@pytest.mark.slow
def test_creep_gives_them_too(tmp_path):
    answer = inverse_laplace("fractional_kelvin_voigt", True)
    rows = [f"{t:.12g},{g:.12g}" for t, g in zip(TIMES, answer, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["time_s,creep_compliance_1/Pa", *rows]) + "\n")
    test = time_tests.read_time_test(tmp_path / "a.csv", "creep", time_tests.Sample(None, None), 0.0, 0.0)
    near = Maxwell(np.float64(500.0), np.array([0.2, 0.2]), np.array([30.0, 0.5]))
    found = {f.kind.name: f for f in springpots_in_time.fractional_in_time(test, near)}
    own = found["fractional_kelvin_voigt"].parameters
    assert np.allclose(own.values, TRUTHS["fractional_kelvin_voigt"], rtol=3e-3)


def test_other_models_of_several_tests_have_the_warnings_of_prony_modes():
    """The rows of the creep test begin under load, and the sweep has noise of 8 %. Both were told for Prony modes
    only.
    """
    rng, omega = np.random.default_rng(0), np.geomspace(0.3, 100, 16)
    G = 300 * (1j * omega) ** 0.3
    noise = 1 + 0.08 * rng.standard_normal((2, 16))
    sweep = Sweep(omega, G.real * noise[0], G.imag * noise[1], source="sweep.csv")
    time = np.append(0.0, np.geomspace(0.05, 50, 16))
    strain = time**0.3 / (300 * math.gamma(1.3)) * (1 + 0.01 * rng.standard_normal(17))
    creep = time_tests.TimeTest("creep", time, np.append(0.0, np.ones(16)), strain, time > 0, source="creep.csv")
    fit = springpots_in_time.choose_together([sweep, creep], "spectrum", 2)
    assert fit.kind.name == "spectrum"
    assert any("no row of creep.csv shows how the load changed between 0 and 0.05 s" in w for w in fit.warnings)
    assert any(w.startswith("the fit misses the data of sweep.csv by") for w in fit.warnings)


@pytest.mark.slow
def test_a_sweep_and_a_relaxation_test_together(tmp_path, capsys):
    """The relaxation time of this model, 0.05 s, is in the sweep's band; its equilibrium is in the range of the other
    test.
    """
    rng, omega = np.random.default_rng(1), np.geomspace(0.5, 300, 20)
    G = FORMULAS["fractional_zener"](1j * omega, *TRUTHS["fractional_zener"])
    factor = 1 + 0.01 * rng.standard_normal((2, 20))
    rows = [f"{w},{a},{b}" for w, a, b in zip(omega, G.real * factor[0], G.imag * factor[1], strict=True)]
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    (tmp_path / "sweep.csv").write_text("\n".join([head, *rows]) + "\n")
    answer = inverse_laplace("fractional_zener", False) * (1 + 0.003 * rng.standard_normal(25))
    rows = [f"{t},{g}" for t, g in zip(TIMES, answer, strict=True)]
    (tmp_path / "b.csv").write_text("\n".join(["time_s,relaxation_modulus_Pa", *rows]) + "\n")
    args = [str(tmp_path / "sweep.csv"), "--with", str(tmp_path / "b.csv"), "--out", str(tmp_path / "out")]
    assert main([*args, "--model", "auto"]) == 0
    content = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert content["model"] == "fractional_zener"
    for name, true in zip(CASES["fractional_zener"].names, TRUTHS["fractional_zener"], strict=True):
        own = content["parameters"][name]
        assert abs(own["value"] - true) < 4 * own["standard_error"] < 0.4 * true, name
    sweep, relaxation = content["tests"]
    assert 0.005 < sweep["misfit"] < 0.02 and 0.0015 < relaxation["misfit"] < 0.006
    without = relaxation["standard_errors_without_it"]["equilibrium_modulus"]
    assert without > 2 * content["parameters"]["equilibrium_modulus"]["standard_error"]
    assert "without 1" in capsys.readouterr().out


@pytest.mark.parametrize("more", [["--modes", "2"]])
def test_what_springpots_do_not_have_is_refused(more, tmp_path, capsys):
    (tmp_path / "a.csv").write_text("time_s,relaxation_modulus_Pa\n1,2\n2,1.5\n3,1.2\n4,1.1\n")
    assert main(["relaxation", str(tmp_path / "a.csv"), "--model", "auto", *more]) == 2
    assert f"{more[0]} works only with --model prony" in capsys.readouterr().err


RECORDS = [
    ("relaxation", "stressrelaxation_fishmuscle_data.csv"),
    ("relaxation", "stressrelaxation_ps160_data.csv"),
    ("creep", "creep_mucus_data.csv"),
    ("creep", "creep_perihepatic_data.csv"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "file"), RECORDS)
def test_every_model_reaches_the_best_of_a_hundred_starts_of_scipy(kind, file):
    path = SHARED / "data" / "rheology" / "pyrheo" / file
    if not path.exists():
        pytest.skip("the measured records are not here")
    test = time_tests.read_time_test(path, kind)
    near, rng = time_fits.fit(test).model, np.random.default_rng(0)
    for fit in springpots_in_time.fractional_in_time(test, near):
        own = springpots_in_time.residuals_of_springpot(fit.kind.name, test)
        both = jax.jit(lambda u, own=own: (own(u), jax.jacfwd(own)(u)))
        spread = np.where(np.array(CASES[fit.kind.name].free) % 2 == 0, 2.0, 1.5)
        moduli, best = np.log(float(near.shear_modulus)), np.inf
        for _ in range(100):
            centre = np.where(np.array(CASES[fit.kind.name].free) % 2 == 0, moduli - 2, 0.0)
            start = centre + spread * rng.standard_normal(len(centre))
            seen = {}

            def rows(u, both=both, seen=seen):
                seen[u.tobytes()] = tuple(np.nan_to_num(np.asarray(v), nan=1e6) for v in both(jnp.asarray(u)))
                return seen[u.tobytes()][0]

            def slopes(u, rows=rows, seen=seen):
                return rows(u) is not None and seen[u.tobytes()][1]

            found = scipy.optimize.least_squares(rows, start, slopes, method="lm", max_nfev=200)
            # An exponent within 1e-3 of 1 is a dashpot. In two records it acts only at the first times.
            if found.x[CASES[fit.kind.name].free.index(3)] < 7:
                best = min(best, found.cost)
        assert float(fit.solution.cost) <= best * (1 + 1e-4), fit.kind.name


@pytest.mark.slow
def test_the_posterior_of_springpots_in_time_has_the_errors_of_the_fit():
    """The test determines the model well. Deviations of the draws are the standard errors, and their means the fit."""
    answer = inverse_laplace("fractional_kelvin_voigt", False)
    answer = answer * (1 + 0.005 * np.random.default_rng(0).standard_normal(25))
    time, answer = np.concatenate([[0.0], TIMES]), np.concatenate([[np.nan], answer])
    test = time_tests.TimeTest("relaxation", time, np.ones(26), answer, time > 0)
    near = Maxwell(np.float64(500.0), np.array([0.2, 0.2]), np.array([30.0, 0.5]))
    found = {f.kind.name: f for f in springpots_in_time.fractional_in_time(test, near)}
    fit = found["fractional_kelvin_voigt"]
    drawn = posterior.of_time_test(fit, test, 500)
    assert drawn.names == fit.kind.names and np.all(drawn.r_hat < 1.02)
    draws, own = drawn.draws.reshape(-1, 3), fit.parameters
    # Student's t with 22 degrees of freedom is 5 % wider than the normal one. 2,000 draws scatter by 2 %.
    assert np.allclose(draws.std(axis=0), own.standard_errors, rtol=0.25)
    assert np.all(np.abs(draws.mean(axis=0) - own.values) < 0.5 * own.standard_errors)


@pytest.mark.slow
def test_fish_muscle_relaxes_as_two_springpots_in_a_row():
    """pyRheo shows its fractional Maxwell model for this record. Modes need eleven numbers and fit less well."""
    file = SHARED / "data" / "rheology" / "pyrheo" / "stressrelaxation_fishmuscle_data.csv"
    if not file.exists():
        pytest.skip("the record of fish muscle is not here")
    test = time_tests.read_time_test(file, "relaxation", time_tests.Sample(None, None), 0.0, 0.0)
    found = springpots_in_time.choose_in_time(test, "fractional")
    assert found.kind.name == "fractional_maxwell" and found.relative_errors.mean() < 0.004


def test_the_spectrum_of_a_relaxation_test_gets_a_note_instead_of_draws(tmp_path, capsys):
    """If `auto` chose the spectrum, --samples ended in a traceback and nothing was written."""
    t, tau = np.geomspace(0.01, 1000, 60), np.geomspace(1e-5, 1e6, 200)
    weights = np.exp(-0.5 * (np.log(tau) / 4.5) ** 2)
    G = 300 + 700 * np.exp(-t[:, None] / tau) @ (weights / weights.sum())
    G = G * (1 + 1e-3 * np.random.default_rng(0).standard_normal(60))
    rows = np.column_stack([t, np.full(60, 0.01), 0.01 * G])
    np.savetxt(tmp_path / "r.csv", rows, "%.12g", ",", header="time_s,strain [1],stress_Pa", comments="")
    ask = ["--ramp", "0", "--model", "auto", "--samples", "100", "--out", str(tmp_path)]
    assert main(["relaxation", str(tmp_path / "r.csv"), *ask]) == 0
    shown = capsys.readouterr()
    assert "note: --samples works only with models of a few parameters" in shown.err
    assert "relaxation, spectrum" in shown.out and (tmp_path / "fit.json").is_file()


def creep_of_burgers(spring: float) -> time_tests.TimeTest:
    """Creep of a Maxwell and a Kelvin element in series, with 0.5 % noise. `spring`: modulus [Pa] beside the dashpot of
    the Maxwell element; 0: a fluid."""
    t = np.geomspace(0.02, 300, 60)
    flow = (1 - np.exp(-t * spring / 1600)) / spring if spring else t / 1600
    strain = 10 * (1 / 800 + flow + (1 - np.exp(-t / 3)) / 500)
    strain = strain * (1 + 0.005 * np.random.default_rng(0).standard_normal(len(t)))
    at, stress = np.concatenate([[0.0, 1e-7], t]), np.concatenate([[0.0], np.full(len(t) + 1, 10.0)])
    return time_tests.TimeTest("creep", at, stress, np.concatenate([[0.0, 0.0], strain]), at > 1e-6)


def test_a_fluid_is_no_solid_by_chance():
    """The solid, whose criterion is 2.3 lower by chance, was chosen, and `auto` did not show the fluid."""
    fit = springpots_in_time.choose_in_time(creep_of_burgers(0.0), "auto", 2)
    rows = {row["model"]: row["above_the_lowest"] for row in fit.details["tried"]}
    assert fit.kind.name == "prony_fluid" and 0 <= rows["prony"] < rows["prony_fluid"] < rows["prony"] + 6
    assert min(rows.values()) == 0 and set(rows) > {"spectrum", "springpot"}


def test_a_fluid_in_two_tests_is_no_solid_by_chance():
    """Several tests together chose the solid, whose criterion is lower by chance, and `auto` did not show the fluid."""
    creep, rng = creep_of_burgers(0.0), np.random.default_rng(1)
    omega = np.geomspace(0.5, 50, 12)
    compliance = 1 / 800 + 1 / (1600j * omega) + 1 / (500 * (1 + 3j * omega))
    G = (1 / compliance) * (1 + 0.01 * rng.standard_normal(12))
    fit = common_fit.fit([Sweep(omega, G.real, G.imag), creep], 2)
    (own,) = (row for row in fit.tried if row["model"] == "prony_fluid")
    table = springpots_in_time._with_other_kind([own], fit, fit.tried)
    rows = {row["model"]: row["above_the_lowest"] for row in table}
    assert fit.kind.name == "prony_fluid" and 0 <= rows["prony"] < rows["prony_fluid"] < rows["prony"] + 6


def test_a_fluid_is_told_that_a_solid_fits_better():
    """The criterion of the solid is 5.7 lower, which is not enough to choose it. There was no warning."""
    fit = springpots_in_time.choose_in_time(creep_of_burgers(0.03), "prony", 2)
    assert fit.kind.name == "prony_fluid"
    assert any("prony explains the data about as well as prony_fluid (criterion 5.7 lower" in w for w in fit.warnings)


def test_a_weak_solid_is_told_that_it_may_be_a_fluid():
    fit = springpots_in_time.choose_in_time(creep_of_burgers(0.06), "prony", 2)
    assert fit.kind.name == "prony"
    assert any("prony_fluid explains the data about as well as prony" in w for w in fit.warnings)
