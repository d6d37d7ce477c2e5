"""Inputs from Python that no file reader has checked: wrong ones get one sentence instead of a wrong number."""

import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from fitting.amplitude import cycle
from fitting.fits import joint, samples, scene_numbers, stress_stretch, time_tests
from fitting.fits.families import hyperelastic
from fitting.fits.scene_numbers import Problem
from fitting.fits.together import common_fit
from fitting.methods.generalised_maxwell import Maxwell, moduli
from fitting.readers.curves import Curve
from fitting.readers.displacements import Displacements
from fitting.readers.rheometer import Sweep
from fitting.readers.time_tests import of_columns
from fitting.rigs import compression, hertz, thin_layer, torsion
from liverjax.core.struct import replace
from liverjax.physics.viscosity import Prony

LAW = lj.laws.NeoHookean(mu=1000.0, bulk=5000.0)
OMEGA = np.geomspace(0.1, 100, 8)
MODEL = Maxwell(1000.0, np.array([0.3, 0.2]), np.array([1.0, 0.05]))
SWEEP = Sweep(OMEGA, *map(np.asarray, moduli(MODEL, jnp.asarray(OMEGA))))
ONE = Sweep(OMEGA[:1], SWEEP.storage[:1], SWEEP.loss[:1])
RIG = torsion.make_rig(cell_size=0.004)
PRESSED = replace(RIG, held=RIG.mesh.points)
TIME = np.geomspace(0.01, 10, 12)
TEST = of_columns("relaxation", np.append(0.0, TIME), np.ones(13), np.append(0.0, 700 + 300 * np.exp(-TIME)), ("t", []))
STRETCH = np.linspace(1.0, 1.3, 9)


def stretched(F):
    return [Curve("tension", "uniaxial", F, (0, 0), 1000 * (STRETCH - STRETCH**-2))]


def neo_hookean(F):
    (candidate,) = hyperelastic.candidates("neo_hookean", None)
    return stress_stretch.fit(candidate, stretched(F))


def measured(step, node):
    mesh = lj.shapes.box((0.01, 0.01, 0.01), (1, 1, 1))
    scene = lj.Scene(mesh=mesh, law=LAW, solve=lj.Solve(steps=2))
    row = np.full((1, 3), 1e-4)
    data = Displacements(np.array([step]), np.full((1, 4), node), np.eye(4)[:1], row, row)
    return Problem((scene,), (data,))


ELONGATED = STRETCH[:, None, None] ** np.array([1, 0, 0]) * np.eye(3)
PLAIN = np.eye(3) * np.stack([STRETCH, STRETCH**-0.5, STRETCH**-0.5], axis=1)[:, :, None]
WRONG = {
    "drive by = 'torque' cannot impose strains": lambda: torsion.strain_sweep(
        RIG, LAW, None, [1e-3], drive=torsion.Drive()
    ),
    "drive start = 'steady' is not known: use cycle or rest": lambda: torsion.moduli(
        RIG, LAW, None, 1.0, 1e-6, torsion.Drive(start="steady")
    ),
    "drive by = 'Torque' is not known": lambda: torsion.oscillate(
        RIG, LAW, None, 1.0, 1e-6, torsion.Drive(by="Torque")
    ),
    "a compressed rig cannot be converted": lambda: torsion.scene_of(PRESSED, LAW, None, 1.0, 1e-6),
    "the factor of a compressed rig": lambda: torsion.geometry_factor(PRESSED, LAW),
    "-0.05 is out of range": lambda: compression.compressed(RIG, LAW, -0.05),
    "free_height = True and a compression by 0.1 exclude": lambda: compression.compressed(
        replace(RIG, free_height=True), LAW, 0.1
    ),
    "plates = 'Cone' is not known": lambda: cycle.reading(np.array([0.1]), np.ones((1, 17)), "Cone"),
    "shape = 'Sphere' is not known": lambda: hertz.half_space(hertz.Indenter("Sphere", 1.0, 0.5, 1.0), np.ones(1)),
    "over 8 times the thickness": lambda: thin_layer.punch_factor(50.0, 1.0, 0.3),
    "only one of storage_sd and loss_sd": lambda: joint.sweep(SWEEP._replace(storage_sd=0.01 * SWEEP.storage)),
    "ascending order": lambda: common_fit.fit([Sweep(OMEGA[::-1], SWEEP.storage, SWEEP.loss), TEST], 1),
    "modes = 1.9 must be a whole number": lambda: common_fit.fit([SWEEP, TEST], 1.9),
    "modes = 2.9 must be a whole number": lambda: time_tests.fit(TEST, 2.9),
    "one frequency does not determine a mode": lambda: samples.fit([ONE, ONE]),
    "the times do not ascend": lambda: of_columns("creep", TIME[::-1], np.ones(12), TIME, ("file", [])),
    "det F = 1.3 at point 8": lambda: neo_hookean(ELONGATED),
    "F or stress is not finite": lambda: neo_hookean(PLAIN * np.where(STRETCH > 1.2, np.nan, 1.0)[:, None, None]),
    "give \\(n, 3, 3\\) and \\(n,\\)": lambda: neo_hookean(PLAIN[:4]),
    "data.0.step contains a number outside 0 to 1": lambda: scene_numbers.check_data(measured(2, 0)),
    "data.0.nodes contains a number outside 0 to 7": lambda: scene_numbers.check_data(measured(0, 8)),
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_input_gets_one_sentence(words):
    with pytest.raises(lj.InputError, match=words) as caught:
        WRONG[words]()
    assert "\n" not in str(caught.value)


def test_right_inputs_are_fitted():
    assert np.isclose(neo_hookean(PLAIN).shear_modulus, 1000, rtol=1e-6)
    scene_numbers.check_data(measured(1, 7))


SPONGE = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=1e-5)


@pytest.mark.parametrize(
    ("name", "truth", "expected"),
    [("fluid_fraction", 1.1, 1.0), ("fluid_fraction", 0.8, 0.8), ("limit_bulk", 300, 300)],
)
def test_a_fit_respects_the_bounds_of_a_porous_body(name, truth, expected, monkeypatch, recwarn):
    """A fluid fraction above 1 was a result without a warning, or an error at the end of the fit."""
    problem = measured(1, 7)
    timed = replace(problem.scenes[0], porosity=SPONGE, solve=lj.Solve(dt=1.0, steps=2))
    problem = problem._replace(scenes=(timed,))

    def misfit(problem, values):
        off = values[f"porosity.{name}"] / truth - 1
        return 100 * off * jnp.array([1.0, 0.9, 1.1]), jnp.zeros(1, int)

    monkeypatch.setattr(scene_numbers, "misfit", misfit)
    possible, at_bound = name != "limit_bulk", truth == 1.1
    found = scene_numbers.fit_numbers(problem, [f"porosity.{name}"], mesh_error=not possible)
    assert np.isclose(found.values[0], expected, rtol=1e-5) and (found.values[0] <= 1 or not possible)
    told = [str(w.message) for w in recwarn]
    assert found.converged != at_bound and told == list(found.warnings) and len(told) == (at_bound or not possible)
    assert possible or "limit_bulk = 300 must be above bulk = 400" in told[0]
    assert not at_bound or "the upper bound of a parameter (porosity.fluid_fraction = 1)" in told[0]


def test_errors_of_a_scene_that_is_not_possible_are_unknown():
    problem = measured(1, 7)
    timed = replace(problem.scenes[0], porosity=SPONGE, solve=lj.Solve(dt=1.0, steps=2))
    with pytest.warns(UserWarning, match="the effect of the ") as told:
        found = scene_numbers.discretisation_errors(problem._replace(scenes=(timed,)), {"porosity.limit_bulk": 300.0})
    assert found == (None, None) and len(told) == 2


def test_strains_may_have_any_order():
    strains, storage = np.array([1e-3, 1e-2, 0.1, 0.3]), np.array([1000.0, 995, 960, 700])
    limit = torsion.linearity_limit(strains, storage)
    assert 0.1 < limit < 0.3 and torsion.linearity_limit(strains[::-1], storage[::-1]) == limit


@pytest.mark.ci
def test_the_time_steps_of_a_torsion_test_are_in_its_errors():
    test = joint.torsion_sweep(SWEEP, RIG, 1e-7, torsion.Drive(steps=20))
    prony = Prony(ratios=MODEL.ratios, relaxation_times=MODEL.relaxation_times)
    of_mesh, of_steps = test.errors(LAW, prony)
    found, _ = test.predict(LAW, prony, MODEL)
    exact = np.concatenate([SWEEP.storage, SWEEP.loss])
    assert np.all(np.asarray(of_mesh) == 0) and np.abs(of_steps / exact).max() > 1e-3
    assert np.abs(found + of_steps - exact).max() < 1e-5 * exact.max()  # the simulation has a finite strain


def test_a_start_before_the_load_is_told():
    time = np.append([0.0, 4.0, 8.0, 10.0], 10 + TIME)
    load, stress = np.where(time > 10, 1.0, 0.0), np.where(time > 10, 700 + 300 * np.exp(-(time - 10)), 0.0)
    test = of_columns("relaxation", time, load, stress, ("file", []), start=0.5)
    assert any("--min-time 0.5 s has no effect, because the load begins at 10 s" in note for note in test.notes)
    later = of_columns("relaxation", time, load, stress, ("file", []), start=10.5)
    assert later.time[later.used][0] >= 10.5 and not any("has no effect" in note for note in later.notes)
