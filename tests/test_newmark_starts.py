"""Transient runs from given positions: the first acceleration contains all forces, and the initial stress relaxes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_simulation import LAW, bottom, box, march

import liverjax as lj
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.mesh.nodal import nodal_volumes
from liverjax.physics import boundary
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.inertia import Motion
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation.equations import initial_state

pytestmark = pytest.mark.quick_to_compile


def _let_go(**changes) -> lj.Scene:
    """A body of six elements, fixed at its bottom, with Newmark's method."""
    mesh = box(1)
    solve = lj.Solve(kind="dynamic", dt=0.01, integrator="newmark", tolerance=1e-10)
    return lj.Scene(mesh=mesh, law=LAW, body=lj.Body(density=1060.0), fixed=(bottom(mesh),), solve=solve, **changes)


def _stretched(scene: lj.Scene, by: float | jax.Array) -> jax.Array:
    return scene.mesh.points * (1 + by * jnp.array([[0.0, 0.0, 1.0]]))


@pytest.mark.slow
def test_newmark_keeps_its_order_from_a_stretched_start():
    """The body is stretched by 2 % and released. Without the law's force in the first acceleration, the order was 1."""
    scene = _let_go()
    start = _stretched(scene, 0.02)
    x = [np.asarray(state.x[-1]) for state, _ in march(scene, (10, 20, 40), 0.05, start)]
    observed = np.log2(np.linalg.norm(x[1] - x[0]) / np.linalg.norm(x[2] - x[1]))
    assert abs(observed - 2) < 0.25


def test_an_obstacle_on_its_way_does_not_push_at_the_start():
    """The obstacle begins at its position at time 0. The force at the end of the first step was once used instead."""
    scene = _let_go()
    top = jnp.asarray(boundary.boundary_triangles(scene.mesh, scene.mesh.node_sets["z_max"]))
    place, by = jnp.array([0.0, 0.0, float(scene.mesh.points[:, 2].max())]), jnp.array([0.0, 0.0, -0.01])
    scene = replace(scene, physics=(Obstacle(triangles=top, position=place, by=by, axis=jnp.array([0.0, 0.0, -1.0])),))
    scene = replace(scene, physics=tuple(p.in_body(scene.mesh, scene.law) for p in scene.physics))
    (motion,) = (m for m in initial_state(scene, scene.mesh.points).memories if isinstance(m, Motion))
    assert np.abs(motion.acceleration).max() < 1e-6


def test_a_pressed_plate_begins_with_the_acceleration_of_its_force():
    """The force acts from time 0 on. Without it in the first acceleration, the first displacement was half as large."""
    side = 0.01
    held = [{"where": {"z_max": 0.0}}, {"where": {"z_min": 0.0}, "axes": "xy"}]
    common = {
        "mesh": {"shape": "box", "size": [side] * 3, "cells": [1, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 2000.0},
        "fixed": held,
        "body": {"density": 1000.0},
        "solve": {"kind": "dynamic", "integrator": "newmark", "dt": 1e-4, "steps": 1},
    }
    plate = {"shape": "plane", "position": [0, 0, side], "axis": [0, 0, -1.0], "force": [0, 0, -5e-3]}
    plate |= {"history": [[0, 1], [1, 1]], "where": {"z_min": side}}
    scene = scene_from(common | {"obstacle": [plate]})
    (motion,) = (m for m in initial_state(scene).memories if isinstance(m, Motion))
    mass = 1000.0 * np.asarray(nodal_volumes(scene.mesh))
    # The force is balanced up to the rounding of positions times the plate's stiffness.
    assert np.isclose(mass @ np.asarray(motion.acceleration)[:, 2], -5e-3, rtol=1e-6)


@pytest.mark.slow
def test_a_step_too_short_for_the_digits_is_told_as_roundoff():
    """4 m/dt^2 times the rounding of positions is above the tolerance. Each step was cut 12 times without success."""
    mesh = box(1)
    body, solve = lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -9.81])), lj.Solve(kind="dynamic", dt=1e-6)
    solve = replace(solve, steps=2, integrator="newmark")
    result = lj.simulate(lj.Scene(mesh=mesh, law=LAW, body=body, fixed=(bottom(mesh),), solve=solve))
    assert int(result.statistics.cuts.sum()) == 0 and int(result.status[0]) == status.STALLED
    assert "very short time steps" in status.advice(status.STALLED)


@pytest.mark.slow
def test_derivatives_by_a_stretched_start():
    scene = _let_go()

    @jax.jit
    def end(by: jax.Array) -> jax.Array:
        run = replace(scene, solve=replace(scene.solve, steps=3))
        return jnp.sum(lj.simulate(run, start=_stretched(scene, by)).positions[-1, -1])

    h = 1e-4
    difference = (end(jnp.asarray(0.02 + h)) - end(jnp.asarray(0.02 - h))) / (2 * h)
    assert np.isclose(jax.grad(end)(jnp.asarray(0.02)), difference, rtol=1e-5)


@pytest.mark.ci
def test_the_first_acceleration_has_all_forces_at_the_start():
    """Mass times acceleration is minus the law's force, plus the fluid pressure of a porous body, P0 on a third of the
    area.
    """

    def push(scene: lj.Scene, start: jax.Array | None = None) -> np.ndarray:
        state = initial_state(scene, start)
        motion = next(m for m in state.memories if isinstance(m, Motion))
        return np.asarray(1060.0 * nodal_volumes(scene.mesh)[:, None] * motion.acceleration)

    scene = _let_go()
    X = scene.mesh.points
    free = np.asarray(X[:, 2:] > 0)
    start = X * jnp.array([[1.0, 1.0, 1.02]])
    expected = np.where(free, -np.asarray(mjed.internal_force(scene.mesh, LAW, start)), 0.0)
    assert np.allclose(push(scene, start), expected, rtol=1e-10, atol=1e-12 * np.abs(expected).max())
    mixed = replace(scene, solve=replace(scene.solve, volumetric="mixed"))
    # In a uniform state, the unknown pressures are those of the law.
    assert np.allclose(push(mixed, start), expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    wet = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-9, initial_pressure=50.0)
    surface = (lj.Traction(triangles=jnp.asarray(boundary.boundary_triangles(scene.mesh)), pressure=-50.0),)
    out = np.where(free, np.asarray(boundary.follower_forces(surface, X)), 0.0)
    assert np.allclose(push(replace(scene, porosity=wet)), out, rtol=1e-8, atol=1e-10 * np.abs(out).max())
    assert np.all(push(scene) == 0.0)


@pytest.mark.parametrize(
    ("order", "part", "tau"),
    [pytest.param(*c, marks=pytest.mark.slow) for c in ((1, "isochoric", 0.1), (2, "all", [[0.1] * 6]))],
)
def test_the_stress_at_the_start_relaxes_from_its_first_moment(order, part, tau):
    """With constant positions, the force is the elastic one times 1 - g (1 - exp(-t/tau)), exact for a constant
    stress.
    """
    mesh = box(1) if order == 1 else lj.quadratic(box(1))
    by = 0.05 * mesh.points * jnp.array([[0.0, 0.0, 1.0]])
    everywhere = jnp.arange(mesh.number_of_nodes)
    held = lj.Displaced(nodes=everywhere, by=by, times=jnp.array([0.0, 1.0]), history=jnp.array([1.0, 1.0]))
    law = lj.laws.StableNeoHookean(mu=800.0, lame_lambda=0.0) if part == "all" else LAW
    viscous = lj.Prony(
        ratios=jnp.full(np.shape(tau) or (1,), 0.4), relaxation_times=jnp.atleast_1d(jnp.array(tau)), part=part
    )
    solve = lj.Solve(kind="dynamic", dt=0.05, steps=4, tolerance=1e-10)
    scene = lj.Scene(
        mesh=mesh, law=law, viscosity=viscous, body=lj.Body(density=1060.0), displaced=(held,), solve=solve
    )
    found = lj.simulate(scene, start=mesh.points + by).check()
    left = 1 - 0.4 * (1 - np.exp(-np.asarray(found.times) / 0.1))
    whole = mjed.internal_force(mesh, law.isochoric_part() if part == "isochoric" else law, mesh.points + by)
    rest = mjed.internal_force(mesh, law.volumetric_part(), mesh.points + by) if part == "isochoric" else 0.0
    exact = left[:, None, None] * np.asarray(whole)[None] + np.asarray(rest)
    assert np.allclose(found.reactions, exact, rtol=1e-9, atol=1e-12 * np.abs(exact).max())


def test_no_stress_has_relaxed_and_no_fluid_has_flowed_in_the_first_acceleration():
    """The stress and the pressures after a whole first step were once used."""
    scene = _let_go()
    start, top = _stretched(scene, 0.1), jnp.asarray(scene.mesh.node_sets["z_max"])

    @jax.jit
    def first(permeability: float, ratio: float) -> jax.Array:
        wet = {"permeability": permeability, "initial_pressure": 50.0, "drained": top}
        porous = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, **wet)
        viscous = lj.Prony(ratios=jnp.array([ratio]), relaxation_times=jnp.array([0.01]))
        state = initial_state(replace(scene, porosity=porous, viscosity=viscous), start)
        return next(m for m in state.memories if isinstance(m, Motion)).acceleration

    found, expected = first(1e-4, 0.8), first(0.0, 0.0)
    assert np.allclose(found, expected, rtol=1e-10, atol=1e-10 * float(jnp.abs(expected).max()))
