"""Rigid obstacles: distances against difference quotients, Hertz, weights on planes, energy, gradients, invalid
input.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.mesh.surface import areas as triangle_areas
from liverjax.physics.contact.obstacle import Obstacle, touching_term
from liverjax.physics.contact.shapes import SHAPES, distance
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

LAW = lj.laws.NeoHookean(mu=800.0, bulk=4000.0)
SIDE = 0.1


def surface(mesh: lj.TetMesh, **where) -> jax.Array:
    """Return the triangles of a region of the surface."""
    return jnp.asarray(lj.boundary.boundary_triangles(mesh, lj.boundary.select(mesh, where)))


@pytest.mark.parametrize("shape", SHAPES)
def test_distances_and_their_derivatives(shape):
    """Compare normals of length 1 and second derivatives with automatic differentiation of the distance."""
    axis = jnp.array([2.0, -1.0, 2.0]) / 3
    y = jnp.asarray(np.random.default_rng(0).normal(size=(40, 3)))

    def of(y):
        return distance(shape, list(y), axis, 0.3, 0.6)

    found = jax.vmap(of)(y)
    slope = jax.vmap(jax.grad(lambda y: of(y).value))(y)
    bent = jax.vmap(jax.hessian(lambda y: of(y).value))(y)
    normal = jnp.stack(found.normal, axis=-1)
    assert np.allclose(jnp.linalg.norm(normal, axis=1), 1.0, atol=1e-14)
    assert np.allclose(normal, slope, atol=1e-13)
    assert np.allclose(jnp.stack([jnp.stack(row, -1) for row in found.bent], -2), bent, atol=1e-11)


def test_a_cone_with_a_round_tip_begins_at_its_place():
    """On the axis, the distance is that to the tip. Far from the axis, it is that of the sharp cone moved by
    rho/sin.
    """
    up, angle, rho = jnp.array([0.0, 0.0, 1.0]), 0.7, 0.01
    below = distance("cone", list(jnp.array([0.0, 0.0, -0.2])), up, rho, angle)
    assert np.isclose(below.value, 0.2, atol=1e-12) and np.allclose(jnp.stack(below.normal), [0, 0, -1], atol=1e-12)
    beside = distance("cone", list(jnp.array([1.0, 0.0, 1.0])), up, rho, angle)
    moved = rho / np.sin(angle) - rho
    assert np.isclose(beside.value, np.cos(angle) - np.sin(angle) * (1.0 + moved), atol=1e-12)


def lying(order: int = 1, **changes) -> lj.Scene:
    """A cube is pressed on a plane by a traction. Its sides slide, so its stress is uniform."""
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), (2, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    sides = tuple(lj.Fixed(nodes=jnp.asarray(lj.boundary.select(mesh, {f"{a}_max": 0.0})), axes=a) for a in "xy")
    plane = Obstacle(triangles=surface(mesh, z_max=0.0), stiffness=1e6)
    push = lj.Traction(triangles=surface(mesh, z_min=SIDE), value=jnp.array([0.0, 0.0, -50.0]))
    return lj.Scene(mesh=mesh, law=LAW, fixed=sides, traction=(push,), physics=(plane,), solve=lj.Solve(**changes))


@pytest.mark.ci
@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_pressed_cube_sinks_by_pressure_over_stiffness(order):
    scene = lying(order)
    lj.check_scene(scene)

    def sunk(k):
        found = lj.simulate(lj.with_parameters(scene, {"obstacle.0.stiffness": k}))
        sole = np.flatnonzero(np.isclose(np.asarray(scene.mesh.points)[:, 2], 0.0))
        return found.positions[-1, sole, 2], found.status

    depth, slope, status = jax.jvp(sunk, (1e6,), (1.0,), has_aux=True)
    # The residual is 1e-8 of the acting forces.
    assert status.max() == 0 and np.allclose(depth, -50.0 / 1e6, rtol=1e-6)
    assert np.allclose(slope, 50.0 / 1e12, rtol=1e-6)


@pytest.mark.ci
def test_a_body_just_above_a_plane_counts_as_lying_on_it():
    """The check accepted a gap of 1e-7 of a triangle as contact, but the stiffness did not: the run failed."""
    scene = lying()
    heavy = lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -1.0]))
    plane = replace(scene.physics[0], position=jnp.array([0.0, 0.0, -2e-9]))
    scene = replace(scene, traction=(), body=heavy, physics=(plane,))
    lj.check_scene(scene)
    found = lj.simulate(scene).check()
    assert int(found.statistics.iterations[0]) < 10
    np.testing.assert_allclose(lj.obstacle_forces(scene, found).force[0, -1], [0, 0, -1000.0 * SIDE**3], atol=1e-7)


@pytest.mark.parametrize("gap", [0.0, 2e-9])
def test_a_body_is_pulled_off_a_plane_in_few_iterations(gap):
    """A surface without pressure had the contact stiffness up to 1e-6 of a triangle: an iteration moved it by 1 %."""
    scene = lying()
    x = scene.mesh.points
    plane = replace(scene.physics[0], position=jnp.array([0.0, 0.0, -gap]), stiffness=1e10)
    unit, term = jnp.zeros_like(x).at[:, 2].set(1.0), touching_term(plane, scene.mesh, jnp.zeros((2, 3)))

    @jax.jit
    def force(u):
        return jax.jvp(lambda u: term.force(scene.mesh, x + u * unit, 1.0)[:, 2].sum(), (u,), (1.0,))

    of_body, up, u = 1e-2 * float(force(0.0)[1]), 1e-8, 0.0
    assert of_body > 0  # the surface touches the plane
    for _ in range(3):
        held, slope = map(float, force(u))
        u += (of_body * (up - u) - held) / (of_body + slope)
    assert np.isclose(u, up, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize(("ratio", "volumetric", "depth"), [(3.0, "element", 5e-5), (1e3, "mixed", 2e-5)])
@pytest.mark.slow
def test_a_sphere_on_a_layer_takes_the_force_of_its_integral_equation(ratio, volumetric, depth, verified):
    """The mesh has about 500 quadratic elements. The contact is 6 to 10 % as wide as the sphere.

    At K/mu = 1000 and a depth of 5e-5, the force is 1.7 % below that of small strains on every mesh. This is an effect
    of finite strain, which falls with the depth.
    """
    from fitting.rigs.thin_layer import Indenter, Layer
    from liverjax.mesh import cylinders
    from liverjax.physics.sliding_support import SlidingSupport

    R, h, mu = 5e-3, 10e-3, 800.0
    a = np.sqrt(R * depth)
    radii = cylinders.graded(h, {0.0: a / 3, a: a / 6, h: h / 4}, h / 4, cylinders.GROWTH)
    heights = cylinders.graded(h, {0.0: h / 4, h: a / 6}, h / 4, cylinders.GROWTH)
    mesh, normal, parts, _ = cylinders.sector(radii, heights, 24)
    mesh = lj.quadratic(mesh)
    sets = {name: np.asarray(nodes) for name, nodes in mesh.node_sets.items()}
    fixed = [(sets["bottom"], "xyz"), (sets["start"], "y"), (np.intersect1d(sets["start"], sets["end"]), "xy")]
    top = lj.boundary.boundary_triangles(mesh, sets["top"])
    near = np.hypot(*np.asarray(mesh.points)[top].mean(axis=1)[:, :2].T) < 4 * a
    place, by = jnp.array([0.0, 0.0, h + R]), jnp.array([0.0, 0.0, -depth])
    sphere = Obstacle(triangles=jnp.asarray(top[near]), shape="sphere", radius=R, position=place, by=by)
    slides = SlidingSupport(nodes=jnp.asarray(sets["end"]), normal=jnp.asarray(normal))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=mu, bulk=ratio * mu),
        fixed=tuple(lj.Fixed(nodes=jnp.asarray(n), axes=axes) for n, axes in fixed),
        physics=(slides, sphere),
        solve=lj.Solve(steps=2, volumetric=volumetric),
    )
    found = lj.obstacle_forces(scene, lj.simulate(scene).check())
    poisson = (3 * ratio - 2) / (2 * (3 * ratio + 1))
    layer = Layer(Indenter(shape="sphere", radius=R, thickness=h, poisson=poisson))
    exact = 2 * mu * (1 + poisson) * float(layer.force(np.array([depth]))[0])
    error = abs(parts * float(found.force[0, -1, 2]) / exact - 1)
    verified(f"sphere on a layer, K/mu = {ratio:g}", "integral equation", error, 0.01)
    assert error < 0.01
    assert found.depth[0, -1] < 2e-3 * depth


@pytest.mark.slow
def test_a_falling_cube_bounces():
    """With Newmark's method and the contact force at the end of the step, the fraction exp(-pi w dt/2) of the energy is
    kept.
    """
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), (1, 1, 1))
    plane = Obstacle(triangles=surface(mesh, z_max=0.0), position=jnp.array([0.0, 0.0, -0.005]), stiffness=4e6)
    stiff = lj.laws.NeoHookean(mu=1e8, bulk=1e8)
    dt, steps = 5e-4, 170
    scene = lj.Scene(
        mesh=mesh,
        law=stiff,
        body=lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -9.81])),
        physics=(plane,),
        solve=lj.Solve(kind="dynamic", dt=dt, steps=steps, integrator="newmark"),
    )
    lj.check_scene(scene)
    result = lj.simulate(scene).check()
    z = np.asarray(result.positions)[:, :, 2].mean(axis=1) - SIDE / 2
    # A stiff cube of 1 kg falls 5 mm and bounces on a spring of stiffness times area, 40,000 N/m.
    fall = np.sqrt(2 * 0.005 / 9.81)
    w = np.sqrt(40000.0 / 1.0)
    touching = np.asarray(lj.obstacle_forces(scene, result).force)[0, :, 2] < -1e-9
    first, last = np.flatnonzero(touching)[[0, -1]]
    contact = (np.pi + 2 * np.arctan(9.81 / w / (9.81 * fall))) / w
    assert abs(first * dt - fall) < 2 * dt and abs((last - first + 1) * dt - contact) < 3 * dt
    height = 0.005 + z[last:].max()
    assert abs(height / 0.005 - np.exp(-0.5 * np.pi * w * dt)) < 0.05


@pytest.mark.slow
def test_gradients_through_closing_contact():
    """The force on a sphere is differentiated with respect to its depth and to the law's modulus. The error of
    difference quotients falls, reaches a minimum and rises.
    """
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), (2, 2, 2))
    sphere = Obstacle(
        triangles=surface(mesh, z_min=SIDE),
        shape="sphere",
        radius=0.2,
        position=jnp.array([0.045, 0.055, SIDE + 0.201]),
        by=jnp.array([0.0, 0.0, -0.01]),
    )
    scene = lj.Scene(
        mesh=mesh,
        law=LAW,
        fixed=(lj.Fixed(nodes=jnp.asarray(lj.boundary.select(mesh, {"z_max": 0.0}))),),
        physics=(sphere,),
        solve=lj.Solve(steps=2, tolerance=1e-12),
    )

    @jax.jit
    def force(p):
        changed = lj.with_parameters(
            scene, {"law.mu": p[0], "obstacle.0.by": jnp.stack([0.0 * p[1], 0.0 * p[1], p[1]])}
        )
        return lj.obstacle_forces(changed, lj.simulate(changed)).force[0, -1, 2]

    p = jnp.array([800.0, -0.01])
    assert force(p) > 0  # the body pushes the sphere upwards
    forward, backward = jax.jacfwd(force)(p), jax.grad(force)(p)
    assert np.allclose(forward, backward, rtol=1e-7)
    for k in range(2):
        unit = np.eye(2)[k] * np.asarray(p)
        errors = [
            abs((force(p + h * unit) - force(p - h * unit)) / (2 * h * p[k]) / forward[k] - 1)
            for h in (1e-3, 1e-4, 1e-5)
        ]
        assert min(errors) < 1e-6


@pytest.mark.ci
@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_forces_on_obstacles_know_regions_and_precision(precision):
    """The default contact stiffness follows from the law of each region, as in the run, so the forces balance."""
    scene = lying(steps=1, precision=precision, tolerance=1e-8 if precision == "float64" else 1e-4)
    stiff = lj.Region(elements=jnp.arange(8), law={"mu": 8e4})
    plane = replace(scene.physics[0], stiffness=None)
    scene = replace(scene, region=(stiff,), physics=(plane,))
    result = lj.simulate(scene).check()
    found = lj.obstacle_forces(scene, result)
    tolerance = 1e-6 if precision == "float64" else 1e-2
    assert np.isclose(found.force[0, -1, 2], -50.0 * SIDE**2, rtol=tolerance)


@pytest.mark.parametrize("order", [1, 2])
def test_the_default_stiffness_is_that_of_the_element_at_each_triangle(order):
    """The modulus was that of the stiffest element of the body, so a stiff region far away prevented convergence."""
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), (2, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    triangles = surface(mesh)
    at = [np.flatnonzero(np.isin(mesh.tetrahedra, own).sum(axis=1) == 3)[0] for own in np.asarray(triangles)]
    mu = jnp.linspace(1.0, 5.0, mesh.number_of_elements)
    law = replace(LAW, mu=mu, bulk=1.0)

    def stiffness(mesh, triangles, law):
        return Obstacle(triangles=triangles).in_body(mesh, mesh.at_points(law)).stiffness

    areas = np.linalg.norm(triangle_areas(mesh.points, triangles), axis=1)
    found = jax.jit(stiffness)(mesh, triangles, law)
    assert np.allclose(found, 100 * (1 + 4 / 3 * mu[np.array(at)]) / np.sqrt(areas))


def on_its_own() -> lj.Scene:
    """A cube without obstacles near it."""
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), (1, 1, 1))
    return lj.Scene(mesh=mesh, law=LAW, fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),))


@pytest.mark.slow  # the default run of tests/test_pay_for_what_is_there.py compares the equations themselves
def test_a_scene_without_obstacles_has_none_in_its_program():
    scene, place = on_its_own(), jnp.array([0.0, 0.0, -1.0])
    far = replace(scene, physics=(Obstacle(triangles=surface(scene.mesh), position=place),))
    with_, without = (len(str(jax.make_jaxpr(lj.simulate)(s))) for s in (far, scene))
    assert with_ > 1.02 * without


def test_a_scene_without_obstacles_has_no_forces_on_them():
    scene = on_its_own()
    nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(lj.simulate, scene))
    assert lj.obstacle_forces(scene, nothing).force.shape == (0, 1, 3)


SCENE = {
    "mesh": {"shape": "box", "size": [SIDE] * 3, "cells": [1, 1, 1]},
    "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
    "fixed": [{"where": {"z_max": 0.0}}],
}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"shape": "ball", "position": [0, 0, 1]}, "shape = 'ball' is not known"),
        ({"shape": "sphere", "position": [0, 0, 1]}, "is a sphere without radius: add this key"),
        ({"shape": "sphere", "radius": 0.1}, "is a sphere without position: add this key"),
        ({"shape": "sphere", "radius": 0.0, "position": [0, 0, 1]}, "must be above 0"),
        ({"shape": "sphere", "radius": -0.1, "position": [0, 0, 1]}, "must be at least 0 m: give e.g. 0.01"),
        (
            {"shape": "sphere", "radius": 0.1, "position": [0, 0, 0.15]},
            "the obstacle overlaps the body by 0.0[0-9]* m; move the obstacle out of the body",
        ),
        (
            {"shape": "sphere", "radius": 0.01, "position": [0.05, 0.05, 0.05]},
            "is inside the body: move the obstacle out",
        ),
        ({"shape": "cylinder", "radius": 0.01, "axis": [1, 0, 0], "position": [9, 0.05, 0.05]}, "inside the body"),
        ({"shape": "plane", "axis": [0, 0, 0], "position": [0, 0, -1]}, "must be of length 1"),
        ({"shape": "cone", "half_angle": 95.0, "axis": [0, 0, 1], "position": [0, 0, 1]}, "must be below 90"),
        ({"shape": "plane", "axis": [0, 0, 1], "position": [0, 0]}, "must be three numbers"),
        ({"shape": "plane", "axis": [0, 0, 1], "position": [True, 0, 1]}, "must be three numbers"),
        ({"shape": "plane", "axis": [0, 0, 1], "position": ["0", 0, 1]}, "must be three numbers"),
        ({"shape": "plane", "axis": [0, 0, 10**400], "position": [0, 0, 1]}, "must be three numbers"),
        ({"position": [0, 0, 1]}, "has no shape: use one of plane, sphere"),
        ({"shape": "sphere", "radius": [0.1, 0.2], "position": [0, 0, 1]}, "must be one number"),
        ({"shape": "plane", "axis": [0, 0, 1], "position": [0, 0, -1], "friction": [0.1]}, "must be one number"),
        ({"shape": "plane", "axis": [0, 0, 1], "position": [0, 0, -1], "radius": 0.1}, "which has no radius"),
        (
            {"shape": "plane", "axis": [0, 0, 1], "position": [0, 0, -1], "where": 3},
            "is not a table of bounds: write where",
        ),
    ],
)
def test_bad_obstacles_are_one_sentence(table, words):
    with pytest.raises(InputError, match=words) as error:
        scene_from(SCENE | {"obstacle": [table]})
    assert "obstacle.0" in str(error.value) and "\n" not in str(error.value)
