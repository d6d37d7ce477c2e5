"""Coulomb friction at rigid obstacles: a block on an incline, its tangent, derivatives, invalid input."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import in_precision, replace
from liverjax.mesh.nodal import nodal_volumes
from liverjax.physics.base import Free, Step
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation.cautions import of_contacts, of_run
from liverjax.solvers import attached

pytestmark = pytest.mark.quick_to_compile

SIDE, G, TAN = 0.1, 9.81, 0.4
DT, STEPS = 2e-3, 50


def block(mu: float, order: int = 1, **solve) -> lj.Scene:
    """A stiff cube of 1 kg on a plane. Gravity is tilted from the normal by the angle of the incline."""
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), (1, 1, 1))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    sole = lj.boundary.boundary_triangles(mesh, lj.boundary.select(mesh, {"z_max": 0.0}))
    gravity = G * np.array([TAN, 0.0, -1.0]) / np.hypot(TAN, 1)
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1e6, bulk=1e6),
        body=lj.Body(density=1000.0, gravity=jnp.asarray(gravity)),
        physics=(RoughObstacle(triangles=jnp.asarray(sole), stiffness=4e7, friction=mu),),
        solve=lj.Solve(**solve),
    )


def velocity(scene: lj.Scene, result) -> float:
    """Return the velocity of the centre of mass along the incline in the last step [m/s]."""
    m = np.asarray(nodal_volumes(scene.mesh))
    last = np.asarray(result.positions[-1] - result.positions[-2])[:, 0]
    return float(m @ last / m.sum() / DT)


@pytest.mark.ci
def test_a_block_sticks_below_the_angle_of_friction_and_slides_above():
    """The speed is g (sin - mu cos) t, and the shear force is mu times the normal force of the plane."""
    seen = {}
    for mu in (0.5, 0.3):
        scene = block(mu, kind="dynamic", dt=DT, steps=STEPS)
        lj.check_scene(scene)
        result = lj.simulate(scene).check()
        force = np.asarray(lj.obstacle_forces(scene, result).force)[0]
        seen[mu] = velocity(scene, result), np.linalg.norm(force[:, :2], axis=1) / -force[:, 2]
    speed = G * (TAN - 0.3) / np.hypot(TAN, 1) * DT * STEPS
    # The block oscillates on its contact at about 60 Hz. The amplitude is part of the slip before sliding, mu F/(k A) =
    # 10 um.
    rocks = 2 * np.pi * 60 * 1e-5
    assert rocks < 0.05 * speed
    assert abs(seen[0.3][0] - speed) < rocks and abs(seen[0.5][0]) < rocks
    # The points slide in nearly one direction, which becomes more exact as the oscillation decays.
    assert np.all(seen[0.3][1] <= 0.3 * (1 + 1e-9))
    assert np.allclose(seen[0.3][1][5:], 0.3, rtol=1e-3) and np.allclose(seen[0.3][1][-20:], 0.3, rtol=1e-5)
    assert np.all(seen[0.5][1][5:] < 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_at_rest_the_plane_carries_the_weight(order):
    """If the block sticks, the force of the plane is the weight. Beyond the angle of friction there is no
    equilibrium.
    """
    scene = block(0.5, order, steps=2, tolerance=1e-10)
    lj.check_scene(scene)
    result = lj.simulate(scene).check()
    weight = np.asarray(scene.body.gravity) * 1000.0 * SIDE**3
    assert np.allclose(lj.obstacle_forces(scene, result).force[0, -1], weight, atol=1e-8 * G)
    slides = lj.simulate(lj.with_parameters(scene, {"obstacle.0.friction": 0.3}))
    assert slides.status[-1] != status.CONVERGED
    assert any("only friction prevents sliding of the body" in said for said in of_run.cautions_of_run(scene, slides))
    assert not any("only friction" in said for said in of_run.cautions_of_run(scene, result))


def test_a_failed_run_of_a_body_that_only_friction_holds_says_so():
    scene, failed = block(0.5), SimpleNamespace(statistics=SimpleNamespace(status=np.array([status.NOT_FINITE])))
    assert "[[fixed]]" in of_contacts.of_friction_alone(scene, failed)[0]
    held = replace(scene, fixed=(lj.Fixed(nodes=scene.mesh.node_sets["x_min"]),))
    assert of_contacts.of_friction_alone(held, failed) == []
    moving = replace(scene, solve=lj.Solve(kind="dynamic", dt=DT))
    assert of_contacts.of_friction_alone(moving, failed) == []


@pytest.mark.parametrize("order", [1, 2])
def test_the_tangent_is_the_derivative_of_the_force(order):
    """Some points stick, some slide, and some do not touch."""
    scene = block(0.3, order)
    mesh = scene.mesh
    at_random = np.random.default_rng(14).normal(size=(2, *mesh.points.shape))
    step = Step(mesh, mesh.points - jnp.array([[0.0, 0.0, 2e-5]]), 1.0, 1, None, False, None, Free(jnp.ones(())))
    acting = scene.physics[0].freeze(None, step)
    x, v = step.x + 1e-5 * np.array([[0.5, 0.5, 3.0]]) * at_random[0], jnp.asarray(at_random[1])
    slip = np.linalg.norm(acting.slip_at(acting.points(x), 1.0), axis=0)
    free = np.linalg.norm(replace(acting, friction=1e9).slip_at(acting.points(x), 1.0), axis=0)
    kinds = {"open": np.any(slip == 0), "sticks": np.any((slip > 0) & (slip == free)), "slides": np.any(slip < free)}
    assert all(kinds.values()), kinds
    exact = jax.jvp(lambda x: acting.force(mesh, x, 1.0), (x,), (v,))[1]
    K = acting.attached(mesh, x, 1.0)
    found = jnp.stack(attached.product(K, tuple(v.T)), axis=1)
    assert np.allclose(found, exact, rtol=0, atol=1e-12 * np.abs(exact).max())
    assert not np.allclose(K.blocks, attached.symmetric_part(K).blocks, atol=1e-3 * np.abs(K.blocks).max())


@pytest.mark.parametrize("order", [1, 2])
def test_a_search_sees_an_energy_whose_gradient_is_the_force(order):
    """The second derivative of this energy has no negative eigenvalue. Where no point slides, it is the tangent
    itself.
    """
    scene = block(0.3, order)
    mesh = scene.mesh
    step = Step(mesh, mesh.points - jnp.array([[0.0, 0.0, 2e-5]]), 1.0, 1, None, False, None, Free(jnp.ones(())))
    acting = scene.physics[0].freeze(None, step)
    x = step.x + 1e-5 * np.array([[0.5, 0.5, 3.0]]) * np.random.default_rng(14).normal(size=mesh.points.shape)
    slope = jax.grad(lambda x, start: acting.energy_from(mesh, x, start))(x, x)
    exact = acting.force(mesh, x, 1.0)
    assert np.allclose(slope, exact, rtol=0, atol=1e-12 * np.abs(exact).max())
    v = jnp.asarray(np.random.default_rng(0).normal(size=x.shape))
    curved = jax.jvp(lambda y: jax.grad(lambda y: acting.energy_from(mesh, y, x))(y), (x,), (v,))[1]
    K = acting.definite(mesh, x, 1.0)
    found = jnp.stack(attached.product(K, tuple(v.T)), axis=1)
    assert np.allclose(found, curved, rtol=0, atol=1e-10 * np.abs(curved).max())
    size = np.linalg.eigvalsh(np.moveaxis(np.asarray(K.blocks).reshape(*2 * (3 * len(K.nodes),), -1), -1, 0))
    assert size.min() > -1e-12 * size.max()
    sticks = replace(acting, friction=1e9)
    a, b = (K.blocks for K in (sticks.definite(mesh, x, 1.0), sticks.attached(mesh, x, 1.0)))
    assert np.allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max())


@pytest.mark.slow
def test_derivative_of_the_way_by_the_coefficient():
    """For implicit Euler the derivative is -g cos n(n+1)/2 dt^2. The error of difference quotients falls, reaches a
    minimum and rises. With mu = 0 there is no friction.
    """
    scene = block(0.3, kind="dynamic", dt=DT, steps=STEPS, tolerance=1e-11)
    m = nodal_volumes(scene.mesh) / SIDE**3

    @jax.jit
    def way(mu):
        end = lj.simulate(lj.with_parameters(scene, {"obstacle.0.friction": mu})).positions[-1, :, 0]
        return jnp.sum(m * end)

    by, reverse = jax.jit(jax.jacfwd(way))(0.3), jax.grad(way)(0.3)
    expected = -G / np.hypot(TAN, 1) * STEPS * (STEPS + 1) / 2 * DT**2
    # In the first step the deepest points still stick. This step contributes 50 of 1275 parts to the displacement.
    assert np.isclose(by, expected, rtol=STEPS / (STEPS * (STEPS + 1) / 2)) and np.isclose(by, reverse, rtol=1e-7)
    errors = [abs((way(0.3 + h) - way(0.3 - h)) / (2 * h) / by - 1) for h in (3e-2, 1e-4, 1e-9)]
    assert errors[1] < 1e-5 and errors[1] < errors[0] and errors[1] < errors[2]
    plain = {f: getattr(scene.physics[0], f) for f in ("triangles", "stiffness")}
    smooth = lj.simulate(replace(scene, physics=(Obstacle(**plain),))).positions[-1, :, 0]
    assert np.isclose(way(0.0), jnp.sum(m * smooth), rtol=1e-9)


def test_bad_friction_is_one_sentence():
    table = {"shape": "plane", "position": [0, 0, 0], "axis": [0, 0, 1], "friction": 0.3}
    scene = {
        "mesh": {"shape": "box", "size": [SIDE] * 3, "cells": [1, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "obstacle": [table],
    }
    # Friction supports a body along the plane, so no other support is needed.
    found = scene_from(scene)
    assert isinstance(found.physics[0], RoughObstacle)
    with pytest.raises(InputError, match="do not prevent every rigid motion of the body"):
        scene_from(scene | {"obstacle": [table | {"friction": 0.0}]})
    with pytest.raises(InputError, match=r"obstacle\.0\.friction = -0\.1"):
        scene_from(scene | {"obstacle": [table | {"friction": -0.1}]})


def test_a_point_that_has_not_moved_has_derivatives():
    """In single precision, the reverse-mode derivatives of the slip were NaN at a point without any slip."""
    scene, dtype = block(0.3), jnp.float32
    mesh = jax.tree.map(partial(in_precision, dtype=dtype), scene.mesh)
    (rough,) = jax.tree.map(partial(in_precision, dtype=dtype), scene.physics)
    x = mesh.points - jnp.array([[0.0, 0.0, 1e-3]], dtype)
    one = jnp.ones((), dtype)
    acting = rough.freeze(None, Step(mesh, x, 1, 1, one, True, None, Free(jnp.ones_like(x))))
    _, back = jax.vjp(lambda at: acting.slip_at(at, one), acting.points(x))
    (slope,) = back(jnp.ones_like(acting.past))
    # A point that sticks keeps its whole motion along the plane.
    assert slope.dtype == dtype and np.array_equal(slope[:2], np.ones(slope[:2].shape)) and not np.any(slope[2])
