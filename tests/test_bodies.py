"""Every physics of a body in its place, by element order: in motion, viscous and porous; sweeps, gradients, robust.

One body has them all, so that a table of features takes few programs. In motion it is viscous and has a fluid; at rest
it is elastic. The answers are witnessed where each physics has its own tests; here one body is run in different ways.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements.gradients import volume_ratios
from liverjax.physics.attached import ligament, vessel
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.porosity import Inlet
from liverjax.physics.sliding_support import on_plane
from liverjax.scenes.scene import numbers_at

pytestmark = pytest.mark.quick_to_compile

SIZE = (0.02, 0.01, 0.01)
LAW = lj.laws.NeoHookean(mu=800.0, bulk=4000.0)
LAYER = lj.laws.NeoHookean(mu=1e4, bulk=1e5)
PRONY = lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([0.1]))
#: Two points inside the body.
LINE = np.array([[0.002, 0.004, 0.003], [0.017, 0.006, 0.007]])
TIMES = jnp.array([0.0, 0.05, 0.1])
#: Centre of a ball of 5 mm that touches the top.
ABOVE = jnp.array([0.012, 0.005, SIZE[2] + 0.005])


def everything(mesh: lj.TetMesh) -> tuple:
    """Every physics that has a table of its own in scene files, once."""

    def side(name: str) -> jax.Array:
        return jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets[name]), jnp.int32)

    ball = {"triangles": side("z_max"), "shape": "sphere", "radius": 0.005}
    plate = {"axis": jnp.array([0.0, -1.0, 0.0]), "position": jnp.array([0.0, SIZE[1], 0.0])}
    return (
        ElasticSupport(triangles=side("z_min"), normal=2e4, tangential=1e3),
        on_plane(mesh, np.asarray(mesh.node_sets["y_min"])),
        Membrane(triangles=side("z_min"), thickness=1e-5, law=LAYER),
        ligament.between(mesh, LINE, stiffness=5.0, pre_tension=1e-3),
        vessel.along(mesh, LINE, 5e-4, LAYER),
        Obstacle(triangles=side("z_min"), stiffness=1e5),
        RoughObstacle(triangles=side("y_max"), stiffness=1e6, friction=0.2, by=jnp.array([4e-4, -2e-4, 0.0]), **plate),
        PressedObstacle(**ball, position=ABOVE, stiffness=1e6, force=jnp.array([0.0, 0.0, -2e-3])),
    )


#: Numbers that a sweep varies and a derivative is taken by.
NUMBERS = (
    "support.0.normal",
    "membrane.0.thickness",
    "ligament.0.stiffness",
    "vessel.0.law.mu",
    "obstacle.0.stiffness",
    "obstacle.1.friction",
    "obstacle.1.by",
    "obstacle.2.force",
    "traction.0.history",
    "region.0.law.bulk",
)
#: The bulk modulus of a sponge takes the place of the law's, so a law's own moves nothing then.
FLUID = ("porosity.inlet.0.flux", "porosity.inlet.1.pressure", "region.1.viscosity.ratios", "region.1.porosity.bulk")


def at_rest(order: int, **solve) -> lj.Scene:
    """Two steps of an elastic body without inertia."""
    mesh = lj.shapes.box(SIZE, (2, 1, 1))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    right = jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets["x_max"]))
    pull = lj.Traction(triangles=right, value=jnp.array([20.0, 0.0, -10.0]), times=TIMES, history=TIMES / 0.1)
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=800.0, bulk=4000.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        body=lj.Body(density=1000.0, gravity=(0.0, 0.0, -3.0)),
        traction=(pull,),
        region=(lj.Region(elements=jnp.arange(4), law=replace(lj.laws.typical("ogden"), bulk=jnp.asarray(5e3))),),
        physics=everything(mesh),
        solve=lj.Solve(**{"steps": 2, "dt": 0.05, "tolerance": 1e-11} | solve),
    )


def in_motion(order: int) -> lj.Scene:
    """Three steps of a viscous sponge that falls; fluid enters below and at the end."""
    scene = at_rest(order, kind="dynamic", steps=3, dt=0.03)
    below = jnp.asarray(lj.boundary.boundary_triangles(scene.mesh, scene.mesh.node_sets["z_min"]))
    end = np.asarray(scene.mesh.node_sets["x_max"])
    given = Inlet(nodes=jnp.asarray(end[end < scene.mesh.number_of_vertices]), pressure=jnp.asarray(5.0))
    sponge = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-6)
    own = lj.Region(
        elements=jnp.arange(6, 9),
        viscosity={"ratios": jnp.array([0.2])},
        porosity={"bulk": jnp.asarray(500.0)},
    )
    return replace(
        scene,
        viscosity=PRONY,
        porosity=replace(sponge, inlet=(Inlet(triangles=below, flux=jnp.asarray(1e-4)), given)),
        region=(*scene.region, own),
    )


def check_sweep_and_gradient(scene: lj.Scene, numbers: tuple[str, ...]) -> None:
    """Lanes converge and are the runs by themselves; difference quotients come to the derivative, by every number."""
    lj.check_scene(scene)
    first = {name: jnp.asarray(numbers_at(scene, name)) for name in numbers}

    @jax.jit
    def moved(factors):
        changed = {name: factor * first[name] for name, factor in zip(numbers, factors, strict=True)}
        result = lj.simulate(lj.with_parameters(scene, changed))
        return 1e6 * jnp.mean((result.positions[-1] - scene.mesh.points) ** 2), result.status

    one = jnp.ones(len(numbers))
    (value, status), slopes = jax.jit(jax.value_and_grad(moved, has_aux=True))(one)
    h = np.array([3e-2, 1e-3, 1e-4, 1e-7])
    rows = np.concatenate([sign * h[:, None, None] * np.eye(len(numbers))[None] for sign in (1, -1)])
    lanes, codes = jax.jit(jax.vmap(moved))(
        1 + jnp.asarray(np.concatenate([0 * rows[0, :1], rows.reshape(-1, len(numbers))]))
    )
    assert status.max() == 0 and codes.max() == 0
    assert np.isclose(lanes[0], value, rtol=1e-8)
    plus, minus = np.asarray(lanes[1:]).reshape(2, len(h), len(numbers))
    for k, name in enumerate(numbers):
        errors = np.abs((plus[:, k] - minus[:, k]) / (2 * h) - slopes[k])
        # A residual of 1e-11 moves the value by 1e-11 of itself and more: over h, 1e-7 of it.
        small = 1e-4 * abs(slopes[k]) + 1e-7 * value
        assert slopes[k] != 0 and errors[1:3].min() < small, (name, slopes[k], errors)
        assert errors[1:3].min() <= errors[0] + small and errors[1:3].min() <= errors[3] + small, (name, errors)


ORDERS = pytest.mark.parametrize("order", [1, 2])


@pytest.mark.slow
@ORDERS
def test_in_motion_with_viscosity_and_fluid_it_sweeps_and_has_gradients(order):
    check_sweep_and_gradient(in_motion(order), NUMBERS[:-1] + FLUID)


@pytest.mark.slow
@ORDERS
def test_at_rest_it_sweeps_and_has_gradients(order):
    check_sweep_and_gradient(at_rest(order), NUMBERS)


@pytest.mark.slow
@ORDERS
def test_robust_steps_find_the_same_from_an_inverted_start(order):
    """Friction and a pressed obstacle among the rest; without a start and from one with inverted elements."""
    plain, robust = at_rest(order), at_rest(order, robust="projected")
    lj.check_scene(robust)
    rest = lj.simulate(plain).check().positions
    run = jax.jit(lambda start: lj.simulate(robust, start=start))
    mesh = plain.mesh
    noise = {1: 0.6, 2: 0.3}[order] * SIZE[1] * np.random.default_rng(3).standard_normal(mesh.points.shape)
    start = mesh.points + jnp.asarray(noise).at[mesh.node_sets["x_min"]].set(0.0)
    assert volume_ratios(mesh, start).min() < 0
    for begin in (mesh.points, start):
        assert np.abs(run(begin).check().positions - rest).max() < 1e-7 * SIZE[0]


@pytest.mark.slow
@ORDERS
def test_a_factorisation_finds_the_same(order):
    """Friction without symmetry, and the rank-one stiffness of a pressed obstacle."""
    rest = lj.simulate(at_rest(order)).check().positions
    direct = at_rest(order, linear_solver="direct")
    lj.check_scene(direct)
    assert np.abs(lj.simulate(direct).check().positions - rest).max() < 1e-8 * SIZE[0]
