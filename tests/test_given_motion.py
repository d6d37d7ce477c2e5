"""Newmark's method with a given motion: displaced nodes and plates with a given angle have second-order reactions."""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from test_simulation import LAW, bottom, box

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.physics.prescribed import given_acceleration
from liverjax.physics.rigid_plate import RigidPlate

pytestmark = pytest.mark.quick_to_compile

_TIMES = np.linspace(0.0, 0.2, 2001)
#: Begins at rest, but with an acceleration.
_COURSE = 1.0 - np.cos(2 * np.pi * _TIMES / 0.1)


def test_the_acceleration_of_a_cubic_motion_is_exact_at_every_step():
    dt, steps = 0.1, 5
    t = dt * np.arange(1, steps + 1)
    cubic = [given_acceleration(lambda k: (dt * jnp.asarray(k, float)) ** 3, k, steps, dt) for k in range(1, steps + 1)]
    assert np.allclose(cubic, 6 * t, atol=1e-12)
    assert np.isclose(given_acceleration(lambda k: (dt * k) ** 2, 0, steps, dt), 2.0)


def test_a_body_that_starts_with_a_jump_of_velocity_stops_nowhere():
    """At constant velocity the acceleration is 0 at the end of every step, also of the last one."""
    for steps in (1, 2, 3, 4):
        found = [
            float(given_acceleration(lambda k: 0.5 * jnp.asarray(k, float), k, steps, 1.0)) for k in range(steps + 1)
        ]
        assert found == [1.0] + [0.0] * steps


def _ends(scene: lj.Scene, moved: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the last positions, and the reactions on some nodes at half time and at the end."""
    solve = lj.Solve(kind="dynamic", dt=0.06 / steps, steps=steps, integrator="newmark", tolerance=1e-9)
    result = lj.simulate(replace(scene, solve=solve)).check()
    return np.asarray(result.positions)[-1], np.asarray(result.reactions)[[steps // 2 - 1, -1]][:, moved].sum(axis=1)


def _order(scene: lj.Scene, moved: np.ndarray) -> list[float]:
    runs = [_ends(scene, moved, steps) for steps in (30, 60, 120)]
    size = [[float(np.linalg.norm(a - b)) for a, b in zip(one, two, strict=True)] for one, two in pairwise(runs)]
    return [float(np.log2(a / b)) for a, b in zip(*size, strict=True)]


@pytest.mark.ci
@pytest.mark.parametrize("mass", ["lumped", pytest.param("consistent", marks=pytest.mark.slow)])
def test_displaced_nodes_have_reactions_of_second_order(mass):
    """The inertia force of displaced nodes was that of one step before: the reactions were of first order and, with a
    consistent mass, the positions of the other nodes, too."""
    mesh = box(2)
    way = jnp.asarray(np.outer(_COURSE, [0.01, 0.0, 0.005]))
    moved = lj.Displaced(nodes=mesh.node_sets["z_max"], times=jnp.asarray(_TIMES), history=way)
    scene = lj.Scene(mesh=mesh, law=LAW, body=lj.Body(density=1060.0, mass=mass), fixed=(bottom(mesh),))
    assert min(_order(replace(scene, displaced=(moved,)), np.asarray(moved.nodes))) > 1.7


@pytest.mark.slow
def test_a_plate_with_a_given_angle_has_a_torque_of_second_order():
    mesh = box(2)
    nodes = jnp.asarray(mesh.node_sets["z_max"])
    plate = RigidPlate(
        nodes=nodes, turn=jnp.asarray(0.2 * _COURSE), times=jnp.asarray(_TIMES), centre=(0.05, 0.05, 0.1)
    )
    scene = lj.Scene(mesh=mesh, law=LAW, body=lj.Body(density=1060.0), fixed=(bottom(mesh),), physics=(plate,))
    corner = np.asarray(nodes)[:1]
    assert min(_order(scene, corner)) > 1.7
