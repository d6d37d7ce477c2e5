"""Obstacles under a force: a bar by hand, the body under the displacement that was found, unloading, derivatives."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.physics.base import Step
from liverjax.physics.contact.obstacle import Obstacle, largest_depth, touching_term
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation import run
from liverjax.simulation.cautions import of_contacts
from liverjax.simulation.cautions.of_run import cautions_of_run

pytestmark = pytest.mark.quick_to_compile

LAW = lj.laws.NeoHookean(mu=800.0, bulk=4000.0)
SIDE = 0.01


def cube(obstacle, order=1, cells=(2, 2, 2), **changes):
    """A cube of 1 cm on a table."""
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), cells)
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    top = lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_max"])
    given = {"fixed": (lj.Fixed(nodes=mesh.node_sets["z_min"]),), "solve": lj.Solve(steps=2, tolerance=1e-10)} | changes
    return lj.Scene(mesh=mesh, law=LAW, physics=(obstacle(jnp.asarray(top)),), **given)


def plane(top, **numbers):
    place = {"position": jnp.array([0.0, 0.0, SIDE]), "axis": jnp.array([0.0, 0.0, -1.0])}
    return PressedObstacle(triangles=top, shape="plane", **place | numbers)


def sphere(kind, top, **numbers):
    place = {"position": jnp.array([0.4 * SIDE, 0.5 * SIDE, SIDE + 0.006]), "radius": 0.005}
    return kind(triangles=top, shape="sphere", **place, **numbers)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_a_plate_on_a_held_bar(order, verified):
    """Without lateral motion, the stress is F/A at one stretch. The plate's penetration follows from its stiffness."""
    F, hardness = 0.05, 1e8
    scene = cube(lambda top: plane(top, force=jnp.array([0.0, 0.0, -F]), stiffness=hardness), order, (1, 1, 2))
    nodes = jnp.arange(scene.mesh.number_of_nodes)
    scene = replace(scene, fixed=(*scene.fixed, lj.Fixed(nodes=nodes, axes="xy")))
    result = lj.simulate(scene).check()
    found = lj.obstacle_forces(scene, result)

    def stress(stretch):
        return float(LAW.first_piola(jnp.diag(jnp.array([1.0, 1.0, stretch])))[2, 2])

    stretch = scipy.optimize.brentq(lambda l: stress(l) + F / SIDE**2, 0.5, 1.0, xtol=1e-15)
    travel = SIDE * (1 - stretch) + F / SIDE**2 / hardness
    error = abs(float(found.displacement[0, -1, 2]) / -travel - 1)
    verified(f"plate under a weight on a held bar, order {order}", "root of one equation", error, 1e-8)
    assert error < 1e-8
    np.testing.assert_allclose(found.force[0, :, 2], [F / 2, F], rtol=1e-10)
    np.testing.assert_allclose(result.positions[-1][scene.mesh.node_sets["z_max"], 2], SIDE * stretch, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_a_ball_pressed_is_the_ball_moved_as_far(order):
    """The ball starts 1 mm above the body. The displacement found for a force gives this force."""
    force = jnp.array([0.0, 0.002, -0.02])
    pressed = cube(lambda top: sphere(PressedObstacle, top, force=force), order)
    at_rest = lj.simulate(pressed).check()
    found = lj.obstacle_forces(pressed, at_rest)
    along = np.asarray(force) / np.linalg.norm(force)
    travel = np.asarray(found.displacement[0])
    assert travel[-1] @ along > 1e-3
    np.testing.assert_allclose(np.cross(travel, along), 0, atol=1e-15)
    np.testing.assert_allclose(
        np.asarray(found.force[0]) @ -along, np.linalg.norm(force) * np.array([0.5, 1]), rtol=1e-9
    )
    moved = cube(lambda top: sphere(Obstacle, top, by=jnp.asarray(travel[-1])), order)
    np.testing.assert_allclose(lj.simulate(moved).check().positions[-1], at_rest.positions[-1], atol=1e-10)


@pytest.mark.slow
def test_a_load_that_goes_lets_the_body_back():
    history = {"times": jnp.array([0.0, 0.2, 0.4]), "history": jnp.array([0.0, 1.0, 0.0])}
    scene = cube(
        lambda top: sphere(PressedObstacle, top, force=jnp.array([0.0, 0.0, -0.02]), **history),
        solve=lj.Solve(steps=4, dt=0.1, tolerance=1e-10),
    )
    result = lj.simulate(scene).check()
    found = lj.obstacle_forces(scene, result)
    np.testing.assert_allclose(found.force[0, :, 2], [0.01, 0.02, 0.01, 0.0], atol=1e-11)
    np.testing.assert_allclose(result.positions[-1], scene.mesh.points, atol=1e-9)
    np.testing.assert_allclose(result.positions[0], result.positions[2], atol=1e-9)
    assert found.displacement[0, -1, 2] > found.displacement[0, 0, 2]


@pytest.mark.slow
def test_the_travel_has_derivatives():
    """All points touch, so no difference quotient opens a point. The bulk modulus is not 3 mu, where the default
    stiffness has a kink.
    """
    tilted = {"axis": jnp.array([0.0, np.sin(0.02), -np.cos(0.02)]), "position": jnp.array([0.0, 0.0, SIDE])}
    scene = cube(lambda top: plane(top, force=jnp.array([0.0, 0.0, -0.05]), **tilted), cells=(1, 1, 1))

    def travel(mu):
        own = lj.with_parameters(scene, {"law.mu": mu})
        return lj.obstacle_forces(own, lj.simulate(own)).displacement[0, -1, 2]

    value, slope = jax.jvp(travel, (800.0,), (1.0,))
    errors = [abs(float(travel(800.0 + h) - travel(800.0 - h)) / (2 * h) / slope - 1) for h in (20.0, 2.0)]
    assert errors[0] < 1e-2 and errors[1] < 0.02 * errors[0]
    assert slope > 0 > value  # a stiffer contact is less deep


@pytest.mark.slow
def test_gradients_through_a_pressed_obstacle():
    scene = cube(lambda top: sphere(PressedObstacle, top, force=jnp.array([0.0, 0.0, -0.02])))

    def top(log):
        own = lj.with_parameters(scene, {"law.mu": 800.0 * jnp.exp(log)})
        return 1e3 * jnp.mean(lj.simulate(own).positions[-1][scene.mesh.node_sets["z_max"], 2])

    slope = float(jax.grad(top)(0.0))
    errors = [abs(float(top(h) - top(-h)) / (2 * h) / slope - 1) for h in (1e-2, 1e-3, 1e-4)]
    assert slope > 0 and min(errors) < 1e-6


@pytest.mark.slow
def test_a_body_on_which_a_plate_lies_with_inertia():
    """A plate without mass lies on a body that falls back. Its force is the given one at every step."""
    scene = cube(
        lambda top: plane(top, force=jnp.array([0.0, 0.0, -0.02])),
        cells=(1, 1, 1),
        body=lj.Body(density=1000.0, gravity=(0.0, 0.0, 0.0)),
        solve=lj.Solve(kind="dynamic", dt=0.01, steps=3),
    )
    found = lj.obstacle_forces(scene, lj.simulate(scene).check())
    np.testing.assert_allclose(found.force[0, :, 2], 0.02 * np.array([1, 2, 3]) / 3, rtol=1e-9)


CONTENT = {
    "mesh": {"shape": "box", "size": [0.01, 0.01, 0.01], "cells": [1, 1, 1]},
    "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 2400.0},
    "fixed": [{"where": {"z_max": 0.0}}],
}
BALL = {"shape": "sphere", "radius": 0.005, "position": [0.005, 0.005, 0.016], "force": [0, 0, -0.01]}


def test_scene_files_press_an_obstacle():
    scene = scene_from(CONTENT | {"obstacle": [BALL | {"history": [[0, 0], [1, 1]]}], "solve": {"dt": 0.5, "steps": 2}})
    assert isinstance(scene.physics[0], PressedObstacle)
    assert scene.physics[0].load(1, 2, 0.5) == pytest.approx(0.005)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"force": [0, 0, 1.0]}, "presses the obstacle past the body"),
        ({"force": [0, 0, 0]}, "not all 0"),
        ({"force": [0, 1]}, "must be three numbers"),
        ({"force": [0, 0, -1], "by": [0, 0, 1]}, "obstacle.0 has force together with by: remove one"),
        ({"force": [0, 0, -1], "friction": 0.5}, "obstacle.0 has force together with friction: remove one"),
        ({"history": [[0, 0, 0, 1]]}, "history"),
        ({"history": [[0, 1], [1, -0.5]]}, "factor -0.5, but the force of an obstacle can only press"),
    ],
)
def test_obstacles_that_cannot_be_pressed_get_one_sentence(change, words):
    with pytest.raises(lj.InputError, match=words) as told:
        scene_from(CONTENT | {"obstacle": [BALL | change], "solve": {"dt": 1.0}})
    assert "\n" not in str(told.value)


@pytest.mark.slow
def test_a_ball_between_the_contact_points_is_told():
    """The force is right, but the position is not. Of a displacement of 4.7 mm, 3.6 mm were inside the body, without a
    warning.
    """
    table = {
        "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [2, 2, 2]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "fixed": [{"where": {"z_max": 0.0}}],
        "obstacle": [{"shape": "sphere", "radius": 0.02, "position": [0.03, 0.03, 0.12], "force": [0, 0, -0.05]}],
    }
    scene = scene_from(table)
    said = cautions_of_run(scene, lj.simulate(scene).check())
    assert any("obstacle.0 penetrates the body by 0.0036 m between the points" in sentence for sentence in said)
    small = {"shape": "sphere", "radius": 0.006, "position": [0.0333, 0.0333, 0.106], "force": [0, 0, -0.02]}
    with pytest.raises(lj.InputError, match="passes between the points at which contact is tested"):
        scene_from(table | {"obstacle": [small]})
    with pytest.raises(lj.InputError, match="presses the obstacle past the body"):
        scene_from(table | {"obstacle": [small | {"position": [0.2, 0.2, 0.2]}]})


@pytest.mark.slow
def test_a_light_force_is_balanced_to_the_roundoff_of_positions():
    """When 16 digits of the force were required, no displacement was found, and every step failed."""
    scene = cube(lambda top: sphere(PressedObstacle, top, force=jnp.array([0.0, 0.0, -1.0])))
    run = jax.jit(lj.simulate)
    for force in (1e-2, 1e-3, 1e-4, 1e-5, 1e-7):
        own = lj.with_parameters(scene, {"obstacle.0.force": jnp.array([0.0, 0.0, -force])})
        result = run(own).check()
        found = lj.obstacle_forces(own, result).force[0, -1, 2]
        # Contact stiffness times the rounding of positions: about 1e4 N/m and 2e-18 m here.
        assert abs(float(found) / force - 1) < 1e-6


def test_derivatives_where_a_surface_just_touches():
    """A minimum has half of the derivative at 0, and all or none of it if the distance is rounded. The derivative was
    45 times too large.
    """
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), (2, 2, 2))
    top = jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_max"]))
    place = {"position": jnp.array([0.0, 0.0, SIDE]), "axis": jnp.array([0.0, 0.0, -1.0])}
    flat = Obstacle(triangles=top, shape="plane", stiffness=1e6, **place)

    def force(depth):
        moved = jnp.zeros((2, 3)).at[:, 2].set(-depth)
        return jnp.sum(touching_term(flat, mesh, moved).force(mesh, mesh.points, 1.0)[:, 2])

    for derivative in (jax.grad, jax.jacfwd):
        at_touch, pressed, apart = (float(derivative(force)(v)) for v in (0.0, 1e-9, -1e-6))
        assert at_touch == pytest.approx(pressed, rel=1e-9)
        assert at_touch == pytest.approx(1e6 * SIDE**2, rel=1e-9) and apart == 0

    def deepest(depth):
        return largest_depth(flat, mesh, mesh.points, jnp.array([0.0, 0.0, -1.0]) * depth)

    assert float(jax.grad(deepest)(0.0)) == pytest.approx(1.0, rel=1e-12) and float(jax.grad(deepest)(-1e-6)) == 0


@pytest.mark.parametrize("shape", ["plane", "sphere"])
def test_the_travel_of_a_pressed_obstacle_has_second_derivatives(shape):
    """One Newton step from the solution gives first derivatives only. The second ones were 12 times too large for a
    sphere.
    """
    scene = cube(
        lambda top: (
            plane(top, force=jnp.array([0.0, 0.0, -0.1]), stiffness=1e6)
            if shape == "plane"
            else sphere(PressedObstacle, top, force=jnp.array([0.0, 0.0, -0.1]), stiffness=1e8)
        )
    )
    x = scene.mesh.points
    (own,) = scene.physics
    acting = own.freeze(None, Step(scene.mesh, x, 1, 1, None, False, None, None))

    def travel(load):
        return replace(acting, load=jnp.stack([jnp.zeros(()), load])).travel(acting.points(x), 1.0)

    v, h = 0.1, 1e-3
    first, second = jax.jit(jax.jacfwd(travel)), jax.jit(jax.jacfwd(jax.jacfwd(travel)))
    away = [float(first(v + k * h)) for k in (-2, -1, 1, 2)]
    exact = (8 * (away[2] - away[1]) - (away[3] - away[0])) / (12 * h)
    # Fourth order in h / v, and rounding of the first derivative over h.
    assert float(second(v)) == pytest.approx(exact, rel=1e-5, abs=1e-9 * abs(away[0]) / h)
    if shape == "plane":  # without a load the plane just touches: 1 / (sum of the stiffness of its points)
        assert float(first(0.0)) == pytest.approx(away[0], rel=1e-9)


def test_a_body_with_a_given_loaded_shape_is_unloaded_only_once():
    """After the run, the reference points were unloaded once more. A caution uses the displacement of the obstacle."""
    scene = cube(partial(plane, force=jnp.array([0.0, 0.0, -1e-3])), cells=(1, 1, 1), solve=lj.Solve(steps=1))
    result = SimpleNamespace(positions=scene.mesh.points[None], times=np.ones(1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "unload", None)  # a call would fail
        assert of_contacts.of_obstacles(replace(scene, points_are="loaded"), result) == []


def test_a_weight_just_above_a_body_presses_it_in_few_iterations():
    """The tangent had the stiffness of the contact at this gap, the balance of the weight had not: 325 iterations."""
    place, force = jnp.array([0.0, 0.0, SIDE + 2e-9]), jnp.array([0.0, 0.0, -1e-8])
    found = lj.simulate(cube(lambda top: plane(top, force=force, position=place))).check()
    assert max(found.statistics.iterations) < 10
