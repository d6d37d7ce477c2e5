"""Every law compared with independent numbers: law_values.json, computed with 50 digits (`experiments/sources`).

Other tests compare an energy with its own derivatives. These tests also detect an energy that is wrong together with
its derivatives.
"""

import json
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT

import liverjax as lj
from liverjax.laws.terms import chapter_terms, products
from liverjax.tensors.matrices import pack, unpack

pytestmark = pytest.mark.quick_to_compile

TABLE = json.loads((ROOT / "tests" / "law_values.json").read_text())
CASES = TABLE["cases"]
DIRECTION = np.array(TABLE["direction"])

#: Bound of rounding. A value takes at most 200 roundings of 1.1e-16. They are magnified at these gradients: a
#: difference such as Ibar1 - 3 by Ibar1/(Ibar1 - 3) <= 18, a squared J - 1 by 11, an exponential by its exponent 10; in
#: total by at most 40. 200 x 1.1e-16 x 40 = 9e-13. (Found: 5e-15.)
TOLERANCE = 1e-12


def made(case: dict) -> lj.Law:
    """Return the law of a case, as from the tables of a scene file."""
    parts = []
    for table in case["laws"]:
        below = table.get("continued_below")
        law = lj.laws.create(**{k: v for k, v in table.items() if k != "continued_below"})
        parts.append(law if below is None else lj.laws.continued(law, below))
    return sum(parts)


def is_product(law: lj.Law) -> bool:
    """Return whether the law has the chapter's product form."""
    try:
        return all(products.groups(part) is not None for part in lj.laws.summands(law))
    except lj.InputError:
        return False


LAWS = {name: made(case) for name, case in CASES.items()}
PRODUCTS = [name for name, law in LAWS.items() if is_product(law)]


def gradients(case: dict) -> jnp.ndarray:
    return jnp.asarray([TABLE["gradients"][name] for name in case["at"]])


def column(case: dict, quantity: str) -> np.ndarray:
    return np.array([row[quantity] for row in case["at"].values()])


def compare(case: dict, P: jnp.ndarray, curvature: jnp.ndarray) -> None:
    """Compare first Piola stresses relative to their largest entry, and second derivatives relative to themselves."""
    exact = column(case, "first_piola")
    error = np.abs(np.asarray(P) - exact).max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2))
    assert error.max() < TOLERANCE
    np.testing.assert_allclose(curvature, column(case, "curvature"), rtol=TOLERANCE)


def test_every_law_is_in_the_table_with_each_of_its_parameters():
    rows = [table for case in CASES.values() for table in case["laws"]]
    assert {row["name"] for row in rows} == set(lj.laws.LAWS)
    for name, law in lj.laws.LAWS.items():
        given = {key for row in rows if row["name"] == name for key in row}
        assert {field.name for field in lj.laws.parameters(law)} <= given, name
    assert {row.get("volumetric") for row in rows if "bulk" in row} >= {None, "log", "simo"}


@pytest.mark.parametrize("name", CASES)
def test_energies(name):
    W = LAWS[name].energy(gradients(CASES[name]))
    np.testing.assert_allclose(W, column(CASES[name], "energy"), rtol=TOLERANCE)


@pytest.mark.parametrize("name", CASES)
def test_stresses_and_second_derivatives(name):
    law, F = LAWS[name], gradients(CASES[name])
    curvature = jnp.einsum("iJ,niJkL,kL->n", DIRECTION, law.tangent(F), DIRECTION)
    compare(CASES[name], law.first_piola(F), curvature)


@pytest.mark.parametrize("name", PRODUCTS)
def test_the_chapters_products(name):
    law, F = LAWS[name], unpack(gradients(CASES[name]))
    axes = [tuple(jnp.full_like(F[0][0], float(i == j)) for j in range(3)) for i in range(3)]
    pairs = tuple((i, j) for i in range(3) for j in range(3))
    blocks = [pack(block) for block in chapter_terms.blocks(law, F, axes, pairs)]
    curvature = sum(
        jnp.einsum("i,nij,j->n", DIRECTION[:, a], block, DIRECTION[:, b])
        for (a, b), block in zip(pairs, blocks, strict=True)
    )
    compare(CASES[name], pack(chapter_terms.first_piola(law, F)), curvature)


def test_the_chapters_products_are_of_these_laws():
    assert set(PRODUCTS) == {
        "neo_hookean",
        "neo_hookean_compressible",
        "saint_venant_kirchhoff",
        "mooney_rivlin",
        "mooney_rivlin, third order",
        "yeoh",
        "arruda_boyce",
        "fung_demiray",
        "veronda_westmann",
    }


@pytest.mark.parametrize("name", CASES)
def test_ground_state_moduli(name):
    law = LAWS[name]
    for modulus in ("shear_modulus", "bulk_modulus"):
        assert np.isclose(getattr(law, modulus)(), CASES[name][modulus], rtol=TOLERANCE), modulus


#: Formulas of the literature, to check the program that makes the table.
KNOWN_MODULI = {
    "neo_hookean": 770.0,
    "mooney_rivlin": 2 * (300 + 85),
    "yeoh": 2 * 385.0,
    "arruda_boyce": 730 * (1 + 3 / (5 * 1.3) + 99 / (175 * 1.3**2) + 513 / (875 * 1.3**3) + 42039 / (67375 * 1.3**4)),
    "ogden": (700 * 2.5 + 40 * 3.7) / 2,
    "bogen": 400 * 3.3 / 2,
    "logarithmic": 1925 * 0.05 * 4.4**2 / 2,
    "exponential": 385 * 0.25 * 2.6**2 / 2,
    "fung_demiray": 770.0,
    "veronda_westmann": 350 * 2.2,
}


@pytest.mark.parametrize("name", KNOWN_MODULI)
def test_the_table_has_the_known_moduli(name):
    assert np.isclose(CASES[name]["shear_modulus"], KNOWN_MODULI[name], rtol=TOLERANCE)


@pytest.mark.parametrize("name", ["neo_hookean", "arruda_boyce", "logarithmic"])
def test_the_table_is_what_its_program_computes(name):
    pytest.importorskip("mpmath")
    sys.path.insert(0, str(ROOT))
    from experiments.sources import law_values

    assert law_values.CASES.keys() == CASES.keys()
    assert law_values.values(name) == CASES[name]
