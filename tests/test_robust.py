"""Inverted, flat and crushed elements: finite energies, positive stiffness, and minima that are found."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax import laws
from liverjax.core import status
from liverjax.core.struct import param, replace, static, struct
from liverjax.elements import projection
from liverjax.laws.base import Volumetric
from liverjax.laws.terms import invariant_terms
from liverjax.mesh import shapes
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation import equations, tangent
from liverjax.solvers.block_matrix import flat
from liverjax.tensors.matrices import pack, unpack

pytestmark = pytest.mark.quick_to_compile

EPS = np.finfo(float).eps
AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
ALL = tuple((i, j) for i in range(3) for j in range(3))


@pytest.fixture(scope="module")
def gradients():
    """Return deformation gradients: random, half of them inverted; zero, flat, a line, rest and its mirror image."""
    rng = np.random.default_rng(0)
    special = [np.zeros((3, 3)), np.diag([1.0, 1, 0]), np.diag([1.0, 0, 0]), np.eye(3), -np.eye(3)]
    return jnp.asarray(np.concatenate([special, rng.standard_normal((60, 3, 3))]))


def matrix(blocks, n: int) -> np.ndarray:
    """Return the matrices (n, 9, 9) of the blocks of the unit vectors."""
    A = np.zeros((n, 9, 9))
    for (i, j), block in zip(ALL, blocks, strict=True):
        for r in range(3):
            for c in range(3):
                A[:, 3 * i + r, 3 * j + c] = block[r][c]
    return A


def test_frame_takes_every_gradient_apart(gradients):
    U, s, V = projection.frame(unpack(gradients))
    U, V, s = pack(U), pack(V), jnp.stack(s, axis=-1)
    assert np.abs(U * s[:, None, :] @ jnp.swapaxes(V, 1, 2) - gradients).max() < 50 * EPS
    for R in (U, V):
        assert np.abs(R @ jnp.swapaxes(R, 1, 2) - jnp.eye(3)[None]).max() < 20 * EPS
        assert np.allclose(np.linalg.det(R), 1)
    assert (np.asarray(s[:, 0] >= s[:, 1]) & np.asarray(s[:, 1] >= abs(s[:, 2]))).all()


@pytest.mark.parametrize("name", ["neo_hookean", "mooney_rivlin", "saint_venant_kirchhoff", "stable_neo_hookean"])
def test_projection_is_the_absolute_value_of_the_eigenvalues(gradients, name):
    law = laws.typical(name)
    if name in ("neo_hookean", "mooney_rivlin"):
        law = laws.continued(law, 0.3)
    F = unpack(gradients)
    A = matrix(invariant_terms.blocks(invariant_terms.state(law, F), AXES, ALL), len(gradients))
    found = matrix(projection.blocks([(1.0, law)], None, F, AXES, ALL), len(gradients))
    values, vectors = np.linalg.eigh(A)
    assert (values < 0).any()
    exact = np.einsum("nij,nj,nkj->nik", vectors, abs(values), vectors)
    # LAPACK and this code: n eps |A| each, about ten operations per entry.
    assert np.abs(found - exact).max() < 100 * EPS * np.abs(A).max()


def test_projection_of_stretches(gradients):
    law = laws.typical("ogden")
    F = jnp.eye(3)[None] + 0.15 * gradients
    F = F[np.asarray(jnp.linalg.det(F)) > 0.1]
    A = matrix(invariant_terms.blocks(invariant_terms.state(law, unpack(F)), AXES, ALL), len(F))
    found = matrix(projection.blocks([(1.0, law)], None, unpack(F), AXES, ALL), len(F))
    values, vectors = np.linalg.eigh(A)
    exact = np.einsum("nij,nj,nkj->nik", vectors, abs(values), vectors)
    assert np.abs(found - exact).max() < 1e3 * EPS * np.abs(A).max()


@pytest.mark.parametrize("name", ["costa", "fibre"])
def test_projection_of_other_axes_is_positive_and_exact_where_nothing_is_negative(gradients, name):
    fibre = dict(fibre=jnp.array([1.0, 0.2, 0.1]))

    @lj.struct
    class Fibre(lj.Law):
        k: object = lj.param("Pa", "stiffness")
        fibre: object = lj.param("1", "direction")
        invariants = ("I4",)

        def strain_energy(self, I):
            """Return an energy quadratic in the strain of the fibre."""
            return self.k * (I.I4 - 1) ** 2

    law = laws.typical("costa") if name == "costa" else laws.typical("stable_neo_hookean") + Fibre(k=200.0, **fibre)
    F = jnp.eye(3)[None] + 0.3 * gradients
    A = matrix(projection.blocks([(1.0, law)], None, unpack(F), AXES, ALL), len(F))
    assert (np.linalg.eigvalsh(A)[:, 0] > -100 * EPS * np.abs(A).max(axis=(1, 2))).all()
    rest = jnp.eye(3)[None]
    exact = matrix(invariant_terms.blocks(invariant_terms.state(law, unpack(rest)), AXES, ALL), 1)
    found = matrix(projection.blocks([(1.0, law)], None, unpack(rest), AXES, ALL), 1)
    assert np.abs(found - exact).max() < 100 * EPS * np.abs(exact).max()


@pytest.mark.parametrize(
    "law",
    [
        laws.NeoHookean(mu=700.0, bulk=2000.0, volumetric="log"),
        laws.NeoHookeanCompressible(mu=700.0, lame_lambda=3000.0),
        laws.MooneyRivlin(c10=300.0, c01=50.0, bulk=2000.0) + laws.NeoHookean(mu=10.0, bulk=None),
    ],
    ids=["isochoric and volumetric", "in one", "sum"],
)
def test_a_continued_law_is_finite_and_smooth(gradients, law):
    c = 0.3
    longer = laws.continued(law, c)
    P, A = longer.first_piola(gradients), longer.tangent(gradients)
    exact = jax.vmap(jax.grad(longer.energy))(gradients)
    assert np.isfinite(P).all() and np.isfinite(A).all()
    assert np.abs(P - exact).max() < 1e3 * EPS * np.abs(P).max()
    curved = jax.vmap(jax.jacfwd(jax.grad(longer.energy)))(gradients)
    assert np.abs(A - curved).max() < 1e4 * EPS * np.abs(A).max()
    above = np.asarray(jnp.linalg.det(gradients)) > c
    assert above.any() and np.array_equal(P[above], law.first_piola(gradients)[above])
    # Value and derivative at J = c: the differences fall with the step.
    for h in (1e-4, 1e-6):
        J = jnp.array([c - h, c + h])[:, None, None]
        F = J ** (1 / 3) * jnp.eye(3)[None]
        (below, over), (P_below, P_over) = longer.energy(F), longer.first_piola(F)
        scale = np.abs(P_over).max()
        assert abs(over - below) < 10 * h * scale and np.abs(P_over - P_below).max() < 100 * h * scale


def test_a_volumetric_energy_is_continued_once(gradients):
    """A law with only a volumetric energy U(J), and a law that cannot be split, had U(J) twice."""

    @struct
    class Whole(laws.Law):
        bulk: float = param("Pa", typical=2000.0)
        volumetric: str = static("quadratic")
        invariants = ("I1", "J")

        def strain_energy(self, I):
            return 350.0 * (I.J ** (-2 / 3) * I.I1 - 3) + 0.5 * self.bulk * (I.J - 1) ** 2

    one = laws.continued(laws.NeoHookean(mu=700.0, bulk=2000.0), 0.3)
    two = laws.continued(laws.NeoHookean(mu=700.0, bulk=None) + Volumetric(bulk=2000.0), 0.3)
    assert np.allclose(two.energy(gradients), one.energy(gradients), rtol=1e-12)
    above = gradients[np.asarray(jnp.linalg.det(gradients)) > 0.3]
    whole = Whole(bulk=2000.0)
    assert np.allclose(laws.continued(whole, 0.3).energy(above), whole.energy(above), rtol=1e-12)


def test_a_scene_file_continues_its_law_and_keeps_its_names():
    content = {
        "mesh": {"shape": "box", "size": [1.0, 1.0, 1.0], "cells": [1, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 700.0, "bulk": 2000.0, "continued_below": 0.2},
        "fixed": [{"where": {"z_max": 0.0}}],
    }
    scene = lj.with_parameters(scene_from(content), {"law.mu": 800.0})
    assert scene.law.shear_modulus() == 800.0 and scene.law.below == 0.2 and scene.law.bulk_modulus() == 2000.0
    assert np.isfinite(scene.law.energy(-jnp.eye(3)))
    content["law"]["continued_below"] = -1
    with pytest.raises(lj.InputError, match="continued_below = -1 must lie between 0 and 1"):
        scene_from(content)


def test_continuation_is_refused_where_it_means_nothing():
    for law, sentence in ((laws.typical("ogden"), "principal stretches"), (laws.typical("costa"), "Green's strain")):
        with pytest.raises(lj.InputError, match=sentence):
            laws.continued(law, 0.1)
    with pytest.raises(lj.InputError, match="between 0 and 1"):
        laws.continued(laws.typical("yeoh"), 1.5)


# -- energies and minima ---------------------------------------------------------------------------------------------

MESH = shapes.box((0.1, 0.1, 0.1), (3, 3, 3))
TOP, BOTTOM = (np.flatnonzero(np.asarray(MESH.points)[:, 2] == z) for z in (MESH.points[:, 2].max(), 0.0))
PRONY = lj.Prony(ratios=jnp.array([0.2, 0.3]), relaxation_times=jnp.array([0.3, 0.03]))
SPONGE = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-5)
HANGING = lj.Scene(
    mesh=MESH,
    law=laws.NeoHookean(mu=770.0, bulk=2200.0),
    body=lj.Body(density=1060.0, gravity=jnp.array([0.0, 0.0, -2.0])),
    fixed=(lj.Fixed(nodes=TOP),),
    solve=lj.Solve(kind="dynamic", dt=0.05, steps=3),
)
SCENES = {
    "static": replace(HANGING, solve=lj.Solve(steps=3)),
    "dynamic": HANGING,
    "newmark": replace(HANGING, solve=replace(HANGING.solve, integrator="newmark")),
    "viscous": replace(HANGING, viscosity=PRONY),
    "isochoric, chapter": replace(HANGING, viscosity=replace(PRONY, part="isochoric", scheme="chapter")),
    "porous": replace(HANGING, porosity=SPONGE),
    "complete, chapter": replace(HANGING, porosity=replace(SPONGE, scheme="chapter"), viscosity=PRONY),
    "nodal": replace(HANGING, solve=replace(HANGING.solve, volumetric="nodal")),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if "chapter" in name else name for name in SCENES]
)
def test_the_residual_is_the_gradient_of_the_energy(name):
    scene = SCENES[name]
    rng = np.random.default_rng(0)
    shaken = [MESH.points + 0.003 * rng.standard_normal(MESH.points.shape) for _ in range(2)]
    begin = equations.initial_state(scene)
    # Any state can be used, so no step is run: every array is slightly changed from rest.
    state = jax.tree.map(lambda a: a + 0.01 * (1 + abs(a)) * rng.standard_normal(a.shape), begin)._replace(x=shaken[0])

    @jax.jit
    def both(scene, state, x):
        e = equations.equations(scene, state, 2.0)
        q = q0 = flat(e.free.vectors(x))
        return equations.residual(e, q, 1.0)[0], jax.grad(lambda q: equations.energy(e, q, q0))(q)

    r, slope = both(scene, state, shaken[1])
    # The porous energy contains an iterative solve to a hundredth of the scene's tolerance.
    bound = 1e-8 if scene.porosity is not None and scene.porosity.scheme == "implicit" else 1e-12
    assert np.linalg.norm(r - slope) < bound * np.linalg.norm(r)


def inverted_start(part: float, seed: int) -> jax.Array:
    """Return positions in which about this fraction of the elements is inverted."""
    noise = np.random.default_rng(seed).standard_normal(MESH.points.shape)
    low, high = 0.0, 0.3
    for _ in range(30):
        middle = 0.5 * (low + high)
        J = lj.tet_mesh(MESH.points + middle * noise, MESH.tetrahedra).volumes / MESH.volumes
        low, high = (middle, high) if np.mean(np.asarray(J) < 0) < part else (low, middle)
    return MESH.points + high * noise


STARTS = {"finite everywhere": laws.typical("stable_neo_hookean"), "not finite": laws.NeoHookean(mu=770.0, bulk=7000.0)}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(STARTS))
def test_from_inverted_starts_the_energy_falls_to_the_minimum(name):
    """In motion the solver must use the starting point. In one very long step, inertia has no effect."""
    scene = replace(HANGING, law=STARTS[name], solve=lj.Solve(kind="dynamic", dt=1e4, robust="projected"))
    run = jax.jit(lambda start: lj.simulate(scene, start=start))
    rest = run(MESH.points).check()
    for seed in (1, 2, 3):
        result = run(inverted_start(0.2, seed)).check()
        assert int(result.statistics.iterations[0]) <= 30
        # Newton stops at a residual of 1e-8 of the forces. Displacements have the size of the body's strain.
        assert np.abs(np.asarray(result.positions - rest.positions)).max() < 1e-6 * 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", STARTS)
def test_at_rest_every_start_leads_to_the_same_equilibrium(name):
    """Here a starting point is only a guess. If it is nearly flat, half inverted or crushed, the reference shape
    replaces it.
    """
    still = replace(HANGING, law=STARTS[name], solve=lj.Solve(robust="projected"))
    run = jax.jit(lambda start: lj.simulate(still, start=start))
    rest = run(MESH.points).check()
    crushed = MESH.points * jnp.array([[1.0, 1.0, 0.05]])
    for start in (*(inverted_start(part, seed) for part in (0.01, 0.2, 0.5) for seed in (1, 2, 3)), crushed):
        result = run(start).check()
        assert int(result.statistics.iterations[0]) <= 60
        assert np.abs(np.asarray(result.positions - rest.positions)).max() < 1e-6 * 0.1


@pytest.mark.slow
def test_without_it_the_code_tells():
    result = lj.simulate(replace(HANGING, solve=lj.Solve()), start=inverted_start(0.2, 1))
    assert int(result.status[0]) != status.CONVERGED
    with pytest.raises(RuntimeError, match="step 1: "):
        result.check()


@pytest.mark.slow
def test_equilibrium_with_inverted_elements_is_no_success():
    """The body is pushed through its own support. A quadratic law has an equilibrium there, but a real body has not."""
    law = laws.StableNeoHookean(mu=770.0, lame_lambda=1000.0)
    through = lj.Displaced(nodes=BOTTOM, by=jnp.array([0.0, 0.0, 0.25]))
    scene = replace(HANGING, law=law, body=None, displaced=(through,), solve=lj.Solve(steps=4, robust="projected"))
    assert int(lj.simulate(scene).status[-1]) == status.INVERTED
    assert "inverted" in status.advice(status.INVERTED)


@pytest.mark.slow
def test_gradients_use_the_true_tangent():
    law = laws.typical("stable_neo_hookean")
    start = inverted_start(0.2, 2)

    @jax.jit
    @jax.value_and_grad
    def tip(g):
        scene = replace(HANGING, law=law, body=replace(HANGING.body, gravity=jnp.array([0.0, 0.0, 1.0]) * g))
        solve = lj.Solve(robust="projected", tolerance=1e-11)
        return lj.simulate(replace(scene, solve=solve), start=start).positions[-1, BOTTOM[0], 2]

    h = 1e-3
    difference = (tip(-2.0 + h)[0] - tip(-2.0 - h)[0]) / (2 * h)
    value, slope = tip(-2.0)
    assert np.isclose(slope, difference, rtol=1e-6)
    # At rest an inverted starting point is replaced by the reference shape, so the result is that of a run from there.
    straight = lj.simulate(replace(HANGING, law=law, solve=lj.Solve(tolerance=1e-11))).check()
    assert np.isclose(value, straight.positions[-1, BOTTOM[0], 2], rtol=0, atol=1e-9 * 0.1)


@pytest.mark.slow
def test_a_following_pressure_is_held_in_each_iteration():
    """The pressure has no energy. Nevertheless the minimiser finds the equilibrium of the plain run."""
    top = jnp.asarray(lj.boundary.boundary_triangles(MESH, BOTTOM))
    scene = replace(HANGING, traction=(lj.Traction(triangles=top, pressure=30.0),), solve=lj.Solve(steps=2))
    rest = lj.simulate(scene).check().positions
    robust = replace(scene, solve=replace(scene.solve, robust="projected"))
    run = jax.jit(lambda start: lj.simulate(robust, start=start))
    for start in (MESH.points, inverted_start(0.2, 1)):
        assert np.abs(run(start).check().positions - rest).max() < 1e-6 * 0.1


@pytest.mark.slow
@pytest.mark.parametrize("taken", [True, False])
def test_the_kind_of_a_tangent_may_be_chosen_when_the_program_runs(taken):
    mesh, law = shapes.box((1.0, 1.0, 1.0), (1, 1, 1)), laws.typical("saint_venant_kirchhoff")
    scene = lj.Scene(mesh=mesh, law=law, fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),))
    e = equations.equations(scene, equations.initial_state(scene), 1.0)
    x = 0.4 * mesh.points  # below 0.577 the stiffness has negative eigenvalues
    chosen = jax.jit(lambda taken: tangent.tangent(e, None, x, 1.0, None, ("projected", taken)))(jnp.array(taken))
    kind, other = ("projected", "true") if taken else ("true", "projected")
    expected, not_this = (tangent.tangent(e, None, x, 1.0, None, k).matrix.rows for k in (kind, other))
    size = np.abs(np.array(expected)).max()
    assert np.abs(np.array(chosen.matrix.rows) - np.array(expected)).max() < 1e-13 * size
    assert np.abs(np.array(not_this) - np.array(expected)).max() > 1e-3 * size


def test_a_start_of_the_wrong_shape_is_refused():
    with pytest.raises(lj.InputError, match="start has shape"):
        lj.simulate(HANGING, start=MESH.points[1:])
