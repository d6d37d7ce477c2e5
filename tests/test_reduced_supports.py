"""Supports of reduced models: the full model in other coordinates, and its error."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import every_motion, moves_as_full

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.mesh.selection import surface_of
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.reduced.model import other_numbers, refuse_unseen_numbers, with_all_points
from liverjax.reduced.physics.supports import forces_of_springs, spring_matrix

pytestmark = pytest.mark.quick_to_compile

PRONY = lj.Prony(ratios=jnp.array([0.4]), relaxation_times=jnp.array([0.1]))


def _on_springs(order: int = 1, cells: tuple = (1, 1, 1), **changes) -> lj.Scene:
    """A bar of 3 x 1 x 1 cm that lies on springs, slides at one end, and is otherwise fixed at single nodes only."""
    mesh = lj.shapes.box([0.03, 0.01, 0.01], list(cells))
    mesh = lj.quadratic(mesh) if order == 2 else mesh

    def at(**where: float) -> np.ndarray:
        return lj.boundary.select(mesh, where, None, "support")

    bottom = jnp.asarray(surface_of(mesh, at(z_max=0.0), None), jnp.int32)
    supports = (
        ElasticSupport(triangles=bottom, normal=4e4, tangential=1e4),
        ElasticSupport(nodes=jnp.asarray(at(x_min=0.03), jnp.int32), stiffness=0.2),
        SlidingSupport(nodes=jnp.asarray(at(x_max=0.0), jnp.int32), axis="x"),
    )
    body = lj.Body(density=1000.0, gravity=jnp.array([1.0, 0.5, -2.0]))
    law = lj.laws.NeoHookean(mu=800.0, bulk=3000.0)
    return lj.Scene(mesh=mesh, law=law, body=body, physics=supports, **changes)


MOVING = lj.Solve(kind="dynamic", integrator="newmark", dt=0.05, steps=3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "changes"),
    [
        (1, {"solve": lj.Solve()}),
        pytest.param(1, {"viscosity": PRONY, "solve": MOVING}, marks=pytest.mark.slow),
        pytest.param(2, {"solve": lj.Solve()}, marks=pytest.mark.slow),
    ],
)
def test_all_motions_and_points_on_springs_are_the_full_model(order, changes):
    """One end is moved too. Its springs act on the other nodes of their triangles."""
    scene = _on_springs(order, **changes)
    end = jnp.asarray(lj.boundary.select(scene.mesh, {"x_min": 0.03, "z_max": 0.0}, None, "displaced"))
    scene = replace(scene, displaced=(lj.Displaced(nodes=end, by=jnp.array([0.001, 0.0, 0.002])),))
    near = moves_as_full(scene)
    moved = np.abs(near - scene.mesh.points[None]).max()
    far = lj.simulate(replace(scene, physics=scene.physics[1:])).positions
    assert np.abs(far - near).max() > 0.05 * moved


@pytest.mark.ci
@pytest.mark.parametrize("order", [1, 2])
def test_the_matrix_of_springs_is_the_derivative_of_their_forces(order):
    scene = _on_springs(order)
    rest = jnp.zeros_like(scene.mesh.points)
    exact = np.asarray(jax.jacfwd(lambda u: forces_of_springs(scene, u))(rest)).reshape(rest.size, -1)
    np.testing.assert_allclose(spring_matrix(scene).toarray(), exact, atol=1e-13 * np.abs(exact).max())


@pytest.mark.slow
def test_stiffness_of_springs_stays_free_and_the_error_is_stated():
    scene = _on_springs(cells=(3, 2, 2), solve=lj.Solve())
    rng = np.random.default_rng(0)
    rows = {
        "law.mu": rng.uniform(700, 900, 12),
        "support.0.normal": rng.uniform(3e4, 6e4, 12),
        "body.gravity": rng.uniform([0, 0, -3], [2, 1, -1], (12, 3)),
    }
    model = lj.reduce_scene(scene, rows, 1e-6, 12, 1e-4)
    numbers = {"law.mu": 770.0, "support.0.normal": 4.4e4, "body.gravity": jnp.array([1.2, 0.4, -2.2])}
    own = lj.with_parameters(scene, numbers)
    full, found = lj.simulate(own).check(), lj.simulate_reduced(model, own)
    x = lj.reduced_positions(model, own, found)
    moved = float(np.linalg.norm(full.positions - own.mesh.points[None], axis=-1).max())
    true = float(np.linalg.norm(np.asarray(x - full.positions), axis=-1).max())
    assert true < 5e-3 * moved
    stated = float(lj.reduced_error(model, own, found).error.max())
    assert 0.5 < stated / true < 2

    def end(normal: float) -> jax.Array:
        return jnp.sum(
            lj.simulate_reduced(model, lj.with_parameters(own, {"support.0.normal": normal})).coordinates ** 2
        )

    slope, quotient = float(jax.grad(end)(4.4e4)), float(end(4.5e4) - end(4.3e4)) / 2e3
    assert slope == pytest.approx(quotient, rel=1e-3)


def test_other_supports_are_refused():
    scene = _on_springs()
    model = with_all_points(scene, every_motion(scene))
    springs, ends, slide = scene.physics
    for other, sentence in (
        ((springs, ends), "was made for scene"),
        ((springs, ends, replace(slide, axis="y")), "was made for scene"),
        ((replace(springs, history=jnp.ones(2), times=jnp.arange(2.0)),), r"cannot have a history of \[\[support\]\]"),
        ((replace(slide, axis="", normal=jnp.array([0.6, 0.8, 0.0])),), "normal to x, y or z"),
        ((Obstacle(triangles=springs.triangles, stiffness=1e6),), r"cannot have \[\[obstacle\]\]"),
    ):
        with pytest.raises(lj.InputError, match=sentence):
            lj.simulate_reduced(model, replace(scene, physics=other))
    stiffer = replace(scene, physics=(springs, replace(ends, stiffness=0.4), slide))
    model = replace(model, others=other_numbers(scene, {}))
    with pytest.raises(lj.InputError, match=r"support\.1\.stiffness differs from the training"):
        refuse_unseen_numbers(model, stiffer)
