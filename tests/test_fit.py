"""Identification: recovery, statistics, other optimisers, choice of modes, messages to the user."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.optimize
from conftest import ROOT

from fitting.fits import simulated_rheometer, viscoelastic
from fitting.methods import generalised_maxwell, uncertainty
from fitting.methods.estimate import spread
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.least_squares import Solution, bfgs, levenberg_marquardt, with_jacobian
from fitting.readers.rheometer import Sweep, read_sweep
from fitting.reports import sweep_report
from liverjax import InputError

TRUTH = np.array([770.0, 0.235, 0.333, 0.27, 0.03])
OMEGA = 2 * np.pi * np.geomspace(0.1, 4.0, 16)


def sweep(noise: float = 0.0, seed: int = 0, model: np.ndarray = TRUTH, omega: np.ndarray = OMEGA) -> Sweep:
    n = (len(model) - 1) // 2
    maxwell = Maxwell(jnp.asarray(model[0]), jnp.asarray(model[1 : n + 1]), jnp.asarray(model[n + 1 :]))
    rng = np.random.default_rng(seed)
    storage, loss = (
        np.asarray(v) * (1 + noise * rng.standard_normal(len(omega)))
        for v in generalised_maxwell.moduli(maxwell, jnp.asarray(omega))
    )
    return Sweep(omega, storage, loss)


def parameters(f: viscoelastic.Fit) -> np.ndarray:
    return f.uncertainty.values


def test_parametrisation_has_an_inverse():
    @jax.jit
    def there_and_back(model):
        n = (len(model) - 1) // 2
        u = generalised_maxwell.unconstrained(Maxwell(model[0], model[1 : n + 1], model[n + 1 :]))
        return uncertainty.parameter_vector(u)

    for model in (TRUTH, np.array([1e4, 0.5, 1.0]), np.array([1.0, 0.1, 0.2, 0.3, 9.0, 1.0, 1e-3])):
        assert np.allclose(there_and_back(model), model, rtol=1e-12)


@pytest.mark.core
def test_noise_free_sweep_is_recovered():
    f = viscoelastic.closed_form(sweep(), 2)
    assert f.converged and np.abs(parameters(f) / TRUTH - 1).max() < 1e-6


def test_given_deviations_change_the_weights_not_the_answer():
    s = sweep()
    f = viscoelastic.closed_form(s._replace(storage_sd=0.02 * s.storage, loss_sd=5.0 + 0 * s.loss), 2)
    assert np.abs(parameters(f) / TRUTH - 1).max() < 1e-6
    assert f.uncertainty.noise == 1.0


@pytest.mark.ci
@pytest.mark.parametrize("draws", [12, pytest.param(24, marks=pytest.mark.slow)])
@pytest.mark.parametrize("given", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_noise_in_percent_does_not_make_moduli_too_small(given, draws):
    """With weights from the measured moduli, points that are low by chance count most. With 10 % of noise, G0 was 2 %
    too small.
    """
    omega, found = np.geomspace(0.1, 100, 100), []
    truth = np.array([2500.0, 0.3, 0.4, 0.05, 1.2])
    for seed in range(draws):
        s = sweep(0.1, seed, truth, omega)
        s = s._replace(storage_sd=0.1 * s.storage, loss_sd=0.1 * s.loss) if given else s
        found.append(viscoelastic.closed_form(s, 2).uncertainty.values[0] / 2500 - 1)
    # One fit has an error of 0.85 %. Three standard deviations of the mean are allowed.
    assert abs(np.mean(found)) < 3 * 0.0085 / np.sqrt(draws)


def test_scales_follow_the_curve_and_not_the_noise():
    s = sweep(0.1, 3, omega=np.geomspace(0.02, 20, 60))
    exact = sweep(omega=s.angular_frequency)
    off = [np.std(np.log(a / b)) for a, b in zip(s.deviations, (exact.storage, exact.loss), strict=True)]
    assert max(off) < 0.05  # the scatter of the points is 0.1
    # Without noise the curve passes through the points. For fewer than five frequencies, the points are used
    # themselves.
    assert all(np.allclose(a, b, rtol=1e-4) for a, b in zip(exact.deviations, (exact.storage, exact.loss), strict=True))
    few = s._replace(**{k: getattr(s, k)[:4] for k in ("angular_frequency", "storage", "loss")})
    assert np.array_equal(few.deviations[0], few.storage)
    # A reading that is wrong by a large factor must not count more. Its scale is its own size.
    wrong = exact._replace(storage=exact.storage * np.where(np.arange(60) == 20, 30.0, 1.0))
    assert wrong.deviations[0][20] == wrong.storage[20]
    assert np.allclose(np.delete(wrong.deviations[0] / exact.storage, 20), 1, rtol=1e-3)
    # Points at the same frequency, for example from repeated sweeps, count as one.
    again = s._replace(angular_frequency=np.repeat(s.angular_frequency[::3], 3) * np.tile([1, 1 + 1e-9, 1 + 1e-7], 20))
    assert np.all(np.isfinite(again.deviations))


@pytest.fixture(scope="module")
def draws():
    """200 seeded sweeps with 2 % noise on every modulus: parameters and standard errors."""
    sweeps = [sweep(0.02, seed) for seed in range(200)]
    starts = np.stack(
        [generalised_maxwell.starts(s, 2, generalised_maxwell.spectrum(s, per_decade=4), count=4) for s in sweeps]
    )
    storage, loss = np.stack([s.storage for s in sweeps]), np.stack([s.loss for s in sweeps])

    @jax.jit
    def all_fits(starts, storage, loss):
        def one(u, G1, G2):
            return levenberg_marquardt(
                generalised_maxwell.residuals, u, jnp.asarray(OMEGA), G1, G2, jnp.concatenate([G1, G2])
            )

        return jax.vmap(jax.vmap(one, in_axes=(0, None, None)))(starts, storage, loss)

    found = jax.tree.map(np.asarray, all_fits(starts, storage, loss))
    best = np.argmin(found.cost, axis=1)
    rows = [jax.tree.map(lambda leaf, k=k, i=i: leaf[k, i], found) for k, i in enumerate(best)]
    spreads = [uncertainty.estimate(r, deviations_given=False) for r in rows]
    return np.stack([s.values for s in spreads]), np.stack([s.standard_errors for s in spreads]), spreads


@pytest.mark.slow
def test_spreads_are_the_best_possible(draws):
    values, errors, _ = draws
    # Standard deviations from `mathematics.md`: G0 1.5 %, g1 1.8 %, g2 2.1 %, tau1 2.3 %, tau2 7.4 % (relative).
    stated = np.array([1.5, 1.8, 2.1, 2.3, 7.4]) / 100
    assert np.all(np.abs(values.std(axis=0) / TRUTH / stated - 1) < 0.2)
    # The standard errors of each draw agree with them.
    assert np.all(np.abs(np.median(errors, axis=0) / TRUTH / stated - 1) < 0.2)


@pytest.mark.ci
def test_intervals_cover(draws):
    values, errors, spreads = draws
    inside = np.abs(values - TRUTH) < spreads[0].quantile * errors
    assert np.all((inside.mean(axis=0) >= 0.90) & (inside.mean(axis=0) <= 0.99)), inside.mean(axis=0)


def test_profile_likelihood():
    s = sweep(0.02, 3)
    f = viscoelastic.closed_form(s, 2)
    intervals = uncertainty.profile_intervals(f.solution, s, f.uncertainty)
    for j, name in enumerate(f.uncertainty.names):
        low, high = intervals[name]
        half = f.uncertainty.quantile * f.uncertainty.standard_errors[j]
        value = f.uncertainty.values[j]
        # The problem is nearly quadratic: the profile differs from the linearised interval only by its skewness.
        assert np.isclose(value - low, half, rtol=0.35) and np.isclose(high - value, half, rtol=0.35), (name, low, high)
        assert low < TRUTH[j] < high


@pytest.mark.ci
@pytest.mark.parametrize("modes", [pytest.param(1, marks=pytest.mark.slow), 2, 3])
def test_lions_mane_no_worse_than_scipy_from_50_starts(modes):
    s = read_sweep(ROOT / "data" / "lions_mane_frequency_sweep.csv")
    scales = np.concatenate(s.deviations)
    residuals = jax.jit(
        lambda u: generalised_maxwell.residuals(u, jnp.asarray(s.angular_frequency), s.storage, s.loss, scales)
    )
    jacobian = jax.jit(jax.jacfwd(residuals))
    rng = np.random.default_rng(0)
    low, high = -np.log(s.angular_frequency[-1]) - 1, -np.log(s.angular_frequency[0]) + 1
    best = np.inf
    for _ in range(50):
        tau = np.exp(np.sort(rng.uniform(low, high, modes))[::-1])
        g = rng.dirichlet(np.ones(modes + 1))[:modes]
        start = generalised_maxwell.unconstrained(
            Maxwell(jnp.asarray(s.storage.max() * rng.uniform(1, 3)), jnp.asarray(g), jnp.asarray(tau))
        )
        best = min(best, scipy.optimize.least_squares(residuals, start, jac=jacobian).cost)
    f = viscoelastic.closed_form(s, modes)
    assert f.converged and float(f.solution.cost) <= best * (1 + 1e-9)


@pytest.mark.ci
def test_bfgs_finds_the_same_minimum():
    s = sweep(0.02, 1)
    f = viscoelastic.closed_form(s, 2)
    data = (jnp.asarray(s.angular_frequency), s.storage, s.loss, np.concatenate(s.deviations))
    start = generalised_maxwell.starts(s, 2, generalised_maxwell.spectrum(s), count=2)[0]
    found = jax.jit(lambda u, *d: bfgs(generalised_maxwell.residuals, u, *d))(start, *data)
    assert bool(found.converged)
    assert np.isclose(found.cost, f.solution.cost, rtol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_auto_finds_the_two_modes_of_table_2(noise):
    s = sweep(noise, 5)
    told = []
    chosen, tried = viscoelastic.choose_modes(s, generalised_maxwell.spectrum(s), progress=told.append)
    assert chosen.modes == 2 and len(tried) <= 4
    assert told == [f"{n + 1} modes" for n in range(len(tried))]


def test_modes_limited_by_points():
    s = sweep(omega=OMEGA[:3])
    with pytest.raises(InputError, match="use at most --modes 2"):
        viscoelastic.closed_form(s, 3)


def melt() -> Sweep:
    """A fractional Maxwell liquid has a broad spectrum that ends in flow, for example a polymer melt or a
    dynamic gel.
    """
    omega = np.geomspace(0.1, 100, 31)
    z = 0.1j * omega
    G = 1000 / (1 / z + z**-0.5)
    return Sweep(omega, G.real, G.imag)


@pytest.mark.parametrize("modes", [5, 12])
def test_many_modes_of_a_melt_have_starts(modes):
    s = melt()
    assert np.all(np.isfinite(generalised_maxwell.starts(s, modes, generalised_maxwell.spectrum(s))))


def test_where_the_active_set_cycles_the_bounded_solver_finds_the_same(monkeypatch):
    rng = np.random.default_rng(0)
    A, b = rng.uniform(0.1, 1, (20, 4)), rng.uniform(-1, 1, 20)
    x, rest = generalised_maxwell.non_negative(A, b)

    def cycles(*_, **__):
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(scipy.optimize, "nnls", cycles)
    y, other = generalised_maxwell.non_negative(A, b)
    # lsq_linear stops when the cost changes by less than a fraction of 1e-10. The relative error of x is the root of
    # this, 1e-5.
    assert np.all(y >= 0) and np.isclose(other, rest, rtol=1e-10) and np.allclose(x, y, atol=1e-5)


def test_a_number_of_modes_that_breaks_down_leaves_the_others(monkeypatch):
    s, closed_form = sweep(0.01, 5, omega=np.geomspace(1, 100, 12)), viscoelastic.closed_form

    def breaking(sweep, modes, *rest):
        if modes == 2:
            raise RuntimeError("Maximum number of iterations reached.")
        return closed_form(sweep, modes, *rest)

    monkeypatch.setattr(viscoelastic, "closed_form", breaking)
    chosen, tried = viscoelastic.choose_modes(s, generalised_maxwell.spectrum(s))
    assert [f.modes for f in tried] == [1, 3] and chosen.modes in (1, 3)
    assert warned(chosen, "2 modes could not be fitted (Maximum number of iterations reached.)")
    monkeypatch.setattr(viscoelastic, "closed_form", lambda *a: breaking(s, 2))
    with pytest.raises(InputError, match="every fit failed"):
        viscoelastic.choose_modes(s, generalised_maxwell.spectrum(s))


@pytest.mark.ci
@pytest.mark.parametrize("modes", [pytest.param(2, marks=pytest.mark.slow), 25])
def test_the_picture_holds_its_table_and_its_legends_cover_nothing(modes):
    s = melt()
    u = generalised_maxwell.starts(s, modes, generalised_maxwell.spectrum(s), count=2)[0]
    found = with_jacobian(generalised_maxwell.residuals)(
        u, s.angular_frequency, s.storage, s.loss, np.concatenate(s.deviations)
    )
    solution = Solution(u, *found, 0.5 * found[0] @ found[0], 1, 0.0, True)
    model = generalised_maxwell.natural(u)
    fitted = (np.asarray(v) for v in generalised_maxwell.moduli(model, jnp.asarray(s.angular_frequency)))
    spread = uncertainty.estimate(solution, False)
    one = viscoelastic.Fit("closed-form", model, solution, spread, True, *fitted, (), 0.1, 1.0, {})
    picture = sweep_report.figure(s, [one, one._replace(method="torsion")])
    picture.canvas.draw()
    axes = [a for sub in picture.subfigs for a in sub.axes]
    top, rest, times, table = axes
    (text,) = table.texts
    assert text.get_text().count("\n") == modes + 3
    assert text.get_window_extent().y0 >= picture.bbox.y0 and text.get_window_extent().x1 <= picture.bbox.x1
    assert text.get_window_extent().y1 <= times.get_tightbbox().y0 + 1  # a pixel for rounding
    sizes = [a.get_window_extent().height / picture.dpi for a in (top, rest, times)]
    assert sizes[0] > 2 and sizes[1] > 0.9 and sizes[2] > 1.5
    for a in (top, times):
        assert a.get_legend().get_window_extent().y0 >= a.get_window_extent().y1
    names = [t.get_text() for t in top.get_legend().get_texts()]
    assert {"G' simulated", "G'' simulated", "G' measured", "G'' closed form"} <= set(names)
    plt.close(picture)


def test_a_shift_by_inertia_is_not_called_discretisation():
    closed = viscoelastic.closed_form(sweep(), 1)
    moved = closed.uncertainty._replace(values=closed.uncertainty.values * np.array([1.0, 1.0, 2.0]))
    plain, heavy = (
        simulated_rheometer._bias(closed, closed._replace(uncertainty=moved, details={"density_kg_m3": density}))
        for density in (None, 1060.0)
    )
    assert "relaxation_times[0]: the simulation's discretisation changes this parameter by 1e+02 %" in plain[0]
    assert (
        "relaxation_times[0]: the sample's inertia and the discretisation change this parameter by 1e+02 %" in heavy[0]
    )
    assert "closed form" in plain[0] and "closed form" not in heavy[0]


def test_the_larger_of_mesh_and_time_steps_is_named_for_each_parameter():
    own = SimpleNamespace(mesh_bias=np.array([-50.0, 1e-4]), time_step_bias=np.array([5.0, 1e-3]))
    simulated = SimpleNamespace(details={}, uncertainty=own, parameters=None)
    closed = SimpleNamespace(details={})
    causes = [simulated_rheometer._cause(closed, simulated, k)[0] for k in (0, 1)]
    assert "the mesh" in causes[0] and "discretisation" in causes[1]


def test_what_auto_chooses_is_not_advised_against():
    # Three modes within 1.6 decades, without noise: the criterion alone would choose all three.
    model = np.array([770.0, 0.2, 0.25, 0.3, 1.0, 0.2, 0.05])
    s = sweep(0.0, model=model)
    chosen, _ = viscoelastic.choose_modes(s, generalised_maxwell.spectrum(s))
    assert chosen.modes == 2 and not warned(chosen, "fewer modes") and not warned(chosen, "merged")
    narrow = sweep(0.01, 2, omega=2 * np.pi * np.geomspace(1, 1.5, 12))
    one, _ = viscoelastic.choose_modes(narrow, generalised_maxwell.spectrum(narrow))
    assert one.modes == 1 and warned(one, "use a wider sweep") and not warned(one, "fewer modes")


def warned(f: viscoelastic.Fit, words: str) -> bool:
    return any(words in sentence for sentence in f.warnings)


def test_user_is_told_what_the_data_do_not_tell():
    f = viscoelastic.closed_form(sweep(0.01, 2), 2)
    assert warned(f, "relaxation_times[1]") and warned(f, "outside the 0.0398-1.59 s")
    assert not warned(f, "merged") and not warned(f, "equilibrium")
    three = viscoelastic.closed_form(sweep(0.01, 2), 3)
    assert warned(three, "use fewer modes") or warned(three, "merged")
    fluid = viscoelastic.closed_form(sweep(0.01, 2, np.array([1000.0, 0.9999, 0.1])), 1)
    assert warned(fluid, "cannot be distinguished from zero")
    narrow = viscoelastic.closed_form(sweep(0.01, 2, omega=2 * np.pi * np.geomspace(1, 2, 12)), 3)
    assert warned(narrow, "too short for 3 modes")
    s = sweep(0.01, 2)
    wide = viscoelastic.closed_form(s._replace(storage_sd=0.4 * s.storage, loss_sd=0.4 * s.loss), 2)
    assert warned(wide, "spread between samples") and wide.uncertainty.noise < 0.1
    small = viscoelastic.closed_form(s._replace(storage_sd=1e-3 * s.storage, loss_sd=1e-3 * s.loss), 2)
    assert warned(small, "times the given deviations") and small.uncertainty.noise > 5


@pytest.mark.ci
def test_merged_modes_are_named():
    f = viscoelastic.closed_form(sweep(0.0, 0), 2)
    u = generalised_maxwell.unconstrained(Maxwell(jnp.array(770.0), jnp.array([0.3, 0.2]), jnp.array([0.12, 0.1])))
    moved = f.solution._replace(u=u)
    sentences = uncertainty.cautions(sweep(), uncertainty.estimate(moved, False))
    assert any("have merged" in s and "use 1 mode" in s for s in sentences)


def test_better_than_pyvisco_on_the_noise_free_table_2_sweep():
    # PyVisco 2.1.3 finds G0 603 Pa and tau 0.108 and 0.450 s here. The errors are 22 %, 260 % and 67 %.
    f = viscoelastic.closed_form(sweep(), 2)
    theirs = np.array([603.0, 0.450, 0.108]) / TRUTH[[0, 3, 4]] - 1
    ours = parameters(f)[[0, 3, 4]] / TRUTH[[0, 3, 4]] - 1
    assert np.all(np.abs(ours) < 1e-6 * np.abs(theirs))
    # It also reports 'converged' for exchanged columns. For a NaN and a negative modulus, see test_rheometer.
    s = sweep()
    with pytest.raises(InputError, match="the two columns are exchanged"):
        viscoelastic.closed_form(s._replace(storage=s.loss, loss=s.storage), 2)


@pytest.fixture(scope="module")
def coarse_torsion():
    s = sweep()
    closed = viscoelastic.closed_form(s, 2)
    return s, closed, simulated_rheometer.through_torsion(s, closed, simulated_rheometer.Simulation(cell_size=0.004))


@pytest.mark.core
def test_torsion_fit_recovers_table_2(coarse_torsion):
    _, _, f = coarse_torsion
    assert f.converged and np.abs(parameters(f) / TRUTH - 1).max() < 5e-3
    assert f.details["geometry_factor"] > 1.3  # such a coarse mesh is far too stiff, which is corrected


def test_the_table_says_what_the_simulation_adds(coarse_torsion):
    _, closed, simulated = coarse_torsion
    errors = simulated.uncertainty.standard_errors
    last = np.arange(len(errors)) == len(errors) - 1  # a relaxation time
    near = simulated._replace(
        uncertainty=simulated.uncertainty._replace(values=closed.uncertainty.values + 0.03 * errors * last)
    )
    assert simulated_rheometer.largest_shift(closed, near) == pytest.approx(0.03)
    assert "agree within 3 % of the standard errors" in sweep_report._agreement([closed, near])[0]
    moved = closed.uncertainty.values + 2 * errors * last
    far = simulated._replace(uncertainty=simulated.uncertainty._replace(values=moved))
    assert "changes a parameter by 2 standard errors" in sweep_report._agreement([closed, far])[0]
    # The equilibrium modulus is in the table, so its change counts too.
    u = simulated.uncertainty._replace(values=closed.uncertainty.values)
    both = np.isin(np.arange(len(errors)), (1, 2))  # the ratios
    other = u._replace(values=u.values - u.standard_errors * both)
    by_rest = u.values[0] * u.standard_errors[both].sum() / uncertainty.equilibrium_error(other)
    assert by_rest > 1.1
    shift = simulated_rheometer.largest_shift(closed, simulated._replace(uncertainty=other))
    assert shift == pytest.approx(by_rest, rel=1e-9)


def test_torsion_fit_says_when_discretisation_exceeds_the_error(coarse_torsion):
    _, _, f = coarse_torsion
    assert warned(f, "discretisation changes this parameter by")


def test_the_biases_are_what_simulated_and_closed_form_differ_by(coarse_torsion):
    """Data and model are equal. The fits differ only by mesh, time steps and finite strain, which is below 1e-5
    here.
    """
    _, closed, f = coarse_torsion
    u = f.uncertainty
    moved = u.values - closed.uncertainty.values
    assert np.abs(u.time_step_bias / u.values).max() > 1e-4
    # The biases are of first order in relative changes of a thousandth. Finite strain changes a parameter by up to 1e-4
    # of its error.
    left = np.abs(moved - u.mesh_bias - u.time_step_bias)
    assert np.all(left < 0.05 * np.abs(u.time_step_bias) + 1e-3 * u.standard_errors)


@pytest.mark.slow
def test_chapter_recursion_biases_the_fit():
    s = sweep(omega=OMEGA[::3])
    closed = viscoelastic.closed_form(s, 2)
    simulation = simulated_rheometer.Simulation(cell_size=0.004, scheme="chapter")
    f = simulated_rheometer.through_torsion(s, closed, simulation)
    # The scheme is of first order. With 50 steps per cycle, G'' has an error of 5 % at 4 Hz, which biases the
    # parameters.
    assert f.converged and np.abs(parameters(f) / TRUTH - 1).max() > 0.02


@pytest.mark.slow
def test_twelve_decades_need_more_than_six_modes():
    tau = 10.0 ** np.arange(4, -4, -1)
    model = np.concatenate([[1e5], np.full(8, 0.1), tau])
    s = sweep(0.0, model=model, omega=np.geomspace(1e-6, 1e6, 60))
    chosen, _ = viscoelastic.choose_modes(s, generalised_maxwell.spectrum(s))
    assert chosen.modes == 8 and np.allclose(parameters(chosen), model, rtol=1e-4)


def test_an_outlier_is_named():
    s = sweep(0.0)
    storage = s.storage.copy()
    storage[5] *= 3
    f = viscoelastic.closed_form(s._replace(storage=storage), 2)
    assert warned(f, "storage_modulus at 0.342 Hz")


def test_a_plateau_that_is_measured_is_no_fluid():
    model = np.array([1e9, 0.5, 0.499, 1e-6, 1e-8])
    f = viscoelastic.closed_form(sweep(0.01, 2, model, np.geomspace(1e2, 1e10, 40)), 2)
    assert not warned(f, "cannot be distinguished from zero")


def test_parameters_at_a_bound_claim_no_certainty():
    f = viscoelastic.closed_form(sweep(0.02, 4, omega=2 * np.pi * np.linspace(1, 1.01, 10)), 1)
    assert np.all(f.uncertainty.standard_errors > 0) and warned(f, "too short")


def test_a_point_without_derivatives_is_not_gone_to():
    """The cost falls towards u = 2, but beyond u = 1 the derivative is NaN. The fit stays below u = 1 and finite."""

    @jax.custom_jvp
    def residuals(u):
        return u - 2

    residuals.defjvp(lambda p, t: (residuals(*p), jnp.where(p[0] > 1, jnp.nan, 0.5) * t[0]))
    found = levenberg_marquardt(residuals, jnp.zeros(1))
    assert float(found.u[0]) <= 1 and np.all(np.isfinite(found.jacobian))
    lost = levenberg_marquardt(residuals, 1.5 * jnp.ones(1))
    assert not bool(lost.converged)
    half, _ = spread(np.full((3, 1), np.nan), 1.0, np.ones((1, 1)))
    assert np.all(np.isinf(half))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"storage": [1.0, 2.0]}, "storage is of type list; give an array"),
        ({"loss": np.ones(3)}, r"loss has shape \(3,\); give one number per frequency"),
        ({"loss": np.append(np.ones(15), -1.0)}, r"loss\[15\] = -1 must be above 0"),
        ({"storage": np.append(np.ones(15), np.nan)}, r"storage\[15\] = nan must be above 0"),
        ({"storage_sd": np.ones(16)}, "only one of storage_sd and loss_sd is given"),
        ({"storage_sd": np.zeros(16), "loss_sd": np.ones(16)}, r"storage_sd\[0\] = 0 must be above 0"),
        ({"angular_frequency": OMEGA[::-1]}, "angular_frequency must be in ascending order"),
        ({"angular_frequency": OMEGA * 1j}, "angular_frequency is of type ndarray; give an array of real"),
    ],
)
def test_sweeps_made_in_python_are_refused_in_one_sentence(change, words):
    for fit in (lambda s: viscoelastic.closed_form(s, 1), generalised_maxwell.refuse_impossible):
        with pytest.raises(InputError, match=words):
            fit(sweep()._replace(**change))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"modes": 2.0}, "modes = 2.0 must be a whole number"),
        ({"modes": "auto"}, "modes = 'auto' must be a whole number: give e.g. 2, or call choose_modes"),
        ({"modes": 2, "optimizer": "foo"}, "optimizer = 'foo' is not known"),
    ],
)
def test_unknown_choices_of_a_fit_are_refused(more, words):
    with pytest.raises(InputError, match=words):
        viscoelastic.closed_form(sweep(), **more)
