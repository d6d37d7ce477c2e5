"""Consistent masses: sums, free fall, factorisation, derivatives; and the estimated mesh error in motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_quadratic import crooked

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.mesh.nodal import load_volumes, nodal_volumes
from liverjax.mesh.promotion import cubic
from liverjax.physics.base import Free, Start, Step
from liverjax.physics.inertia import Inertia, inertia_forces
from liverjax.physics.registry import physics_of
from liverjax.solvers import attached

pytestmark = pytest.mark.quick_to_compile

LINEAR = crooked((2, 1, 1), (0.02, 0.01, 0.01))
MESHES = {1: LINEAR, 2: lj.quadratic(LINEAR), 3: cubic(lj.quadratic(LINEAR))}
GRAVITY = np.array([0.3, 0.0, -9.81])


def falling(order: int, mass: str, integrator: str = "newmark", **solve) -> lj.Scene:
    return lj.Scene(
        mesh=MESHES[order],
        law=lj.laws.NeoHookean(mu=800.0, bulk=1600.0),
        body=lj.Body(density=1000.0, gravity=jnp.asarray(GRAVITY), mass=mass),
        solve=lj.Solve(kind="dynamic", integrator=integrator, dt=0.002, steps=4, **solve),
    )


def fallen(scene: lj.Scene) -> np.ndarray:
    """Return the positions (T, 1, 3) of all points of a free body, by the recursion of the integrator."""
    n, dt = np.arange(1, scene.solve.steps + 1), scene.solve.dt
    way = dt**2 * (n**2 if scene.solve.integrator == "newmark" else n * (n + 1)) / 2
    return way[:, None, None] * GRAVITY


@pytest.mark.parametrize("order", [1, 2, 3])
def test_masses_integrate_products_of_functions(order):
    """Multiplied by a constant field they give the weight; by a linear field, together with itself, its second
    moments.
    """
    mesh = MESHES[order]
    mass, shared = Inertia(density=1000.0, mass="consistent").masses_on(mesh)

    def product(v: jax.Array) -> jax.Array:
        return mass[:, None] * v + jnp.stack(attached.product(shared, tuple(v.T)), axis=1)

    assert mass.min() > 0
    whole = mesh.number_of_vertices + (order > 1) * mesh.pattern.edges.shape[1]
    one = jnp.zeros_like(mesh.points).at[:whole].set(1.0)
    assert np.allclose(product(one)[:, 0], 1000.0 * load_volumes(mesh), rtol=1e-13, atol=1e-13 * mass.max())
    moment = jnp.vdot(mesh.points[:, 0], product(mesh.points)[:, 0])
    # For the corners X_a of tetrahedra: V/20 (sum_a X_a^2 + (sum_a X_a)^2).
    X = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra), 0]
    exact = 1000.0 * np.sum(np.asarray(mesh.volumes) / 20 * ((X**2).sum(axis=1) + X.sum(axis=1) ** 2))
    assert np.isclose(moment, exact, rtol=1e-13)


def test_numbers_by_node_have_the_sum_of_the_lumped_masses():
    """The masses used only the densities of the vertices."""
    mesh = MESHES[2]
    density = jnp.linspace(900.0, 1100.0, mesh.number_of_nodes)
    mass, shared = Inertia(density=density, mass="consistent").masses_on(mesh)
    total = jnp.sum(mass) + jnp.sum(jnp.stack(attached.product(shared, (jnp.ones_like(mass),))))
    assert np.isclose(total, jnp.sum(density * nodal_volumes(mesh)), rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_a_free_body_of_two_densities_falls_as_one(order):
    """The weight belonged to other densities than the mass, so the body bent, and the mesh error of the undeformed fall
    with lumped masses was not zero.
    """
    density = jnp.where(MESHES[order].points[:, 0] < 0.011, 1000.0, 2000.0)
    scene = falling(order, "lumped" if order == 1 else "consistent", tolerance=1e-10)
    scene = replace(scene, body=replace(scene.body, density=density))
    result = lj.simulate(scene, mesh_error=order == 1).check()
    way = fallen(scene)
    assert np.abs(result.positions - scene.mesh.points[None] - way).max() < 1e-8 * np.abs(way).max()
    if order == 1:
        assert np.abs(result.mesh_error.positions).max() < 1e-8 * np.abs(way).max()


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_weight_of_two_densities_is_their_mass_times_gravity(order):
    """The weight belonged to other densities than the mass, so a free body bent."""
    scene = falling(order, "consistent")
    density = 1000.0 * (1 + jnp.arange(scene.mesh.number_of_nodes) % 2)
    _, inertia, loads = physics_of(replace(scene, body=replace(scene.body, density=density)))
    mass, shared = inertia.masses_on(scene.mesh)
    whole = scene.mesh.number_of_vertices + (order > 1) * scene.mesh.pattern.edges.shape[1]
    falls = jnp.zeros_like(scene.mesh.points).at[:whole].set(GRAVITY)
    step = Step(scene.mesh, scene.mesh.points, 1.0, 4, 0.002, True, 1e-8, Free(jnp.ones_like(falls)))
    weight = -loads.freeze(None, step).force(scene.mesh, scene.mesh.points, 1.0)
    off = weight - inertia_forces(mass, shared, falls)
    assert np.abs(off).max() < 1e-13 * np.abs(weight).max()
    assert np.allclose(weight[:whole].sum(axis=0), jnp.sum(inertia.density * nodal_volumes(scene.mesh)) * GRAVITY)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_a_body_of_two_densities_has_one_weight(order, mass):
    """With consistent masses, static and dynamic scenes had different weights. With quadratic elements and lumped
    masses, the total weight was not the total mass times gravity.
    """
    scene = falling(order, mass)
    density = 1000.0 * (1 + jnp.arange(scene.mesh.number_of_nodes) % 2)
    scene = replace(scene, body=replace(scene.body, density=density))
    step = Step(scene.mesh, scene.mesh.points, 1.0, 4, 0.002, True, 1e-8, Free(jnp.ones_like(scene.mesh.points)))
    kinds = (replace(scene, solve=replace(scene.solve, kind=kind)) for kind in ("static", "dynamic"))
    still, moving = (physics_of(each)[-1].freeze(None, step).dead for each in kinds)
    assert np.array_equal(still, moving)
    masses = density * nodal_volumes(scene.mesh)
    whole = scene.mesh.number_of_vertices + (order > 1) * scene.mesh.pattern.edges.shape[1]
    assert np.allclose(still[:whole].sum(axis=0), masses.sum() * GRAVITY, rtol=1e-13)
    if order == 1 and mass == "lumped":
        assert np.array_equal(still, masses[:, None] * GRAVITY[None])


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["euler", "newmark"])
def test_a_free_quadratic_body_falls_as_one(integrator):
    """Lumped masses of quadratic elements are not proportional to their weight, so the body would bend."""
    found = []
    for mass in ("consistent", "lumped"):
        scene = falling(2, mass, integrator, tolerance=1e-10)
        off = lj.simulate(scene).check().positions - scene.mesh.points[None] - fallen(scene)
        found.append(np.abs(off).max() / np.abs(fallen(scene)).max())
    assert found[0] < 1e-9 and found[1] > 0.05


def test_accelerations_at_the_beginning_are_those_of_the_weight():
    """With one side fixed, m a = f where the body is free, and 0 where it is fixed."""
    mesh = MESHES[2]
    own = Inertia(density=1000.0, integrator="newmark", mass="consistent")
    mask = jnp.ones_like(mesh.points).at[mesh.node_sets["x_min"]].set(0.0)
    weight = 1000.0 * load_volumes(mesh)[:, None] * jnp.asarray(GRAVITY)[None]
    a = own.begin(Start(mesh, mesh.points, Free(mask), lambda: -weight)).acceleration
    mass, shared = own.masses_on(mesh)
    force = mass[:, None] * a + jnp.stack(attached.product(shared, tuple(a.T)), axis=1)
    assert np.all(a[mesh.node_sets["x_min"]] == 0)
    assert np.abs(mask * (force - weight)).max() < 1e-10 * np.abs(weight).max()


def held(order: int, **solve) -> lj.Scene:
    scene = falling(order, "consistent", **solve)
    return replace(scene, fixed=(lj.Fixed(nodes=scene.mesh.node_sets["x_min"]),))


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_a_factorisation_and_a_robust_step_find_the_same(order):
    rest = lj.simulate(held(order, tolerance=1e-11)).check().positions
    for solve in ({"linear_solver": "direct"}, {"robust": "projected"}):
        other = lj.simulate(held(order, tolerance=1e-11, **solve)).check().positions
        assert np.abs(other - rest).max() < 1e-9 * np.abs(rest - MESHES[order].points[None]).max()


@pytest.mark.slow
def test_derivatives_go_through_the_first_acceleration():
    scene = held(2, tolerance=1e-11)

    def tip(density: float) -> jax.Array:
        return 1e3 * jnp.sum(lj.simulate(lj.with_parameters(scene, {"body.density": density})).positions[-1, :, 2])

    slope, h = jax.grad(tip)(1000.0), 1e-1
    assert np.isclose((tip(1000.0 + h) - tip(1000.0 - h)) / (2 * h), slope, rtol=1e-5)


@pytest.mark.slow
def test_the_estimate_in_free_fall_is_nothing():
    """The added functions have weight and mass in the same proportion. A body of linear elements falls equally in both
    spaces.
    """
    scene = falling(1, "lumped", tolerance=1e-10)
    result = lj.simulate(scene, mesh_error=True).check()
    assert bool(result.mesh_error.found.all())
    assert np.abs(result.mesh_error.positions).max() < 1e-8 * np.abs(fallen(scene)).max()


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_the_estimate_in_motion_is_the_way_to_the_richer_run(order):
    """A beam oscillates with a small amplitude. For linear elements, the estimate gives the motion of quadratic ones on
    the same mesh. For quadratic elements, it gives two thirds of the difference to a finer mesh (`moving_mesh` has
    more).
    """
    mesh = lj.shapes.box((0.1, 0.02, 0.02), (5, 1, 1) if order == 1 else (2, 1, 1))
    scene = lj.Scene(
        mesh=mesh if order == 1 else lj.quadratic(mesh),
        law=lj.laws.NeoHookean(mu=4000.0, bulk=8000.0),
        body=lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -0.05])),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        solve=lj.Solve(kind="dynamic", integrator="newmark", dt=0.02, steps=30),
    )
    scene = scene if order == 1 else replace(scene, fixed=(lj.Fixed(nodes=scene.mesh.node_sets["x_min"]),))
    result = lj.simulate(scene, mesh_error=True).check()
    assert bool(result.mesh_error.found.all())
    fine = lj.quadratic(mesh if order == 1 else lj.refined(mesh))
    body = replace(scene.body, mass="consistent")
    richer = replace(scene, mesh=fine, body=body, fixed=(lj.Fixed(nodes=fine.node_sets["x_min"]),))
    V = mesh.number_of_vertices
    truth, found, change = (
        np.asarray(x[:, :V, 2])
        for x in (lj.simulate(richer).check().positions, result.positions, result.mesh_error.positions)
    )
    off = truth - found
    size = np.linalg.norm(change) / np.linalg.norm(off)
    if order == 1:
        # The linear solves of thirty steps have an error of a hundredth. The motion of 4 mm (of 100) is nearly linear.
        assert np.linalg.norm(change - off) < 0.05 * np.linalg.norm(off)
    assert 0.5 < size < 2 and np.vdot(change, off) > 0.9 * np.linalg.norm(change) * np.linalg.norm(off)
