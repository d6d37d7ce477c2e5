"""Samples of the posterior: of known densities, of a fit against quadrature, and calibrated by simulation."""

import json
import types

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats
from conftest import ROOT

from fitting.__main__ import main
from fitting.fits import instrument, posterior, simulated_rheometer, viscoelastic
from fitting.fits.families import models
from fitting.fits.honesty import alike_points
from fitting.methods import generalised_maxwell, springpots, uncertainty
from fitting.methods.least_squares import levenberg_marquardt
from fitting.methods.sampling import tempering
from fitting.methods.sampling.diagnostics import r_hat
from fitting.methods.sampling.tempering import Density
from fitting.readers.rheometer import Sweep

pytestmark = pytest.mark.quick_to_compile

LION = ROOT / "data" / "lions_mane_frequency_sweep.csv"
PORCINE = ROOT / "data" / "porcine_liver_frequency_sweep.csv"
OMEGA = np.geomspace(0.1, 100, 11)


def two_peaks(u: np.ndarray) -> np.ndarray:
    """A density with 0.3 of its mass around (-4, …) and 0.7 around (4, …), a hundred times narrower than the prior."""
    narrow = [-0.5 * np.sum((u - c) ** 2, axis=-1) / 0.1**2 - 2 * np.log(0.1 * np.sqrt(2 * np.pi)) for c in (-4, 4)]
    return np.logaddexp(np.log(0.3) + narrow[0], np.log(0.7) + narrow[1])


def test_two_far_peaks_keep_their_masses_and_the_evidence_is_known():
    flat = Density(
        two_peaks,
        lambda u: np.where(np.all(np.abs(u) < 10, axis=-1), 0.0, -np.inf),
        lambda rng, n: rng.uniform(-10, 10, (n, 2)),
    )
    found = tempering.run(flat, 1000)
    right = found.draws[..., 0] > 0
    # 4000 draws with mass 0.7, resampled about five times: the standard error of the mass is 0.02.
    assert right.mean() == pytest.approx(0.7, abs=0.06)
    assert found.log_evidence.mean() == pytest.approx(-2 * np.log(20), abs=0.15)
    assert found.draws[right].mean() == pytest.approx(4, abs=0.01)
    assert found.draws[right].std() == pytest.approx(0.1, rel=0.05)


#: Results of arviz_stats 0.8.0, rhat(method="rank"), for the draws below.
ARVIZ = (1.04440297, 1.03997086)


def test_r_hat_is_that_of_arviz():
    rng = np.random.default_rng(3)
    draws = rng.standard_normal((4, 400)).cumsum(axis=1) / 30 + rng.standard_normal((4, 400))
    assert r_hat(draws) == pytest.approx(ARVIZ[0], rel=1e-8)
    assert r_hat(rng.standard_cauchy((4, 401)) * np.array([1, 1, 1, 3])[:, None]) == pytest.approx(ARVIZ[1], rel=1e-8)


def test_a_given_size_of_errors_is_only_ever_enlarged():
    """The integral over the size of the errors has a closed form. It is compared with quadrature."""
    for m, square in ((20, 3.0), (20, 25.0), (62, 300.0)):
        grids = [np.linspace(low, 6, 400001) for low in (-3, 0)]
        free, above = (np.trapezoid(np.exp(-m * t - 0.5 * square * np.exp(-2 * t)), t) for t in grids)
        ours = [posterior.log_likelihood(np.array(square), m, given) for given in (False, True)]
        constant = scipy.special.gammaln(0.5 * m) - np.log(2)
        assert ours[0] + constant == pytest.approx(np.log(free), rel=1e-6)
        assert ours[1] + constant == pytest.approx(np.log(above), rel=1e-5)


#: The logarithm of the regularised lower incomplete gamma function P(m / 2, square / 2), for (m, square), from mpmath
#: with 40 digits.
MPMATH = {
    (400, 1.0): -1002.3589326739,
    (1000, 80.0): -806.80753833155,
    (1000, 200.0): -408.5228443913,
    (100000, 2000.0): -146607.45889846,
}


def test_residuals_far_below_the_given_errors_have_a_likelihood():
    """The integral underflowed where the residuals are smallest: the best fit had the likelihood 0."""
    for (m, square), log_p in MPMATH.items():
        squares = np.array([square, 2.0 * m])  # one value underflows, the other one does not
        found, free = (posterior.log_likelihood(squares, m, given) for given in (True, False))
        assert (found - free)[0] == pytest.approx(log_p, rel=1e-10)
        assert (found - free)[1] == pytest.approx(0.0, abs=1e-6)


def one_mode(noise: float, seed: int) -> Sweep:
    rng = np.random.default_rng(seed)
    model = generalised_maxwell.Maxwell(np.float64(700.0), np.array([0.4]), np.array([0.3]))
    storage, loss = generalised_maxwell.moduli(model, OMEGA)
    factor = 1 + noise * rng.standard_normal((2, len(OMEGA)))
    return Sweep(OMEGA, storage * factor[0], loss * factor[1])


def test_the_draws_of_one_mode_have_the_moments_of_quadrature():
    sweep = one_mode(0.2, 1)
    fit = viscoelastic.closed_form(sweep, 1)
    found = posterior.of_sweep(fit, sweep, 1000)
    data = (OMEGA, sweep.storage, sweep.loss, np.concatenate(sweep.deviations))
    at = posterior._sweep_target(fit.kind, sweep, lambda u: generalised_maxwell.residuals(u, *data))
    centre = np.asarray(fit.solution.u)
    axes = [c + np.linspace(-w, w, n) for c, w, n in zip(centre, (0.2, 0.5, 0.3), (41, 41, 41), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    log_density = np.concatenate([at.log_likelihood(u) + at.prior.log_prior(u) for u in np.array_split(grid, 50)])
    weight = np.exp(log_density - log_density.max())
    weight /= weight.sum()
    numbers = at.prior.numbers(grid)
    mean = weight @ numbers
    sd = np.sqrt(weight @ (numbers - mean) ** 2)
    flat = found.draws.reshape(-1, 4)
    assert found.names == ("shear_modulus", "equilibrium_modulus", "ratios[0]", "relaxation_times[0]")
    assert np.all(np.abs(flat.mean(axis=0) - mean) < 0.08 * sd)  # 4000 draws: 0.016, times five resamplings
    assert np.allclose(flat.std(axis=0), sd, rtol=0.1)
    assert found.r_hat.max() < 1.01


def test_noise_of_different_size_in_the_two_moduli_is_weighted():
    """The posterior took one size of noise for both. Its equilibrium modulus had a standard deviation of 2.7 Pa."""
    s, rng = one_mode(0.0, 1), np.random.default_rng(1)
    s = s._replace(storage=s.storage * (1 + 0.003 * rng.normal(size=11)), loss=s.loss * (1 + 0.1 * rng.normal(size=11)))
    fit = viscoelastic.closed_form(s, 1)
    assert fit.noise_root is not None
    draws = posterior.of_sweep(fit, s, 200).draws.reshape(-1, 4)[:, 1]
    assert draws.std() < 1.2 and abs(draws.mean() - 420) < 3 * draws.std()


def test_other_weights_than_those_in_the_file_are_told():
    """The deviations in the file are not noise. The posterior used other weights than the fit, without a message."""
    noise, omega = 1 + 0.02 * np.random.default_rng(0).standard_normal((2, 16)), 2 * np.pi * np.geomspace(0.1, 20, 16)
    x = 0.1j * omega
    G = 300 + 400 * x / (1 + x)
    sweep = Sweep(omega, G.real * noise[0], G.imag * noise[1])
    in_file = sweep._replace(storage_sd=0.02 * sweep.storage, loss_sd=1.2 * sweep.loss)
    fit = viscoelastic.closed_form(in_file, 1)
    (told,) = alike_points.posterior_cautions(fit, in_file)
    assert "does not use the deviations in the file as weights" in told
    # Neither smaller deviations, which are noise, nor a sweep without deviations need this warning.
    for other in (sweep, in_file._replace(loss_sd=0.02 * sweep.loss)):
        assert not alike_points.posterior_cautions(viscoelastic.closed_form(other, 1), other)


def test_the_error_of_the_inertia_is_drawn_with_its_prior():
    """Moments of five numbers are compared with quadrature of the density, which is written out here."""
    s = one_mode(0.1, 1)
    # in units of a standard deviation of the prior, which changes the last modulus by 120 Pa
    share, off = 40 * OMEGA, 0.6
    s = s._replace(storage=s.storage - off * 0.03 * share, inertia=share)
    fit, better = instrument.without_error_of_inertia(viscoelastic.closed_form(s, 1), s)
    found = posterior.of_sweep(fit, better, 1000)
    assert better is not s and found.names[-1] == "inertia_off_by" and "deviation of 3 %" in found.prior

    axes = [c + np.linspace(-w, w, 31) for c, w in zip(fit.solution.u, (0.15, 0.35, 0.3), strict=True)]
    errors, scales = np.linspace(-4, 4, 33), better.deviations
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    model = generalised_maxwell.moduli(generalised_maxwell.natural(grid), OMEGA)
    square = np.stack(
        [
            np.sum(((model[0] - s.storage - e * 0.03 * share) / scales[0]) ** 2, axis=1)
            + np.sum(((model[1] - s.loss) / scales[1]) ** 2, axis=1)
            for e in errors
        ],
        axis=1,
    )
    rest = 1 / (1 + np.exp(grid[:, 1]))  # uniform ratio: the derivative of the logit
    weight = square**-11 * np.exp(-0.5 * errors**2) * (rest * (1 - rest))[:, None]
    weight /= weight.sum()
    numbers = posterior._sweep_target(fit.kind, s, None).prior.numbers(grid)
    of_modes, of_error = weight.sum(axis=1), weight.sum(axis=0)
    mean = np.append(of_modes @ numbers, 0.03 * of_error @ errors)
    second = np.append(of_modes @ numbers**2, 0.03**2 * of_error @ errors**2)
    sd = np.sqrt(second - mean**2)
    flat = found.draws.reshape(-1, 5)
    assert np.all(np.abs(flat.mean(axis=0) - mean) < 0.08 * sd)  # as without the inertia
    assert np.allclose(flat.std(axis=0), sd, rtol=0.1)
    assert found.r_hat.max() < 1.01


@pytest.mark.parametrize("springpot", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_error_of_the_gap_is_a_factor_of_all_moduli(springpot):
    s = one_mode(0.02, 1)
    fit = viscoelastic.closed_form(s, 1)
    if springpot:
        (fit,) = (f for f in models.fractional(s) if f.kind.name == "fractional_zener")
    alone = posterior.of_sweep(fit, s, 500)
    wide = posterior.of_sweep(instrument.with_gap_error(fit, 0.05), s, 500)
    factor = wide.draws / alone.draws
    gap = factor[..., :1]
    moduli = ["modulus" in name or name.startswith("springpot") for name in alone.names]
    assert any(moduli) and not all(moduli)
    assert np.allclose(factor, np.where(moduli, gap, 1.0), rtol=1e-12)
    # 2000 draws have standard errors of 2.2 % of a deviation for the mean and 1.6 % for the deviation. Four of these.
    assert abs(gap.mean() - 1) < 0.09 * 0.05 and gap.std() == pytest.approx(0.05, rel=0.07)
    assert "5 %" in wide.prior and wide.r_hat.max() < 1.02


def test_data_without_noise_have_a_narrow_posterior_and_no_warning():
    sweep = one_mode(0.0, 1)
    found = posterior.of_sweep(viscoelastic.closed_form(sweep, 1), sweep, 200)
    assert not found.warnings()
    assert np.allclose(found.draws, [700.0, 420.0, 0.4, 0.3], rtol=100 * posterior.QUIETEST)


def calibration(modes: int, count: int, noise: float, monkeypatch) -> np.ndarray:
    """Return p-values (K,) of a uniform distribution of the true values' ranks among their draws.

    The true values are drawn from the prior.
    """
    monkeypatch.setattr(tempering, "CHAINS", 1)
    monkeypatch.setattr(tempering, "FEWEST", 100)
    prior = posterior.Modes(False, (np.log(100.0), np.log(10000.0)), (np.log(0.003), np.log(30.0)))
    rng = np.random.default_rng(0)
    ranks = []
    for k in range(count):
        truth = prior.from_prior(rng, 1, 2 * modes + 1)
        moduli = np.concatenate(generalised_maxwell.moduli(generalised_maxwell.natural(truth[0]), OMEGA))
        scales = noise * np.abs(moduli[: len(OMEGA)].mean()) * np.ones(2 * len(OMEGA))
        measured = moduli + scales * rng.standard_normal(len(moduli))
        data = (OMEGA, *np.split(measured, 2), scales)
        at = posterior.Target(lambda u, data=data: generalised_maxwell.residuals(u, *data), prior, False)
        draws = posterior.sample(at, 2 * modes + 1, 99, seed=k).draws[0]
        ranks.append((draws < prior.numbers(truth)).sum(axis=0))
    bins = np.stack([np.bincount(row * 10 // 100, minlength=10) for row in np.array(ranks).T])
    return scipy.stats.chisquare(bins, axis=1).pvalue


@pytest.mark.slow
def test_ranks_of_the_truth_are_uniform(monkeypatch):
    assert calibration(1, 40, 0.1, monkeypatch).min() > 1e-3


@pytest.mark.slow
def test_ranks_of_the_truth_are_uniform_of_two_modes(monkeypatch):
    assert calibration(2, 400, 0.05, monkeypatch).min() > 1e-3


@pytest.mark.slow
def test_a_prior_without_its_slopes_is_found_out(monkeypatch):
    """The calibration must detect this mistake: a flat density of logits and gaps."""
    right = posterior.Modes.log_prior
    flat = lambda self, u: np.where(np.isfinite(right(self, u)), 0.0, -np.inf)  # noqa: E731
    monkeypatch.setattr(posterior.Modes, "log_prior", flat)
    assert calibration(1, 40, 0.1, monkeypatch).min() < 1e-3


def test_the_command_writes_draws_and_their_summary(tmp_path, capsys):
    assert main([str(LION), "--method", "closed-form", "--modes", "1", "--samples", "200", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "fit.json").read_text())["posterior"]
    assert (
        content["chains"] == 4
        and content["draws_per_chain"] == 200
        and "are uniform on the simplex" in content["prior"]
    )
    rows = np.genfromtxt(tmp_path / "posterior.csv", delimiter=",", names=True, deletechars="")
    assert rows.shape == (800,) and rows.dtype.names == ("chain", *content["numbers"])
    fit = json.loads((tmp_path / "fit.json").read_text())
    for name, row in content["numbers"].items():
        value = fit[name] if name in fit else fit[name.split("[")[0]][0]
        assert row["interval_95"][0] < value < row["interval_95"][1]
        assert np.isclose(np.median(rows[name]), row["median"], rtol=1e-6)
    assert "posterior: 4 chains of 200" in capsys.readouterr().out
    assert not list(tmp_path.glob("*.part"))  # each file is written beside its place, and then renamed


def test_a_springpot_has_the_errors_of_its_curvature():
    """There are two parameters and little noise, so the posterior is normal, with the spread of the linearised fit."""
    rng = np.random.default_rng(5)
    G = 700 * (1j * OMEGA) ** 0.3 * np.exp(0.01 * (rng.standard_normal(11) + 1j * rng.standard_normal(11)))
    sweep = Sweep(OMEGA, G.real, G.imag)
    reference, model = springpots.reference_frequency(sweep), springpots.FRACTIONAL[0]
    scaled = (OMEGA / reference, sweep.storage, sweep.loss, np.concatenate(sweep.deviations))
    start = jnp.log(jnp.array([700.0, 0.4]))

    def residuals(u):
        return springpots.springpot_residuals(springpots.full(model, u), model.switches, *scaled)

    def values(u):
        return model.values(springpots.full(model, u), reference)

    found = levenberg_marquardt(residuals, start)
    p = uncertainty.estimated(model.names, values, found, 22, False)
    fit = types.SimpleNamespace(
        kind=viscoelastic.Kind(model.name, values=values), solution=found, details={}, noise_root=None
    )
    draws = posterior.of_sweep(fit, sweep, 500)
    flat = draws.draws.reshape(-1, 2)
    assert draws.names == p.names and "exponents are uniform" in draws.prior
    assert np.all(np.abs(flat.mean(axis=0) - p.values) < 0.1 * p.standard_errors)
    # The size of 22 errors is unknown. Student's t with 20 degrees of freedom is 5 % wider.
    assert np.allclose(flat.std(axis=0), p.standard_errors * np.sqrt(20 / 18), rtol=0.1)


@pytest.mark.slow
def test_relaxation_is_sampled_too(tmp_path):
    time = np.geomspace(0.01, 100, 60)
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal(60)
    modulus = (300 + 400 * np.exp(-time / 2.0)) * noise
    np.savetxt(
        tmp_path / "r.csv",
        np.column_stack([time, modulus]),
        delimiter=",",
        header="time_s,relaxation_modulus_Pa",
        comments="",
    )
    arguments = ["relaxation", str(tmp_path / "r.csv"), "--modes", "1", "--samples", "200", "--out", str(tmp_path)]
    assert main(arguments) == 0
    content = json.loads((tmp_path / "fit.json").read_text())
    rows, errors = content["posterior"]["numbers"], content["standard_errors"]
    for name, truth, error in (
        ("shear_modulus", content["shear_modulus"], errors["shear_modulus"]),
        ("relaxation_times[0]", content["relaxation_times"][0], errors["relaxation_times"][0]),
    ):
        assert abs(rows[name]["mean"] - truth) < 0.3 * error and np.isclose(
            rows[name]["standard_deviation"], error, rtol=0.2
        )


@pytest.mark.slow
def test_the_posterior_through_the_simulation_is_checked_by_simulating(tmp_path):
    sweep = one_mode(0.02, 2)
    closed = viscoelastic.closed_form(sweep, 1)
    simulation = simulated_rheometer.Simulation(steps=20)
    fit = simulated_rheometer.through_torsion(sweep, closed, simulation)
    found = posterior.of_simulation(fit, sweep, simulation, 500)
    assert found.simulated["largest_difference"] < 1e-2 and found.r_hat.max() < 1.02
    assert np.all(
        np.abs(np.median(found.draws, axis=(0, 1))[[0, 2, 3]] - fit.uncertainty.values)
        < fit.uncertainty.standard_errors
    )
    lost = found._replace(simulated={"draws": 12.0, "largest_difference": 2.0})
    assert "log density is wrong by up to 2" in lost.warnings()[0]


def test_the_evidence_prefers_the_true_number_of_modes_where_the_noise_is_weighted():
    """The evidence ignored the weights, which come from the residuals of each fit, and was best for one mode."""
    w, rng = np.geomspace(0.1, 100, 31), np.random.default_rng(1)
    truth = generalised_maxwell.Maxwell(np.float64(1000.0), np.array([0.3, 0.4]), np.array([1.0, 0.05]))
    storage, loss = generalised_maxwell.moduli(truth, w)
    s = Sweep(w, storage * (1 + 0.005 * rng.normal(size=31)), loss * (1 + 0.03 * rng.normal(size=31)))
    fits = [viscoelastic.closed_form(s, modes) for modes in (1, 2)]
    assert fits[1].noise_root is not None
    one, two = (posterior.of_sweep(fit, s, 100).chains.log_evidence.mean() for fit in fits)
    assert two > one + 50


@pytest.mark.parametrize("name", ["fractional_maxwell", "fractional_parallel"])
def test_both_exponents_have_the_stated_prior(name):
    """The ratio of the exponents was uniform, so the density of the larger exponent a was 1 / a times too large."""
    (model,) = (m for m in springpots.FRACTIONAL if m.name == name)
    prior = posterior.Springpots(model, (0.0, 10.0), lambda u: model.values(springpots.full(model, u), 1.0))
    drawn = prior.from_prior(np.random.default_rng(0), 20_000, 4)
    exponents = np.sort(prior.numbers(drawn)[:, [1, 3]], axis=1)
    # Two uniform numbers in order have the means 1/3 and 2/3, and the variance 1/18.
    assert np.allclose(exponents.mean(axis=0), [1 / 3, 2 / 3], atol=0.01)
    assert np.allclose(exponents.var(axis=0), 1 / 18, atol=0.002)
    # The moments of `log_prior` on a grid of logits are the same.
    grid = np.stack(np.meshgrid(*[np.linspace(-12, 12, 121)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    u = np.full((len(grid), 4), 5.0)
    u[:, ~prior._moduli] = grid
    weights = np.exp(prior.log_prior(u))
    own = np.sort(prior.numbers(u)[:, [1, 3]], axis=1)
    assert np.allclose(weights @ own / weights.sum(), [1 / 3, 2 / 3], atol=0.002)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--samples", "5"], "--samples 5 is out of range: give 100 to 100000"),
        (["--samples", "1000", "--model", "spectrum"], "remove --samples for --model spectrum"),
        ([str(PORCINE), "--samples", "1000"], "works only for one sample, and 2 files are given"),
    ],
)
def test_what_cannot_be_sampled_is_refused(arguments, sentence, tmp_path, capsys):
    assert main([str(LION), *arguments, "--out", str(tmp_path)]) == 2
    assert sentence in capsys.readouterr().err


def test_chains_that_do_not_agree_are_named():
    found = posterior.of_sweep(viscoelastic.closed_form(one_mode(0.02, 1), 1), one_mode(0.02, 1), 200)
    assert not found.warnings()
    assert "R-hat 1.3" in found._replace(r_hat=np.array([1.0, 1.3, 1.0, 1.0])).warnings()[0]


@pytest.mark.ci
def test_a_posterior_that_the_prior_cuts_is_told():
    """The mode has 8 s. Frequencies from 0.3 Hz on do not distinguish it from longer ones, and the prior ends
    at 5 s.
    """
    omega = 2 * np.pi * np.geomspace(0.316, 31.6, 25)
    G = sum(1000 * 1j * omega * tau / (1 + 1j * omega * tau) for tau in (8.0, 0.05))
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal((2, 25))
    s = Sweep(omega, G.real * noise[0], G.imag * noise[1])
    told = posterior.of_sweep(viscoelastic.closed_form(s, 2), s, 100).warnings()
    assert any(
        "the prior truncates the posterior of relaxation_times[0]" in w and "the bound of 5.04 s" in w for w in told
    )
