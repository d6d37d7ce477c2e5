"""Bodies in a uniform state, which quadratic elements represent exactly: their estimated mesh error is 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.elements import mjed, reference
from liverjax.mesh.promotion import cubic
from liverjax.mesh.tetrahedra import with_points
from liverjax.physics.base import Free, Step
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.prescribed import free_places, prescribed
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.enriched import enriched
from liverjax.scenes.refined import on_refined_mesh
from liverjax.simulation.equations import free_directions
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


@pytest.mark.ci
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


def _motions(scene: lj.Scene) -> tuple[np.ndarray, jax.Array]:
    mesh, displaced = scene.mesh, scene.displaced
    return free_places(mesh, scene.fixed, displaced), prescribed(mesh, displaced, 0.5, 1.0)


@pytest.mark.ci
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("richer", [enriched, lambda scene: on_refined_mesh(scene)[0]])
def test_a_clamp_of_two_entries_is_a_clamp_of_one(order, richer):
    """New nodes between two entries were free, and the estimated change of a force was 60 % larger."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (4, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    x, floor = np.asarray(mesh.points), np.asarray(mesh.node_sets["z_min"])
    left, right = floor[x[floor, 0] <= 0.051], floor[x[floor, 0] > 0.051]
    law = lj.laws.NeoHookean(mu=770.0, bulk=2200.0)

    def moved(nodes: np.ndarray, by: np.ndarray, **more) -> lj.Displaced:
        return lj.Displaced(nodes=jnp.asarray(nodes), by=jnp.asarray(by), **more)

    clock = {"times": jnp.array([0.0, 1.0]), "history": jnp.array([0.0, 2.0])}
    jump = np.where((x[floor, 0] > 0.051)[:, None], [0.0, 0.0, 1e-3], 0.0)
    shifts = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2e-3]])
    still = lj.Fixed(nodes=jnp.asarray(left))
    later = lj.Displaced(nodes=jnp.asarray(right), times=clock["times"], history=shifts)
    for one, two in (
        ({"fixed": (lj.Fixed(nodes=floor),)}, {"fixed": (still, lj.Fixed(nodes=right))}),
        ({"displaced": (moved(floor, 0.1 * x[floor]),)},
         {"displaced": (moved(left, 0.1 * x[left]), moved(right, 0.1 * x[right]))}),
        ({"displaced": (moved(floor, jump, **clock),)}, {"fixed": (still,), "displaced": (later,)}),
    ):  # fmt: skip
        (free, by), (own, own_by) = (_motions(richer(lj.Scene(mesh=mesh, law=law, **each))) for each in (one, two))
        assert np.array_equal(free, own) and np.allclose(by, own_by, atol=1e-16)


@pytest.mark.parametrize("richer", [enriched, lambda scene: on_refined_mesh(scene)[0]])
@pytest.mark.parametrize(("axis", "height"), [(0, 0.0), (2, 0.1)], ids=["rows", "layers"])
def test_a_clamp_of_single_rows_or_layers_is_a_clamp_of_one(axis, height, richer):
    """No triangle had all its nodes in one row of a side, so the new nodes were free. Between layers of nodes, new
    nodes inside the body were free too.
    """
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (3, 3, 3))
    x = np.asarray(mesh.points)
    clamp = np.flatnonzero(x[:, 2] < height + 0.001)
    rows = [clamp[np.abs(x[clamp, axis] - v) < 0.001] for v in np.linspace(0.0, 0.1, 4)]
    law = lj.laws.NeoHookean(mu=770.0, bulk=2200.0)

    def moved(nodes: np.ndarray) -> lj.Displaced:
        return lj.Displaced(nodes=jnp.asarray(nodes), by=jnp.asarray(0.1 * x[nodes]))

    for one in (lambda nodes: {"fixed": (lj.Fixed(nodes=nodes),)}, lambda nodes: {"displaced": (moved(nodes),)}):
        several = [one(nodes) for nodes in rows]
        joined = {key: sum((entry[key] for entry in several), ()) for key in several[0]}
        both = (_motions(richer(lj.Scene(mesh=mesh, law=law, **entries))) for entries in (one(clamp), joined))
        (free, by), (own, own_by) = both
        assert np.array_equal(free, own) and np.allclose(by, own_by, atol=1e-16)


def test_two_clamps_that_meet_at_an_edge_leave_the_other_sides_free():
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (3, 3, 3))
    x = np.asarray(mesh.points)
    rows = [np.flatnonzero((x[:, 2] < 0.001) & (np.abs(x[:, 1] - v) < 0.001)) for v in np.linspace(0.0, 0.1, 4)]
    side = np.flatnonzero((x[:, 0] < 0.001) & (x[:, 2] > 0.001))
    fixed = tuple(lj.Fixed(nodes=nodes) for nodes in (*rows, side))
    rich = enriched(lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0), fixed=fixed))
    y, (free, _) = np.asarray(rich.mesh.points), _motions(rich)
    assert np.array_equal(~free.any(axis=1), (y[:, 0] < 0.001) | (y[:, 2] < 0.001))


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("richer", [enriched, lambda scene: on_refined_mesh(scene)[0]])
def test_a_clamp_of_two_entries_has_known_nodes_inside_jit(order, richer):
    """The node numbers of the richer scene were unknown inside jit, which stopped with an error. There was one entry
    for each axis, and some entries had no nodes.
    """
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (4, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    x, floor = np.asarray(mesh.points), np.asarray(mesh.node_sets["z_min"])
    fixed = tuple(lj.Fixed(nodes=floor[side]) for side in (x[floor, 0] <= 0.051, x[floor, 0] > 0.051))
    corner = lj.Displaced(nodes=np.asarray(mesh.node_sets["z_max"])[:1], by=jnp.array([0.0, 0.0, 1e-3]))
    found = []

    def traced(mu: jax.Array) -> jax.Array:
        law = lj.laws.NeoHookean(mu=mu, bulk=2200.0)
        rich = richer(lj.Scene(mesh=mesh, law=law, fixed=fixed, displaced=(corner,)))
        found.append([(entry.axes, np.asarray(entry.nodes)) for entry in rich.fixed])
        return mu

    traced(770.0)
    jax.eval_shape(traced, 770.0)
    outside, inside = found
    assert len(outside) == len(inside) == 3 and outside[2][0] == "xyz"
    assert all(a[0] == b[0] and np.array_equal(a[1], b[1]) for a, b in zip(outside, inside, strict=True))
    assert all(len(nodes) for _, nodes in inside)


def test_the_sides_between_two_clamps_stay_free():
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 1))
    fixed = tuple(lj.Fixed(nodes=mesh.node_sets[name]) for name in ("z_min", "z_max"))
    rich = enriched(lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0), fixed=fixed))
    z = np.asarray(rich.mesh.points)[:, 2]
    free, _ = _motions(rich)
    assert np.array_equal(free.all(axis=1), (z > 0.01) & (z < 0.09))


def test_one_density_per_node_keeps_float32():
    """The densities of the functions of order 3 were in float64, and the estimate stopped with an error."""
    mesh = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, MESH)
    body = lj.Body(density=jnp.linspace(900.0, 1100.0, mesh.number_of_nodes, dtype=jnp.float32))
    rich = enriched(lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0), body=body))
    assert rich.body.density.dtype == jnp.float32 and rich.body.density.shape == (rich.mesh.number_of_nodes,)


@pytest.mark.ci
def test_stiffness_of_order_3_is_the_derivative_of_the_force():
    """The signs of the functions on edges were missing."""
    rich = cubic(lj.quadratic(lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))))
    law, rng = lj.laws.NeoHookean(mu=770.0, bulk=2200.0), np.random.default_rng(0)
    x, v = (rich.points + jnp.asarray(1e-3 * rng.standard_normal(rich.points.shape)) for _ in range(2))
    force, exact = jax.jvp(lambda x: mjed.internal_force(rich, law, x), (x,), (v,))
    for K in (mjed.stiffness_matrix(rich, law, x), reference.stiffness_matrix(rich, law, x)):
        assert np.abs(K @ np.ravel(v) - np.ravel(exact)).max() < 1e-12 * np.abs(exact).max()
    for other in (reference.internal_force(rich, law, x), reference.standard_internal_force(rich, law, x)):
        assert np.abs(other - force).max() < 1e-12 * np.abs(force).max()


@pytest.mark.ci
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


@pytest.mark.parametrize("richer", [enriched, lambda scene: on_refined_mesh(scene)[0]])
def test_a_sliding_support_beside_another_support_leaves_no_node_free(richer):
    """New nodes between a sliding support and another support were free."""
    mesh = lj.shapes.box((0.1, 0.05, 0.05), (4, 2, 2))
    x, floor = np.asarray(mesh.points), np.asarray(mesh.node_sets["z_min"])
    left, right = floor[x[floor, 0] <= 0.051], floor[x[floor, 0] > 0.051]
    law = lj.laws.NeoHookean(mu=770.0, bulk=2200.0)
    turn = np.array([[np.cos(0.3), 0.0, np.sin(0.3)], [0.0, 1.0, 0.0], [-np.sin(0.3), 0.0, np.cos(0.3)]])
    turned = with_points(mesh, jnp.asarray(x @ turn.T))
    rounded = jnp.asarray(turn[:, 2], jnp.float32)  # of length 1 - 2e-8: this ended with an IndexError
    for own, kind in ((mesh, {"axis": "z"}), *((turned, {"normal": n}) for n in (jnp.asarray(turn[:, 2]), rounded))):
        one, other = (SlidingSupport(nodes=nodes, **kind) for nodes in (left, right))
        clamp = (lj.Fixed(nodes=left),)
        for fixed, physics in ((clamp, (other,)), ((), (one, other))):
            rich = richer(lj.Scene(mesh=own, law=law, fixed=fixed, physics=physics))
            free = free_directions(rich)
            normal = turn[:, 2] if free.normals is not None else np.array([0.0, 0.0, 1.0])
            moved = np.abs(np.asarray(free.vectors(jnp.tile(normal, (len(rich.mesh.points), 1)))) @ normal)
            assert np.array_equal(moved < 1e-6, np.abs(np.asarray(rich.mesh.points) @ normal) < 1e-9)
