"""A sphere of other stiffness in a uniform body: fractions of cut elements, the fit, and the bias due to the mesh."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from fitting.fits import inclusion, scene_numbers
from fitting.readers import displacements
from liverjax.core.struct import replace
from liverjax.mesh.shape_functions import basis

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.slow
def test_a_sphere_is_found_where_it_is():
    """Data and fit use the same mesh, so the estimator itself is tested, from a wrong starting point."""
    mesh = lj.shapes.box((0.06, 0.06, 0.05), (6, 6, 5))
    below = mesh.node_sets["z_min"]

    def scene(gravity, mu):
        return lj.Scene(
            mesh=mesh,
            law=lj.laws.NeoHookean(mu=mu, bulk=jnp.asarray(3000.0)),
            body=lj.Body(density=1000.0, gravity=jnp.array(gravity)),
            fixed=(lj.Fixed(nodes=below),),
        )

    centre = jnp.array([0.035, 0.03, 0.03])
    mu = 800.0 * (1 + 2.0 * inclusion.fraction(mesh, centre, 0.016))
    loads = ([5.0, 0.0, 0.0], [0.0, 5.0, -3.0])
    X = np.asarray(mesh.points)
    seen = np.flatnonzero(X[:, 2] > 0.04)
    rng, data = np.random.default_rng(0), []
    for gravity in loads:
        u = np.asarray(lj.simulate(scene(gravity, mu)).check().positions[-1] - mesh.points)[seen]
        weights = np.tile([1.0, 0, 0, 0], (len(seen), 1))
        nodes = np.repeat(seen[:, None], 4, axis=1)
        noise, sd = 2e-6 * rng.normal(size=u.shape), np.full(u.shape, 2e-6)
        data.append(displacements.Displacements(np.zeros(len(seen), np.int32), nodes, weights, u + noise, sd))
    made = tuple(scene(g, jnp.asarray(900.0)) for g in loads)
    start = np.array([0.030, 0.033, 0.027, np.log(0.013), 0.0, 0.7])
    found = inclusion.estimate(
        scene_numbers.Problem(made, tuple(data)), "law.mu", start, max_iterations=30, mesh_error=False
    )
    values = dict(zip(found.names, found.values, strict=True))
    true = [*np.asarray(centre), 0.016, 800.0, 2400.0]
    assert np.all(np.abs(found.values - true) < 5 * found.standard_errors), (values, found.standard_errors)
    assert 0.5 < found.chi2 / found.components < 1.5


def test_the_fractions_of_cut_elements_add_up_to_the_volume_of_the_sphere():
    mesh, radius = lj.shapes.box((0.06,) * 3, (6, 6, 6)), 0.013
    parts = inclusion.fraction(mesh, jnp.array([0.031, 0.029, 0.033]), radius)
    assert np.isclose(float(jnp.sum(parts * mesh.volumes)), 4 / 3 * np.pi * radius**3, rtol=0.01)
    assert float(parts.min()) < 1e-5 and float(parts.max()) > 1 - 1e-5


def _hung_cube(mesh: lj.TetMesh, gravity: list, mu: object) -> lj.Scene:
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=jnp.asarray(mu), bulk=jnp.asarray(5000.0)),
        body=lj.Body(density=1000.0, gravity=jnp.array(gravity)),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
    )


@pytest.mark.slow
def test_the_bias_of_a_sphere_contains_its_edge():
    """The radius is one element edge, and the data are from a mesh with a third of the cell size. Without the edge of
    the sphere, the estimated bias had the wrong sign."""
    centre, radius, side = np.array([0.031, 0.029, 0.0327]), 0.0168, 0.06
    fine, mesh = (lj.quadratic(lj.shapes.box((side,) * 3, (n,) * 3)) for n in (12, 4))
    places = np.einsum("qk,eki->qei", basis(2).L.T, np.asarray(fine.points)[np.asarray(fine.tetrahedra)])
    mu = np.where(np.linalg.norm(places - centre, axis=-1) < radius, 3000.0, 1000.0)
    number = {tuple(p): i for i, p in enumerate(np.rint(np.asarray(fine.points) / side * 24).astype(int).tolist())}
    seen = np.flatnonzero(np.asarray(mesh.points)[:, 2] > 1e-6)
    of = [number[tuple(p)] for p in np.rint(np.asarray(mesh.points)[seen] / side * 24).astype(int).tolist()]
    scenes, data = [], []
    for gravity in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]):
        true = _hung_cube(fine, gravity, mu)
        u = np.asarray(lj.simulate(true).check().positions[-1] - fine.points)[of]
        weights, nodes = np.tile([1.0, 0, 0, 0], (len(seen), 1)), np.repeat(seen[:, None], 4, axis=1)
        sd = np.full(u.shape, 2e-3 * np.abs(u).max())
        data.append(displacements.Displacements(np.zeros(len(seen), np.int32), nodes, weights, u, sd))
        scenes.append(_hung_cube(mesh, gravity, 1000.0))
    start = np.array([*(centre + 1e-3), np.log(1.1 * radius), 0.0, 0.9])
    with pytest.warns(UserWarning, match="correlated|the error of the mesh"):
        found = inclusion.estimate(scene_numbers.Problem(tuple(scenes), tuple(data)), "law.mu", start)
    true = np.array([*centre, radius, 1000.0, 3000.0])
    off, left = np.abs(found.values / true - 1), np.abs((found.values - found.mesh_bias) / true - 1)
    assert np.all(left[3:] < 0.8 * off[3:]), (off, left)


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{"porous": True}, {"precision": "float32"}, {"region": True}])
def test_the_bias_of_a_sphere_is_found_in_other_scenes(changes):
    """In a porous body the richer mesh is refined, and in single precision it has single precision, too."""
    mesh = lj.shapes.box((0.06,) * 3, (2, 2, 2))
    scene = _hung_cube(mesh, [0.0, 2.0, -1.0], 1000.0)
    solve = lj.Solve(precision=changes.get("precision", "float64"), tolerance=1e-4)
    if "porous" in changes:
        sponge = lj.Porosity(bulk=2000.0, limit_bulk=2e5, fluid_fraction=0.2, permeability=1e-8)
        scene = replace(scene, porosity=replace(sponge, drained=mesh.node_sets["z_max"]))
        solve = replace(solve, dt=0.1)
    if "region" in changes:
        stiff = lj.Region(elements=jnp.arange(4), law={"mu": 2000.0})
        scene = replace(scene, region=(stiff,))
    scene = replace(scene, solve=solve)
    true = lj.with_parameters(scene, {"law.mu": 1000.0 * (1 + inclusion.fraction(mesh, jnp.full(3, 0.03), 0.02))})
    u = np.asarray(lj.simulate(true).check().positions[-1] - mesh.points, float)
    seen = np.arange(mesh.number_of_nodes)
    weights, nodes = np.tile([1.0, 0, 0, 0], (len(seen), 1)), np.repeat(seen[:, None], 4, axis=1)
    data = displacements.Displacements(np.zeros(len(seen), np.int32), nodes, weights, u, np.full(u.shape, 1e-4))
    start = np.array([0.029, 0.03, 0.031, np.log(0.021), 0.0, 0.6])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = inclusion.estimate(scene_numbers.Problem((scene,), (data,)), "law.mu", start, max_iterations=3)
    assert np.all(np.isfinite(found.mesh_bias))
