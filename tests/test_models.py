"""Models beyond Prony modes: springpots, a spectrum on a grid, fluids; their choice and conversion to modes."""

import json

import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.optimize
from conftest import ROOT, SHARED

from fitting.__main__ import main
from fitting.fits import simulated_rheometer, viscoelastic
from fitting.fits.families import limits as family_limits
from fitting.fits.families import models
from fitting.fits.honesty import total_error
from fitting.methods import as_prony_modes, generalised_maxwell, springpots, uncertainty
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.rheometer import Sweep, read_sweep
from fitting.reports import sweep_report
from liverjax import InputError, laws

pytestmark = pytest.mark.quick_to_compile

OMEGA = np.geomspace(0.1, 100, 16)
CASES = {model.name: model for model in springpots.FRACTIONAL}
#: The models as written in the literature, as functions of the reported numbers.
FORMULAS = {
    "springpot": lambda iw, v, a: v * iw**a,
    "fractional_kelvin_voigt": lambda iw, e, v, a: e + v * iw**a,
    "fractional_zener": lambda iw, e, m, tau, a: e + m * (iw * tau) ** a / (1 + (iw * tau) ** a),
    "fractional_maxwell": lambda iw, v, a, w, b: v * iw**a * w * iw**b / (v * iw**a + w * iw**b),
    "fractional_parallel": lambda iw, w, b, v, a: v * iw**a + w * iw**b,
}
TRUTHS = {
    "springpot": (700.0, 0.3),
    "fractional_kelvin_voigt": (300.0, 100.0, 0.45),
    "fractional_zener": (300.0, 900.0, 0.05, 0.6),
    "fractional_maxwell": (900.0, 0.9, 400.0, 0.2),
    "fractional_parallel": (400.0, 0.1, 30.0, 0.8),
}


def fractional_sweep(name: str, noise: float = 0.0, seed: int = 0, omega: np.ndarray = OMEGA) -> Sweep:
    G = FORMULAS[name](1j * omega, *TRUTHS[name])
    factor = 1 + noise * np.random.default_rng(seed).standard_normal((2, len(omega)))
    return Sweep(omega, G.real * factor[0], G.imag * factor[1])


def prony_moduli(model: Maxwell, omega: np.ndarray) -> np.ndarray:
    x = 1j * omega[:, None] * np.asarray(model.relaxation_times)
    rest = 1 - np.sum(model.ratios)
    return np.asarray(model.shear_modulus) * (rest + (np.asarray(model.ratios) * x / (1 + x)).sum(axis=1))


@pytest.mark.parametrize("name", CASES)
def test_the_reported_numbers_are_those_of_the_formula_of_the_literature(name):
    model, rng = CASES[name], np.random.default_rng(1)
    for reference in (1.0, 30.0):
        u = jnp.asarray(rng.uniform(-1, 1, springpots.SIZE))
        storage, loss = springpots.moduli(u, model.switches, OMEGA / reference)
        ours = np.asarray(storage) + 1j * np.asarray(loss)
        values = [mpmath.mpf(float(v)) for v in model.values(u, reference)]
        theirs = [complex(FORMULAS[name](mpmath.mpc(0, w), *values)) for w in OMEGA]
        assert np.allclose(ours, theirs, rtol=1e-12)


@pytest.fixture(scope="module")
def fractional_fits():
    """Return every model fitted to the data of every model, without noise."""
    return {name: models.fractional(fractional_sweep(name)) for name in CASES}


@pytest.mark.parametrize("name", CASES)
def test_noise_free_springpots_are_recovered_and_chosen(fractional_fits, name):
    fits = {f.kind.name: f for f in fractional_fits[name]}
    assert np.allclose(fits[name].parameters.values, TRUTHS[name], rtol=1e-5)
    able = [f for f in fits.values() if models.identifiable(f, fractional_sweep(name))]
    assert min(able, key=viscoelastic.information_criterion).kind.name == name


@pytest.mark.parametrize("name", CASES)
def test_conversions_stay_within_a_percent_of_the_formula(fractional_fits, name):
    f = next(f for f in fractional_fits[name] if f.kind.name == name)
    stated = f.details["conversion"]["largest_relative_error"]
    fine = np.geomspace(OMEGA[0], OMEGA[-1], 487)  # five times finer than the grid of the conversion
    G, ours = FORMULAS[name](1j * fine, *TRUTHS[name]), prony_moduli(f.model, fine)
    found = max(np.abs(ours.real / G.real - 1).max(), np.abs(ours.imag / G.imag - 1).max())
    # between grid points the error may be slightly larger
    assert stated < as_prony_modes.ALLOWED and found < 1.02 * stated + 1e-5
    if name in ("springpot", "fractional_maxwell", "fractional_parallel"):  # fluids: no modulus remains
        assert np.isclose(f.model.ratios.sum(), 1, rtol=1e-12)


def test_converted_modes_relax_as_the_mittag_leffler_function(fractional_fits):
    """The fractional Zener solid relaxes as E_a(-(t/tau)^a), summed by mpmath. The conversion did not use these
    times.
    """
    f = next(f for f in fractional_fits["fractional_zener"] if f.kind.name == "fractional_zener")
    e, m, tau, a = TRUTHS["fractional_zener"]

    def mittag_leffler(z):
        with mpmath.workdps(60):
            return float(mpmath.nsum(lambda k: z**k / mpmath.gamma(a * k + 1), [0, mpmath.inf], method="d"))

    for t in (0.03, 0.1, 0.3, 1.0):  # inside 1/100 to 1/0.1 s, away from the ends
        exact = e + m * mittag_leffler(-(mpmath.mpf(t / tau) ** a))
        G0, g, times = f.model
        ours = float(G0 * (1 - np.sum(g * (1 - np.exp(-t / times)))))
        assert abs(ours / exact - 1) < as_prony_modes.ALLOWED, t


def scipy_best(s: Sweep, name: str, count: int, seed: int = 0) -> float:
    """Return the lowest cost of SciPy's least squares from random starting points, with the formula of the
    literature.
    """
    rng, scales = np.random.default_rng(seed), np.concatenate(s.deviations)
    size, best = np.log(s.storage.max()), np.inf
    exponents = np.array(["exponent" in n for n in CASES[name].names])
    middle = -0.5 * np.log(s.angular_frequency[0] * s.angular_frequency[-1])
    spread = 0.5 * np.log(s.angular_frequency[-1] / s.angular_frequency[0]) + 1

    def residuals(q):
        p = np.where(exponents, 1 / (1 + np.exp(-q)), np.exp(np.clip(q, -200, 200)))
        G = FORMULAS[name](1j * s.angular_frequency, *p)
        r = (np.concatenate([G.real, G.imag]) - np.concatenate([s.storage, s.loss])) / scales
        return np.where(np.isfinite(r), r, 1e6)

    for _ in range(count):
        q = rng.uniform(size - 3, size + 2, len(exponents))
        q[exponents] = rng.uniform(-3, 3, exponents.sum())
        for k, n in enumerate(CASES[name].names):
            if n == "relaxation_time":
                q[k] = middle + rng.uniform(-spread, spread)
            elif "springpot" in n:  # a springpot that equals the data somewhere in the band
                alpha = 1 / (1 + np.exp(-q[k + 1]))
                q[k] += alpha * (middle + rng.uniform(-spread, spread))
        try:
            best = min(best, scipy.optimize.least_squares(residuals, q, x_scale="jac", max_nfev=200).cost)
        except np.linalg.LinAlgError:
            continue
    return best


GIVEN = {"lion's mane": "lions_mane_frequency_sweep.csv", "porcine liver": "porcine_liver_frequency_sweep.csv"}


@pytest.mark.parametrize("data", GIVEN)
def test_no_fractional_fit_is_worse_than_scipy_from_random_starts(data):
    s = read_sweep(ROOT / "data" / GIVEN[data])
    with np.errstate(all="ignore"):
        for f in models.fractional(s):
            # The exchange of the two springpots gives the same model, so SciPy may give the larger exponent to either.
            assert float(f.solution.cost) <= scipy_best(s, f.kind.name, 20) * (1 + 1e-6), f.kind.name


@pytest.mark.slow
def test_every_given_sweep_is_fitted_no_worse_than_by_scipy_from_100_starts():
    files = sorted((SHARED / "data" / "rheology" / "pyrheo").glob("osc*.csv"))
    files += sorted((SHARED / "data" / "lions_mane").glob("*.csv"))
    if not files:
        pytest.skip("the measured sweeps are not here")
    for file in files:
        s = read_sweep(file)
        with np.errstate(all="ignore"):
            for f in models.fractional(s):
                best = scipy_best(s, f.kind.name, 100)
                assert float(f.solution.cost) <= best * (1 + 1e-6), (file.name, f.kind.name)


def maxwell_fluid(noise: float) -> Sweep:
    omega = np.geomspace(0.1, 40, 31)
    G = 400 * 1j * omega * 5 / (1 + 1j * omega * 5) + 600 * 1j * omega * 0.05 / (1 + 1j * omega * 0.05)
    factor = 1 + noise * np.random.default_rng(0).standard_normal((2, len(omega)))
    return Sweep(omega, G.real * factor[0], G.imag * factor[1])


def test_a_fluid_is_recovered_without_an_equilibrium_modulus():
    s = maxwell_fluid(0.02)
    f = models.fluid(s, generalised_maxwell.spectrum(s))
    assert f.modes == 2 and f.kind.name == "prony_fluid" and float(f.model.ratios.sum()) == pytest.approx(1, abs=1e-14)
    truth = np.array([1000, 0.4, 0.6, 5, 0.05])
    assert np.all(np.abs(f.uncertainty.values - truth) < 3 * f.uncertainty.standard_errors)
    assert not any("equilibrium" in w for w in f.warnings)
    # The table once said "G_inf 2.2e-13 ± inf Pa".
    rounded = f._replace(model=f.model._replace(ratios=f.model.ratios * (1 - 1e-15)))
    assert sweep_report.summary(rounded, s)["equilibrium_modulus"] == 0.0
    assert not any("inf Pa" in row or "nan" in row for row in sweep_report._lines(f))
    assert any("a fluid" in row for row in sweep_report._lines(f))


def test_times_far_apart_do_not_overflow():
    """If a fit diverges, NumPy's warning on an exponential means nothing to a user."""
    with np.errstate(over="raise"):
        model = generalised_maxwell.natural(np.array([0.0, 0.0, 0.0, 0.0, 900.0]))
    assert model.relaxation_times[1] == 0.0


def test_one_mode_of_a_fluid_leaves_nothing_free():
    """The only ratio is 1 by definition. It had an infinite error, and the fluid was never chosen."""
    omega = np.geomspace(0.1, 100, 31)
    factor = 1 + 0.01 * np.random.default_rng(1).standard_normal((2, len(omega)))
    G = 100 * 0.3j * omega / (1 + 0.3j * omega)
    s = Sweep(omega, G.real * factor[0], G.imag * factor[1])
    f = models.fluid(s, generalised_maxwell.spectrum(s))
    assert f.modes == 1 and viscoelastic.identifiable(f, s)
    assert f.uncertainty.standard_errors[1] == 0
    assert np.all(np.abs(f.uncertainty.values - [100, 1, 0.3])[[0, 2]] < 3 * f.uncertainty.standard_errors[[0, 2]])


def test_two_frequencies_are_too_few_for_four_numbers():
    """Four parameters fit four data exactly, and had errors of 1e-12."""
    found = models.fractional(fractional_sweep("fractional_zener", omega=np.array([0.6, 6.0])))
    assert [f.kind.name for f in found] == ["springpot", "fractional_kelvin_voigt"]


def automatic(s: Sweep) -> viscoelastic.Fit:
    dense = generalised_maxwell.spectrum(s)
    return models.choose(s, "auto", viscoelastic.choose_modes(s, dense)[0], dense)


@pytest.mark.slow
def test_auto_takes_the_model_that_made_the_data():
    fluid = automatic(maxwell_fluid(0.02))
    assert fluid.kind.name == "prony_fluid"
    rows = fluid.details["models_compared"]
    assert rows[0]["above_the_lowest"] == 0 and {"prony", "spectrum", "springpot"} <= {r["model"] for r in rows}
    zener = automatic(fractional_sweep("fractional_zener", 0.02, 1, np.geomspace(0.1, 40, 31)))
    assert zener.kind.name == "fractional_zener" and zener.details["conversion"]["largest_relative_error"] < 0.01


@pytest.mark.parametrize("model", ["fractional", "spectrum"])
def test_the_command_writes_the_model(model, tmp_path, capsys):
    file = ROOT / "data" / GIVEN["porcine liver"]
    assert main([str(file), "--method", "closed-form", "--model", model, "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "fit.json").read_text())
    out = capsys.readouterr().out
    assert content["model"] == {"fractional": "fractional_zener", "spectrum": "spectrum"}[model]
    assert content["modes"] == len(content["ratios"]) == len(content["relaxation_times"])
    assert content["details"]["conversion"]["largest_relative_error"] < 0.01
    assert content["parameters"]["equilibrium_modulus"]["unit"] == "Pa"
    assert content["standard_errors"]["relaxation_times"] == [None] * content["modes"]  # chosen, not measured
    assert ("criterion" in out) == (model == "fractional") and "Prony modes" in out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--model", "spectrum", "--modes", "3"], "--modes 3 works only with --model prony: remove this option"),
        (["--model", "auto", "--profile"], "--profile works only with --model prony"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, sentence, tmp_path, capsys):
    file = ROOT / "data" / GIVEN["porcine liver"]
    assert main([str(file), *options, "--out", str(tmp_path)]) == 2
    assert sentence in capsys.readouterr().err


def test_errors_of_the_discretisation_are_those_of_the_springpot():
    """The time steps moved the exponent by several standard errors. The total error did not contain this change, and
    the warnings named the internal Prony modes.
    """
    omega = 2 * np.pi * np.geomspace(0.01, 10, 20)
    noise = 1 + 0.003 * np.random.default_rng(0).standard_normal((2, 20))
    G = 300 * (1j * omega) ** 0.3
    s = Sweep(omega, G.real * noise[0], G.imag * noise[1])
    closed = next(f for f in models.fractional(s) if f.kind.name == "springpot")
    simulation, law, scales = (
        simulated_rheometer.Simulation(),
        laws.typical("neo_hookean"),
        np.concatenate(s.deviations),
    )
    fit = simulated_rheometer._with_biases(closed, (None, law, jnp.asarray(omega), scales), simulation)
    material = simulated_rheometer.law_and_prony(closed.kind.maxwell(closed.solution.u), law, simulation)
    in_steps, exact = (
        np.asarray(G) for G in simulated_rheometer._of_no_mesh(*material, jnp.asarray(omega), simulation.steps)
    )
    G = s.storage + 1j * s.loss + exact - in_steps  # the fit of the simulation is about the fit to these data
    moved = next(f for f in models.fractional(Sweep(omega, G.real, G.imag)) if f.kind.name == "springpot")
    moved = moved._replace(parameters=fit.parameters._replace(values=moved.parameters.values))
    shift = moved.parameters.values - closed.parameters.values
    assert abs(shift[1]) > 2 * closed.parameters.standard_errors[1]
    assert fit.parameters.time_step_bias == pytest.approx(shift, rel=0.1)
    shares = total_error.error_shares(fit)
    assert shares["time_step"] == pytest.approx(dict(zip(closed.kind.names, abs(shift), strict=True)), rel=0.1)
    assert total_error.total_errors(fit)["exponent"] > abs(0.9 * shift[1])
    told = simulated_rheometer._bias(closed, moved)
    assert [w.split(":")[0] for w in told] == ["springpot", "exponent"]
    errors = closed.parameters.standard_errors
    assert simulated_rheometer.largest_shift(closed, moved) == pytest.approx(np.max(np.abs(shift) / errors))


@pytest.mark.slow
def test_a_fractional_model_goes_through_the_torsion_simulation():
    s = fractional_sweep("fractional_zener", omega=np.geomspace(0.5, 30, 7))
    closed = next(f for f in models.fractional(s) if f.kind.name == "fractional_zener")
    f = simulated_rheometer.through_torsion(s, closed, simulated_rheometer.Simulation(cell_size=0.004))
    # Errors of the fit: the conversion (below 1 %) and 50 steps per cycle (0.15 %).
    assert f.converged and np.allclose(f.parameters.values, TRUTHS["fractional_zener"], rtol=0.05)
    assert np.max(f.relative_errors(s)) < 0.01


def test_a_sweep_of_no_maxwell_solid_is_refused_for_every_model(tmp_path, capsys):
    file = tmp_path / "sweep.csv"
    file.write_text("frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n0.1,30,300\n1,60,400\n10,90,500\n")
    assert main([str(file), "--model", "auto", "--out", str(tmp_path / "fit")]) == 2
    assert "the two columns are exchanged" in capsys.readouterr().err
    with pytest.raises(InputError):
        generalised_maxwell.refuse_impossible(read_sweep(file))


@pytest.mark.slow
def test_no_start_of_scipy_is_below_the_fluid():
    s, rng, best = maxwell_fluid(0.02), np.random.default_rng(0), np.inf
    scales, data = np.concatenate(s.deviations), np.concatenate([s.storage, s.loss])
    f = models.fluid(s, generalised_maxwell.spectrum(s))

    def residuals(q):
        strengths, times = np.exp(np.split(np.clip(q, -50, 50), 2))
        x = 1j * s.angular_frequency[:, None] * times
        G = (strengths * x / (1 + x)).sum(axis=1)
        return (np.concatenate([G.real, G.imag]) - data) / scales

    for _ in range(100):
        start = np.concatenate([rng.uniform(3, 8, f.modes), rng.uniform(-5, 4, f.modes)])
        best = min(best, scipy.optimize.least_squares(residuals, start, x_scale="jac").cost)
    assert float(f.solution.cost) <= best * (1 + 1e-8)


def curve_of_20_decades(relaxing):
    """A sweep of 81 frequencies with 2 % of noise; `relaxing` gives the part above the plateau from i omega."""
    omega = 2 * np.pi * np.logspace(-10, 10, 81)
    G, factor = 1e3 + relaxing(1j * omega), 1 + 0.02 * np.random.default_rng(1).standard_normal((2, 81))
    return Sweep(omega, G.real * factor[0], G.imag * factor[1])


def test_few_modes_converge_on_a_wide_curve():
    """The modes have a misfit of a half, so Gauss-Newton converges slowly: more than 200 iterations."""
    s = curve_of_20_decades(lambda x: 1e6 * x**0.3 / (1 + x**0.3))
    f = viscoelastic.closed_form(s, 3)
    assert f.converged and f.details["iterations"] > 200 and viscoelastic.identifiable(f, s)


@pytest.mark.slow
def test_as_many_modes_are_found_as_a_wide_curve_has():
    """There is one time per decade. Fewer modes have misfits of 73, 62, 53, … %, and the criterion falls with each
    mode.
    """
    times = np.logspace(-9, 9, 20)
    s = curve_of_20_decades(lambda x: sum(5e3 * x * t / (1 + x * t) for t in times))
    f, tried = viscoelastic.choose_modes(s, generalised_maxwell.refuse_impossible(s))
    assert f.modes == 20 and f.converged and all(viscoelastic.identifiable(t, s) for t in tried[:20])
    assert np.mean(f.relative_errors(s)) < 0.02
    # Each time is within four standard errors.
    errors = f.uncertainty.standard_errors[21:] / times[::-1]
    assert np.all(np.abs(np.log(f.model.relaxation_times / times[::-1])) < 4 * errors)


@pytest.mark.slow
def test_a_master_curve_of_26_decades_is_followed_by_the_spectrum():
    """The data are synthetic: two broad fractional steps and a plateau, 2 % of noise. 8 or 9 free modes leave 30 %
    here.
    """
    omega = np.geomspace(1e-12, 1e14, 160)
    slow, fast = (1j * omega * 1e8) ** 0.8, (1j * omega * 1e-5) ** 0.45
    G = 2e3 + 1e6 * slow / (1 + slow) + 1e9 * fast / (1 + fast)
    factor = 1 + 0.02 * np.random.default_rng(0).standard_normal((2, 160))
    s = Sweep(omega, G.real * factor[0], G.imag * factor[1])
    f = models.spectrum_fit(s)
    assert np.mean(f.relative_errors(s)) < 0.02 and f.details["conversion"]["largest_relative_error"] < 0.01
    exact = np.concatenate([G.real, G.imag])
    # The noise of 2 % is averaged over about seven moduli per parameter.
    assert np.mean(np.abs(np.concatenate([f.storage, f.loss]) / exact - 1)) < 0.012
    assert f.details["spectrum"]["decades_carried"] > 20


@pytest.mark.parametrize(
    ("name", "limits"), [("fractional_zener", (1200.0, 300.0)), ("fractional_kelvin_voigt", (None, 300.0))]
)
def test_limits_of_prony_modes_have_the_error_of_their_band(name, limits):
    """The modes follow the model only within the band. Their limits were wrong by 13 and 22 of their standard
    errors.
    """
    s = fractional_sweep(name, 0.01, omega=np.geomspace(0.1, 100, 30))
    (fit,) = (f for f in models.fractional(s) if f.kind.name == name)
    content = sweep_report.summary(fit, s)
    for key, true in zip(("shear_modulus", "equilibrium_modulus"), limits, strict=True):
        if true is not None:
            assert abs(content[key] - true) < 3 * content["standard_errors"][key]
            assert abs(content[key] - true) > 3 * family_limits.limit_errors(fit.uncertainty, fit.model, None)[key]
            assert any(
                f"{family_limits.NAMES[key]} of the" in w and "only over the measured" in w for w in fit.warnings
            )
    prony = viscoelastic.closed_form(s, 2)
    assert sweep_report.summary(prony, s)["standard_errors"]["shear_modulus"] == prony.uncertainty.standard_errors[0]


@pytest.mark.ci
def test_an_exponent_at_its_bound_is_told():
    s = Sweep(OMEGA, 1e-3 * OMEGA, 10.0 * OMEGA)
    (fit,) = (f for f in models.fractional(s) if f.kind.name == "springpot")
    assert any("exponent is at its bound 1: the springpot is a dashpot" in w for w in fit.warnings)
    assert any("no finite instantaneous modulus" in w for w in fit.warnings)


def test_only_prony_modes_of_a_solid_have_profile_intervals():
    s = Sweep(OMEGA, 10 * OMEGA**0.3, 5 * OMEGA**0.3)
    (fit,) = (f for f in models.fractional(s) if f.kind.name == "springpot")
    assert not uncertainty.has_profile(fit.solution, fit.uncertainty)
    with pytest.raises(InputError, match="profile intervals are for Prony modes of a solid"):
        uncertainty.profile_intervals(fit.solution, s, fit.uncertainty)
    solid = viscoelastic.closed_form(s, 1)
    assert uncertainty.has_profile(solid.solution, solid.uncertainty)


def test_a_springpot_that_is_a_spring_gives_a_finite_modulus():
    """At high frequencies a Maxwell model is its spring, but it was told to have no finite instantaneous modulus."""
    G = 1j * OMEGA * 100 / (1 + 1j * OMEGA * 100 / 700.0)
    (fit,) = (f for f in models.fractional(Sweep(OMEGA, G.real, G.imag)) if f.kind.name == "fractional_maxwell")
    assert any("the springpot is a spring" in w for w in fit.warnings)
    assert not any("no finite instantaneous modulus" in w for w in fit.warnings)
    assert np.isclose(fit.model.shear_modulus, 700, rtol=0.02)


def test_a_small_exponent_that_is_known_is_at_no_bound_and_has_modes():
    """For an elastic solid with a loss of a thousandth, the exponent is 2/pi atan(1e-3). The modes need an equilibrium
    modulus.
    """
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal((2, 16))
    fits = models.fractional(Sweep(OMEGA, 1000 * noise[0], 1.0 * noise[1]))
    (fit,) = (f for f in fits if f.kind.name == "springpot")
    assert fit.parameters.values[1] == pytest.approx(2 / np.pi * np.arctan(1e-3), rel=0.01)
    assert fit.details["conversion"]["largest_relative_error"] < as_prony_modes.ALLOWED
    assert not any("at its bound" in w or "narrower band" in w for w in fit.warnings)
    (spring,) = (f for f in fits if f.kind.name == "fractional_maxwell")
    unknown = spring.parameters._replace(standard_errors=np.full(4, 1e-3), values=np.array([900, 1e-4, 400, 0.2]))
    assert len(models.at_bounds(unknown)) == 1


def test_the_total_error_stands_beside_a_model_s_own_numbers(tmp_path):
    main(
        [
            str(ROOT / "data" / "porcine_liver_frequency_sweep.csv"),
            "--method",
            "closed-form",
            "--model",
            "spectrum",
            "--out",
            str(tmp_path),
        ]
    )
    content = json.loads((tmp_path / "fit.json").read_text())
    own = content["parameters"]["equilibrium_modulus"]
    assert own["total_error"] == content["total_errors"]["equilibrium_modulus"] >= own["standard_error"]
    # The strengths had no total error.
    strengths = [p for name, p in content["parameters"].items() if name.startswith("strengths[")]
    assert [p["total_error"] for p in strengths] == content["total_errors"]["strengths"]
    relative = [
        s / p["value"] for s, p in zip(content["error_shares"]["geometry"]["strengths"], strengths, strict=True)
    ]
    assert len(relative) > 3 and np.allclose(relative, relative[0]) and relative[0] > 0.01
