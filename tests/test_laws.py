"""Every shipped law: derivatives by hand against automatic differentiation, rest state, bounds, user-defined laws."""

from functools import cache, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.laws.derivatives import autodiff_derivatives
from liverjax.laws.terms import chapter_terms, invariant_terms
from liverjax.tensors.matrices import Invariants, pack, unpack

pytestmark = pytest.mark.quick_to_compile

LAWS = {name: lj.laws.typical(name) for name in lj.laws.LAWS}
LAWS |= {
    "mooney_rivlin, third order": lj.laws.MooneyRivlin(
        c10=300.0, c01=85.0, c20=40.0, c11=-7.0, c02=11.0, c30=5.0, c21=3.0, c12=-2.0, c03=1.0, bulk=7700.0
    ),
    "neo_hookean, log": lj.laws.NeoHookean(mu=770.0, bulk=7700.0, volumetric="log"),
    "neo_hookean, simo": lj.laws.NeoHookean(mu=770.0, bulk=7700.0, volumetric="simo"),
    "neo_hookean, isochoric": lj.laws.NeoHookean(mu=770.0, bulk=None),
    "ogden, five terms": lj.laws.Ogden(
        mu=(200.0, -100.0, 30.0, 50.0, -5.0), alpha=(1.3, -2.0, 5.0, 2.0, -9.0), bulk=7700.0, volumetric="log"
    ),
    "costa, turned": lj.laws.create(
        "costa",
        c=200.0,
        b_ff=8.0,
        b_ss=4.0,
        b_nn=3.0,
        b_fs=5.0,
        b_fn=4.0,
        b_sn=2.0,
        bulk=7700.0,
        fibre=[1.0, 0.3, -0.2],
        sheet=[0.2, 1.0, 0.5],
    ),
    "sum": lj.laws.NeoHookean(mu=500.0, bulk=700.0) + lj.laws.SaintVenantKirchhoff(mu=100.0, lame_lambda=300.0),
}


ANISOTROPIC = {"costa", "costa, turned"}


def random_gradients(n: int) -> np.ndarray:
    """Return gradients near rigid, stretched to 3, and compressed to J = 0.1, each between random rotations."""
    rng = np.random.default_rng(1)
    stretches = np.concatenate(
        [
            1 + 1e-4 * rng.standard_normal((n // 4, 3)),
            rng.uniform(0.4, 3.0, (n // 2, 3)),
            rng.uniform(0.3, 2.0, (n - n // 4 - n // 2, 3)),
        ]
    )
    flat = n - n // 4 - n // 2
    stretches[-flat:, 2] = 0.1 / stretches[-flat:, :2].prod(axis=1)  # J = 0.1
    Q1, Q2 = (np.linalg.qr(rng.standard_normal((n, 3, 3)))[0] for _ in range(2))
    F = np.einsum("nij,nj,nkj->nik", Q1, stretches, Q2)
    return F * np.sign(np.linalg.det(F))[:, None, None]


#: Rest and many other gradients. They are the same for all tests, so that each law is compiled once.
POINTS = np.concatenate([np.eye(3)[None], random_gradients(1000)])


@jax.jit
def by_hand(law, F):
    """Return energy, stress and tangent."""
    return law.energy(F), law.first_piola(F), law.tangent(F)


@cache
def at_points(name):
    """Return `by_hand` at POINTS."""
    return tuple(np.asarray(v) for v in by_hand(LAWS[name], POINTS))


@jax.jit
def by_autodiff(law, F):
    """Return stress and tangent by automatic differentiation; nine derivatives of the stress are computed with the
    stress.
    """
    stress = partial(lj.reference.first_piola, law)
    directions = jnp.broadcast_to(jnp.eye(9).reshape(9, *[1] * (F.ndim - 2), 3, 3), (9, *F.shape))
    P, columns = jax.vmap(lambda d: jax.jvp(stress, (F,), (d,)), out_axes=(None, 0))(directions)
    return P, jnp.moveaxis(columns, 0, -1).reshape(*F.shape, 3, 3)


#: Laws with one power of the stretches. Its derivatives are most of their programs, so one program serves all these
#: laws.
ONE_POWER = ("bogen", "logarithmic", "exponential")


@lj.struct
class SideBySide(lj.Law):
    """Several laws with the same power: row k of F belongs to law k."""

    laws: tuple = lj.param("1")
    alpha: Any = lj.param("1")
    bulk: Any = lj.param("Pa")
    volumetric: str = lj.static("quadratic")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        return (self.alpha,)

    def stretch_energy(self, X):
        return jnp.stack([law.stretch_energy(x) for law, x in zip(self.laws, X, strict=True)])


@cache
def references_of_one_power():
    """Return `by_autodiff` of these laws at POINTS."""
    laws = tuple(LAWS[name] for name in ONE_POWER)
    ((alpha, volumetric),) = {(law.alpha, law.volumetric) for law in laws}
    bulk = jnp.array([[law.bulk] for law in laws])
    together = SideBySide(laws=laws, alpha=alpha, bulk=bulk, volumetric=volumetric)
    P, A = (np.asarray(v) for v in by_autodiff(together, np.stack([POINTS] * len(laws))))
    return dict(zip(ONE_POWER, zip(P, A, strict=True), strict=True))


def references(name):
    """Return stress and tangent at POINTS by automatic differentiation of the energy."""
    if name in ONE_POWER:
        return references_of_one_power()[name]
    return tuple(np.asarray(v) for v in by_autodiff(LAWS[name], POINTS))


#: One law of each kind: one invariant, two, stretches, fibres. The others run with -m slow.
KINDS = ("neo_hookean", "mooney_rivlin", "arruda_boyce", "costa")


@pytest.mark.parametrize("name", [n if n in KINDS else pytest.param(n, marks=pytest.mark.slow) for n in LAWS])
def test_stress_and_tangent_against_autodiff(name):
    # NumPy computes the maxima, because jnp.max of jax 0.12.0.1 ignores NaN in arrays with several dimensions.
    law, (W, P, A) = LAWS[name], at_points(name)
    exists = np.isfinite(W)  # the logarithmic law is undefined beyond a finite stretch
    assert np.array_equal(np.isfinite(P).all(axis=(1, 2)), exists)
    P, A = P[exists], A[exists]
    P_ref, A_ref = (v[exists] for v in references(name))
    # Errors are relative to the size of the terms of an entry. Near rest the stress is a small difference of such
    # terms.
    size_A = np.abs(A_ref).max(axis=(1, 2, 3, 4))
    size_P = np.abs(P_ref).max(axis=(1, 2)) + law.shear_modulus()
    assert exists.mean() > 0.7
    assert (np.abs(P - P_ref).max(axis=(1, 2)) / size_P).max() < 1e-11
    assert (np.abs(A - A_ref).max(axis=(1, 2, 3, 4)) / size_A).max() < 1e-11


@pytest.mark.parametrize(
    "name", [n if n != "ogden, five terms" else pytest.param(n, marks=pytest.mark.slow) for n in LAWS]
)
def test_rest_state_and_stated_moduli(name):
    law, (W, P, A) = LAWS[name], (v[0] for v in at_points(name))
    G, K = law.shear_modulus(), law.bulk_modulus()
    assert abs(W) < 1e-12 * G
    assert np.abs(P).max() < 1e-12 * (G + K)
    normal, shear = np.einsum("iijj->ij", A), np.array([A[0, 1, 0, 1], A[0, 2, 0, 2], A[1, 2, 1, 2]])
    # Voigt averages; for an isotropic law they are the moduli in every direction.
    coupled = normal[0, 1] + normal[0, 2] + normal[1, 2]
    assert np.isclose((np.trace(normal) + 2 * coupled) / 9, K, rtol=1e-12, atol=1e-12 * G)
    assert np.isclose((np.trace(normal) - coupled) / 15 + shear.sum() / 5, G, rtol=1e-12)
    if name not in ANISOTROPIC:
        assert np.allclose(shear, G, rtol=1e-12)
        assert np.allclose(normal, K - 2 / 3 * G + 2 * G * np.eye(3), rtol=1e-12, atol=1e-9 * G)


@pytest.mark.parametrize("name", LAWS)
def test_objective_and_symmetric(name):
    W, _, A = at_points(name)
    Q = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    Q = Q * np.sign(np.linalg.det(Q))
    turned = by_hand(LAWS[name], np.einsum("ij,njk->nik", Q, POINTS))[0]
    # Near rest, an energy is a small difference of numbers of the size of its modulus.
    assert np.allclose(turned, W, rtol=1e-9, atol=1e-12 * LAWS[name].shear_modulus(), equal_nan=True)
    assert np.nanmax(np.abs(A - np.transpose(A, (0, 3, 4, 1, 2)))) < 1e-12 * np.nanmax(np.abs(A))


def test_user_law_needs_only_its_energy():
    @lj.struct
    class Mine(lj.Law):
        """A user-defined law: W = mu/2 (J^(-2/3) I1 - 3) + bulk/2 (J - 1)^2."""

        mu: Any = lj.param("Pa")
        bulk: Any = lj.param("Pa")
        volumetric: str = lj.static("quadratic")
        invariants: ClassVar = ("I1", "J")

        def strain_energy(self, I):
            return self.mu / 2 * (I.J ** (-2 / 3) * I.I1 - 3) + self.bulk / 2 * (I.J - 1) ** 2

    mine, shipped = Mine(mu=770.0, bulk=7700.0), lj.laws.NeoHookean(mu=770.0, bulk=7700.0)
    tangent, expected = jax.jit(lambda law: law.tangent(POINTS[:100]))(mine), at_points("neo_hookean")[2][:100]
    assert np.allclose(tangent, expected, rtol=1e-9, atol=1e-9)
    first, second = autodiff_derivatives(shipped, Invariants(I1=jnp.array([3.5]), J=jnp.array([0.9])))
    by_hand = shipped.energy_derivatives(Invariants(I1=jnp.array([3.5]), J=jnp.array([0.9])))
    for key, value in by_hand[1].items():
        assert np.isclose(second[key][0], value[0], rtol=1e-12)
    assert np.isclose(first["J"][0], by_hand[0]["J"][0], rtol=1e-12)


def test_a_planted_mistake_is_caught():
    class Wrong(lj.laws.NeoHookean):
        def isochoric_derivatives(self, I1, I2):
            return {"I1": -0.5 * self.mu}, {}

    wrong = lj.struct(Wrong)(mu=770.0, bulk=7700.0)
    error = jax.jit(lambda law, F: law.first_piola(F) - lj.reference.first_piola(law, F))(wrong, random_gradients(8))
    assert np.abs(error).max() > 100


def test_only_invariants_asked_for_are_computed():
    # The structure counts, not a multiplication by zero: neo-Hookean never forms C = F^T F or I2.
    F = jnp.eye(3)
    text = str(jax.make_jaxpr(LAWS["neo_hookean"].energy)(F))
    more = str(jax.make_jaxpr(LAWS["mooney_rivlin"].energy)(F))
    assert text.count("mul") < more.count("mul")
    first, second = LAWS["saint_venant_kirchhoff"].energy_derivatives(Invariants(I1=jnp.array(3.0), I2=jnp.array(3.0)))
    assert "J" not in first and set(second) == {("I1", "I1")}


def test_parts_of_a_split_law_add_up():
    law, F = LAWS["arruda_boyce"], jnp.asarray(random_gradients(16))
    whole = lj.laws.isochoric_part(law).energy(F) + lj.laws.volumetric_part(law).energy(F)
    assert np.allclose(whole, law.energy(F), rtol=1e-12)
    assert lj.laws.isochoric_part(LAWS["saint_venant_kirchhoff"]) is None
    assert lj.laws.volumetric_part(LAWS["saint_venant_kirchhoff"]) is None


def test_parts_of_sums_and_of_laws_without_bulk():
    @lj.struct
    class Bare(lj.Law):
        mu: Any = lj.param("Pa")

        def isochoric_energy(self, I1, I2):
            return self.mu / 2 * (I1 - 3)

    bare, fluid = Bare(mu=770.0), lj.laws.Volumetric(bulk=7700.0)
    assert bare.isochoric_part() is bare and bare.volumetric_part() is None
    assert (bare + fluid).isochoric_part() is bare and (bare + fluid).volumetric_part() is fluid
    assert fluid.isochoric_part() is None and (bare + LAWS["saint_venant_kirchhoff"]).isochoric_part() is None
    with pytest.raises(lj.InputError, match="one mu and one alpha for each term"):
        (bare + lj.laws.Ogden(mu=(1.0, 2.0), alpha=(2.0,), bulk=1.0)).check()


@pytest.mark.parametrize(
    ("name", "values", "sentence"),
    [
        ("neo_hokean", {}, "did you mean neo_hookean"),
        ("neo_hookean", {"mu": 1.0}, "needs parameter bulk"),
        ("neo_hookean", {"mu": -1.0, "bulk": 1.0}, "must be above 0 Pa"),
        ("neo_hookean", {"mu": float("nan"), "bulk": 1.0}, "not finite"),
        ("neo_hookean", {"mu": "soft", "bulk": 1.0}, "not a number"),
        ("neo_hookean", {"mu": 1.0, "bulck": 1.0}, "did you mean bulk"),
        ("neo_hookean", {"mu": 1.0, "bulk": 1.0, "volumetric": "cubic"}, "use one of quadratic"),
    ],
)
def test_create_refuses_in_one_sentence(name, values, sentence):
    with pytest.raises(lj.InputError, match=sentence):
        lj.laws.create(name, **values)


def test_create_under_tracing_and_optional_parameters():
    energy = jax.grad(lambda m: lj.laws.create("neo_hookean", mu=m, bulk=7700.0).energy(1.1 * jnp.eye(3)))(770.0)
    assert np.isfinite(energy)
    with pytest.raises(lj.InputError, match="not a number"):
        lj.laws.create("neo_hookean", mu="770", bulk=7700.0)
    with pytest.raises(lj.InputError, match=r"bulk = None|not finite"):
        lj.laws.create("neo_hookean", mu=770.0, bulk=None)
    assert lj.laws.create("mooney_rivlin", c10=1.0, c01=1.0, c20=None, bulk=10.0).c20 is None
    ogden = jax.grad(
        lambda m: lj.laws.create("ogden", mu=[m, -40.0], alpha=[2.5, -4.0], bulk=7e3).energy(1.1 * jnp.eye(3))
    )
    assert np.isfinite(ogden(700.0))
    both = sum([LAWS["yeoh"], LAWS["ogden"]])
    assert np.isclose(both.shear_modulus(), 2 * 770.0)
    assert lj.laws.scaled(lj.laws.Ogden(mu=[1.0], alpha=[2.0], bulk=3.0), 2.0).mu == (2.0,)
    assert LAWS["costa"].tangent(jnp.eye(3, dtype=jnp.float32)).dtype == jnp.float32
    integer = np.array([[2, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert np.allclose(LAWS["neo_hookean"].first_piola(integer), LAWS["neo_hookean"].first_piola(integer * 1.0))


def test_a_sum_of_sums_is_one_sum():
    """The stress of the laws in an inner sum was lost, and `scaled` raised KeyError."""
    a, b, c = (LAWS[name] for name in ("ogden", "neo_hookean", "yeoh"))
    nested = lj.laws.Sum(laws=(lj.laws.Sum(laws=(a, b)), c))
    F = jnp.asarray(random_gradients(1)[0])
    assert np.allclose(nested.first_piola(F), sum(law.first_piola(F) for law in (a, b, c)), rtol=1e-12)
    assert np.isclose(lj.laws.scaled(nested, 2.0).energy(F), 2 * nested.energy(F), rtol=1e-12)
    assert jax.tree.structure(nested) == jax.tree.structure(a + b + c)
    assert replace(nested, laws=(a + b, c)).laws == (a, b, c)


def test_the_terms_of_the_chapter_know_the_continued_volume():
    """The terms "chapter" did not use `below`, so a flat element had a larger pressure."""
    law = lj.laws.NeoHookean(mu=500.0, bulk=None) + lj.laws.Volumetric(bulk=5000.0, volumetric="log", below=0.5)
    F = unpack(jnp.diag(jnp.array([1.0, 1.0, 0.3])))
    P, of_chapter = (np.asarray(pack(terms.first_piola(law, F))) for terms in (invariant_terms, chapter_terms))
    assert np.allclose(of_chapter, P, rtol=1e-12)


def test_a_modulus_in_another_unit_than_pascal_is_refused():
    """`scaled` did not multiply a modulus in kPa, so such a law did not relax. Later, such a unit was refused in every
    struct."""
    with pytest.raises(lj.InputError, match=r"Soft\.mu has the unit 'kPa': declare the unit Pa"):

        @lj.struct
        class Soft(lj.Law):
            mu: float = lj.param("kPa", typical=0.77)

    @lj.struct
    class Part:
        stiffness: float = lj.param("kPa", default=0.77)

    with pytest.raises(lj.InputError, match=r"Mixed\.stiffness has the unit 'kPa'"):  # a field of another base class

        @lj.struct
        class Mixed(Part, lj.Law):
            pass

    @lj.struct
    class Vessel:
        pressure: float = lj.param("mmHg", default=80.0)

    assert Vessel().pressure == 80.0  # only laws are multiplied, so other structs may have any unit


def test_a_law_of_ogden_without_terms_is_refused():
    """Such a law was made, with the shear modulus 0."""
    with pytest.raises(lj.InputError, match="give at least one term"):
        lj.laws.create("ogden", mu=[], alpha=[], bulk=7700.0)
