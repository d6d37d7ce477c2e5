"""From displacements to stiffness: files, positions, the prior, maps with uncertainty, few parameters, the command."""

import json
from functools import partial

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial

import liverjax as lj
from fitting.__main__ import main
from fitting.fits import field, inclusion, scene_numbers
from fitting.methods import prior
from fitting.readers import displacements
from fitting.reports import field_report
from liverjax.core.struct import replace
from liverjax.mesh.tetrahedra import tet_mesh

pytestmark = pytest.mark.quick_to_compile

_SCENE = """
[mesh]
shape = "box"
size = [0.06, 0.04, 0.04]
cells = [4, 3, 3]
[law]
name = "neo_hookean"
mu = {mu}
bulk = 3000.0
[body]
density = 1000.0
gravity = [{gravity}]
[[fixed]]
where = {{z_max = 0.0}}
"""
SURFACE = np.arange(80)  # every node of this mesh


def _scene(folder, mu=800.0, gravity="4, 0, -3", name="scene.toml"):
    (folder / name).write_text(_SCENE.format(mu=mu, gravity=gravity))
    return lj.load_scene(folder / name)


def _truth(mesh):
    """Return a shear modulus that doubles smoothly towards one end."""
    middle = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)].mean(axis=1)
    return 800.0 * np.exp(0.7 / (1 + np.exp((0.03 - middle[:, 0]) / 0.006)))


def _write(file, scene, noise, mu=None, seed=0):
    """Write synthetic displacements of the upper nodes, by position, with noise [m]."""
    X = np.asarray(scene.mesh.points)
    true = lj.with_parameters(scene, {"law.mu": jnp.asarray(_truth(scene.mesh) if mu is None else mu)})
    u = np.asarray(lj.simulate(true).check().positions[-1]) - X
    seen = np.flatnonzero(X[:, 2] > 0.01)
    rows = np.c_[X[seen], u[seen] + noise * np.random.default_rng(seed).normal(size=(len(seen), 3))]
    np.savetxt(file, rows, delimiter=",", header="x,y,z,ux,uy,uz", comments="")
    return file


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    """Two loads on one block, with noise of a hundredth of the largest displacement."""
    folder = tmp_path_factory.mktemp("field")
    made, data = [], []
    for k, gravity in enumerate(("4, 0, -3", "0, 4, -3")):
        scene = _scene(folder, gravity=gravity, name=f"{k}.toml")
        made.append(scene)
        data.append(displacements.read_displacements(_write(folder / f"{k}.csv", scene, 5e-5, seed=k), scene, 5e-5))
    return scene_numbers.Problem(tuple(made), tuple(data))


def test_places_in_a_mesh():
    """A linear field is interpolated exactly, inside and slightly outside of the mesh."""
    mesh = lj.shapes.box((0.06, 0.04, 0.04), (4, 3, 3))
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.002, 1.05, (50, 3)) * [0.06, 0.04, 0.04]
    nodes, weights, outside = displacements.locate(mesh, points)
    A, b = rng.normal(size=(3, 3)), rng.normal(size=3)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    values = np.asarray(mesh.points) @ A.T + b
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", weights, values[nodes]), points @ A.T + b, atol=1e-12)
    inside = np.all((points >= 0) & (points <= [0.06, 0.04, 0.04]), axis=1)
    assert np.all(outside[inside] < 1e-9) and np.all(outside[~inside] > 0)


def test_points_are_found_where_the_sizes_of_elements_differ_much():
    """Only the 40 elements with the nearest centres were searched: 5 of 1000 points got an element beside the point,
    with barycentric coordinates down to -0.36."""
    rng = np.random.default_rng(1)
    corners = np.stack(np.meshgrid(*3 * [[0.0, 1.0]]), axis=-1).reshape(-1, 3)
    nodes = np.concatenate([rng.uniform(size=(700, 3)) ** 3, corners])
    tets = scipy.spatial.Delaunay(nodes).simplices
    volume = np.linalg.det(nodes[tets[:, 1:]] - nodes[tets[:, :1]])
    tets = np.where(volume[:, None] < 0, tets[:, [0, 2, 1, 3]], tets)[np.abs(volume) > 1e-12]
    points = rng.uniform(0.01, 0.99, (1000, 3))
    own, weights, outside = displacements.locate(tet_mesh(nodes, tets), points)
    assert outside.max() < 1e-9
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", weights, nodes[own]), points, atol=1e-12)


def test_the_prior_has_the_covariance_it_states():
    """The covariance is sd^2 exp(-r / length) in the middle of a large body. The transpose is exact."""
    mesh = lj.shapes.box((0.2, 0.2, 0.2), (10, 10, 10))
    p = prior.prior(mesh, 0.04)
    n, rng = mesh.number_of_nodes, np.random.default_rng(0)
    X = np.asarray(mesh.points)
    z, g = rng.normal(size=n), rng.normal(size=n)
    assert np.isclose(prior.field_at_nodes(p, z) @ g, z @ prior.to_whitened(p, g), rtol=1e-12)
    unit = np.zeros(n)
    centre = np.argmin(np.linalg.norm(X - 0.1, axis=1))
    unit[centre] = 1
    covariance = prior.field_at_nodes(p, prior.to_whitened(p, unit))
    near = np.flatnonzero(np.linalg.norm(X - 0.1, axis=1) < 0.05)
    distance = np.linalg.norm(X[near] - X[centre], axis=1)
    # The cells are half a length wide, so the mesh cuts off the kink at distance 0.
    np.testing.assert_allclose(covariance[near], np.exp(-distance / 0.04), atol=0.2)
    V = np.linalg.qr(rng.normal(size=(n, 3)))[0]
    before, after = prior.variances(p, V, np.array([0.1, 0.5, 0.9]))
    T = prior.field_at_nodes(p, np.eye(n))
    np.testing.assert_allclose(before, np.sum(T**2, axis=1), rtol=1e-9)
    kept = np.eye(n) - V @ np.diag([0.9, 0.5, 0.1]) @ V.T
    np.testing.assert_allclose(after, np.diag(T @ kept @ T.T), rtol=1e-8)


@pytest.mark.slow
def test_a_map_its_uncertainty_and_going_on(problem, tmp_path):
    """The map fits the data to their noise and is closer to the truth than any uniform body. Its standard deviation is
    that of the dense Hessian. An interrupted fit continues.
    """
    rows = []
    file = tmp_path / "progress.h5"
    found = field.estimate(
        problem, length=0.02, max_iterations=40, modes=70, file=file, progress=lambda k, c: rows.append((k, c))
    )
    mesh = problem.scenes[0].mesh
    assert found.reached and rows and found.chi2 <= problem.components
    off, volumes = np.log(found.modulus / _truth(mesh)), np.asarray(mesh.volumes)
    best = np.log(_truth(mesh)) - np.average(np.log(_truth(mesh)), weights=volumes)
    assert np.sqrt(np.average(off**2, weights=volumes)) < 0.5 * np.sqrt(np.average(best**2, weights=volumes))

    # Compare standard deviations with the dense Hessian of all directions.
    p, base = prior.prior(mesh, 0.02), field.start_of(problem, "law.mu")
    T = found.deviation * prior.field_at_nodes(p, np.eye(mesh.number_of_nodes))
    J = np.asarray(
        jax.jit(jax.jacfwd(lambda m: scene_numbers.misfit(problem, field.values_at(problem, "law.mu", base, m))[0]))(
            jnp.asarray(found.log_factor)
        )
    )
    covariance = T @ np.linalg.inv(np.eye(len(T)) + (J @ T).T @ (J @ T)) @ T.T
    # Lanczos leaves out the directions that the data determine least. With 70 of 80, this is a very small part.
    np.testing.assert_allclose(found.sd, np.sqrt(np.diag(covariance)), rtol=0.02)
    assert np.all(found.sd < found.prior_sd)
    values = field.values_at(problem, "law.mu", base, jnp.asarray(found.log_factor))
    bias = covariance @ J.T @ scene_numbers.discretisation_errors(problem, values).mesh
    # Conjugate gradients stop at a relative residual of 0.01.
    assert np.linalg.norm(found.mesh_bias - bias) < 0.02 * np.linalg.norm(bias)

    # The file contains the last point, so a fit that continues from it needs almost no iteration.
    with h5py.File(file) as f:
        np.testing.assert_allclose(found.deviation * prior.field_at_nodes(p, f["z"][:]), found.log_factor, rtol=1e-12)
    again = field.estimate(problem, length=0.02, max_iterations=40, modes=5, file=file, resume=True)
    assert again.chi2 <= found.chi2 * 1.001 and again.deviation == found.deviation
    with pytest.raises(lj.InputError, match="belongs to another fit"):
        field.estimate(problem, name="law.bulk", length=0.02, file=file, resume=True)
    scenes = (replace(scene, solve=replace(scene.solve, newton_iterations=24)) for scene in problem.scenes)
    other = problem._replace(scenes=tuple(scenes))
    with pytest.raises(lj.InputError, match=r"another fit \(law or settings differs\)"):
        field.estimate(other, length=0.02, file=file, resume=True)


@pytest.mark.ci
def test_a_map_goes_on_from_its_own_problem_alone(problem, tmp_path):
    def search(problem, length=0.02):
        p = prior.prior(problem.scenes[0].mesh, length)
        return field._Search(problem, "law.mu", field.start_of(problem, "law.mu"), p, tmp_path / "p.h5", None)

    search(problem).write()
    search(problem).read()
    data = problem.data[0]
    noisier = problem._replace(data=(data._replace(sd=2 * data.sd), *problem.data[1:]))
    moved = problem._replace(data=(data._replace(measured=1.01 * data.measured), *problem.data[1:]))
    stiffer = problem._replace(scenes=(lj.with_parameters(problem.scenes[0], {"law.mu": 900.0}), *problem.scenes[1:]))
    for other, words in (
        (search(problem, 0.03), "length differs"),
        (search(noisier), "noise differs"),
        (search(moved), "displacements differs"),
        (search(stiffer), "scene differs"),
    ):
        with pytest.raises(lj.InputError, match=words):
            other.read()
    (tmp_path / "p.h5").write_text("no HDF5")
    with pytest.raises(lj.InputError, match="belongs to another fit"):
        search(problem).read()


def _of_a_formula(monkeypatch, problem, bend=0.0):
    """Replace the runs by residuals A m + bend (A m)^2 - b, with singular values over three decades."""
    rng = np.random.default_rng(1)
    n = problem.scenes[0].mesh.number_of_nodes
    left, right = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    A, b = left * 10.0 ** np.linspace(2, -1, n) @ right, 8 * rng.normal(size=n)

    @partial(jax.jit, static_argnames="name")
    def linearised(problem, base, m, name):
        def residuals(m):
            r = jnp.asarray(A) @ m
            return r + bend * r**2 - b, (jnp.zeros((), jnp.int32),)

        return jax.linearize(residuals, m, has_aux=True)

    monkeypatch.setattr(field, "_linearised", linearised)
    return A, b


def test_a_map_is_at_its_minimum(problem, monkeypatch):
    """The map solves the normal equations. L-BFGS stopped with a cost 1 % above the minimum."""
    A, b = _of_a_formula(monkeypatch, problem)
    found = field.estimate(problem, length=0.02, modes=30, mesh_error=False)
    p = prior.prior(problem.scenes[0].mesh, 0.02)
    T = found.deviation * prior.field_at_nodes(p, np.eye(len(b)))
    H = np.eye(len(b)) + (A @ T).T @ (A @ T)
    off = np.linalg.solve(T, found.log_factor) - np.linalg.solve(H, (A @ T).T @ b)
    assert np.sqrt(off @ H @ off) < 0.05 and found.distance < 0.05 and field.distance_sentence(found) is None
    # The reported distance from the minimum is correct if the search may not continue.
    few = field.estimate(problem, length=0.02, modes=30, mesh_error=False, max_iterations=2)
    T = few.deviation * prior.field_at_nodes(p, np.eye(len(b)))
    H = np.eye(len(b)) + (A @ T).T @ (A @ T)
    off = np.linalg.solve(T, few.log_factor) - np.linalg.solve(H, (A @ T).T @ b)
    np.testing.assert_allclose(few.distance, np.sqrt(off @ H @ off), rtol=0.02)
    assert "standard deviations of the map away" in field.distance_sentence(few)


@pytest.mark.ci
def test_a_map_that_was_killed_ends_where_an_unbroken_one_ends(problem, monkeypatch, tmp_path):
    _of_a_formula(monkeypatch, problem, bend=0.005)
    how = {"length": 0.02, "modes": 10, "mesh_error": False}
    whole = field.estimate(problem, file=tmp_path / "whole.h5", **how)
    assert len(whole.history) > 1
    file = tmp_path / "killed.h5"
    for after in (3, 9, 2):
        left = iter(range(after))

        def killed(k, chi2, left=left):
            if next(left, None) is None:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            field.estimate(problem, file=file, resume=True, progress=killed, **how)
    again = field.estimate(problem, file=file, resume=True, **how)
    assert again.deviation == whole.deviation and len(again.history) == len(whole.history)
    assert np.abs((again.log_factor - whole.log_factor) / whole.sd).max() < 0.1
    # A finished search is not started again.
    finished = field.estimate(problem, file=file, resume=True, **how)
    np.testing.assert_array_equal(finished.log_factor, again.log_factor)
    assert finished.history == again.history


def test_a_stopped_map_goes_on_with_more_iterations(problem, monkeypatch, tmp_path):
    """The search stopped at its limit of iterations. A larger limit was then the reason to count it as finished."""
    _of_a_formula(monkeypatch, problem)
    file, how = tmp_path / "p.h5", {"length": 0.02, "modes": 30, "mesh_error": False}
    for older in (False, True):
        few = field.estimate(problem, file=file, max_iterations=2, **how)
        assert field.distance_sentence(few) is not None
        with h5py.File(file, "a") as f:
            rows = f["history"][:]
            if older:  # older versions did not write whether the search converged
                del f["history"]
                f["history"] = rows[:, :5]
        more = field.estimate(problem, file=file, resume=True, max_iterations=50, **how)
        assert more.distance < 0.05 and field.distance_sentence(more) is None
        assert more.history[-1]["converged"] == 1


def test_a_prior_that_is_narrow_does_not_hide_an_open_level(problem, monkeypatch):
    """The residuals depend only on differences of m, and the true level is twice that of the scene. The first prior
    fitted the data, so no standard deviation was above 0.5, and there was no warning."""
    n = problem.scenes[0].mesh.number_of_nodes
    A = np.random.default_rng(0).normal(size=(n, n))

    def told(A):
        @partial(jax.jit, static_argnames="name")
        def linearised(problem, base, m, name):
            return jax.linearize(lambda m: (jnp.asarray(A) @ m, (jnp.zeros((), jnp.int32),)), m, has_aux=True)

        monkeypatch.setattr(field, "_linearised", linearised)
        found = field.estimate(problem, length=0.02, modes=10, mesh_error=False)
        assert found.deviation == field.DEVIATIONS[0] and found.sd.max() < field.OPEN
        return field.level_sentence(found)

    assert "only the prior ties the mean modulus" in told(A - A.mean(axis=1, keepdims=True))
    assert told(A) is None


def test_a_search_goes_back_from_where_there_is_no_answer(problem, monkeypatch):
    """Failed runs once had a fixed cost. If it was below chi^2, the search ended at a failed run."""
    _of_a_formula(monkeypatch, problem)
    inner = field._linearised

    def failing(problem, base, m, name):
        r, J, codes = inner(problem, base, m, name)
        return (r * 300 if np.abs(m).max() < 0.02 else r * np.nan), J, codes

    monkeypatch.setattr(field, "_linearised", failing)
    found = field.estimate(problem, length=0.02, modes=10, mesh_error=False, max_iterations=30)
    assert np.isfinite(found.chi2) and 0 < np.abs(found.log_factor).max() < 0.02


def test_a_scene_without_an_answer_is_no_map(problem, monkeypatch):
    def nothing(problem, base, m, name):
        return jax.linearize(lambda m: (jnp.nan * m, (jnp.zeros((), jnp.int32),)), m, has_aux=True)

    monkeypatch.setattr(field, "_linearised", nothing)
    with pytest.raises(lj.InputError, match="fails at the parameters from which the search begins"):
        field.estimate(problem, length=0.02, mesh_error=False)


def test_the_errors_of_mesh_and_time_step_count_as_noise(problem, monkeypatch):
    """Each error is one value per scene, over the measured components. Without estimates nothing changes."""
    first, second = problem.data
    sd = first.sd.copy()
    sd[0] = np.inf  # not measured
    own = problem._replace(data=(first._replace(sd=sd), second))
    of_mesh = np.concatenate([np.full(first.measured.size, 3.0), np.full(second.measured.size, 0.5)])
    of_mesh[:3] = 0.0
    errors = [
        scene_numbers.Discretisation(of_mesh, None),
        scene_numbers.Discretisation(of_mesh, 2.0 * (of_mesh > 0)),
        scene_numbers.Discretisation(None, None),
    ]
    for mesh, steps, factors in zip((3.0, 3.0, 0.0), (0.0, 2.0, 0.0), ((10, 1.25), (14, 5.25), (1, 1)), strict=True):
        monkeypatch.setattr(scene_numbers, "discretisation_errors", lambda *_: errors.pop(0))
        found, sizes = scene_numbers.with_discretisation_as_noise(own)
        assert [one.get("mesh", 0.0) for one in sizes] == pytest.approx([mesh, mesh / 6])
        assert all(set(one) == {k for k, e in (("mesh", mesh), ("time_step", steps)) if e} for one in sizes)
        assert np.all(np.isinf(found.data[0].sd[0]))
        for data, before, factor in zip(found.data, own.data, factors, strict=True):
            np.testing.assert_allclose(data.sd[1:], np.sqrt(factor) * before.sd[1:], rtol=1e-12)


@pytest.mark.ci
@pytest.mark.draws
@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_map_is_written_at_the_nodes_of_its_mesh(tmp_path, order):
    """The map is defined at the vertices. Nodes between them have the mean of the logarithms."""
    mesh = lj.shapes.box((0.06, 0.04, 0.04), (3, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    p, rng = prior.prior(mesh, 0.02), np.random.default_rng(0)
    m = prior.field_at_nodes(p, rng.normal(size=mesh.number_of_vertices))
    none, E = np.zeros_like(m), mesh.number_of_elements
    nowhere, rest = np.zeros(E, bool), (0.1, 0.02, 1.0, 9, True, 0.0, [], np.ones(3), (0,), 1.0)
    found = field.Field("law.mu", m, np.ones(E), none + 0.1, none + 1, none, none, *rest, nowhere, 0.1)
    field_report.write(tmp_path, mesh, {}, found)
    with h5py.File(tmp_path / "field.h5") as f:
        factor = f["factor"][:]
    assert factor.shape == (mesh.number_of_nodes,)
    np.testing.assert_allclose(factor[: len(m)], np.exp(m), rtol=1e-12)
    if order == 2:
        low, high = mesh.pattern.edges
        np.testing.assert_allclose(factor[len(m) :], np.sqrt(factor[low] * factor[high]), rtol=1e-12)
    # Where a region of the scene sets the value, the map has no values.
    given = np.zeros(E, bool)
    given[: E // 2] = True
    field_report.write(tmp_path, mesh, {}, found._replace(given=given))
    with h5py.File(tmp_path / "field.h5") as f:
        lost = np.flatnonzero(np.isnan(f["factor"][:]))
        assert np.array_equal(f["given"][:], given)
    nodes = mesh.element_nodes_on_host
    assert len(lost) and np.array_equal(lost, np.setdiff1d(nodes[:, given], nodes[:, ~given]))


def test_a_sphere_starts_where_the_map_is_known(problem):
    """With a weak prior, the largest values are where the data determine little."""
    mesh = problem.scenes[0].mesh
    X = np.asarray(mesh.points)
    near = np.linalg.norm(X - [0.03, 0.02, 0.02], axis=1) < 0.015
    corner = np.linalg.norm(X, axis=1) < 0.015
    m = np.where(near, 1.0, np.where(corner, -2.0, 0.0))
    sd = np.where(corner, 3.0, 0.1)
    rest = (1.6, 0.02, 1.0, 9, True, 0.0, [], np.ones(3), (0,), 1.0)
    found = field.Field("law.mu", m, m, sd, sd, None, None, *rest, m > 9, 0.1)
    start = inclusion.start_from(problem, found)
    assert np.linalg.norm(start[:3] - [0.03, 0.02, 0.02]) < 0.01 and start[5] > 0


@pytest.mark.slow
def test_the_mesh_bias_of_a_map_corrects_it(tmp_path):
    """The data are from quadratic elements on a mesh refined twice, the map from linear ones on a mesh refined once.
    With its bias subtracted, the map is closer to the uniform truth.
    """
    scene = _scene(tmp_path, gravity="1, 0, -1")

    def on(mesh: lj.TetMesh) -> lj.Scene:
        return replace(scene, mesh=mesh, fixed=(lj.Fixed(nodes=jnp.flatnonzero(mesh.points[:, 2] == 0.0)),))

    coarse, fine = on(lj.refined(scene.mesh)), on(lj.quadratic(lj.refined(lj.refined(scene.mesh))))
    u = np.asarray(lj.simulate(fine).check().positions[-1] - fine.mesh.points)
    X = np.asarray(coarse.mesh.points)
    seen = np.flatnonzero(X[:, 2] > 0.01)
    np.savetxt(tmp_path / "u.csv", np.c_[X[seen], u[seen]], delimiter=",", header="x,y,z,ux,uy,uz", comments="")
    data = displacements.read_displacements(tmp_path / "u.csv", coarse, 0.1 * np.linalg.norm(u, axis=1).max())
    problem = scene_numbers.Problem((coarse,), (data,))
    found = field.estimate(problem, length=0.05, max_iterations=20, modes=20)
    # In directions that the data do not determine, the prior keeps the starting point of the map; here this is the
    # truth.
    off, left = (np.sqrt(np.mean(m**2)) for m in (found.log_factor, found.log_factor - found.mesh_bias))
    assert off > 0.01 and left < 0.5 * off


@pytest.mark.slow
def test_the_gradient_of_the_map(problem):
    """Compare the gradient with respect to the whitened field with central differences."""
    base = field.start_of(problem, "law.mu")
    p = prior.prior(problem.scenes[0].mesh, 0.02)
    sharp = problem._replace(scenes=tuple(replace(s, solve=replace(s.solve, tolerance=1e-12)) for s in problem.scenes))
    search = field._Search(sharp, "law.mu", base, p, None, lambda *_: None)
    rng = np.random.default_rng(3)
    z, d = 0.3 * rng.normal(size=80), rng.normal(size=80)
    slope = search.at(z).gradient() @ d
    ends = [[search.at(z + s * h * d).cost for s in (1, -1)] for h in (1e-3, 1e-4)]
    errors = [abs((a - b) / (2 * h) / slope - 1) for (a, b), h in zip(ends, (1e-3, 1e-4), strict=True)]
    assert min(errors) < 1e-7


@pytest.mark.slow
def test_few_numbers_of_several_scenes(problem):
    """Shear and bulk modulus of a uniform block are within four standard errors, which decrease with the noise."""
    scene = problem.scenes[0]
    X = np.asarray(scene.mesh.points)
    data = []
    for k, s in enumerate(problem.scenes):
        u = np.asarray(lj.simulate(s).check().positions[-1]) - X
        noise = 5e-5 * np.random.default_rng(k).normal(size=u.shape)
        d = problem.data[k]
        placed = np.einsum("nk,nkc->nc", d.weights, (u + noise)[d.nodes])
        data.append(d._replace(measured=placed))
    wrong = [lj.with_parameters(s, {"law.mu": 500.0, "law.bulk": 5000.0}) for s in problem.scenes]
    found = scene_numbers.fit_numbers(
        scene_numbers.Problem(tuple(wrong), tuple(data)), ["law.mu", "law.bulk"], mesh_error=False
    )
    assert found.converged and found.names == ("law.mu", "law.bulk")
    assert np.all(np.abs(found.values - [800.0, 3000.0]) < 4 * found.standard_errors)
    assert 0.5 < found.chi2 / found.components < 1.5
    assert found.standard_errors[0] < 20


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the error of the (mesh|time step) changes")
def test_viscosity_from_a_time_series(tmp_path):
    """A block creeps under its weight. Ratio and relaxation time are estimated from a few nodes over time."""
    text = _SCENE.format(mu=800.0, gravity="4, 0, -3")
    text += "[viscosity]\nratios = [0.4]\nrelaxation_times = [0.3]\n[solve]\ndt = 0.1\nsteps = 10\n"
    (tmp_path / "creep.toml").write_text(text)
    scene = lj.load_scene(tmp_path / "creep.toml")
    run = lj.simulate(scene).check()
    X = np.asarray(scene.mesh.points)
    top = np.flatnonzero(X[:, 2] > 0.039)
    rng, rows = np.random.default_rng(0), []
    for k in range(10):
        u = np.asarray(run.positions[k])[top] - X[top]
        rows.append(np.c_[np.full(len(top), float(run.times[k])), top, u + 2e-5 * rng.normal(size=u.shape)])
    np.savetxt(tmp_path / "u.csv", np.vstack(rows), delimiter=",", header="time,node,ux,uy,uz", comments="")
    (tmp_path / "start.toml").write_text(text.replace("[0.4]", "[0.2]").replace("[0.3]", "[0.6]"))
    names = "law.mu,viscosity.ratios,viscosity.relaxation_times"
    command = ["field", str(tmp_path / "start.toml"), str(tmp_path / "u.csv"), "--parameters", names]
    assert main([*command, "--noise", "2e-5", "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "field.json").read_text())
    for name, true in (("law.mu", 800.0), ("viscosity.ratios.0", 0.4), ("viscosity.relaxation_times.0", 0.3)):
        assert abs(found["values"][name] - true) < 4 * found["standard_errors"][name], found
        assert found["standard_errors"][name] < 0.1 * true


def test_numbers_with_two_dimensions_keep_their_shape(problem, monkeypatch):
    """Displacements (V, 3) were given to the scene as one row, and were refused."""
    seen = []
    monkeypatch.setattr(scene_numbers, "fit", lambda problem, unknowns, **_: seen.append(unknowns) or [None])
    mesh = lj.shapes.box((0.01, 0.01, 0.01), (1, 1, 1))
    by = np.linspace(-1e-4, 1e-4, 12).reshape(4, 3)
    moved = lj.Displaced(nodes=mesh.node_sets["x_max"], by=jnp.asarray(by))
    scene = lj.Scene(mesh=mesh, law=lj.laws.Ogden(mu=(8.0, 2.0), alpha=(2.0, 3.0), bulk=30.0), displaced=(moved,))
    scene_numbers.fit_numbers(problem._replace(scenes=(scene,)), ["displaced.0.by", "law.mu", "law.bulk"])
    found = seen[0].values_of(jnp.asarray(seen[0].start))
    np.testing.assert_allclose(found["displaced.0.by"], by, rtol=1e-12)
    assert found["law.mu"] == (8.0, 2.0) and jnp.shape(found["law.bulk"]) == ()
    assert seen[0].names[4:6] == ["displaced.0.by.4", "displaced.0.by.5"]
