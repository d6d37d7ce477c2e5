"""Laws from stress-stretch curves: known parameters are recovered, SciPy finds no better fit, bad files give
messages.
"""

import json
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from conftest import COMPILED

import liverjax as lj
from fitting.__main__ import main
from fitting.fits import stress_stretch
from fitting.fits.families import compared_laws, hyperelastic
from fitting.readers import curves
from fitting.reports import curves_report
from liverjax.core import names
from liverjax.laws import homogeneous

pytestmark = pytest.mark.quick_to_compile

DATA = Path(__file__).parent.parent / "data"


def synthetic(law: lj.Law, noise: float = 0.0, seed: int = 0) -> list[curves.Curve]:
    """Return curves of a known law in three tests, with Gaussian noise relative to the curve."""
    rng, made = np.random.default_rng(seed), []
    for test, driven in (
        ("uniaxial", np.linspace(0.75, 1.4, 27)),
        ("simple_shear", np.linspace(-0.3, 0.4, 15)),
        ("equibiaxial", np.linspace(0.9, 1.25, 12)),
    ):
        F = homogeneous.deformation_gradient(test, driven)
        at = (0, 1) if test == "simple_shear" else (0, 0)
        P = np.asarray(homogeneous.response(law, test, driven))
        P = P + noise * np.sqrt(np.mean(P**2)) * rng.standard_normal(len(P))
        made.append(curves.Curve(test, test, np.asarray(F), at, P))
    return made


KNOWN = {
    "neo_hookean": lj.laws.NeoHookean(mu=770.0, bulk=None),
    "mooney_rivlin": lj.laws.MooneyRivlin(c10=300.0, c01=85.0, bulk=None),
    "yeoh": lj.laws.Yeoh(c1=385.0, c2=-50.0, c3=200.0, bulk=None),
    "arruda_boyce": lj.laws.ArrudaBoyce(mu=700.0, chain_length=3.0, bulk=None),
    "bogen": lj.laws.Bogen(mu=-150.0, alpha=-9.0, bulk=None),
    "logarithmic": lj.laws.Logarithmic(c1=500.0, c2=0.2, alpha=4.0, bulk=None),
    "exponential": lj.laws.Exponential(c1=100.0, c2=1.0, alpha=-4.0, bulk=None),
    "fung_demiray": lj.laws.FungDemiray(c1=500.0, c2=2.0, bulk=None),
    "veronda_westmann": lj.laws.VerondaWestmann(c1=300.0, c2=2.0, bulk=None),
}


#: Laws of stretches take long to compile, and differ only in scalars.
LONG = ("logarithmic", "bogen", "veronda_westmann", "exponential")


@pytest.mark.parametrize("name", [n if n not in LONG else pytest.param(n, marks=pytest.mark.slow) for n in KNOWN])
def test_noise_free_curves_give_the_parameters_back(name):
    (candidate,) = stress_stretch.candidates(name)
    found = stress_stretch.fit(candidate, synthetic(KNOWN[name]))
    exact = np.array([float(getattr(KNOWN[name], n)) for n in found.names])
    assert found.converged and found.mean_relative_error < 1e-9
    assert np.allclose(found.values, exact, rtol=1e-5)
    assert np.isclose(found.shear_modulus, float(KNOWN[name].shear_modulus()), rtol=1e-6)


OWN = """
import jax.numpy as jnp
import liverjax as lj

@lj.struct
class Gent(lj.Law):
    mu: float = lj.param("Pa", typical=770.0)
    limit: float = lj.param("1", above=0.0, typical=20.0)
    bulk: float = lj.param("Pa", typical=7700.0)
    volumetric: str = lj.static("quadratic")

    def isochoric_energy(self, I1, I2):
        return -self.mu * self.limit / 2 * jnp.log1p(-(I1 - 3) / self.limit)

@lj.struct
class Blatz(lj.Law):
    mu: float = lj.param("Pa", typical=770.0)
    invariants = ("I2", "J")

    def strain_energy(self, I):
        return self.mu / 2 * (I.I2 / I.J**2 + 2 * I.J - 5)
"""


@pytest.mark.ci
def test_a_law_of_ones_own_is_fitted_from_its_file(tmp_path, capsys):
    file = tmp_path / "my_law.py"
    file.write_text(OWN)
    (candidate,) = stress_stretch.candidates(f"{file}:Gent")
    exact = candidate.law(jnp.array([500.0, 3.0]))
    found = stress_stretch.fit(candidate, synthetic(exact))
    assert (found.label, found.names, found.units) == ("Gent", ("mu", "limit"), ("Pa", "1"))
    assert np.allclose(found.values, [500.0, 3.0], rtol=1e-5)
    assert np.isclose(found.shear_modulus, 500.0, rtol=1e-5)  # not stated by the law: computed from the tangent at rest
    assert main(["curves", f"{file}:Blatz", str(DATA / "rubber_curves.csv")]) == 2
    assert "is not an isochoric energy plus U(J)" in capsys.readouterr().err
    assert main(["curves", f"{file}:Gnt", str(DATA / "rubber_curves.csv")]) == 2
    assert f"has no Gnt: use {file}:Gent or {file}:Blatz" in capsys.readouterr().err


WITHOUT_BULK = """
import jax.numpy as jnp
import liverjax as lj

@lj.struct
class Mine(lj.Law):
    c: float = lj.param("Pa", above=0.0, typical=400.0)
    beta: float = lj.param("Pa", lower=0.0, typical=100.0)

    def isochoric_energy(self, I1, I2):
        return self.c * (I1 - 3) + self.beta * (I1 - 3) ** 2

@lj.struct
class Power(lj.Law):
    c: float = lj.param("Pa", above=0.0, typical=400.0)
    alpha: float = lj.param("1", above=0.0, typical=1.2)

    def isochoric_energy(self, I1, I2):
        return self.c * ((I1 - 2) ** self.alpha - 1)
"""


def test_a_law_without_a_bulk_modulus_is_fitted(tmp_path):
    """The fit failed for a law without a field `bulk`, and it did not report values that scenes refuse."""
    (tmp_path / "mine.py").write_text(WITHOUT_BULK)
    (candidate,) = stress_stretch.candidates(f"{tmp_path}/mine.py:Mine")
    truth = lj.laws.Yeoh(c1=350.0, c2=-30.0, c3=0.0, bulk=None)
    found = stress_stretch.fit(candidate, synthetic(truth)[:1], starts=4)
    assert np.allclose(found.values, [350.0, -30.0], rtol=1e-5)
    (told,) = [w for w in found.warnings if "bounds" in w]
    assert told.startswith("beta = -30 is out of the bounds of the law")
    twice = [*found.values, 350.0, 30.0]
    own = candidate._replace(names=("0.c", "0.beta", "1.c", "1.beta"), fields=candidate.fields * 2)
    assert len(hyperelastic.out_of_bounds(own, np.array(twice), {})) == 1
    assert not hyperelastic.out_of_bounds(own, np.array(twice), {"0.beta": "0"})


def test_a_positive_exponent_starts_near_its_typical_value(tmp_path):
    """A parameter alpha that must be positive started at exp(u), with u up to 30 and down to -30."""
    (tmp_path / "mine.py").write_text(WITHOUT_BULK)
    (candidate,) = stress_stretch.candidates(f"{tmp_path}/mine.py:Power")
    starts = candidate.random(np.random.default_rng(0), 128)
    alpha = np.stack([candidate.values(u, 800.0) for u in starts])[:, 1]
    assert 0.9 < np.median(alpha) < 1.6 and alpha.min() > 0.01 and alpha.max() < 1000


SEVERAL = """
import liverjax as lj

several = lj.laws.NeoHookean(mu=300.0, bulk=1e4) + lj.laws.FungDemiray(c1=100.0, c2=1.0, bulk=1e4)
third = lj.laws.MooneyRivlin(c10=300.0, c01=50.0, c20=20.0, c11=0.0, c30=10.0, bulk=1e4)
nothing = lj.laws.MooneyRivlin(c10=0.0, c01=0.0, bulk=1e4)
continued = lj.laws.Continued(law=lj.laws.NeoHookean(mu=300.0, bulk=1e4))
"""


@pytest.mark.ci
def test_laws_that_add_up_are_fitted_together(tmp_path, capsys):
    file = tmp_path / "several.py"
    file.write_text(SEVERAL)
    (candidate,) = stress_stretch.candidates(f"{file}:several")
    assert candidate.names == ("0.mu", "1.c1", "1.c2") and candidate.units == ("Pa", "Pa", "1")
    truth = lj.laws.NeoHookean(mu=400.0, bulk=None) + lj.laws.FungDemiray(c1=200.0, c2=3.0, bulk=None)
    found = stress_stretch.fit(candidate, synthetic(truth))
    assert np.allclose(found.values, [400.0, 200.0, 3.0], rtol=1e-5)
    assert not found.limits and np.isclose(found.shear_modulus, 600.0, rtol=1e-5)
    for name, sentence in (("nothing", "has a value other than 0"), ("continued", "law of Continued is not")):
        assert main(["curves", f"{file}:{name}", str(DATA / "rubber_curves.csv")]) == 2
        error = capsys.readouterr().err
        assert sentence in error and error.count("\n") == 1


def test_the_names_in_a_sum_are_those_of_a_scene(tmp_path):
    """The places did not count a law that has only U(J), and the terms of Ogden's law were `1.mu[0]`."""
    file = tmp_path / "sums.py"
    file.write_text(
        "from liverjax import laws\n"
        "first = laws.Volumetric(bulk=7700.0) + laws.FungDemiray(c1=500.0, c2=1.0, bulk=None)\n"
        "second = first + laws.Ogden(mu=(1.0,), alpha=(2.0,), bulk=None)\n"
    )
    (first,), (second,) = (stress_stretch.candidates(f"{file}:{name}") for name in ("first", "second"))
    assert first.names == ("1.c1", "1.c2")
    assert second.names == ("1.c1", "1.c2", "2.mu.0", "2.alpha.0")
    law = lj.laws.Volumetric(bulk=7700.0) + second.law(jnp.array([500.0, 1.0, 3.0, 2.0]))
    assert [float(names.get(law, name, "law")) for name in second.names] == [500.0, 1.0, 3.0, 2.0]
    assert stress_stretch.candidates("ogden", 1)[0].names == ("mu[0]", "alpha[0]")


def test_coefficients_that_are_given_are_fitted_and_the_others_named(tmp_path):
    file = tmp_path / "third.py"
    file.write_text(SEVERAL)
    (candidate,) = stress_stretch.candidates(f"{file}:third")
    assert candidate.names == ("c10", "c01", "c20", "c30")
    (note,) = candidate.notes
    assert "value 0 is kept for c11" in note and "no value is given or fitted for c02, c21, c12, c03" in note
    truth = lj.laws.MooneyRivlin(c10=250.0, c01=90.0, c20=30.0, c30=60.0, bulk=None)
    found = stress_stretch.fit(candidate, synthetic(truth))
    assert np.allclose(found.values, [250.0, 90.0, 30.0, 60.0], rtol=1e-4)
    (shipped,) = stress_stretch.candidates("mooney_rivlin")
    assert "mooney_rivlin: the fitted parameters are c10, c01; no value is given or fitted for c20" in shipped.notes[0]
    assert not stress_stretch.candidates("yeoh")[0].notes


@pytest.mark.ci
def test_errors_at_two_limits_are_those_of_the_law_there():
    """With c1 to infinity and c2 to 0, the exponential law is Bogen's. The product of c1 and c2 counted as known, and
    the error of alpha was five times too small."""
    data, found = synthetic(lj.laws.Bogen(mu=-250.0, alpha=-8.0, bulk=None), 0.03, 1), {}
    for name in ("exponential", "bogen"):
        (candidate,) = stress_stretch.candidates(name)
        found[name] = stress_stretch.fit(candidate, data)
    assert found["exponential"].limits == {"c1": "infinity", "c2": "0"}
    assert found["exponential"].values[2] == pytest.approx(found["bogen"].values[1], rel=1e-4)
    assert found["exponential"].standard_errors[2] == pytest.approx(found["bogen"].standard_errors[1], rel=1e-2)


def test_a_law_at_its_limit_says_so_without_warnings_of_numpy():
    """Eight chains of infinite length are neo-Hookean."""
    (candidate,) = stress_stretch.candidates("arruda_boyce")
    data = [c for c in synthetic(lj.laws.NeoHookean(mu=770.0, bulk=None), 0.01, 2) if c.test == "uniaxial"]
    softening = data[0]._replace(stress=data[0].stress * (1 - 0.2 * np.abs(data[0].driven - 1)))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = stress_stretch.fit(candidate, [softening])
    assert found.limits == {"chain_length": "infinity"} and np.isfinite(found.standard_errors[0])
    told = " ".join(found.warnings)
    assert "the fit is best at a limit of the law (chain_length to infinity)" in told
    assert "leave chain_length free" not in told
    assert "chain_length → infinity" in curves_report.table([found])


def test_a_curve_that_no_law_follows_is_named():
    (candidate,) = stress_stretch.candidates("neo_hookean")
    tension, shear, _ = synthetic(KNOWN["neo_hookean"])
    foreign = shear._replace(stress=3 * shear.stress, label="another unit")
    found = stress_stretch.fit(candidate, [tension, tension._replace(label="again"), foreign])
    (sentence,) = compared_laws.unfollowed([tension, tension._replace(label="again"), foreign], [found])
    assert sentence.startswith(
        "another unit: no law fits this curve. The nearest law (neo_hookean) misses the curve by"
    )


def test_lines_of_the_picture_are_fine_and_compiled_once_a_law():
    curves_of = synthetic(KNOWN["yeoh"])
    for curve in curves_of:
        dense = curves_report.fine(curve)
        exact = homogeneous.deformation_gradient(curve.test, dense.driven)
        assert len(dense.driven) == 200 and np.ptp(dense.driven) == np.ptp(curve.driven)
        # The bound is rounding of logarithm and exponential. A chord between two points would have an error of 1e-4.
        assert np.allclose(dense.F, exact, atol=1e-14)
    fits = [stress_stretch.fit(stress_stretch.candidates(n)[0], curves_of, starts=2) for n in ("yeoh", "neo_hookean")]
    before = len(COMPILED)
    curves_report.figure(curves_of, fits)
    first = len(COMPILED) - before
    curves_report.figure(curves_of, fits)
    assert first <= len(fits) and len(COMPILED) == before + first


def _stress_of_rubber(test: str, l: np.ndarray, mu: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return the stress of Ogden's law in the three tests, by the textbook formula."""
    l = l[:, None]
    free = {"uniaxial": -alpha / 2 - 1, "equibiaxial": -2 * alpha - 1, "pure_shear": -alpha - 1}[test]
    return (l ** (alpha - 1) - l**free) @ mu


@pytest.mark.slow
def test_rubber_no_worse_than_scipy_from_100_starts():
    found, _ = curves.read_curves([DATA / "rubber_curves.csv"])
    assert [len(c.stress) for c in found] == [24, 16, 13]

    def residuals(x):
        with np.errstate(all="ignore"):
            model = [_stress_of_rubber(c.test, c.driven, 1e5 * x[:3], x[3:]) / c.scale for c in found]
            misfit = np.concatenate([m - c.stress / c.scale for m, c in zip(model, found, strict=True)])
        return np.nan_to_num(misfit, nan=1e6, posinf=1e6, neginf=-1e6)

    rng, best = np.random.default_rng(5), np.inf
    for _ in range(100):
        start = np.concatenate([3 * rng.standard_normal(3), rng.uniform(-6, 6, 3)])
        best = min(best, scipy.optimize.least_squares(residuals, start, max_nfev=500).cost)
    (candidate,) = stress_stretch.candidates("ogden", terms=3)
    ours = stress_stretch.fit(candidate, found)
    assert ours.cost <= best * (1 + 1e-6)
    assert ours.mean_relative_error < 0.03  # Ogden's law of 1972 with three terms fits these data


@pytest.mark.ci
def test_eight_chains_no_worse_than_scipy_from_100_starts():
    found, _ = curves.read_curves([DATA / "rubber_curves.csv"])
    F = [jnp.asarray(c.F) for c in found]
    I1 = [np.asarray(jnp.einsum("nij,nij->n", f, f)) for f in F]
    from liverjax.laws.families.arruda_boyce import COEFFICIENTS

    def residuals(x):
        mu, N = 1e5 * np.exp(x[0]), np.exp(x[1])
        out = []
        for c, i1 in zip(found, I1, strict=True):
            W1 = mu * sum(k * ck * (i1 / N) ** (k - 1) for k, ck in enumerate(COEFFICIENTS, 1))
            l = c.driven
            power = {"uniaxial": -2, "equibiaxial": -5, "pure_shear": -3}[c.test]
            out.append((2 * W1 * (l - l**power) - c.stress) / c.scale)
        return np.concatenate(out)

    rng = np.random.default_rng(6)
    best = min(scipy.optimize.least_squares(residuals, rng.normal(1, 2, 2)).cost for _ in range(100))
    (candidate,) = stress_stretch.candidates("arruda_boyce")
    assert stress_stretch.fit(candidate, found).cost <= best * (1 + 1e-6)


def test_a_law_that_cannot_follow_is_held_stable():
    # The data soften. If Yeoh's coefficients were fitted freely, the stress would decrease.
    l = np.linspace(1.0, 1.6, 13)
    P = 2000 * (l - 1) - 2400 * (l - 1) ** 2
    curve = curves.Curve("soft", "uniaxial", np.asarray(homogeneous.deformation_gradient("uniaxial", l)), (0, 0), P)
    (candidate,) = stress_stretch.candidates("yeoh")
    found = stress_stretch.fit(candidate, [curve])
    model = np.asarray(homogeneous.response(found.law, "uniaxial", l))
    assert np.diff(model).min() > -1e-3 * np.abs(P).max()
    assert any("edge of stability" in w for w in found.warnings)


def test_a_law_that_misses_the_curve_is_not_taken_for_wrong_columns(tmp_path, capsys):
    """A stiffening sample is fitted with a law that does not stiffen. No other meaning of the columns improves
    the fit.
    """
    stretch = np.linspace(1.0, 2.0, 40)
    law = lj.laws.Yeoh(c1=500.0, c2=-80.0, c3=60.0, bulk=1.0)
    P = np.asarray(homogeneous.response(law, "uniaxial", stretch))
    P = P * (1 + 0.002 * np.random.default_rng(1).standard_normal(40))
    rows = "".join(f"uniaxial,{x:.6g},{p:.6g}\n" for x, p in zip(stretch, P, strict=True))
    (tmp_path / "c.csv").write_text("test,stretch,nominal_stress_Pa\n" + rows)
    main(["curves", "neo_hookean", str(tmp_path / "c.csv"), "--out", str(tmp_path)])
    said = capsys.readouterr().err
    assert "the law is inadequate: try other laws" in said and "would fit" not in said


@pytest.mark.draws
@pytest.mark.core
def test_command_writes_table_json_and_picture(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["curves", "fung_demiray", str(DATA / "brain_cortex_curves.csv"), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "fung_demiray" in text and "error" in text
    content = json.loads((out / "curves.json").read_text())
    (law,) = content["laws"]
    assert set(law["parameters"]) == set(law["standard_errors"]) == {"c1", "c2"}
    assert law["run_time_s"] > 0 and 0 < law["mean_relative_error"] < 1
    assert content["best"] == "fung_demiray" and len(content["curves"]) == 2
    assert (out / "curves.png").stat().st_size > 10_000


def test_laws_without_isochoric_form_are_refused(capsys):
    assert main(["curves", "costa", str(DATA / "rubber_curves.csv")]) == 2
    assert "use neo_hookean, mooney_rivlin" in capsys.readouterr().err


def test_measured_data_of_other_folders(tmp_path):
    from conftest import SHARED

    folder = SHARED / "data" / "curves"
    if not folder.is_dir():
        pytest.skip("the digitised curves are not here")
    files = [folder / f"Budday_2017__{n}.csv" for n in ("UT_T_cortex", "CSS_corona_radiata_lambda_0d75")]
    found, notes = curves.read_curves([*files, folder / "Treloar_1944__ET.csv"], unit="kPa")
    assert [c.test for c in found] == ["uniaxial", "simple_shear", "equibiaxial"]
    assert len(notes) == 3 and "names no unit; kPa is assumed" in notes[0]
    assert np.isclose(found[1].F[0, 0, 0], 0.75)


NOT_FINITE = """
import liverjax as lj

@lj.struct
class Root(lj.Law):
    mu: float = lj.param("Pa", typical=770.0)
    bulk: float = lj.param("Pa", typical=7700.0)
    volumetric: str = lj.static("quadratic")

    def isochoric_energy(self, I1, I2):
        return self.mu / 2 * (I1 - 3) + self.mu * (I1 - 3.001) ** 1.5
"""


@pytest.mark.ci
def test_a_law_without_a_finite_stress_is_named(tmp_path, capsys):
    (tmp_path / "root.py").write_text(NOT_FINITE)
    rows = "\n".join(f"uniaxial,{l:.3f},{800 * (l - l**-2):.4f}" for l in np.linspace(0.9, 1.3, 9))
    (tmp_path / "c.csv").write_text(f"test,stretch,nominal_stress_Pa\n{rows}\n")
    words = ["curves", f"{tmp_path}/root.py:Root", str(tmp_path / "c.csv"), "--out", str(tmp_path / "out")]
    assert main(words) == 2 and "Root: the stress is not finite on these curves" in capsys.readouterr().err
    rows = "\n".join(f"1,{g:.3f},{800 + g:.4f},{100 + g:.4f}" for g in np.geomspace(1, 60, 9))
    (tmp_path / "sweep.csv").write_text(f"frequency_Hz,strain_%,storage_modulus_Pa,loss_modulus_Pa\n{rows}\n")
    words = ["amplitude", f"{tmp_path}/root.py:Root", str(tmp_path / "sweep.csv"), "--out", str(tmp_path / "out")]
    assert main(words) == 2 and "Root: the stress is not finite on this sweep" in capsys.readouterr().err
