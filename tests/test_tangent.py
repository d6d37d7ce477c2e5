"""The assembled tangent of a scene compared with autodiff of its forces, and the solvers that use the tangent."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.laws.terms import invariant_terms
from liverjax.mesh.nodal import to_nodes
from liverjax.physics import boundary, darcy, porosity, viscosity
from liverjax.simulation import mixed_system, tangent
from liverjax.simulation.equations import State, equations, initial_state
from liverjax.solvers import block_matrix
from liverjax.solvers.krylov import chebyshev, stabilised_biconjugate_gradients
from liverjax.tensors.matrices import add_matrices, deformation_gradient, determinant

pytestmark = pytest.mark.quick_to_compile

rng = np.random.default_rng(5)
LAW = lj.laws.MooneyRivlin(c10=300.0, c01=85.0, bulk=2200.0)
PRONY = lj.Prony(ratios=jnp.array([0.235, 0.333]), relaxation_times=jnp.array([0.27, 0.03]))
SPONGE = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-5)
MESH = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 3))
X = MESH.points + 0.008 * jnp.asarray(rng.uniform(-1, 1, MESH.points.shape))
V = jnp.asarray(rng.standard_normal(MESH.points.shape))


def test_pattern_names_every_neighbour_once():
    p = MESH.pattern
    tets = np.asarray(MESH.tetrahedra)
    number = p.edges.shape[1]
    for node in (0, 17, MESH.number_of_nodes - 1):
        real = np.asarray(p.row_edges)[:, node] < number
        expected = np.setdiff1d(tets[(tets == node).any(axis=1)], node)
        assert np.array_equal(np.sort(np.asarray(p.row_nodes)[real, node]), expected)
        ends = np.asarray(p.edges)[:, np.asarray(p.row_edges)[real, node]]
        assert (ends == node).any(axis=0).all() and (ends[0] < ends[1]).all()


@pytest.mark.ci
def test_assembled_stiffness_is_the_sparse_one():
    scene = lj.Scene(mesh=MESH, law=LAW)
    e = equations(scene, initial_state(scene), 1.0)
    A = jax.jit(lambda x: tangent.stiffness(e, None, x))(X)
    K = mjed.stiffness_matrix(MESH, LAW, X)
    expected = (K @ np.asarray(V).ravel()).reshape(-1, 3)
    assert np.abs(np.stack(block_matrix.product(A, V.T), axis=-1) - expected).max() < 1e-13 * abs(K).max() * 10


@pytest.mark.ci
@pytest.mark.parametrize("part", [pytest.param("all", marks=pytest.mark.slow), "isochoric"])
def test_viscous_and_porous_tangent_against_autodiff(part):
    prony = lj.Prony(ratios=PRONY.ratios, relaxation_times=PRONY.relaxation_times, part=part)
    scene = lj.Scene(mesh=MESH, law=LAW, viscosity=prony, porosity=SPONGE)
    F0 = deformation_gradient(MESH, X + 0.004 * V)
    law = porosity.law_in_force(SPONGE, LAW)
    if part == "isochoric":  # a volumetric part for the other branch of the code
        law, scene = (
            LAW,
            lj.Scene(mesh=MESH, law=LAW, viscosity=prony, porosity=lj.Porosity(**{**vars(SPONGE), "keep_bulk": True})),
        )
    history = viscosity.advance(prony, viscosity.initial_history(prony, MESH.number_of_elements), law, F0, 0.05)
    memory = viscosity.recall(prony, history, 0.05)
    P = jnp.asarray(rng.uniform(-50, 50, MESH.number_of_nodes))

    def forces(x):
        F = deformation_gradient(MESH, x)
        stress = viscosity.first_piola(prony, memory, law, F)
        return mjed.nodal_force(MESH, add_matrices(stress, porosity.first_piola(SPONGE, MESH, P, F)))

    expected = jax.jit(lambda: jax.jvp(forces, (X,), (V,))[1])()
    state = State(MESH.points, (history, porosity.initial_fluid(SPONGE, MESH)))
    e = equations(replace(scene, solve=lj.Solve(dt=0.05)), state, 1.0)
    A = jax.jit(lambda: tangent.stiffness(e, P, X))()
    error = np.stack(block_matrix.product(A, V.T), axis=-1) - np.asarray(expected)
    assert np.abs(error).max() < 1e-12 * np.abs(np.asarray(expected)).max()


@pytest.mark.ci
def test_coupled_matrix_against_autodiff():
    scene = lj.Scene(mesh=MESH, law=LAW, porosity=SPONGE, solve=lj.Solve(dt=0.05))
    law = porosity.law_in_force(SPONGE, LAW)
    e = equations(scene, initial_state(scene), 1.0)
    n, fluid = MESH.number_of_nodes, porosity.initial_fluid(SPONGE, MESH)
    P, dP = jnp.asarray(rng.uniform(-50, 50, n)), jnp.asarray(rng.standard_normal(n))

    @jax.jit
    def both():
        F = deformation_gradient(MESH, X)
        flow = darcy.flow(SPONGE, MESH, fluid.J, deformation_gradient(MESH, MESH.points), 0.05, 1e-10)
        A = mixed_system.coupled(MESH, tangent.element_blocks(e, P, F), None, F, flow.matrix)

        def equations(x, P):
            F = deformation_gradient(MESH, x)
            stress = add_matrices(invariant_terms.first_piola(law, F), porosity.first_piola(SPONGE, MESH, P, F))
            volume = to_nodes(MESH, MESH.volumes * determinant(F) / 4)
            flux = jnp.stack(block_matrix.product(flow.matrix, (P,)), axis=-1)
            return jnp.concatenate([mjed.nodal_force(MESH, stress), -flux - volume[:, None]], axis=1)

        exact = jax.jvp(equations, (X, P), (V, dP))[1]
        return jnp.stack(block_matrix.product(A, (*V.T, dP)), axis=-1), exact

    ours, exact = map(np.asarray, both())
    for column in (slice(0, 3), slice(3, 4)):  # forces and volumes: each relative to its own size
        assert np.abs(ours[:, column] - exact[:, column]).max() < 1e-12 * np.abs(exact[:, column]).max()


@pytest.mark.ci
def test_darcys_laplacian_and_its_polynomial():
    fluid = porosity.initial_fluid(SPONGE, MESH)
    flow = jax.jit(lambda: darcy.flow(SPONGE, MESH, fluid.J, deformation_gradient(MESH, X), 0.05, 1e-10))()
    n = MESH.number_of_nodes
    A = np.asarray(jax.vmap(lambda e: block_matrix.product(flow.matrix, (e,))[0])(jnp.eye(n)))
    assert np.allclose(A, A.T, rtol=0, atol=1e-15 * A.max())
    assert np.allclose(A.sum(axis=1), np.asarray(flow.store), rtol=1e-9)  # a uniform pressure causes no flow
    lowest = np.linalg.eigvals(A / np.diag(A)[:, None]).real.min()
    # With all eigenvalues in the polynomial's bounds, their error is that of the polynomial. Below, it stays positive
    # definite.
    for low, least in ((lowest, 0.9), (flow.low, 0.0)):
        known = flow._replace(low=jnp.asarray(low))
        B = np.asarray(jax.vmap(lambda e, known=known: darcy.nearly_solved(MESH, known, e))(jnp.eye(n)))
        assert np.allclose(B, B.T, rtol=0, atol=1e-12 * B.max())
        eigenvalues = np.linalg.eigvals(B @ A).real
        assert eigenvalues.min() > least and eigenvalues.max() < 1.1


@pytest.mark.ci
def test_pressures_from_a_guess():
    """A guess changes neither pressures nor derivatives. With a close guess, a looser solve is equally exact."""
    sponge = replace(SPONGE, drained=MESH.node_sets["z_max"])
    J, b = jnp.ones(MESH.number_of_elements), jnp.asarray(1e-6 * rng.standard_normal(MESH.number_of_nodes))

    def pressures(rate, guess):
        F = deformation_gradient(MESH, X)
        flow = darcy.flow(replace(sponge, permeability=rate), MESH, J, F, 0.05, 1e-10)
        return jnp.sum(darcy.solved(MESH, flow, b, guess) ** 3)

    value = jax.jit(jax.value_and_grad(pressures))
    plain, slope = value(2e-5, None)
    at = jax.jit(lambda: darcy.flow(sponge, MESH, J, deformation_gradient(MESH, X), 0.05, 1e-12))()
    exact = jax.jit(lambda: darcy.solved(MESH, at, b))()
    for guess in (darcy.Guess(exact, 1e5), darcy.Guess(1e3 * exact[::-1], 1.0)):
        again, same = value(2e-5, guess)
        assert np.isclose(again, plain, rtol=1e-8) and np.isclose(same, slope, rtol=1e-8)


@pytest.mark.ci
def test_chebyshev_meets_its_bound():
    d = jnp.asarray(rng.uniform(1, 2, 30))
    Q = np.linalg.qr(rng.standard_normal((30, 30)))[0]
    eigenvalues = np.linspace(0.05, 3.0, 30)
    A = np.sqrt(d)[:, None] * (Q * eigenvalues) @ Q.T * np.sqrt(d)[None]
    for degree in (5, 20):
        B = np.stack([chebyshev(lambda v: jnp.asarray(A) @ v, e, d, (0.05, 3.0), degree) for e in jnp.eye(30)])
        error = np.abs(1 - np.linalg.eigvals(B @ A).real).max()
        assert error < 2 * np.exp(-2 * degree * np.sqrt(0.05 / 3.0))


def test_bicgstab_solves_without_symmetry():
    A = jnp.asarray(np.diag(np.arange(1.0, 21)) + 0.3 * rng.standard_normal((20, 20)))
    b = jnp.asarray(rng.standard_normal(20))
    x, s = stabilised_biconjugate_gradients(lambda v: A @ v, b, lambda r: r / jnp.diag(A), 1e-12, 100)
    assert np.allclose(A @ x, b, atol=1e-10) and s.residual < 1e-11 and 3 < s.iterations < 40
    zero, s = stabilised_biconjugate_gradients(lambda v: A @ v, 0 * b, lambda r: r, 1e-12, 100)
    assert s.iterations == 0 and not zero.any()


def inflated(pressure: float, **solve) -> lj.Scene:
    """A block fixed at its bottom, with a pressure on its upper face."""
    return lj.Scene(
        mesh=MESH,
        law=LAW,
        fixed=(lj.Fixed(nodes=MESH.node_sets["z_min"]),),
        traction=(
            lj.Traction(
                triangles=jnp.asarray(boundary.boundary_triangles(MESH, MESH.node_sets["z_max"])), pressure=pressure
            ),
        ),
        solve=lj.Solve(**solve),
    )


def test_follower_pressure_follows():
    # On a closed surface a pressure has no resultant; on a face the resultant belongs to the current area.
    closed = (lj.Traction(triangles=jnp.asarray(boundary.boundary_triangles(MESH)), pressure=3.0),)
    assert np.abs(np.asarray(boundary.follower_forces(closed, X).sum(axis=0))).max() < 1e-15
    turned = MESH.points @ jnp.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]).T
    force = boundary.follower_forces(inflated(4.0).traction, turned).sum(axis=0)
    assert np.allclose(force, [-4.0 * 0.01, 0, 0], atol=1e-15)


@pytest.mark.slow
def test_follower_pressure_in_equilibrium_and_its_gradient():
    scene = inflated(150.0, steps=2, tolerance=1e-11)

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def bulge(p):
        result = lj.simulate(lj.with_parameters(scene, {"traction.0.pressure": p}))
        return result.positions[-1, -1, 0], result

    (_, result), slope = bulge(150.0)
    x = result.check().positions[-1]
    residual = mjed.internal_force(MESH, LAW, x) - boundary.follower_forces(scene.traction, x) - result.reactions[-1]
    assert np.abs(np.asarray(residual)).max() < 1e-10 * np.abs(np.asarray(result.reactions[-1])).sum()
    assert float(x[:, 2].max()) < 0.1
    h = 0.1
    difference = (bulge(150 + h)[0][0] - bulge(150 - h)[0][0]) / (2 * h)
    assert np.isclose(difference, slope, rtol=1e-6)
