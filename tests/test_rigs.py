"""Tension, indentation and creep against what is known, their derivatives, and fits of several tests at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from fitting.fits import joint
from fitting.methods import generalised_maxwell
from fitting.readers.rheometer import Sweep
from fitting.rigs import glued, torsion

pytestmark = pytest.mark.quick_to_compile

LAW = lj.laws.NeoHookean(mu=jnp.asarray(800.0), bulk=jnp.asarray(2400.0))
PRONY = lj.Prony(ratios=jnp.array([0.4]), relaxation_times=jnp.array([0.5]))
R, H = 0.01, 0.01


@pytest.mark.parametrize("times", [(0.1,), pytest.param((0.1, 0.05), marks=pytest.mark.slow)], ids=["one", "two"])
def test_creep_is_that_of_the_standard_linear_solid(times, verified):
    """All stress relaxes alike, so a small strain creeps as 1/(1-g) - g/(1-g) exp(-t (1-g)/tau), averaged over the
    first step, in which the load comes up; at second order."""
    errors = []
    for dt in times:
        rig = glued.creep(R, H, dt, round(1 / dt), 0.01, cell_size=0.005)
        u, codes = glued.read(rig, LAW, PRONY)
        # Nothing relaxes within 1e-9 of the time: the elastic sample, by the same program.
        lasting = lj.Prony(ratios=PRONY.ratios, relaxation_times=jnp.array([1e9]))
        elastic = glued.read(rig, LAW, lasting)[0][-1]
        t = dt * np.arange(1, len(u) + 1)
        rate = 0.6 / 0.5
        exact = 1 / 0.6 - 0.4 / 0.6 * np.exp(-rate * t) * np.expm1(rate * dt) / (rate * dt)
        assert not np.any(codes)
        errors.append(abs(float(u[-1] / elastic / exact[-1]) - 1))
    order = np.log2(errors[0] / errors[1]) if len(times) > 1 else None
    verified(f"creep of a cylinder, steps of {times[-1]} s", "standard linear solid", errors[-1], 1e-3, order)
    # Second order in rate dt = 0.12: at most its square over 12, of what has yet to creep, exp(-1.2).
    assert errors[0] < 4e-4 and (order is None or errors[0] / errors[1] > 3), errors


@pytest.mark.slow
def test_tension_relaxes_as_the_law_says(verified):
    """Held at a small strain, the force falls to 1 - g (1 - q exp(...)): after many relaxation times to 1 - g."""
    strains = np.full(40, 1e-4)
    force, codes = glued.read(glued.tension(R, H, 0.25, strains, cell_size=0.005), LAW, PRONY)
    elastic = glued.read(glued.tension(R, H, 0.25, strains[:1], cell_size=0.005), LAW, None)[0][0]
    assert not np.any(codes)
    off = abs(float(force[-1] / elastic) - 0.6)
    verified("relaxed over elastic force of a cylinder", "1 - sum of ratios", off, 1e-6)
    assert off < 1e-6
    # Stiffer than a free sample, E pi r^2 strain, softer than one held all around.
    E, M = 9 * 2400 * 800 / (3 * 2400 + 800), 2400 + 4 / 3 * 800
    assert E < float(elastic) / (np.pi * R**2 * 1e-4) < M


@pytest.mark.slow
def test_indentation_is_near_that_of_a_half_space():
    """4 G a d / (1 - nu) of a smooth punch on a half-space; glued, and on a block ten times as wide, a little more."""
    rig = glued.indentation(0.02, 0.02, 0.0025, 1.0, [1e-5], cell_size=0.00125)
    force, _ = glued.read(rig, LAW, None)
    nu = (3 * 2400 - 2 * 800) / (2 * (3 * 2400 + 800))
    # Two cells under the punch, and linear tetrahedra are stiff.
    assert 1.0 < float(-force[0]) / (4 * 800 * 0.0025 * 1e-5 / (1 - nu)) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["creep", "tension", "indentation"])
def test_derivatives_by_the_parameters(kind):
    """Of the last reading by mu, g and tau: forward and reverse mode, and central differences."""
    strains = 0.1 * np.arange(1, 4) / 3
    rig = {
        "tension": lambda: glued.tension(R, H, 0.2, strains, cell_size=0.005),
        "indentation": lambda: glued.indentation(R, H, 0.006, 0.2, 0.01 * strains, cell_size=0.005),
        "creep": lambda: glued.creep(R, H, 0.2, 3, 50.0, cell_size=0.005),
    }[kind]()

    @jax.jit
    def last(p):
        law = lj.laws.NeoHookean(mu=p[0], bulk=jnp.asarray(2400.0))
        return glued.read(rig, law, lj.Prony(ratios=p[1:2], relaxation_times=p[2:]))[0][-1]

    p = jnp.array([800.0, 0.4, 0.5])
    reverse, forward = jax.grad(last)(p), jax.jacfwd(last)(p)
    np.testing.assert_allclose(reverse, forward, rtol=1e-7)
    for k in range(3):
        h = 1e-3 * float(p[k])
        difference = (last(p.at[k].add(h)) - last(p.at[k].add(-h))) / (2 * h)
        # Newton's tolerance of 1e-9 over a step of 1e-3, and the step's square.
        assert abs(difference / reverse[k] - 1) < 1e-5


def _sweep(model, noise, seed):
    omega = 2 * np.pi * np.logspace(-1, 1, 12)
    storage, loss = (np.asarray(m) for m in generalised_maxwell.moduli(model, jnp.asarray(omega)))
    rng = np.random.default_rng(seed)
    noisy = [m * (1 + noise * rng.normal(size=12)) for m in (storage, loss)]
    return Sweep(omega, *noisy, noise * storage, noise * loss, "synthetic")


@pytest.mark.slow
def test_two_tests_know_more_than_one():
    """A slow mode outside a sweep's band: creep adds it; every interval of the joint fit is narrower than alone."""
    model = generalised_maxwell.Maxwell(jnp.asarray(800.0), jnp.array([0.3, 0.3]), jnp.array([8.0, 0.1]))
    rig = glued.creep(R, H, 1.0, 20, 20.0, cell_size=0.005)
    law = lj.laws.NeoHookean(mu=1.0, bulk=3.0)
    viscosity = lj.Prony(ratios=model.ratios, relaxation_times=model.relaxation_times)
    readings = np.asarray(glued.read(rig, lj.laws.scaled(law, 800.0), viscosity)[0])
    sd = 0.01 * readings[-1]
    noisy = readings + sd * np.random.default_rng(1).normal(size=readings.shape)
    of_sweep, of_creep = joint.sweep(_sweep(model, 0.02, 0)), joint.through("creep", rig, noisy, sd)
    start = generalised_maxwell.Maxwell(jnp.asarray(700.0), jnp.array([0.25, 0.25]), jnp.array([5.0, 0.2]))
    alone, both = joint.fit([of_sweep], start, law), joint.fit([of_sweep, of_creep], start, law)
    assert both.converged and both.names == alone.names
    true = np.array([800.0, 0.3, 0.3, 8.0, 0.1])
    assert np.all(np.abs(both.values - true) < 4 * both.standard_errors)
    assert np.all(both.standard_errors < alone.standard_errors)
    assert both.standard_errors[3] < 0.5 * alone.standard_errors[3]
    with pytest.raises(lj.InputError, match="readings for 20 steps"):
        joint.through("creep", rig, noisy[:5], sd)


@pytest.mark.slow
def test_a_free_height_serves_as_a_test():
    """The torsion rig whose plate may rise: at small strain the moduli are those of the fixed one."""
    model = generalised_maxwell.Maxwell(jnp.asarray(800.0), jnp.array([0.4]), jnp.array([0.5]))
    data = _sweep(model, 0.01, 2)
    data = data._replace(
        angular_frequency=data.angular_frequency[::6],
        storage=data.storage[::6],
        loss=data.loss[::6],
        storage_sd=data.storage_sd[::6],
        loss_sd=data.loss_sd[::6],
    )
    rig = torsion.make_rig(free_height=True, cell_size=0.004)
    found = joint.fit([joint.torsion_sweep(data, rig, 1e-7)], model, LAW)
    closed = joint.fit([joint.sweep(data)], model, LAW)
    # The discrete cycle of 50 steps differs by its second-order error, below a percent.
    np.testing.assert_allclose(found.values, closed.values, rtol=0.02)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: glued.tension(R, H, 0.0, [0.1]), "dt = 0.0"),
        (lambda: glued.tension(R, H, 0.1, [-0.95]), "above -0.9"),
        (lambda: glued.tension(R, H, 0.1, [np.nan]), "finite numbers"),
        (lambda: glued.tension(-R, H, 0.1, [0.1]), "radius"),
        (lambda: glued.indentation(R, H, 0.02, 0.1, [1e-3]), "punch"),
        (lambda: glued.indentation(R, H, 1e-5, 0.1, [1e-3]), "punch"),
    ],
)
def test_bad_rigs_are_one_sentence(make, words):
    with pytest.raises(lj.InputError, match=words):
        make()
