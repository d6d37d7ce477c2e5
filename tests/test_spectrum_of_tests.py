"""A smooth spectrum of relaxation and creep tests, of several tests and of several samples, against closed forms."""

import json
from functools import partial

import numpy as np
import pytest
import scipy.optimize
from test_models import FORMULAS, TRUTHS
from test_relaxation_spectrum import box_spectrum
from test_springpots_in_time import TIMES, inverse_laplace

from fitting.__main__ import main
from fitting.fits import samples, time_tests
from fitting.fits.families import choice, models, spectrum_of_tests
from fitting.fits.families.choice import Label
from fitting.fits.together import doubts, measured_tests
from fitting.methods import generalised_maxwell, relaxation_spectrum, time_response
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers import time_tests as reader
from fitting.readers.frequency_sweep import Sweep

pytestmark = pytest.mark.quick_to_compile

NAME = "fractional_zener"
NEAR = Maxwell(np.float64(800.0), np.array([0.3, 0.2]), np.array([30.0, 0.5]))


def in_time(kind: str, name: str = NAME, noise: float = 0.003, seed: int = 0) -> reader.TimeTest:
    """A test with a step at 0, whose response is a Mittag-Leffler function."""
    answer = inverse_laplace(name, kind == "creep")
    answer = answer * (1 + noise * np.random.default_rng(seed).standard_normal(len(TIMES)))
    time, answer = np.concatenate([[0.0], TIMES]), np.concatenate([[np.nan], answer])
    return reader.TimeTest(kind, time, np.ones(len(time)), answer, time > 0)


def sweep_of(noise: float = 0.01, scale: float = 1.0, seed: int = 1) -> Sweep:
    omega = np.geomspace(0.01, 300, 25)
    G = scale * FORMULAS[NAME](1j * omega, *TRUTHS[NAME])
    factor = 1 + noise * np.random.default_rng(seed).standard_normal((2, len(omega)))
    return Sweep(omega, G.real * factor[0], G.imag * factor[1])


@pytest.mark.parametrize("kind", [pytest.param("relaxation", marks=pytest.mark.slow), "creep"])
def test_the_spectrum_of_a_test_in_time_has_the_moduli_of_the_material(kind):
    found = spectrum_of_tests.spectrum_in_time(in_time(kind), NEAR)
    assert found.converged and found.relative_errors.mean() < 0.005
    assert 2 < found.kind.effective < 10 and found.details["conversion"]["largest_relative_error"] < 0.01
    omega = 1 / TIMES[4:-4]
    storage, _ = generalised_maxwell.moduli(found.model, omega)
    true = FORMULAS[NAME](1j * omega, *TRUTHS[NAME])
    # Half a decade inside the band, with noise of 0.3 % on 25 points, |G*| is exact to 1 %.
    assert np.allclose(storage, true.real, rtol=0.01)


@pytest.mark.parametrize("kind", ["relaxation", "creep"])
def test_a_material_that_still_relaxes_at_the_end_is_told(kind):
    """A springpot has no equilibrium modulus. The spectrum had one with a small error, and no warning."""
    test = in_time(kind, "springpot", 0.005)
    found = spectrum_of_tests.spectrum_in_time(test, NEAR)
    (told,) = (w for w in found.warnings if "G' of the model falls by" in w)
    assert found.kind.names[0] == "equilibrium_modulus" and told.endswith(": measure longer")
    solid = 500 + 300 * np.exp(-TIMES / 3)
    answer = np.append(np.nan, solid * (1 + 0.005 * np.random.default_rng(0).standard_normal(len(TIMES))))
    relaxed = spectrum_of_tests.spectrum_in_time(test._replace(kind="relaxation", answer=answer), NEAR)
    assert not any("G' of the model falls by" in w for w in relaxed.warnings)


@pytest.mark.parametrize("given", [False, True])
def test_a_common_spectrum_tells_that_the_material_still_relaxes(given):
    """If the sweep had standard deviations and the lowest frequency, the noise of one standard deviation was taken for
    a noise of 100 %, and the warning was lost."""
    omega = np.geomspace(0.001 if given else 0.01, 300, 25)
    noise = 1 + 0.01 * np.random.default_rng(1).standard_normal((2, len(omega)))
    G = FORMULAS["springpot"](1j * omega, *TRUTHS["springpot"])
    deviations = (0.01 * G.real, 0.01 * G.imag) if given else (None, None)
    tests = [Sweep(omega, G.real * noise[0], G.imag * noise[1], *deviations), in_time("relaxation", "springpot")]
    found = spectrum_of_tests.spectrum_together(tests, NEAR, np.array([1.0 if given else 0.01, 0.003]))
    assert any(w.endswith(": measure longer, or at lower frequencies") for w in found.warnings)


def test_no_start_of_scipy_is_below_the_spectrum_of_creep():
    """Creep is not linear in the strengths. The iteration must end where bounded least squares of SciPy end."""
    test = in_time("creep", "fractional_kelvin_voigt")
    told, grid, found = spectrum_of_tests.spectrum_of([test], NEAR, np.ones(1))
    L = relaxation_spectrum.second_differences(len(grid.times), grid.smoothing)
    at, measured, scales = measured_tests.reported_numbers(test)
    function = partial(time_response.residuals_with_jacobian, "creep", spectrum_of_tests._modes_on_grid(grid))

    def rows(x):
        return np.concatenate([function(x, *at, measured, scales)[0], L @ x])

    def slopes(x):
        return np.vstack([function(x, *at, measured, scales)[1], L])

    own, rng = np.sum(rows(found.x) ** 2), np.random.default_rng(0)
    for _ in range(8):
        start = np.exp(rng.uniform(-4, 1, len(found.x)))
        best = scipy.optimize.least_squares(rows, start, slopes, bounds=(0, np.inf), max_nfev=300)
        assert own <= 2 * best.cost * (1 + 1e-4)  # the iteration ends if a step gains less than 1e-9; SciPy's at 1e-8
    assert told.effective < 12


def test_several_tests_have_one_spectrum():
    tests = [sweep_of(), in_time("relaxation")]
    found = spectrum_of_tests.spectrum_together(tests, NEAR, np.array([0.01, 0.003]))
    sweep, relaxation = found.shares
    assert 0.006 < sweep.noise < 0.015 and 0.0015 < relaxation.noise < 0.005
    assert sweep.alone < 1.3 * sweep.noise and not doubts.disagreements(found.shares)
    rest = found.kind.names.index("equilibrium_modulus")
    own = found.parameters.standard_errors[rest]
    assert abs(found.parameters.values[rest] - TRUTHS[NAME][0]) < 4 * own
    assert relaxation.errors_without[rest] > own and found.details["spectrum"]["decades_carried"] > 2


def test_a_population_of_spectra():
    scales = np.exp(0.2 * np.random.default_rng(5).standard_normal(6))
    sweeps = [sweep_of(scale=s, seed=10 + k) for k, s in enumerate(scales)]
    found = samples.fit(sweeps, "spectrum")
    rest = found.populations["equilibrium_modulus"]
    assert rest.mean == pytest.approx(TRUTHS[NAME][0] * np.exp(np.log(scales).mean()), rel=0.03)
    assert rest.spread == pytest.approx(np.log(scales).std(ddof=1), rel=0.2)
    known = [p for n, p in found.populations.items() if n.startswith("strengths[") and p is not None]
    assert len(known) > 4 and np.median([p.spread for p in known]) == pytest.approx(rest.spread, rel=0.5)
    storage, loss = generalised_maxwell.moduli(found.typical, sweeps[0].angular_frequency)
    true = np.exp(np.log(scales).mean()) * FORMULAS[NAME](1j * sweeps[0].angular_frequency, *TRUTHS[NAME])
    assert np.allclose(storage + 1j * loss, true, rtol=0.05)


def written(path, columns: str, *values) -> str:
    rows = (",".join(f"{v:.12g}" for v in row) for row in zip(*values, strict=True))
    path.write_text("\n".join([columns, *rows]) + "\n")
    return str(path)


@pytest.mark.draws
@pytest.mark.parametrize(
    "words",
    [
        ["A", "B"],
        pytest.param(["relaxation", "C"], marks=pytest.mark.slow),
        pytest.param(["A", "--with", "C"], marks=pytest.mark.slow),
    ],
)
def test_the_commands_write_spectra(words, tmp_path, capsys):
    s, t = sweep_of(), in_time("relaxation")
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    files = {
        "A": written(tmp_path / "a.csv", head, s.angular_frequency, s.storage, s.loss),
        "B": written(tmp_path / "b.csv", head, s.angular_frequency, 1.2 * s.storage, 1.2 * s.loss),
        "C": written(tmp_path / "c.csv", "time_s,relaxation_modulus_Pa", t.time[1:], t.answer[1:]),
    }
    assert main([*(files.get(w, w) for w in words), "--model", "spectrum", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "fit.json").read_text())
    assert content["model"] == "spectrum" and content["details"]["spectrum"]["times_per_decade"] in (2, 3)
    assert (tmp_path / "fit.png").stat().st_size > 10_000
    told = capsys.readouterr().out
    assert "strengths[" not in told and ("strength at " in told) == (words == ["A", "B"])
    assert content["equilibrium_modulus"] == pytest.approx(TRUTHS[NAME][0], rel=0.25)


@pytest.mark.parametrize(
    ("labels", "criteria", "chosen"),
    [
        ((Label("spectrum"), Label("prony", 2)), (0, 5), 1),  # a spectrum contains modes, so 5 is not strong evidence
        ((Label("spectrum"), Label("prony", 2)), (0, 7), 0),
        ((Label("fractional_parallel"), Label("fractional_kelvin_voigt")), (0, 3), 1),
        # neither is a special case of the other
        ((Label("fractional_maxwell"), Label("fractional_kelvin_voigt")), (0, 3), 0),
        ((Label("fractional_zener"), Label("prony", 1)), (0, 3), 1),
        ((Label("fractional_zener"), Label("prony", 2)), (0, 3), 0),
        ((Label("prony", 3), Label("prony_fluid", 3)), (0, 3), 1),
        ((Label("prony", 3), Label("prony_fluid", 4)), (0, 3), 0),
        ((Label("spectrum"), Label("fractional_zener"), Label("fractional_kelvin_voigt")), (0, 2, 4), 2),
    ],
)
def test_a_general_model_needs_strong_evidence(labels, criteria, chosen):
    assert choice.preferred(labels, criteria) == chosen


def test_criteria_count_the_parameters_in_effect():
    test = in_time("relaxation")
    found = spectrum_of_tests.spectrum_in_time(test, NEAR)
    m, square = len(found.measured), np.sum(((found.fitted - found.measured) / found.scales) ** 2)
    assert time_tests.criterion(found) == pytest.approx(m * np.log(square / m) + found.kind.effective * np.log(m))


@pytest.mark.parametrize("seed", range(3))
def test_a_spectrum_of_separate_modes_says_that_its_errors_are_too_small(seed):
    """Half to four fifths of the 95 % intervals of the moduli contained the truth, without a warning."""
    omega, rng = 2 * np.pi * np.logspace(-1.5, 1.5, 40), np.random.default_rng(seed)
    modes = Maxwell(np.float64(3000.0), np.array([0.2, 0.3, 0.2]), np.array([3.0, 0.2, 0.01]))
    noisy = (np.asarray(m) * (1 + 0.03 * rng.standard_normal(40)) for m in generalised_maxwell.moduli(modes, omega))
    told = models.spectrum_fit(Sweep(omega, *noisy)).warnings
    assert any(w.startswith("the spectrum has gaps: ") and "use --model prony" in w for w in told)
    smooth = models.spectrum_fit(box_spectrum(np.geomspace(1e-2, 1e2, 41), 1e-3, 1e3, 0.03))
    assert not any("gaps" in w for w in smooth.warnings)
