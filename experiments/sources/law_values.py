"""Energies, stresses and moduli of every law with 50 digits, computed from the published energies alone.

``python -m experiments.sources.law_values`` writes tests/law_values.json, which tests/test_law_values.py compares the
laws with. No code of the laws is used. Energies are functions of F, computed with invariants, principal stretches or
Green's strain. All derivatives are numerical ones of mpmath. Needs mpmath: ``pip install '.[test]'``.
"""

import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import mpmath as mp

TABLE = Path(__file__).parents[2] / "tests" / "law_values.json"
DIGITS = 50

#: Deformation gradients: J = 1.22, 0.48, 1.26 and -0.53. None is symmetric, and the stretches of each differ.
GRADIENTS = {
    "stretched": [[1.2, 0.15, 0.3], [-0.1, 0.9, 0.2], [0.05, -0.12, 1.1]],
    "compressed": [[1.0, -0.4, 0.1], [0.3, 0.6, -0.25], [-0.15, 0.2, 0.6]],
    "large": [[1.7, 0.4, -0.2], [0.1, 0.8, 0.3], [-0.3, 0.2, 1.1]],
    "inverted": [[1.0, -0.4, 0.1], [0.3, 0.6, -0.25], [-0.15, 0.2, -0.8]],
}
POSITIVE = ("stretched", "compressed", "large")
#: The direction of second derivatives.
DIRECTION = [[0.3, -0.7, 0.2], [0.5, 0.4, -0.6], [-0.1, 0.8, 0.9]]

#: Laws with parameters that all differ from 0 and from each other. Several laws of a case are added.
CASES: dict[str, list[dict[str, Any]]] = {
    "neo_hookean": [dict(name="neo_hookean", mu=770.0, bulk=7700.0)],
    "neo_hookean_compressible": [dict(name="neo_hookean_compressible", mu=770.0, lame_lambda=3080.0)],
    "stable_neo_hookean": [dict(name="stable_neo_hookean", mu=770.0, lame_lambda=3080.0)],
    "saint_venant_kirchhoff": [dict(name="saint_venant_kirchhoff", mu=770.0, lame_lambda=3080.0)],
    "mooney_rivlin": [dict(name="mooney_rivlin", c10=300.0, c01=85.0, bulk=7700.0, volumetric="log")],
    "mooney_rivlin, third order": [
        dict(name="mooney_rivlin", c10=300.0, c01=85.0, c20=40.0, c11=-70.0, c02=110.0)
        | dict(c30=50.0, c21=30.0, c12=-20.0, c03=10.0, bulk=7700.0, volumetric="simo")
    ],
    "yeoh": [dict(name="yeoh", c1=385.0, c2=150.0, c3=40.0, bulk=7700.0, volumetric="log")],
    "arruda_boyce": [dict(name="arruda_boyce", mu=730.0, chain_length=1.3, bulk=7700.0, volumetric="simo")],
    "ogden": [dict(name="ogden", mu=[700.0, -40.0], alpha=[2.5, -3.7], bulk=7700.0, volumetric="log")],
    "bogen": [dict(name="bogen", mu=400.0, alpha=3.3, bulk=7700.0)],
    "logarithmic": [dict(name="logarithmic", c1=1925.0, c2=0.05, alpha=4.4, bulk=7700.0, volumetric="simo")],
    "exponential": [dict(name="exponential", c1=385.0, c2=0.25, alpha=-2.6, bulk=7700.0, volumetric="log")],
    "fung_demiray": [dict(name="fung_demiray", c1=770.0, c2=1.7, bulk=7700.0)],
    "veronda_westmann": [dict(name="veronda_westmann", c1=350.0, c2=2.2, bulk=7700.0, volumetric="simo")],
    "costa": [
        dict(name="costa", c=200.0, b_ff=3.1, b_ss=1.7, b_nn=1.3, b_fs=2.3, b_fn=1.9, b_sn=0.7, bulk=7700.0)
        | dict(fibre=[1.0, 0.3, -0.2], sheet=[0.2, 1.0, 0.5], volumetric="log")
    ],
    "mooney_rivlin, continued": [
        dict(name="mooney_rivlin", c10=300.0, c01=85.0, c11=60.0, bulk=7700.0, volumetric="log", continued_below=0.8)
    ],
    "neo_hookean_compressible, continued": [
        dict(name="neo_hookean_compressible", mu=770.0, lame_lambda=3080.0, continued_below=0.8)
    ],
    "sum": [
        dict(name="yeoh", c1=385.0, c2=150.0, c3=40.0, bulk=7700.0),
        dict(name="saint_venant_kirchhoff", mu=110.0, lame_lambda=330.0),
        dict(name="bogen", mu=400.0, alpha=3.3, bulk=700.0, volumetric="simo"),
    ],
}
#: Cases whose energy is finite for every F.
FINITE = (
    "stable_neo_hookean",
    "saint_venant_kirchhoff",
    "mooney_rivlin, continued",
    "neo_hookean_compressible, continued",
)


# -- kinematics -------------------------------------------------------------------------------------------------------


def invariants(F: mp.matrix) -> tuple:
    """Return I1 and I2 of C = F^T F, and J."""
    C = F.T * F
    I1 = trace(C)
    return I1, (I1**2 - trace(C * C)) / 2, mp.det(F)


def trace(A: mp.matrix) -> Any:
    """Return the sum of the diagonal."""
    return A[0, 0] + A[1, 1] + A[2, 2]


def power_sum(F: mp.matrix, J: Any, alpha: float) -> Any:
    """Return Xi(alpha) - 3, from the eigenvalues of C (squares of the principal stretches)."""
    squares = mp.eigsy(F.T * F, eigvals_only=True)
    return sum((v / J ** (mp.mpf(2) / 3)) ** (mp.mpf(alpha) / 2) for v in squares) - 3


def exponent_of_costa(law: dict, F: mp.matrix) -> Any:
    """Return the exponent Q of Costa's law.

    Green's strain E is resolved along the axes fibre, sheet (made orthogonal to the fibre) and normal.
    """
    f, s = (mp.matrix(law[k]) for k in ("fibre", "sheet"))
    s = s - (f.T * s)[0] / (f.T * f)[0] * f
    n = mp.matrix([f[1] * s[2] - f[2] * s[1], f[2] * s[0] - f[0] * s[2], f[0] * s[1] - f[1] * s[0]])
    axes = {name: v / mp.norm(v) for name, v in zip("fsn", (f, s, n), strict=True)}
    E = (F.T * F - mp.eye(3)) / 2
    strain = {a + b: (axes[a].T * E * axes[b])[0] for a in "fsn" for b in "fsn"}
    weight = {pair: law[f"b_{pair}"] for pair in ("ff", "ss", "nn", "fs", "fn", "sn")}
    return sum(mp.mpf(weight.get(p, weight.get(p[::-1]))) * strain[p] ** 2 for p in strain)


# -- energies ---------------------------------------------------------------------------------------------------------


def inverse_langevin(terms: int) -> list[Fraction]:
    """Return a_1, a_3, …: exact power series of the inverse of coth(y) - 1/y = sum_n 4^n B_2n / (2n)! y^(2n-1)."""
    numerators = [mp.bernfrac(2 * n) for n in range(1, terms + 1)]
    forward = [Fraction(4**n * p, q * int(mp.factorial(2 * n))) for n, (p, q) in enumerate(numerators, 1)]
    found: list[Fraction] = []
    for n in range(terms):  # the coefficient of x^(2n+1) in forward(found(x)) is 1 for n = 0, otherwise 0
        trial = [*found, Fraction(0)]
        power, total = trial, forward[0] * trial[n]
        square = product(trial, trial)
        for m in range(1, n + 1):  # the series of y^(2m+1) begins at x^(2m+1)
            power = product(power, square)
            total += forward[m] * power[n - m]
        found.append(((1 if n == 0 else 0) - total) / forward[0])
    return found


def product(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    """Return the product of two power series, cut at the length of the first."""
    return [sum((a[i] * b[n - i] for i in range(n + 1)), Fraction(0)) for n in range(len(a))]


def arruda_boyce(mu: Any, N: Any, I1: Any) -> Any:
    """Return mu N times the integral of the inverse Langevin function from rest to sqrt(I1 / (3 N)), with five
    terms.
    """
    a = inverse_langevin(5)
    terms = ((mp.mpf(c.numerator) / c.denominator / (2 * k), k) for k, c in enumerate(a, 1))
    return mu * N * sum(c * ((I1 / (3 * N)) ** k - (1 / mp.mpf(N)) ** k) for c, k in terms)


def volumetric(law: dict, J: Any) -> Any:
    """Return U(J). Below J = c it is the Taylor parabola of U at c."""
    kind, K, c = law.get("volumetric", "quadratic"), mp.mpf(law["bulk"]), mp.mpf(law.get("continued_below", "-inf"))
    U = {
        "quadratic": lambda J: K / 2 * (J - 1) ** 2,
        "log": lambda J: K / 2 * mp.log(J) ** 2,
        "simo": lambda J: K / 4 * (J**2 - 1 - 2 * mp.log(J)),
    }[kind]
    if c <= J:
        return U(J)
    value, slope, double = (mp.diff(U, c, n) for n in range(3))
    return value + slope * (J - c) + double / 2 * (J - c) ** 2


def whole_energy(law: dict, F: mp.matrix) -> Any:
    """Return the energy of laws that are not a sum of an isochoric and a volumetric energy."""
    (I1, _, J), mu, lam = invariants(F), mp.mpf(law["mu"]), mp.mpf(law["lame_lambda"])
    c = mp.mpf(law.get("continued_below", "-inf"))
    match law["name"]:
        case "neo_hookean_compressible":
            J = J if c <= J else c**2 / (2 * c - J)
            return mu / 2 * (I1 - 3) - mu * mp.log(J) + lam / 2 * mp.log(J) ** 2
        case "stable_neo_hookean":  # Smith, De Goes and Kim 2018, eq. 14, 3.4
            m, lam = 4 * mu / 3, lam + 5 * mu / 6
            a = 1 + m / lam - m / (4 * lam)
            energy = lambda I1, J: m / 2 * (I1 - 3) + lam / 2 * (J - a) ** 2 - m / 2 * mp.log(I1 + 1)  # noqa: E731
            return energy(I1, J) - energy(3, 1)
        case "saint_venant_kirchhoff":
            E = (F.T * F - mp.eye(3)) / 2
            return lam / 2 * trace(E) ** 2 + mu * trace(E * E)
    raise KeyError(law["name"])


def isochoric_energy(law: dict, F: mp.matrix, J: Any) -> Any:
    """Return the isochoric energy of a law that has a separate volumetric energy."""
    I1, I2, _ = invariants(F)
    a, b = I1 / J ** (mp.mpf(2) / 3) - 3, I2 / J ** (mp.mpf(4) / 3) - 3
    p = {key: mp.mpf(v) for key, v in law.items() if isinstance(v, float)}
    match law["name"]:
        case "neo_hookean":
            return p["mu"] / 2 * a
        case "mooney_rivlin":
            return sum(v * a ** int(k[1]) * b ** int(k[2]) for k, v in p.items() if k[0] == "c" and len(k) == 3)
        case "yeoh":
            return p["c1"] * a + p["c2"] * a**2 + p["c3"] * a**3
        case "arruda_boyce":
            return arruda_boyce(p["mu"], p["chain_length"], a + 3)
        case "ogden":
            pairs = zip(law["mu"], law["alpha"], strict=True)
            return sum(mp.mpf(m) / mp.mpf(alpha) * power_sum(F, J, alpha) for m, alpha in pairs)
        case "bogen":
            return p["mu"] / p["alpha"] * power_sum(F, J, p["alpha"])
        case "logarithmic":
            return -p["c1"] * mp.log(1 - p["c2"] * power_sum(F, J, p["alpha"]))
        case "exponential":
            return p["c1"] * (mp.exp(p["c2"] * power_sum(F, J, p["alpha"])) - 1)
        case "fung_demiray":
            return p["c1"] / (2 * p["c2"]) * (mp.exp(p["c2"] * a) - 1)
        case "veronda_westmann":
            return p["c1"] * (mp.exp(p["c2"] * a) - 1) - p["c1"] * p["c2"] / 2 * b
        case "costa":  # not isochoric
            return p["c"] / 2 * (mp.exp(exponent_of_costa(law, F)) - 1)
    raise KeyError(law["name"])


def energy(laws: list[dict], F: mp.matrix) -> Any:
    """Return the strain energy density [Pa]. Below J = c, an isochoric energy is evaluated with c^2 / (2 c - J)
    for J.
    """
    total = mp.mpf(0)
    for law in laws:
        if "bulk" not in law:
            total += whole_energy(law, F)
            continue
        J, c = mp.det(F), mp.mpf(law.get("continued_below", "-inf"))
        total += isochoric_energy(law, F, J if c <= J else c**2 / (2 * c - J)) + volumetric(law, J)
    return total


# -- derivatives ------------------------------------------------------------------------------------------------------


def derivative(laws: list[dict], F: mp.matrix, H: mp.matrix, order: int) -> Any:
    """Return the derivative of the energy of this order at F in the direction H."""
    return mp.diff(lambda t: energy(laws, F + t * H), 0, order)


def unit(i: int, j: int) -> mp.matrix:
    """Return e_i (x) e_j."""
    E = mp.zeros(3)
    E[i, j] = mp.mpf(1)
    return E


def at_gradient(laws: list[dict], F: list[list[float]]) -> dict[str, Any]:
    """Return energy [Pa], first Piola stress [Pa] and the second derivative in `DIRECTION` [Pa], as floats."""
    A = mp.matrix(F)
    return {
        "energy": float(energy(laws, A)),
        "first_piola": [[float(derivative(laws, A, unit(i, j), 1)) for j in range(3)] for i in range(3)],
        "curvature": float(derivative(laws, A, mp.matrix(DIRECTION), 2)),
    }


def at_rest(laws: list[dict]) -> dict[str, float]:
    """Return the ground-state shear and bulk modulus [Pa]: Voigt averages over all directions."""
    second: Callable[[mp.matrix], Any] = lambda H: derivative(laws, mp.eye(3), H, 2)  # noqa: E731
    every = sum(second((unit(i, j) + unit(j, i)) / 2) for i in range(3) for j in range(3))
    spherical = second(mp.eye(3))
    return {"shear_modulus": float((3 * every - spherical) / 30), "bulk_modulus": float(spherical / 9)}


def values(name: str) -> dict[str, Any]:
    """Return all numbers of a case."""
    gradients = GRADIENTS if name in FINITE else POSITIVE
    with mp.workdps(DIGITS):
        at = {g: at_gradient(CASES[name], GRADIENTS[g]) for g in gradients}
        return {"laws": CASES[name], **at_rest(CASES[name]), "at": at}


def text(value: Any, indent: str = "") -> str:
    """Return JSON of nested dictionaries, with one entry per line."""
    if not isinstance(value, dict):
        return json.dumps(value)
    rows = ",\n".join(f"{indent} {json.dumps(key)}: {text(v, indent + ' ')}" for key, v in value.items())
    return f"{{\n{rows}\n{indent}}}"


def main() -> None:
    """Write the table."""
    table = {"gradients": GRADIENTS, "direction": DIRECTION, "cases": {name: values(name) for name in CASES}}
    TABLE.write_text(text(table) + "\n")


if __name__ == "__main__":
    main()
