"""Clusters of near nodes in thin cells: their blocks against autodiff, and the iterations that they save."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.scenes.enriched import enriched
from liverjax.simulation import tangent
from liverjax.simulation.equations import equations, initial_state, positions, residual, unknowns
from liverjax.simulation.mesh_error import Richer

pytestmark = pytest.mark.quick_to_compile

LAW = lj.laws.NeoHookean(mu=700.0, bulk=2200.0)


def plate(aspect: float, cells: int = 4, order: int = 1, **solve) -> lj.Scene:
    """A plate with cells `aspect` times as wide as thick, glued below; its upper face is moved sideways and down."""
    thick = 0.1 / aspect
    mesh = lj.shapes.box((0.1, 0.1, thick), (cells, cells, cells))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    return lj.Scene(
        mesh=mesh,
        law=LAW,
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=thick * jnp.array([0.2, 0.0, -0.1])),),
        solve=lj.Solve(linear_solver="cg", **solve),
    )


@pytest.mark.ci
@pytest.mark.parametrize("order", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
def test_blocks_are_the_inverse_of_the_tangents(order):
    scene = plate(10.0, cells=2 if order > 1 else 4)
    moved = scene.mesh.points + 1e-3 * jnp.asarray(np.random.default_rng(3).uniform(-1, 1, scene.mesh.points.shape))
    for _ in range(order - 1):
        scene = enriched(scene)
        moved = Richer(scene=scene).padded(moved)
    e = equations(scene, initial_state(scene), 1.0)
    q = unknowns(e, moved)
    K = tangent.tangent(e, None, positions(e, q, 1.0), 1.0)
    exact = np.asarray(jax.jit(jax.jacfwd(lambda q: residual(e, q, 1.0)[0]))(q))
    own = scene.mesh.pattern.clusters if order == 1 else scene.mesh.clusters
    blocks, free = np.asarray(K.inverse.clusters), np.asarray(e.free.mask).T.ravel() > 0
    number, seen = scene.mesh.number_of_nodes, 0
    for nodes, there, block in zip(np.asarray(own.nodes), np.asarray(own.there), blocks, strict=True):
        unknown = (nodes[:, None] + number * np.arange(3)).ravel()
        used = np.repeat(there > 0, 3) & free[unknown]
        inverse = np.linalg.inv(exact[np.ix_(unknown[used], unknown[used])])
        assert np.abs(block[np.ix_(used, used)] - inverse).max() < 1e-11 * np.abs(inverse).max()
        seen += used.sum()
    assert seen > 0.8 * free.sum()


def test_cells_of_equal_sides_have_no_clusters():
    cube = plate(1.0, order=2).mesh
    assert cube.pattern.clusters is None and cube.clusters is None
    assert len(jax.tree.leaves(plate(10.0).mesh)) > len(jax.tree.leaves(plate(1.0).mesh))


@pytest.mark.slow
def test_flat_cells_take_as_few_iterations_as_cubes():
    law = lj.laws.NeoHookean(mu=700.0, bulk=7e6)
    counts = []
    for aspect in (1.0, 12.0):
        result = lj.simulate(replace(plate(aspect, volumetric="mixed"), law=law))
        assert (np.asarray(result.status) == status.CONVERGED).all()
        counts.append(int(result.statistics.linear_iterations.sum()))
    # With blocks of single nodes, the number is three times as large.
    assert counts[1] < 1.3 * counts[0]


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_through_flat_cells(order):
    scene = plate(10.0, cells=2, order=order, volumetric="mixed", tolerance=1e-11)
    top = np.asarray(scene.mesh.node_sets["z_max"])

    @jax.jit
    def force(mu):
        own = replace(scene, law=lj.laws.NeoHookean(mu=mu, bulk=7e5))
        return jnp.sum(lj.simulate(own).reactions[-1, top, 0])

    step = 1e-3
    difference = (force(700.0 * (1 + step)) - force(700.0 * (1 - step))) / (2 * step * 700.0)
    for slope in (jax.grad(force)(700.0), jax.jvp(force, (700.0,), (1.0,))[1]):
        assert abs(slope / difference - 1) < 10 * step**2
