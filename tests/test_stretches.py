"""Stretch-based laws against 40-digit arithmetic and polynomial cases, with equal or nearly equal stretches."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import liverjax as lj
from liverjax.tensors import principal
from liverjax.tensors.matrices import unpack

pytestmark = pytest.mark.quick_to_compile

RNG = np.random.default_rng(11)


def rotation() -> np.ndarray:
    """Return a random rotation."""
    Q = np.linalg.qr(RNG.standard_normal((3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))


#: Stretches: rest, two and three equal, nearly equal, and J from 0.05 to 8.
CASES = {
    "rest": (1.0, 1.0, 1.0),
    "three equal": (1.3, 1.3, 1.3),
    "two equal": (1.4, 0.8, 1.4),
    "J = 0.05": (0.7, 0.3, 0.05 / 0.21),
    "J = 8": (2.5, 1.6, 2.0),
    "slender": (0.2, 3.0, 1.1),
} | {f"{gap:g} apart": (1.2, 1.2 + gap, 1.2 - gap / 3) for gap in 10.0 ** -np.arange(3, 13)}

LAWS = {
    "ogden": lj.laws.Ogden(mu=(300.0, -150.0, 20.0), alpha=(1.7, -2.6, 9.0), bulk=7700.0),
    "bogen": lj.laws.typical("bogen"),
    "logarithmic": lj.laws.Logarithmic(c1=2e4, c2=1e-3, alpha=3.3, bulk=7700.0),
    "exponential": lj.laws.Exponential(c1=385.0, c2=0.05, alpha=-2.5, bulk=7700.0),
}


def exact(law: lj.Law, stretches: tuple, *orders: tuple) -> list[float]:
    """Return derivatives of the published energy with respect to the principal stretches, with 60 digits.

    An order is one count per stretch.
    """
    mpmath.mp.dps = 60
    number = lambda v: mpmath.mpf(float(v))  # noqa: E731

    def energy(*lam):
        J = lam[0] * lam[1] * lam[2]

        def X(alpha):
            return sum((v * J ** (-mpmath.mpf(1) / 3)) ** number(alpha) for v in lam) - 3

        U = number(law.bulk) / 2 * (J - 1) ** 2
        match type(law).__name__:
            case "Ogden":
                return sum(number(m) / number(a) * X(a) for m, a in zip(law.mu, law.alpha, strict=True)) + U
            case "Bogen":
                return number(law.mu) / number(law.alpha) * X(law.alpha) + U
            case "Logarithmic":
                return -number(law.c1) * mpmath.log(1 - number(law.c2) * X(law.alpha)) + U
            case "Exponential":
                return number(law.c1) * (mpmath.exp(number(law.c2) * X(law.alpha)) - 1) + U

    lam = tuple(number(v) for v in stretches)
    return [float(mpmath.diff(energy, lam, n) if any(n) else energy(*lam)) for n in orders]


FIRST = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
#: Bogen's law is a term of Ogden's, and tests/test_law_values.py checks its numbers. By default Ogden's law stands for
#: both.
NAMES = [pytest.param(name, marks=pytest.mark.slow) if name == "bogen" else name for name in LAWS]


@jax.jit
def _by_hand(law, F):
    return law.energy(F), law.first_piola(F), law.tangent(F)


def by_hand(law: lj.Law, F: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return energy, stress and tangent. One program serves all tests with equally many F."""
    return tuple(np.asarray(v) for v in _by_hand(law, F))


@pytest.mark.parametrize("name", [n if n != "logarithmic" else pytest.param(n, marks=pytest.mark.slow) for n in NAMES])
def test_energy_and_stress_against_high_precision(name):
    law = LAWS[name]
    # The stretches are given, and F is their product with rotations. Both computations use the same diagonal.
    F = np.stack([np.diag(s) for s in CASES.values()])
    energy, P, _ = by_hand(law, F)
    for k, stretches in enumerate(CASES.values()):
        W, *principal = exact(law, stretches, (0, 0, 0), *FIRST)
        size = np.abs(principal).max() + law.shear_modulus()
        assert np.abs(P[k] - np.diag(principal)).max() < 1e-13 * size
        assert abs(energy[k] - W) < 1e-13 * (abs(W) + law.shear_modulus())
    R, Q = rotation(), rotation()
    turned = by_hand(law, R @ F @ Q)[1]
    size = np.abs(P).max(axis=(1, 2)) + law.shear_modulus()
    assert (np.abs(turned - R @ P @ Q).max(axis=(1, 2)) / size).max() < 1e-11


@pytest.mark.parametrize("name", NAMES)
def test_tangent_against_high_precision(name):
    # Principal form of the tangent (Ogden 1997, section 6.1.4): A_iijj = d2W/dlambda_i dlambda_j. For unequal
    # stretches, A_ijij +- A_ijji = (P_i -+ P_j)/(lambda_i -+ lambda_j).
    law, stretches = LAWS[name], (1.4, 0.8, 1.1)
    A, P = by_hand(law, np.stack([np.diag(stretches)] * len(CASES)))[2][0], exact(law, stretches, *FIRST)
    scale = np.abs(A).max()
    for i in range(3):
        for j in range(3):
            order = tuple(a + b for a, b in zip(FIRST[i], FIRST[j], strict=True))
            assert abs(A[i, i, j, j] - exact(law, stretches, order)[0]) < 1e-12 * scale
            for sign in (1, -1):
                if i != j:
                    expected = (P[i] - sign * P[j]) / (stretches[i] - sign * stretches[j])
                    assert abs(A[i, j, i, j] + sign * A[i, j, j, i] - expected) < 1e-12 * scale


def polynomial(theta, F):
    """Return Ogden's law with exponents 4 and -2, written with invariants, and quadratic U(J)."""
    C, J = F.T @ F, jnp.linalg.det(F)
    I1 = jnp.trace(C)
    I2 = (I1**2 - jnp.trace(C @ C)) / 2
    second = (I1**2 - 2 * I2) * J ** (-4 / 3) - 3
    W = theta[0] / 4 * second - theta[1] / 2 * (I2 * J ** (-4 / 3) - 3)
    return W + theta[2] / 2 * (J - 1) ** 2


def ogden(theta):
    return lj.laws.Ogden(mu=tuple(theta[:2]), alpha=(4.0, -2.0), bulk=theta[2])


THETA = jnp.array([100.0, -200.0, 7000.0])


@cache
def gradients() -> jax.Array:
    """Return the deformation gradients of `CASES` between two rotations."""
    return jnp.stack([jnp.asarray(rotation() @ np.diag(s) @ rotation()) for s in CASES.values()])


#: The exact derivatives, which several tests need.
EXACT = {
    "stress": jax.grad(polynomial, 1),
    "tangent": jax.hessian(polynomial, 1),
    "third": jax.jacfwd(jax.hessian(polynomial, 1), 1),
    "stress by parameters": jax.jacfwd(jax.grad(polynomial, 1)),
    "tangent by parameters": jax.jacfwd(jax.hessian(polynomial, 1)),
}


@cache
def exact_of_cases(derivative: str) -> np.ndarray:
    return np.asarray(jax.jit(jax.vmap(EXACT[derivative], (None, 0)))(THETA, gradients()))


@pytest.mark.parametrize(
    ("what", "ours", "exact", "limit"),
    [
        ("stress", lambda t, F: ogden(t).first_piola(F), "stress", 1e-11),
        ("tangent", lambda t, F: ogden(t).tangent(F), "tangent", 1e-11),
        pytest.param(
            "stress by grad", jax.grad(lambda t, F: ogden(t).energy(F), 1), "stress", 1e-11, marks=pytest.mark.slow
        ),
        pytest.param(
            "tangent by jvp",
            jax.jacfwd(lambda t, F: ogden(t).first_piola(F), 1),
            "tangent",
            1e-11,
            marks=pytest.mark.slow,
        ),
        ("tangent by vjp", jax.jacrev(lambda t, F: ogden(t).first_piola(F), 1), "tangent", 1e-11),
        pytest.param(
            "third derivative",
            jax.jacfwd(lambda t, F: ogden(t).tangent(F), 1),
            "third",
            1e-9,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "third derivative, forward over reverse",
            jax.jacfwd(jax.jacrev(lambda t, F: ogden(t).first_piola(F), 1), 1),
            "third",
            1e-9,
            marks=pytest.mark.slow,
        ),
        (
            "stress by parameters",
            jax.jacfwd(lambda t, F: ogden(t).first_piola(F)),
            "stress by parameters",
            1e-11,
        ),
        pytest.param(
            "tangent by parameters",
            jax.jacrev(lambda t, F: ogden(t).tangent(F)),
            "tangent by parameters",
            1e-11,
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_derivatives_where_stretches_are_equal(what, ours, exact, limit):
    a, b = np.asarray(jax.jit(jax.vmap(ours, (None, 0)))(THETA, gradients())), exact_of_cases(exact)
    axes = tuple(range(1, a.ndim))
    assert np.isfinite(a).all()
    size = np.abs(b).max(axis=axes)
    # At rest some derivatives are zero. The median case gives the size of their terms.
    assert (np.abs(a - b).max(axis=axes) / np.maximum(size, np.median(size))).max() < limit


@pytest.mark.slow
def test_derivative_by_the_exponent_has_the_v_shape():
    # Central differences fall with h^2 and rise with eps/h. Their minimum is near eps^(2/3).
    F = gradients()

    def tangent(alpha):
        return lj.laws.Exponential(c1=385.0, c2=0.25, alpha=alpha, bulk=7700.0).tangent(F)

    run = jax.jit(tangent)
    exact = np.asarray(jax.jit(jax.jacfwd(tangent))(4.0))
    errors = [
        np.abs((np.asarray(run(4.0 + h)) - np.asarray(run(4.0 - h))) / (2 * h) - exact).max() / np.abs(exact).max()
        for h in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-10)
    ]
    assert errors[0] / errors[1] > 50
    assert min(errors) < 1e-9 < errors[-1]


@pytest.mark.slow
def test_derivatives_beyond_the_third_are_refused():
    law, F = LAWS["bogen"], jnp.eye(3)
    for function in (
        jax.jacfwd(jax.jacfwd(law.tangent)),
        jax.jacfwd(jax.jacrev(law.tangent)),
        jax.jacfwd(jax.jacfwd(jax.jacrev(law.first_piola))),
    ):
        with pytest.raises(NotImplementedError, match="third order"):
            function(F)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n in ("ogden", "bogen", "logarithmic") else []) for n in LAWS]
)
def test_single_precision(name):
    # float32 has a rounding error of 6e-8. The condition number of C = F^T F for these stretches is (3.0/0.2)^2.
    F = np.asarray(gradients())
    _, P, A = by_hand(LAWS[name], F)
    _, P32, A32 = by_hand(LAWS[name], F.astype(np.float32))
    assert P32.dtype == A32.dtype == jnp.float32
    size = np.abs(A).max(axis=(1, 2, 3, 4))
    assert (np.abs(P - np.asarray(P32)).max(axis=(1, 2)) / size).max() < 1e-4
    assert (np.abs(A - np.asarray(A32)).max(axis=(1, 2, 3, 4)) / size).max() < 1e-3


def test_principal_stretches_of_many_matrices():
    n = 100_000
    Q1, Q2 = (np.linalg.qr(RNG.standard_normal((n, 3, 3)))[0] for _ in range(2))
    F = Q1 @ (np.exp(RNG.uniform(-3, 1, (n, 3)))[:, :, None] * Q2)
    logs, axes = jax.jit(principal.principal)(unpack(jnp.asarray(F)))
    ours = np.sort(np.exp(np.stack(logs, axis=-1)), axis=-1)
    exact = np.sort(np.linalg.svd(F, compute_uv=False), axis=-1)
    # F N is rounded to eps |F|. Relative to the smallest stretch this is up to e^4 eps, times the 3 products of a sum.
    assert np.abs(ours / exact - 1).max() < 6 * np.exp(4) * np.finfo(float).eps
    N = np.stack([np.stack(row, axis=-1) for row in axes], axis=-2)
    assert np.abs(np.einsum("nki,nkj->nij", N, N) - np.eye(3)).max() < 30 * np.finfo(float).eps


def test_no_lapack_in_the_program():
    mesh, law = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1)), LAWS["ogden"]
    text = str(jax.make_jaxpr(partial(lj.mjed.element_matrices, mesh, law))(mesh.points))
    assert not any(word in text for word in ("eigh", "svd", "cholesky", "triangular"))
