"""Prony recursions (updates of the viscous memory from step to step): exact formulas, orders, limits, parts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.laws.terms import invariant_terms
from liverjax.physics import viscosity
from liverjax.tensors.matrices import unpack

pytestmark = pytest.mark.quick_to_compile

OMEGA = 2 * np.pi * 4.0


def _driven(prony: lj.Prony, steps: int, cycles: int = 40) -> complex:
    """Return G*/G0 of the scalar recursion under a sine, demodulated over its last cycle."""
    dt = 2 * np.pi / OMEGA / steps
    a, b, c = viscosity.coefficients(prony, dt)
    S = jnp.sin(OMEGA * dt * jnp.arange(steps * cycles + 1))

    def step(gamma, pair):
        gamma = a * pair[1] + c * pair[0] + b * gamma
        return gamma, pair[1] - gamma.sum()

    _, stress = jax.lax.scan(step, jnp.zeros_like(a), (S[:-1], S[1:]))
    carrier = jnp.exp(-1j * OMEGA * dt * jnp.arange(1, steps * cycles + 1))[-steps:]
    return complex((carrier * stress[-steps:]).sum() / (carrier * S[-steps:]).sum())


@pytest.mark.parametrize("scheme", viscosity.SCHEMES)
def test_recursion_answers_its_discrete_formula(scheme, table_2, verified):
    prony = replace(table_2, scheme=scheme)
    dt = 2 * np.pi / OMEGA / 50
    formula = 1 - viscosity.complex_ratios(prony, OMEGA, dt).sum()
    off = abs(_driven(prony, 50) - complex(formula))
    verified(f"{scheme} recursion driven by a sine: G*/G0", "its transfer function", off, 1e-12)
    assert off < 1e-12


@pytest.mark.parametrize(("scheme", "order"), [("exponential", 2), ("chapter", 1)])
def test_observed_order(scheme, order, table_2, verified):
    prony = replace(table_2, scheme=scheme)
    exact = viscosity.complex_ratios(prony, OMEGA).sum()
    errors = [
        abs(viscosity.complex_ratios(prony, OMEGA, 2 * np.pi / OMEGA / n).sum() - exact) for n in (50, 100, 200, 400)
    ]
    rates = np.log2(np.asarray(errors[:-1]) / np.asarray(errors[1:]))
    off = np.abs(rates - order).max()
    verified(f"{scheme} recursion: order {order} of G*", "continuous Maxwell model", off, 0.1, rates[-1])
    assert off < 0.1


def test_loss_errors_stated_by_the_mathematics(table_2):
    # From `mathematics.md`: chapter's scheme 5.2 % at 50 steps and 2.6 % at 100, exponential 0.15 % at 50 (G'' at 4
    # Hz).
    exact = viscosity.complex_ratios(table_2, OMEGA).sum().imag
    for scheme, n, percent in (("chapter", 50, 5.2), ("chapter", 100, 2.6), ("exponential", 50, 0.15)):
        prony = replace(table_2, scheme=scheme)
        error = viscosity.complex_ratios(prony, OMEGA, 2 * np.pi / OMEGA / n).sum().imag / exact - 1
        assert np.isclose(100 * abs(float(error)), percent, atol=0.06)


def test_table_2_moduli(table_2, verified):
    f = jnp.array([0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 4.0])
    G = 770 * (1 - viscosity.complex_ratios(table_2, 2 * jnp.pi * f).sum(axis=0))
    storage = np.array([337.8, 351.7, 410.6, 475.7, 531.0, 569.0, 602.7])
    off = np.abs(np.asarray(G.real) / storage - 1).max()
    verified("storage moduli of Table 2's liver at 0.1 to 4 Hz", "tabulated to 0.1 Pa", off, 0.05 / storage.min())
    assert np.allclose(G.real, storage, atol=0.05)
    assert np.allclose(G.imag, [34.7, 64.7, 113.2, 125.8, 133.7, 144.1, 149.4], atol=0.06)


@pytest.mark.parametrize("scheme", viscosity.SCHEMES)
@pytest.mark.parametrize("ratio", [1e-12, 1e-6, 1e-3, 0.0999, 0.1001, 1.0, 1e3, 1e6])
def test_coefficients_are_exact_for_any_step(scheme, ratio):
    mpmath = pytest.importorskip("mpmath")
    prony = lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([1.0]), scheme=scheme)
    a, b, c = (float(v[0]) for v in viscosity.coefficients(prony, ratio))
    with mpmath.workdps(40):
        r = mpmath.mpf(ratio)
        e = mpmath.exp(-r)
        q = (1 - e) / r
        g = mpmath.mpf(0.3)
        exact = (g * (1 - q), e, g * (q - e)) if scheme == "exponential" else (g * r / (1 + r), 1 / (1 + r), 0)
    for ours, theirs in zip((a, b, c), exact, strict=True):
        # 4 roundings; c is the difference of two numbers of size r, which doubles them.
        assert abs(ours - float(theirs)) <= 8 * np.finfo(float).eps * max(abs(float(theirs)), 1e-300)


@pytest.mark.parametrize("part", ["isochoric", pytest.param("all", marks=pytest.mark.slow)])
def test_step_relaxation_follows_alpha(part, table_2):
    law = lj.laws.typical("neo_hookean")
    prony = replace(table_2, part=part)
    F = unpack(jnp.array([[[1.1, 0.2, 0.0], [0.0, 0.95, 0.1], [0.0, 0.0, 1.02]]]))
    history = viscosity.initial_history(prony, 1)
    dt, n = 0.002, 500
    # The first step jumps to F, which the recursion takes as a ramp over one dt. Afterwards the stress is constant.

    def step(history, _):
        P = viscosity.first_piola(prony, viscosity.recall(prony, history, dt), law, F)
        return viscosity.advance(prony, history, law, F, dt), P

    _, stresses = jax.lax.scan(step, history, length=n)
    P = jax.tree.map(lambda own: own[-1], stresses)
    g, tau = np.asarray(table_2.ratios), np.asarray(table_2.relaxation_times)
    ramp = tau / dt * np.expm1(dt / tau)
    alpha = 1 - np.sum(g * (1 - ramp * np.exp(-n * dt / tau)))
    whole = invariant_terms.first_piola(law, F)
    kept = invariant_terms.first_piola(lj.laws.volumetric_part(law), F) if part == "isochoric" else None
    for i in range(3):
        for j in range(3):
            rest = kept[i][j] if kept else 0.0
            assert np.isclose(P[i][j][0], alpha * (whole[i][j] - rest)[0] + np.sum(rest), rtol=1e-10, atol=1e-9)


def test_history_has_only_what_the_scheme_needs(table_2):
    exponential = viscosity.initial_history(table_2, 7)
    chapter = viscosity.initial_history(replace(table_2, scheme="chapter"), 7)
    assert [leaf.shape for leaf in jax.tree.leaves(exponential)] == [(2, 6, 7), (6, 7)]
    assert [leaf.shape for leaf in jax.tree.leaves(chapter)] == [(2, 6, 7)]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"ratios": (0.6, 0.5)}, "add up to less than 1"),
        ({"ratios": (-0.1, 0.5)}, "at least 0"),
        ({"relaxation_times": (0.0, 1.0)}, "must be above 0 s"),
        ({"relaxation_times": (1.0,)}, "one ratio and one relaxation time for each mode"),
        ({"scheme": "euler"}, "use exponential or backward_euler"),
        ({"part": "deviatoric"}, "use all or isochoric"),
        ({"part": "isochoric"}, "unlike SaintVenantKirchhoff"),
    ],
)
def test_bad_viscosity_is_refused(changes, sentence, table_2):
    prony = replace(table_2, **changes)
    with pytest.raises(lj.InputError, match=sentence):
        viscosity.check_viscosity(prony, lj.laws.typical("saint_venant_kirchhoff"))


def test_a_series_that_cannot_be_is_refused_in_python_before_anything_is_compiled():
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
    still = lj.Fixed(nodes=mesh.node_sets["z_min"])

    def run(ratios: object, times: object) -> lj.Scene:
        prony = lj.Prony(ratios=ratios, relaxation_times=times)
        law = lj.laws.NeoHookean(mu=770.0, bulk=2200.0)
        return lj.Scene(mesh=mesh, law=law, viscosity=prony, fixed=(still,), solve=lj.Solve(dt=0.1))

    with pytest.raises(lj.InputError, match=r"ratios = \[0.7, 0.6\] must add up to less than 1"):
        lj.simulate(run(jnp.array([0.7, 0.6]), jnp.array([1.0, 0.1])))
    with pytest.raises(lj.InputError, match="has 2 ratios and 1 relaxation_times"):
        lj.simulate(run(jnp.array([0.3, 0.3]), jnp.array([1.0])))
    # For traced values, only their number is checked.
    traced = jax.make_jaxpr(lambda g: viscosity.check_series(lj.Prony(ratios=(g, g), relaxation_times=(1.0, 0.1))))
    traced(0.7)
    with pytest.raises(lj.InputError, match="has 2 ratios and 1 relaxation_times"):
        jax.make_jaxpr(lambda g: viscosity.check_series(lj.Prony(ratios=(g, g), relaxation_times=(1.0,))))(0.7)


@pytest.mark.parametrize("number", ["relaxation_time", "dt"])
def test_coefficients_have_a_derivative_where_the_step_is_a_relaxation_time(number):
    """Two formulas meet at dt = tau. A derivative that mixed both was half as large. The reference is complex steps
    through the formulas of the docstring.
    """
    g, t = 0.3, 0.05

    def exact(tau, dt):
        r = dt / tau
        q = (1 - np.exp(-r)) / r
        return np.array([g * (1 - q), np.exp(-r), g * (q - np.exp(-r))])

    def found(tau, dt):
        prony = lj.Prony(ratios=jnp.array([g]), relaxation_times=jnp.asarray(tau)[None])
        return jnp.concatenate(lj.viscosity.coefficients(prony, dt))

    k = ("relaxation_time", "dt").index(number)
    h = 1e-20j * np.eye(2)[k]
    for derivative in (jax.jacfwd(found, k), jax.jacrev(found, k)):
        assert np.allclose(derivative(t, t), exact(t + h[0], t + h[1]).imag / 1e-20, rtol=1e-13)


@pytest.mark.parametrize("scheme", ["exponential", "backward_euler"])
def test_a_series_without_modes_relaxes_nothing(scheme):
    """The backward Euler scheme once raised a TypeError here."""
    prony = lj.Prony(ratios=[], relaxation_times=[], scheme=scheme)
    found = viscosity.recall(prony, viscosity.initial_history(prony, 2), 0.1)
    assert float(found.now) == 1.0 and np.array_equal(found.past, np.zeros((3, 3, 2)))
