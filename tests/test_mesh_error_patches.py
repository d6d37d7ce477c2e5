"""Bodies in a uniform state, which quadratic elements have exactly: their estimated mesh error is 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.enriched import enriched
from liverjax.tensors.matrices import deformation_gradient, determinant

pytestmark = pytest.mark.quick_to_compile

MESH = lj.quadratic(lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)))
#: Linear solves of the run end at 1e-8 of the forces, and the estimate is relative to a strain of some percent.
ROUNDOFF = 1e-6


def _face(name: str) -> jax.Array:
    return jnp.asarray(lj.boundary.boundary_triangles(MESH, MESH.node_sets[name]))


def _cube(**more) -> lj.Scene:
    """A cube of quadratic elements that slides on three faces."""
    sliding = tuple(SlidingSupport(nodes=MESH.node_sets[f"{axis}_min"], axis=axis) for axis in "xyz")
    physics = (*sliding, *more.pop("physics", ()))
    return lj.Scene(mesh=MESH, law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0), physics=physics, **more)


def _relative_error(scene: lj.Scene) -> float:
    """Largest estimated error over the largest displacement."""
    result = lj.simulate(scene, mesh_error=True).check()
    assert bool(result.mesh_error.found.all())
    moved = np.abs(np.asarray(result.positions[-1] - scene.mesh.points)).max()
    assert moved > 1e-3
    return float(np.abs(np.asarray(result.mesh_error.positions)).max()) / moved


def test_a_following_pressure_on_a_cube():
    """The functions of a face have 9/20 of a uniform load; without them the error was 0.56."""
    assert _relative_error(_cube(traction=(lj.Traction(triangles=_face("z_max"), pressure=100.0),))) < ROUNDOFF


def test_pressure_on_a_closed_surface_of_order_3_is_the_change_of_volume():
    """At a sheared shape, against the volume of the elements: the force, and its change with a motion."""
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
