"""Contact in motion by Newmark's method: the force of an obstacle with prescribed motion acts at the end of each step,
and adds no energy.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.mesh.nodal import nodal_volumes
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.rigid_plate import RigidPlate

pytestmark = pytest.mark.quick_to_compile

SIDE, DENSITY = 0.02, 1060.0


def block(cells: int, order: int = 1) -> lj.Scene:
    mesh = lj.shapes.box((SIDE,) * 3, (cells,) * 3)
    return lj.Scene(
        mesh=mesh if order == 1 else lj.quadratic(mesh),
        law=lj.laws.NeoHookean(mu=800.0, bulk=3000.0),
        body=lj.Body(density=DENSITY),
        solve=lj.Solve(kind="dynamic", integrator="newmark", tolerance=1e-10),
    )


def plane(scene: lj.Scene, **given) -> Obstacle:
    """A plane above the block."""
    kind = RoughObstacle if "friction" in given else Obstacle
    top = jnp.asarray(lj.boundary.boundary_triangles(scene.mesh, scene.mesh.node_sets["z_max"]))
    return kind(triangles=top, axis=jnp.array([0.0, 0.0, -1.0]), **given)


@pytest.mark.ci
def test_a_still_obstacle_gives_no_energy():
    """A plane presses the block for 0.1 s and stops. When the mean of the contact forces at both ends of a step was
    used, the block got 600 times its energy, although every step converged.
    """
    scene = block(2)
    times, ways = jnp.array([0.0, 0.1]), jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.0015]])
    above = plane(scene, position=jnp.array([0.0, 0.0, SIDE + 1e-4]), times=times, history=ways)
    # The nodes of one edge are fixed and touch the plane.
    held = tuple(lj.Fixed(nodes=scene.mesh.node_sets[side]) for side in ("z_min", "x_min"))
    scene = replace(scene, fixed=held, physics=(above,), solve=replace(scene.solve, dt=0.002, steps=200))
    result = lj.simulate(scene).check()
    x = np.asarray(result.positions)
    mass = DENSITY * np.asarray(nodal_volumes(scene.mesh))[:, None]
    energy = 0.5 * np.sum(mass * (np.diff(x, axis=0) / 0.002) ** 2, axis=(1, 2))
    assert energy[150:].max() < 1.5 * energy[50:100].max()
    # The fixed faces carry the force of the plane, apart from the inertia of the remaining motion.
    force = np.asarray(lj.obstacle_forces(scene, result).force)[0, 100:, 2].mean()
    assert np.isclose(np.asarray(result.reactions)[100:, :, 2].sum(axis=1).mean(), force, rtol=0.02)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("side", "by", "mass"),
    [
        ("z_min", "angle", "consistent"),
        pytest.param("z_max", "torque", "lumped", marks=pytest.mark.slow),
        pytest.param("z_max", "torque", "consistent", marks=pytest.mark.slow),
    ],
)
def test_an_obstacle_gives_a_body_with_a_rigid_plate_no_energy(side, by, mass):
    """The body rises against a plane. Its rigid plate touches the plane (z_max) or not (z_min). At the end of each step
    m (v1 - v0) = dt (weight + contact), along the axis of the plate.
    """
    scene, dt, weight = block(1), 0.002, DENSITY * SIDE**3 * 9.81
    nodes = jnp.asarray(scene.mesh.node_sets[side])
    centre = jnp.array([SIDE / 2, SIDE / 2, 0.0])
    plate = RigidPlate(nodes=nodes, turn=0.0, by=by, lifts=True, centre=centre)
    above = plane(scene, position=jnp.array([0.0, 0.0, SIDE + 1e-3]))
    scene = replace(
        scene,
        body=replace(scene.body, gravity=jnp.array([0.0, 0.0, 9.81]), mass=mass),
        physics=(plate, above),
        solve=replace(scene.solve, dt=dt, steps=60),
    )
    result = lj.simulate(scene).check()
    mesh, x = scene.mesh, np.concatenate([np.asarray(scene.mesh.points)[None], np.asarray(result.positions)])
    velocity = np.diff(x, axis=0) / dt
    centre = DENSITY * np.einsum("v,tv->t", np.asarray(nodal_volumes(mesh)), x[:, :, 2])
    if mass == "lumped":
        moving = 0.5 * DENSITY * np.einsum("v,tvi,tvi->t", np.asarray(nodal_volumes(mesh)), velocity, velocity)
    else:
        own = velocity[:, np.asarray(mesh.tetrahedra)]
        share = DENSITY / 20 * np.asarray(mesh.volumes)
        moving = 0.5 * np.einsum("e,teai,tebi,ab->t", share, own, own, 1 + np.eye(4))
    given = 9.81 * (0.5 * (centre[1:] + centre[:-1]) - centre[0])
    contact = np.asarray(lj.obstacle_forces(scene, result).force)[0, :, 2]
    assert contact.max() > weight and np.flatnonzero(contact)[0] > 3
    assert np.all(moving < given + 1e-9 * given.max()) and moving.max() > 0.1 * given.max()
    momentum = [0.0]
    for way in np.diff(centre):  # v0 + v1 is twice the displacement over dt
        momentum.append(2 * way / dt - momentum[-1])
    assert np.allclose(np.diff(momentum) / dt - weight, -contact, atol=1e-6 * contact.max())


@pytest.mark.ci
@pytest.mark.parametrize(
    ("order", "mass"),
    [
        pytest.param(1, "lumped", marks=pytest.mark.slow),
        (1, "consistent"),
        pytest.param(2, "consistent", marks=pytest.mark.slow),
    ],
)
def test_the_change_of_momentum_is_the_force_at_the_end(order, mass):
    """A block flies against a plane with friction. In each step, m (v1 - v0) = dt (weight + contact at the end)."""
    scene, up = block(1, order), jnp.array([2.0, 0.0, 9.81])
    ceiling = plane(scene, friction=0.3, position=jnp.array([0.0, 0.0, SIDE + 1e-3]))
    scene = replace(
        scene,
        body=replace(scene.body, gravity=up, mass=mass),
        physics=(ceiling,),
        solve=replace(scene.solve, dt=0.002, steps=20),
    )
    result = lj.simulate(scene).check()
    weights = np.asarray(nodal_volumes(scene.mesh)) if order == 1 else _consistent_weights(scene.mesh)
    x = np.concatenate([np.asarray(scene.mesh.points)[None], np.asarray(result.positions)])
    centre = DENSITY * np.einsum("v,tvi->ti", weights, x)
    momentum = [np.zeros(3)]
    for way in np.diff(centre, axis=0):  # v0 + v1 is twice the displacement over dt
        momentum.append(2 * way / 0.002 - momentum[-1])
    force = np.diff(momentum, axis=0) / 0.002 - DENSITY * SIDE**3 * np.asarray(up)
    contact = np.asarray(lj.obstacle_forces(scene, result).force)[0]
    size = np.abs(contact).max()
    assert contact[0, 2] == 0 and contact[:, 2].max() > 0.1 and np.abs(contact[:, 0]).max() > 0.01
    assert np.allclose(force, -contact, atol=1e-6 * size)


@pytest.mark.slow
def test_gradients_of_reactions_with_consistent_mass():
    """In reverse mode, a cotangent on fixed nodes was multiplied by a matrix that is singular there. The result was
    NaN.
    """
    scene = block(1)
    above = plane(scene, position=jnp.array([0.0, 0.0, SIDE]), by=jnp.array([0.0, 0.0, -0.001]), stiffness=1e6)
    scene = replace(
        scene,
        body=replace(scene.body, gravity=jnp.array([1.0, 0.0, 0.0]), mass="consistent"),
        fixed=(lj.Fixed(nodes=scene.mesh.node_sets["z_min"]),),
        physics=(above,),
        solve=replace(scene.solve, dt=0.002, steps=2),
    )

    def force(mu: jax.Array) -> jax.Array:
        return jnp.sum(lj.simulate(lj.with_parameters(scene, {"law.mu": mu})).reactions[-1, :, 2])

    backward, forward = jax.jit(jax.grad(force))(800.0), jax.jit(lambda mu: jax.jvp(force, (mu,), (1.0,))[1])(800.0)
    assert abs(forward) > 1e-6 and np.isclose(backward, forward, rtol=1e-6)


def _consistent_weights(mesh: lj.TetMesh) -> np.ndarray:
    """Return the integrals (V,) of the shape functions of quadratic elements: -1/20 and 1/5 of the volume."""
    weights = np.zeros(mesh.number_of_nodes)
    for k, nodes in enumerate(mesh.element_nodes_on_host):
        np.add.at(weights, nodes, np.asarray(mesh.volumes) * (-0.05 if k < 4 else 0.2))
    return weights
