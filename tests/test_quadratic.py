"""Quadratic tetrahedra: the same physics at their points, exact cases, and orders of convergence."""

import itertools
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT

import liverjax as lj
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh import promotion
from liverjax.mesh.nodal import load_volumes, nodal_volumes
from liverjax.mesh.shape_functions import basis
from liverjax.physics.attached import ligament, vessel
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.sliding_support import on_plane
from liverjax.scenes.enriched import enriched
from liverjax.simulation import tangent
from liverjax.simulation.equations import equations, forces, initial_state, residual
from liverjax.simulation.run import prepared, simulate_part
from liverjax.solvers.block_matrix import flat
from liverjax.tensors.matrices import deformation_gradient, determinant, pack

pytestmark = pytest.mark.quick_to_compile

LAW = lj.laws.NeoHookean(mu=800.0, bulk=4000.0)


def crooked(cells=(2, 1, 1), size=(0.02, 0.01, 0.01)) -> lj.TetMesh:
    """A box with displaced inner nodes."""
    box = lj.shapes.box(size, cells)
    inside = np.setdiff1d(np.arange(box.number_of_nodes), lj.boundary.boundary_triangles(box))
    shift = np.zeros(box.points.shape)
    shift[inside] = 0.15 * size[1] / cells[1] * np.random.default_rng(3).uniform(-1, 1, (len(inside), 3))
    return lj.tet_mesh(np.asarray(box.points) + shift, box.tetrahedra, box.node_sets)


MESH = lj.quadratic(crooked())
X = MESH.points + 4e-4 * np.random.default_rng(1).standard_normal(MESH.points.shape)


@pytest.mark.parametrize(("order", "degree"), [(2, 2), (3, 5)])
def test_points_integrate_what_the_stiffness_needs(order, degree):
    rule = basis(order)
    for powers in np.ndindex(*4 * (degree + 1,)):
        if sum(powers) == degree:
            exact = 6 * np.prod([float(factorial(p)) for p in powers]) / factorial(degree + 3)
            found = np.sum(rule.weights * np.prod(rule.L ** np.array(powers)[:, None], axis=0))
            assert abs(found - exact) < 1e-15
    assert np.abs(rule.N[:10].sum(axis=0) - 1).max() < 1e-15


@pytest.mark.parametrize(
    "name", ["neo_hookean", *(pytest.param(n, marks=pytest.mark.slow) for n in ("ogden", "costa")), "mooney_rivlin"]
)
def test_terms_at_points_are_derivatives_of_the_energy(name):
    law = lj.laws.typical(name)
    force = lj.mjed.internal_force(MESH, law, X)
    for other in (lj.reference.internal_force(MESH, law, X), lj.reference.standard_internal_force(MESH, law, X)):
        assert np.abs(force - other).max() < 1e-12 * np.abs(force).max()
    K, H = lj.mjed.stiffness_matrix(MESH, law, X), lj.reference.stiffness_matrix(MESH, law, X)
    assert K.shape == (3 * MESH.number_of_nodes,) * 2 and abs(K - H).max() < 2e-11 * abs(H).max()


@pytest.mark.ci
def test_terms_of_stretches_at_points_are_differences_of_the_energy():
    """A fast variant of the test before, for a law of principal stretches, whose second derivatives compile slowly."""
    law = lj.laws.typical("ogden")
    v, h = np.random.default_rng(4).standard_normal(X.shape), 1e-7
    ends = [X + h * v, X - h * v]
    energies, forces = ([f(MESH, law, x) for x in ends] for f in (lj.mjed.energy, lj.mjed.internal_force))
    force, K = lj.mjed.internal_force(MESH, law, X), lj.mjed.stiffness_matrix(MESH, law, X)
    # With strains of 1e-5, truncation is their square, and rounding is 1e-16 over them.
    assert abs((energies[0] - energies[1]) / (2 * h) / jnp.vdot(force, v) - 1) < 1e-7
    slope = (forces[0] - forces[1]).ravel() / (2 * h)
    assert np.abs(K @ v.ravel() - slope).max() < 1e-7 * np.abs(slope).max()


def test_numbers_by_element_act_at_all_points_of_it():
    mu = 800.0 + 100.0 * jnp.arange(MESH.number_of_elements)
    total = sum(
        float(lj.mjed.energy(MESH, lj.laws.NeoHookean(mu=jnp.where(jnp.arange(len(mu)) == k, mu, 0.0), bulk=0.0), X))
        for k in range(len(mu))
    )
    assert np.isclose(total, float(lj.mjed.energy(MESH, lj.laws.NeoHookean(mu=mu, bulk=0.0), X)), rtol=1e-12)
    fibre = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (len(mu), 1))
    costa = lj.laws.typical("costa")
    one, many = (
        lj.mjed.energy(MESH, replace(costa, fibre=f, sheet=s), X)
        for f, s in ((fibre[0], jnp.array([0.0, 1.0, 0.0])), (fibre, jnp.roll(fibre, 1, axis=1)))
    )
    assert np.isclose(one, many, rtol=1e-14)


def test_a_quadratic_field_is_shown_exactly():
    A, B = np.random.default_rng(0).standard_normal((2, 3, 3))
    x = MESH.points @ (np.eye(3) + 0.1 * A).T + (MESH.points**2) @ B
    F = pack(deformation_gradient(MESH, x))
    corners = MESH.points[MESH.tetrahedra]
    at = jnp.einsum("vq,evi->qei", basis(2).L, corners)
    exact = np.eye(3) + 0.1 * A + 2 * np.asarray(at)[..., None, :] * B.T
    assert np.abs(F - exact).max() < 1e-13


@pytest.mark.slow
def test_an_affine_motion_of_the_surface_moves_the_inside_alike():
    A = np.array([[1.1, 0.2, 0.0], [0.0, 0.95, 0.1], [0.05, 0.0, 1.05]])
    mesh = lj.quadratic(crooked((2, 2, 2), (0.01, 0.01, 0.01)))
    outer = np.flatnonzero(np.any((np.asarray(mesh.points) < 1e-9) | (np.asarray(mesh.points) > 0.01 - 1e-9), axis=1))
    by = jnp.asarray(mesh.points[outer] @ (A - np.eye(3)).T)
    scene = lj.Scene(mesh=mesh, law=LAW, displaced=(lj.Displaced(nodes=jnp.asarray(outer), by=by),))
    result = lj.simulate(scene).check()
    assert len(outer) < mesh.number_of_nodes
    assert np.abs(result.positions[-1] - mesh.points @ A.T).max() < 1e-8 * 0.01


def test_shares_of_mass_and_weight():
    assert np.isclose(nodal_volumes(MESH).sum(), MESH.volumes.sum(), rtol=1e-14) and nodal_volumes(MESH).min() > 0
    assert np.isclose(load_volumes(MESH).sum(), MESH.volumes.sum(), rtol=1e-14)
    # The centre of gravity is exact for functions of degree 2.
    one = lj.quadratic(lj.tet_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]]))
    assert np.allclose(load_volumes(one) @ one.points, 1 / 24, rtol=1e-14)
    assert np.allclose(load_volumes(one) @ one.points**2, 1 / 60, rtol=1e-14)


def test_pressure_on_a_closed_surface_holds_itself():
    triangles = jnp.asarray(lj.boundary.boundary_triangles(MESH))
    load = (lj.Traction(triangles=triangles, pressure=3.0),)
    force = lj.boundary.follower_forces(load, X, MESH)
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * np.abs(force).sum()
    assert np.abs(jnp.cross(X, force).sum(axis=0)).max() < 1e-12 * np.abs(force).sum()
    # The virtual work of a swelling x -> (1 + t) x is 3 p V of the deformed body, whose surface is curved.
    J = determinant(deformation_gradient(lj.quadratic(crooked()), X))
    swelling = -float(jnp.vdot(force, X)) / 3.0
    assert abs(swelling / (3 * float(jnp.sum(MESH.weights * J))) - 1) < 2e-3


def harmonic(points: np.ndarray) -> np.ndarray:
    """Return grad of exp(a x) sin(a y) + z (x^2 - y^2) a^2. It has no divergence and no curl, so every linear solid is
    in equilibrium.
    """
    a, (x, y, z) = 100.0, points.T
    return 1e-7 * np.stack(
        [
            np.exp(a * x) * np.sin(a * y) + 2 * a * z * x,
            np.exp(a * x) * np.cos(a * y) - 2 * a * z * y,
            a * (x**2 - y**2),
        ],
        axis=1,
    )


def _errors(order: int, n: int) -> tuple[float, float]:
    """Return root mean square errors of displacements [m] and of F at the points of a fine integration rule."""
    box = lj.shapes.box((0.01, 0.01, 0.01), (n, n, n))
    mesh = lj.quadratic(box) if order == 2 else box
    X = np.asarray(mesh.points)
    outer = np.flatnonzero(np.any((X < 1e-9) | (X > 0.01 - 1e-9), axis=1))
    moved = lj.Displaced(nodes=jnp.asarray(outer), by=jnp.asarray(harmonic(X[outer])))
    result = lj.simulate(lj.Scene(mesh=mesh, law=LAW, displaced=(moved,), solve=lj.Solve(tolerance=1e-10))).check()
    u = np.asarray(result.positions[-1]) - X
    rule, corners = basis(3), np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)]
    at = np.einsum("vq,evi->qei", rule.L, corners)
    N = rule.N[:10] if order == 2 else rule.L
    shown = np.einsum("aq,aei->qei", N, np.stack([u[np.asarray(nodes)] for nodes in mesh.element_nodes]))
    exact = harmonic(at.reshape(-1, 3)).reshape(at.shape)
    slope = jax.vmap(jax.jacfwd(lambda p: _harmonic(p)))(jnp.asarray(at.reshape(-1, 3))).reshape(*at.shape, 3)
    c = rule.c[:10] if order == 2 else np.broadcast_to(np.eye(4)[:, :, None], (4, 4, len(rule.weights)))
    D = np.concatenate([-np.asarray(mesh.shape_vectors).sum(axis=0)[None], np.asarray(mesh.shape_vectors)])
    gradient = np.einsum(
        "aei,akq,kje->qeij", np.stack([u[np.asarray(nodes)] for nodes in mesh.element_nodes]), c, D, optimize=True
    )
    weight = rule.weights[:, None] / mesh.number_of_elements

    def mean(difference):
        return float(np.sqrt(np.sum(weight * np.sum(difference.reshape(*difference.shape[:2], -1) ** 2, axis=2))))

    return mean(shown - exact), mean(gradient - np.asarray(slope))


def _harmonic(p):
    a, (x, y, z) = 100.0, p
    first = jnp.exp(a * x) * jnp.sin(a * y) + 2 * a * z * x
    second = jnp.exp(a * x) * jnp.cos(a * y) - 2 * a * z * y
    return 1e-7 * jnp.stack([first, second, a * (x**2 - y**2)])


@pytest.mark.ci
@pytest.mark.parametrize(("order", "cells"), [pytest.param(1, (4, 8), marks=pytest.mark.slow), (2, (2, 4))])
def test_observed_orders_of_a_smooth_solution(order, cells, verified):
    (u1, F1), (u2, F2) = (_errors(order, n) for n in cells)
    displacement, strain = np.log2(u1 / u2), np.log2(F1 / F2)
    # Displacements have one order more than strains and stresses. On coarse meshes the order differs by 0.1 or 0.2.
    assert abs(displacement - (order + 1)) < 0.25 and abs(strain - order) < 0.25
    verified(f"smooth field, order {order}", "analytic", u2, u1, order=displacement)


def test_held_faces_hold_the_middles_of_their_edges_and_pairs_do_not():
    box = lj.shapes.box((1.0, 1.0, 1.0), (2, 1, 1))
    face = np.asarray(box.node_sets["x_min"])
    assert len(promotion.of_faces(box, face)) == 9
    assert np.array_equal(promotion.of_faces(box, face[:2]), face[:2])


@pytest.mark.parametrize("cells", [(2, 2, 2), (2, 3, 5), (3, 2, 1)])
def test_middles_of_several_held_sides_lie_on_these_sides(cells):
    """Where two sides meet there are faces with a vertex on each. Their middle nodes were fixed too."""
    box = lj.shapes.box((1.0, 2.0, 3.0), cells)
    points = np.asarray(lj.quadratic(box).points)
    sides = {name: (k // 2, (0.0, (1.0, 2.0, 3.0)[k // 2])[k % 2]) for k, name in enumerate(box.node_sets)}
    assert list(sides) == ["x_min", "x_max", "y_min", "y_max", "z_min", "z_max"]
    for number in (1, 2, 3, 6):
        for names in itertools.combinations(sides, number):
            held = np.unique(np.concatenate([np.asarray(box.node_sets[name]) for name in names]))
            on_sides = [points[:, axis] == place for axis, place in (sides[name] for name in names)]
            expected = set(np.flatnonzero(np.any(on_sides, axis=0)))
            found = set(promotion.of_faces(box, held))
            if 1 in cells:  # without inner vertices, this may be a fixed part of the body
                assert expected <= found
            else:
                assert found == expected, names


@pytest.mark.parametrize("cells", [(4, 4, 1), (4, 4, 2)])
@pytest.mark.parametrize("thick", [False, True])
def test_a_held_part_of_a_plate_holds_the_middles_within_it(cells, thick):
    """In a plate one element thick, vertices cannot distinguish an inner plane from two fixed sides."""
    plate = lj.shapes.box((0.1, 0.1, 0.02), cells)
    points = np.asarray(lj.quadratic(plate).points)

    def on_place(x: np.ndarray) -> np.ndarray:
        return np.flatnonzero(x[:, 0] < 0.051 if thick else abs(x[:, 0] - 0.05) < 1e-9)

    found = promotion.of_faces(plate, on_place(np.asarray(plate.points)))
    assert set(found) == set(on_place(points))


def test_all_faces_of_a_coarse_surface_are_held():
    """No two faces of an octahedron have nearly the same direction."""
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    faces = [[1, 2, 3], [2, 4, 3], [4, 5, 3], [5, 1, 3], [2, 1, 6], [4, 2, 6], [5, 4, 6], [1, 5, 6]]
    octahedron = lj.tet_mesh(corners, np.array([[0, *face] for face in faces]))
    assert len(promotion.of_faces(octahedron, np.arange(1, 7))) == 6 + 12


def test_points_do_not_see_a_fold_that_vertices_show():
    one = lj.quadratic(lj.tet_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]]))
    x = one.points.at[4].add(jnp.array([-0.3, 0.0, 0.0]))
    J = np.asarray(volume_ratios(one, x))
    assert J[:4].min() > 0 > J.min()


# -- features by order ---------------------------------------------------------------------------------------------

PRONY = lj.Prony(ratios=jnp.array([0.3, 0.2]), relaxation_times=jnp.array([0.3, 0.05]))


TIMES = jnp.array([0.0, 0.1])
#: Two points inside the cantilever.
LINE = np.array([[0.002, 0.004, 0.003], [0.017, 0.006, 0.007]])


def scene_of(mesh: lj.TetMesh, feature: str) -> lj.Scene:
    """A cantilever with a feature."""
    sponge = lj.Porosity(
        bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-6, drained=mesh.node_sets["z_max"]
    )
    right, below = (
        jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets[side])) for side in ("x_max", "z_min")
    )
    solve = {"steps": 2, "dt": 0.05}
    changes = {
        "elastic": {},
        "direct": {"solve": {"linear_solver": "direct"}},
        "averaged": {"solve": {"volumetric": "nodal", "linear_solver": "direct"}},
        "dynamic": {"solve": {"kind": "dynamic"}},
        "newmark": {"solve": {"kind": "dynamic", "integrator": "newmark"}},
        "viscous": {"viscosity": PRONY},
        "isochoric": {"viscosity": replace(PRONY, part="isochoric", scheme="backward_euler")},
        "porous": {"porosity": sponge},
        "porous direct": {"porosity": sponge, "solve": {"linear_solver": "direct"}},
        "lagged": {"porosity": replace(sponge, scheme="lagged"), "solve": {"dt": 1e-3}},
        "complete": {"porosity": sponge, "viscosity": PRONY, "solve": {"kind": "dynamic"}},
        "traction": {"traction": (lj.Traction(triangles=right, value=jnp.array([0.0, 0.0, -50.0])),)},
        "pressure": {"traction": (lj.Traction(triangles=right, pressure=40.0),)},
        "support": {"physics": (ElasticSupport(triangles=below, normal=1e4, tangential=1e3),)},
        "sliding": {"physics": (on_plane(mesh, np.asarray(mesh.node_sets["y_min"])),)},
        "membrane": {"physics": (Membrane(triangles=below, thickness=1e-4, law=lj.laws.NeoHookean(mu=1e4, bulk=1e5)),)},
        "ligament": {"physics": (ligament.between(mesh, LINE, stiffness=5.0, pre_tension=1e-3),)},
        "vessel": {"physics": (vessel.along(mesh, LINE, 5e-4, lj.laws.NeoHookean(mu=1e4, bulk=1e5)),)},
        "history": {"traction": (lj.Traction(triangles=right, pressure=40.0, times=TIMES, history=TIMES / 0.1),)},
        "projected": {"solve": {"robust": "projected"}},
        "one step": {"solve": {"newton": "one_step", "tolerance": 1e-3, "kind": "dynamic"}},
        "region": {"region": (lj.Region(elements=jnp.array([0, 1]), law={"mu": jnp.array(2000.0)}),)},
        "stretches": {"law": lj.laws.typical("ogden")},
        "float32": {"solve": {"precision": "float32", "tolerance": 1e-4}},
    }[feature]
    solve |= changes.pop("solve", {})
    scene = lj.Scene(
        mesh=mesh,
        law=LAW,
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        body=lj.Body(density=1000.0, gravity=(0.0, 0.0, -3.0)),
        solve=lj.Solve(**solve),
    )
    return replace(scene, **changes)


FEATURES = (
    *("elastic", "direct", "averaged", "dynamic", "newmark", "viscous", "isochoric", "porous", "porous direct"),
    *("lagged", "complete", "traction", "pressure", "support", "sliding", "projected", "one step", "region"),
    *("stretches", "float32", "membrane", "ligament", "vessel", "history"),
)


@pytest.mark.slow
@pytest.mark.parametrize("feature", sorted(FEATURES))
def test_every_feature_runs_on_both_orders(feature):
    """Both orders converge, and their results differ by less than the mesh error of linear elements."""
    linear = crooked()
    shown = []
    for mesh in (linear, lj.quadratic(linear)):
        scene = scene_of(mesh, feature)
        lj.check_scene(scene)
        result = lj.simulate(scene)
        assert set(np.asarray(result.status).tolist()) <= {status.CONVERGED, status.ONE_STEP}
        assert result.pressure is None or result.pressure.shape == result.positions.shape[:2]
        shown.append(np.abs(np.asarray(result.positions[-1] - mesh.points)).max())
    assert 0.9 < shown[1] / shown[0] < 6


@pytest.mark.parametrize(
    "feature",
    [
        pytest.param("elastic", marks=pytest.mark.slow),
        pytest.param("porous", marks=pytest.mark.core),
        "pressure",
        pytest.param("isochoric", marks=pytest.mark.slow),
        pytest.param("sliding", marks=pytest.mark.slow),
        pytest.param("membrane", marks=pytest.mark.slow),
    ],
)
def test_the_tangent_is_the_derivative_of_the_forces(feature):
    scene = scene_of(MESH, feature)
    e = equations(scene, initial_state(scene), 1.0)
    v = flat(e.free.vectors(jnp.asarray(np.random.default_rng(2).standard_normal(X.shape))))
    q = flat(e.free.vectors(X))
    one = jnp.ones(())

    @jax.jit
    def both(q, v):
        f = forces(e, q, one)
        K = tangent.tangent(e, f.pressure, f.x, one)
        return tangent.product(e, K, exactly=True)(v), jax.jvp(lambda q: residual(e, q, one)[0], (q,), (v,))[1]

    product, exact = both(q, v)
    # The pressure of a porous body is solved to a hundredth of the tolerance.
    allowed = 1e-8 if feature == "porous" else 1e-12
    assert np.abs(product - exact).max() < allowed * np.abs(exact).max()


@pytest.mark.slow
def test_gradients_forward_reverse_and_by_differences():
    mesh = lj.quadratic(lj.shapes.box((0.02, 0.01, 0.01), (1, 1, 1)))
    scene = scene_of(mesh, "complete")
    scene = replace(scene, solve=replace(scene.solve, tolerance=1e-11))
    names = ("law.mu", "viscosity.ratios.0", "porosity.permeability")
    start = jnp.array([800.0, 0.3, 2e-6])

    @jax.jit
    def shown(values):
        numbers = dict(zip(names, values * start, strict=True))
        return jnp.sum(lj.simulate(lj.with_parameters(scene, numbers)).positions[-1, :, 2] ** 2)

    one = jnp.ones(3)
    reverse, forward = jax.grad(shown)(one), jax.jacfwd(shown)(one)
    assert np.abs(reverse - forward).max() < 1e-8 * np.abs(forward).max()
    for k in range(3):
        h = 1e-4 * (jnp.arange(3) == k)
        difference = (shown(one + h) - shown(one - h)) / 2e-4
        assert abs(difference - forward[k]) < 1e-6 * np.abs(forward).max()


@pytest.mark.slow
def test_the_liver_is_that_of_dolfinx(verified):
    """Quadratic elements on the phantom's 5,351 tetrahedra at rest: 45.09 and 20.610 mm by DOLFINx."""
    scene = lj.load_scene(ROOT / "experiments" / "scenes" / "liver_gravity.toml")
    held = [np.asarray(f.nodes) for f in scene.fixed]
    scene = replace(scene, viscosity=None, porosity=None, solve=lj.Solve(tolerance=1e-8, linear_solver="cg"))
    scene = enriched(scene)
    assert all(np.array_equal(f.nodes[: len(n)], n) for f, n in zip(scene.fixed, held, strict=True))
    size = np.linalg.norm(lj.simulate(scene).check().positions[-1] - scene.mesh.points, axis=1)
    found = np.array([size.max(), size[: scene.mesh.number_of_vertices].mean()])
    difference = np.abs(found / [45.09e-3, 20.610e-3] - 1).max()
    assert difference < 1e-4
    verified("liver phantom under 2 m/s2, quadratic", "DOLFINx", difference, 1e-4)


@pytest.mark.slow
def test_runs_in_parts_batches_and_inverted_starts():
    mesh = lj.quadratic(lj.shapes.box((0.02, 0.01, 0.01), (1, 1, 1)))
    scene = prepared(scene_of(mesh, "complete"))
    scene = replace(scene, solve=replace(scene.solve, steps=4))
    whole = lj.simulate(scene)
    first, state = simulate_part(scene, initial_state(scene), 1.0, 2)
    second, _ = simulate_part(scene, state, 3.0, 2)
    parts = np.concatenate([first.positions, second.positions])
    # Each part begins with a new tangent. The results agree up to the tolerance of a step, 1e-8 of the forces.
    assert np.abs(parts - whole.positions).max() < 1e-6 * np.abs(whole.positions - mesh.points[None]).max()
    batch = lj.simulate_batch(scene, {"law.mu": jnp.array([800.0, 900.0])})
    assert np.abs(batch.result.positions[0] - whole.positions).max() < 1e-6 * 0.01
    static = replace(scene_of(mesh, "projected"), solve=lj.Solve(robust="projected"))
    rest = lj.simulate(static).check().positions[-1]
    start = mesh.points + 0.01 * jnp.asarray(np.random.default_rng(0).standard_normal(mesh.points.shape))
    start = start.at[mesh.node_sets["x_min"]].set(mesh.points[mesh.node_sets["x_min"]])
    assert volume_ratios(mesh, start).min() < 0
    found = lj.simulate(static, start=start).check().positions[-1]
    assert np.abs(found - rest).max() < 1e-6 * 0.01


def test_points_in_quadratic_elements_move_with_their_functions():
    from fitting.readers.displacements import locate

    at = np.array([[0.0031, 0.0042, 0.0027], [0.013, 0.008, 0.0011]])
    nodes, weights, outside = locate(MESH, at)
    field = np.asarray(MESH.points) ** 2 @ np.array([1.0, -2.0, 0.5])
    assert np.allclose(np.sum(weights * field[nodes], axis=1), at**2 @ [1.0, -2.0, 0.5], atol=1e-16)
    assert np.all(outside == 0)
