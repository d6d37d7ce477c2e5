"""MJED on meshes against automatic differentiation, standard finite elements and FEBio."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.elements import mjed, reference
from liverjax.laws.terms import chapter_terms, invariant_terms
from liverjax.tensors import matrices
from liverjax.tensors.matrices import deformation_gradient, stored

pytestmark = pytest.mark.quick_to_compile

LAWS = list(lj.laws.LAWS)


#: One law of each kind by default; Green's strain is in tests/test_fibres.py. The others differ in scalars that
#: tests/test_laws.py checks. They run with -m slow, apart from stretch-based laws, of which one stands for all.
KINDS = ("neo_hookean", "mooney_rivlin", "saint_venant_kirchhoff")
OTHERS = [n for n in LAWS if n not in (*KINDS, "ogden", "logarithmic", "exponential")]


@pytest.mark.ci
@pytest.mark.parametrize("name", [*KINDS, *(pytest.param(n, marks=pytest.mark.slow) for n in OTHERS)])
def test_force_and_stiffness_against_both_references(name, distorted_box):
    mesh, x = distorted_box
    law = lj.laws.typical(name)
    f, K = mjed.internal_force(mesh, law, x), mjed.stiffness_matrix(mesh, law, x)
    scale_f, scale_K = np.abs(f).max(), np.abs(K).max()
    for force in (reference.internal_force, reference.standard_internal_force):
        assert np.abs(force(mesh, law, x) - f).max() < 1e-11 * scale_f
    for stiffness in (reference.stiffness_matrix, reference.standard_stiffness_matrix):
        assert np.abs(stiffness(mesh, law, x) - K).max() < 1e-11 * scale_K
    assert np.abs(K - K.T).max() < 1e-13 * scale_K
    assert np.isclose(mjed.energy(mesh, law, x), reference.energy(mesh, law, x), rtol=1e-13)


@pytest.mark.parametrize("name", LAWS)
def test_rigid_motion_makes_no_force(name):
    mesh, law = lj.shapes.box((1.0, 1.0, 1.0), (2, 2, 2)), lj.laws.typical(name)
    Q = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))[0]
    Q *= np.sign(np.linalg.det(Q))
    x = np.asarray(mesh.points) @ Q.T + np.array([3.0, -1.0, 2.0])
    # Rounding of the positions (4 m) over the cell (0.5 m), times stress scale K and face area 0.25 m^2, 24 faces.
    limit = 24 * 0.25 * 4 / 0.5 * np.finfo(float).eps * (law.bulk_modulus() + law.shear_modulus())
    assert np.abs(mjed.internal_force(mesh, law, x)).max() < limit


def test_regularised_stiffness_keeps_the_trace(distorted_box):
    mesh, _ = distorted_box
    law, x = lj.laws.typical("neo_hookean"), mesh.points * jnp.array([[0.7, 0.9, 0.8]])
    plain = mjed.element_matrices(mesh, law, x)
    changed = mjed.element_matrices(mesh, law, x, regularised=True)
    diagonal = np.arange(0, 144, 13)
    assert np.allclose(plain[:, diagonal].sum(axis=1), changed[:, diagonal].sum(axis=1), rtol=1e-12)
    assert np.abs(plain - changed).max() > 1e-2 * np.abs(plain).max()


NO_PRODUCTS = ("stable_neo_hookean", "ogden", "bogen", "logarithmic", "exponential", "costa")
#: Functions of a sum: regularisation of each term differs from that of the sum.
FUNCTIONS = ("fung_demiray", "veronda_westmann")


@pytest.mark.parametrize("name", [n for n in LAWS if n not in NO_PRODUCTS])
def test_six_terms_of_the_chapter_are_the_same(name, distorted_box):
    mesh, x = distorted_box
    law, F = lj.laws.typical(name), deformation_gradient(mesh, x)
    D = [tuple(mesh.shape_vectors[a]) for a in range(2)]
    for regularised in (False,) if name in FUNCTIONS else (False, True):
        contracted = invariant_terms.blocks(invariant_terms.state(law, F), D, ((0, 1), (1, 1)), regularised)
        six = chapter_terms.blocks(law, F, D, ((0, 1), (1, 1)), regularised)
        for a, b in zip(contracted, six, strict=True):
            a, b = np.asarray(matrices.pack(a)), np.asarray(matrices.pack(b))
            assert np.abs(a - b).max() < 1e-12 * np.abs(a).max()
    P, P_six = (np.asarray(matrices.pack(t.first_piola(law, F))) for t in (invariant_terms, chapter_terms))
    assert np.abs(P - P_six).max() < 1e-12 * np.abs(P).max()


def test_stiffness_matrix_in_the_chapters_form(distorted_box):
    mesh, x = distorted_box
    law = lj.laws.typical("neo_hookean")
    K = mjed.stiffness_matrix(mesh, law, x)
    assert np.abs(mjed.stiffness_matrix(mesh, law, x, terms="chapter") - K).max() < 1e-12 * np.abs(K).max()


def test_a_law_that_is_no_product_is_refused_in_the_chapters_form(distorted_box):
    mesh, x = distorted_box
    with pytest.raises(lj.InputError, match="Ogden is not a sum of products"):
        mjed.stiffness_matrix(mesh, lj.laws.typical("ogden"), x, terms="chapter")
    with pytest.raises(lj.InputError, match="use contracted or chapter"):
        mjed.stiffness_matrix(mesh, lj.laws.typical("yeoh"), x, terms="six")


@pytest.mark.parametrize("value", [-np.inf, np.inf, np.nan, -1.0])
def test_what_is_stored_is_the_same(value):
    values = {"a": jnp.array([value, 2.0]), "b": 3.0}
    same = jax.tree.map(lambda a, b: np.array_equal(a, b, equal_nan=True), values, jax.jit(stored)(values))
    assert all(same.values())


def test_positions_of_another_shape_are_refused(distorted_box):
    mesh, x = distorted_box
    for wrong in (x[1:], x.T):
        with pytest.raises(lj.InputError, match="positions have shape"):
            mjed.internal_force(mesh, lj.laws.typical("yeoh"), wrong)


#: FEBio's energies (README of its results): lambda = 3080, mu = 770, k = 7700, U = k/2 ln^2 J.
FEBIO_LAWS = {
    "neo-Hookean": lj.laws.NeoHookeanCompressible(mu=770.0, lame_lambda=3080.0),
    "StVenantKirchhoff": lj.laws.SaintVenantKirchhoff(mu=770.0, lame_lambda=3080.0),
    "Mooney-Rivlin": lj.laws.MooneyRivlin(c10=300.0, c01=85.0, bulk=7700.0, volumetric="log"),
    "Veronda-Westmann": lj.laws.VerondaWestmann(c1=350.0, c2=2.2, bulk=7700.0, volumetric="log"),
}


def test_cauchy_stress_against_febio(febio, verified):
    cases = [m for m in json.loads((febio / "stress_at_F.json").read_text()) if m["material"] in FEBIO_LAWS]
    assert len(cases) == 20
    worst = 0.0
    for case in cases:
        law = FEBIO_LAWS[case["material"]]
        F, theirs = jnp.asarray(case["F"]), np.asarray(case["sigma"])
        ours = law.first_piola(F) @ F.T / jnp.linalg.det(F)
        worst = max(worst, float(np.abs(ours - theirs).max() / law.bulk_modulus()))
        assert np.isclose(law.energy(F), case["W"], rtol=1e-11)
    verified("Cauchy stress of four laws at five F, over the bulk modulus", "FEBio", worst, 1e-11)
    assert worst < 1e-11


@pytest.mark.parametrize("name", ["neo-Hookean", "Mooney-Rivlin", "Veronda-Westmann"])
def test_febio_solution_is_in_equilibrium_here(febio, name, verified):
    points = np.loadtxt(febio / "cube3_nodes.csv", delimiter=",")
    tets = np.loadtxt(febio / "cube3_tets.csv", delimiter=",", dtype=int)
    rows = np.loadtxt(febio / f"a_{name}_nodes.csv", delimiter=",")
    mesh = lj.tet_mesh(points, tets)
    f = np.asarray(mjed.internal_force(mesh, FEBIO_LAWS[name], jnp.asarray(points + rows[:, 1:4])))
    # The internal force equals the support's force on the body at fixed nodes, and is zero elsewhere.
    off = np.abs(f - rows[:, 4:7]).max() / np.abs(rows[:, 4:7]).max()
    verified(f"forces in FEBio's solution of a cube, {name}", "FEBio, same mesh", off, 1e-9)
    assert off < 1e-9
