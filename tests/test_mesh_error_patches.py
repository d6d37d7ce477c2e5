"""Bodies in a uniform state, which quadratic elements represent exactly: their estimated mesh error is 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.physics.base import Free, Step
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.enriched import enriched
from liverjax.solvers import attached
from liverjax.tensors.matrices import deformation_gradient, determinant

pytestmark = pytest.mark.quick_to_compile

MESH = lj.quadratic(lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)))
#: Linear solves of the run have a relative residual of 1e-8, and the estimate is relative to a strain of some percent.
ROUNDOFF = 1e-6


def _face(name: str) -> jax.Array:
    return jnp.asarray(lj.boundary.boundary_triangles(MESH, MESH.node_sets[name]))


def _cube(**more) -> lj.Scene:
    """A cube of quadratic elements that slides on three faces."""
    sliding = tuple(SlidingSupport(nodes=MESH.node_sets[f"{axis}_min"], axis=axis) for axis in "xyz")
    physics = (*sliding, *more.pop("physics", ()))
    return lj.Scene(mesh=MESH, law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0), physics=physics, **more)


def _relative_error(scene: lj.Scene) -> float:
    """Return the largest estimated error over the largest displacement."""
    result = lj.simulate(scene, mesh_error=True).check()
    assert bool(result.mesh_error.found.all())
    moved = np.abs(np.asarray(result.positions[-1] - scene.mesh.points)).max()
    assert moved > 1e-3
    return float(np.abs(np.asarray(result.mesh_error.positions)).max()) / moved


@pytest.mark.slow
def test_a_following_pressure_on_a_cube():
    """The functions of a face carry 9/20 of a uniform load. Without them the relative error was 0.56."""
    assert _relative_error(_cube(traction=(lj.Traction(triangles=_face("z_max"), pressure=100.0),))) < ROUNDOFF


@pytest.mark.parametrize(
    "history",
    [
        pytest.param(None, marks=pytest.mark.slow),
        pytest.param(jnp.array([0.5, 1.0]), marks=pytest.mark.slow),
        pytest.param(jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1e-3]]), marks=pytest.mark.slow),
    ],
)
def test_a_cube_between_planes_and_an_elastic_foundation(history):
    """Where the motion of the body is uniform, the traction of the foundation is too. Without the functions of order 3,
    the relative error was 0.07.
    """
    times = None if history is None else jnp.array([0.0, 1.0])
    springs = ElasticSupport(triangles=_face("z_max"), normal=1e4, tangential=0.0, times=times, history=history)
    push = lj.Traction(triangles=_face("x_max"), value=jnp.array([-100.0, 0.0, 0.0]))
    dt = None if history is None else 1.0
    assert _relative_error(_cube(physics=(springs,), traction=(push,), solve=lj.Solve(dt=dt))) < ROUNDOFF


def test_a_foundation_of_order_3_has_the_derivatives_of_its_energy():
    scene = enriched(_cube(physics=(ElasticSupport(triangles=_face("z_max"), normal=3e3, tangential=5e2),)))
    rich, rng = scene.mesh, np.random.default_rng(0)
    step = Step(rich, rich.points, 1.0, 1, 1.0, False, 1e-8, Free(jnp.ones_like(rich.points)))
    springs = scene.physics[-1].freeze(None, step)
    x, v = (
        rich.points + jnp.asarray(1e-3 * rng.standard_normal(rich.points.shape)),
        rng.standard_normal(rich.points.shape),
    )
    slope = jax.grad(lambda x: springs.energy(rich, x))(x)
    assert np.abs(springs.force(rich, x, 1.0) - slope).max() < 1e-12 * np.abs(slope).max()
    found = jnp.stack(attached.product(springs.attached(rich, x, 1.0), tuple(jnp.asarray(v).T)), axis=1)
    exact = jax.jvp(lambda x: springs.force(rich, x, 1.0), (x,), (jnp.asarray(v),))[1]
    assert np.abs(found - exact).max() < 1e-12 * np.abs(exact).max()


def test_pressure_on_a_closed_surface_of_order_3_is_the_change_of_volume():
    """In a sheared shape, the force and its change with a motion are compared with derivatives of the elements'
    volume.
    """
    triangles = jnp.asarray(lj.boundary.boundary_triangles(MESH))
    scene = enriched(_cube(traction=(lj.Traction(triangles=triangles, pressure=3.0),)))
    rich, load = scene.mesh, scene.traction
    X = jnp.concatenate([MESH.points, jnp.zeros((rich.number_of_nodes - len(MESH.points), 3))])
    rng = np.random.default_rng(0)
    x = X @ jnp.asarray(np.eye(3) + 0.2 * rng.standard_normal((3, 3))).T
    first, second = (jnp.asarray(rng.standard_normal(X.shape)) for _ in range(2))

    def volume(x: jax.Array) -> jax.Array:
        return jnp.sum(rich.weights * determinant(deformation_gradient(rich, x)))

    def work(x: jax.Array) -> jax.Array:
        return jnp.vdot(lj.boundary.follower_forces(load, x, rich), first)

    swept = jax.jvp(volume, (x,), (first,))[1]
    assert abs(work(x) + 3.0 * swept) < 1e-12 * abs(swept)
    bent = jax.jvp(lambda x: jax.jvp(volume, (x,), (first,))[1], (x,), (second,))[1]
    assert abs(jax.jvp(work, (x,), (second,))[1] + 3.0 * bent) < 1e-12 * abs(bent)
