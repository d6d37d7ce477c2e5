"""The estimated mesh error: close to the true error, rejected where it is meaningless, and a correction of fits."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core.struct import replace
from liverjax.jobs import long_run
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.simulation import mesh_error, run
from liverjax.simulation.cautions.of_mesh import mesh_sentence

pytestmark = pytest.mark.quick_to_compile


def _pull(order: int, cells: int, by: float = 1e-6) -> lj.Scene:
    mesh = lj.shapes.box((0.01, 0.01, 0.01), (cells, cells, cells))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=800.0, bulk=16000.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([0.0, 0.0, by])),),
        solve=lj.Solve(linear_solver="cg"),
    )


def _force(mesh: lj.TetMesh):
    top = mesh.node_sets["z_max"]
    return lambda x, R: jnp.sum(R[-1, top, 2])


def _pulled(scene: lj.Scene) -> float:
    result = lj.simulate(scene)
    return float(_force(scene.mesh)(result.positions, result.reactions))


#: Force [N] of the cube with 48 quadratic elements with pressures.
QUADRATIC = 3.0073122563605554e-05


@pytest.mark.slow
def test_the_force_by_quadratic_elements():
    scene = replace(_pull(2, 2), solve=lj.Solve(volumetric="mixed"))
    assert np.isclose(_pulled(scene), QUADRATIC, rtol=1e-7)  # Newton's tolerance is 1e-8


@pytest.mark.slow
def test_mesh_error_of_a_small_strain_is_the_way_to_quadratic_elements():
    """The problem is linear, so one linear solve gives the quadratic solution, up to the solver's tolerance of 1e-2."""
    scene = _pull(1, 2)
    result = lj.simulate(scene, mesh_error=True)
    value, change = result.mesh_error.change(_force(scene.mesh), result)
    assert bool(result.mesh_error.found.all()) and change < -0.05 * value
    assert abs(value + change - QUADRATIC) < 0.02 * abs(change)
    assert re.search("nodal positions are wrong by up to .* m.*use order = 2 in", mesh_sentence(scene, result))


@pytest.mark.slow
def test_a_bar_of_two_compressible_materials_has_no_mesh_error():
    """Linear elements contain the exact motion, whose pressure jumps between the materials."""
    mesh = lj.shapes.box((0.01, 0.01, 0.04), (1, 1, 2))
    upper = np.flatnonzero(np.asarray(mesh.points)[np.asarray(mesh.tetrahedra), 2].mean(axis=1) > 0.02)
    law = lj.laws.NeoHookean(mu=700.0, bulk=1000.0)
    scene = lj.Scene(
        mesh=mesh,
        law=law,
        region=(lj.Region(elements=jnp.asarray(upper), law={"mu": 1800.0}),),
        fixed=(
            lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes), axes="xy"),
            lj.Fixed(nodes=mesh.node_sets["z_min"], axes="z"),
        ),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([0.0, 0.0, 0.004]), axes="z"),),
    )
    result = lj.simulate(scene, mesh_error=True)
    assert np.all(np.asarray(result.mesh_error.found))
    # The rest is the tolerance of Newton's method, 1e-8.
    assert np.abs(result.mesh_error.positions).max() < 1e-8 * 0.004


@pytest.mark.slow
@pytest.mark.parametrize(("order", "cells"), [(1, 2), (1, 3), (2, 2)])
@pytest.mark.parametrize("by", [1e-6, 5e-4])
def test_effectivity_against_a_finer_mesh(order, cells, by, verified):
    """The reference has quadratic elements, 4 and 6 cells, extrapolated with the order of edges of clamped
    faces (1.5).
    """
    scene = _pull(order, cells, by)
    result = lj.simulate(scene, mesh_error=True)
    value, change = result.mesh_error.change(_force(scene.mesh), result)
    coarse, fine = (_pulled(_pull(2, n, by)) for n in (4, 6))
    truth = fine + (fine - coarse) / (1.5**1.5 - 1)
    effectivity = float(change) / (truth - float(value))
    assert 0.5 < effectivity < 2
    verified(f"mesh error, order {order}, {cells} cells", "finer meshes", abs(effectivity - 1), 1.0)


@pytest.mark.slow
def test_a_quadratic_body_that_has_come_to_rest_has_the_estimate_of_one_at_rest():
    """Newmark's method begins with force over mass, but the added functions of order 3 have no mass.

    Half of the stiffness relaxes, so the body at rest has the other half.
    """
    mesh = lj.quadratic(lj.shapes.box((0.02, 0.01, 0.01), (2, 1, 1)))
    law = lj.laws.NeoHookean(mu=800.0, bulk=1600.0)
    scene = lj.Scene(
        mesh=mesh,
        law=law,
        viscosity=lj.Prony(ratios=jnp.array([0.5]), relaxation_times=jnp.array([0.02])),
        body=lj.Body(density=1000.0, gravity=(1.0, 0.0, 0.0)),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        solve=lj.Solve(kind="dynamic", integrator="newmark", dt=0.01, steps=300),
    )
    still = replace(scene, law=lj.laws.scaled(law, 0.5), viscosity=None, solve=lj.Solve())
    moved = []
    for each in (scene, still):
        result = lj.simulate(each, mesh_error=True).check()
        assert bool(result.mesh_error.found.all())
        # Newmark's method does not damp the fastest oscillations, so the mean of the last hundred steps is taken.
        moved.append((result.positions[-100:].mean(axis=0), result.mesh_error.positions[-100:].mean(axis=0)))
    (x, change), (expected, its) = moved
    assert np.abs(x - expected).max() < 1e-3 * np.abs(expected - mesh.points).max()
    assert np.abs(change - its).max() < 0.05 * np.abs(its).max()


def _pushed(mu: jax.Array) -> lj.Scene:
    """Return a box with a dead load. Its bulk modulus is 5 mu."""
    mesh = lj.shapes.box((0.04, 0.04, 0.04), (1, 1, 1))
    top = jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_max"]))
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=mu, bulk=5 * mu),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        traction=(lj.Traction(triangles=top, value=jnp.array([0.0, 3.0, 0.0])),),
    )


@pytest.mark.ci
def test_the_derivative_of_the_estimate_contains_the_change_of_the_stiffness():
    """At the reference positions the estimate is proportional to 1 / moduli. The derivative of a run's estimate was a
    fifth of the true one, because the stiffness was a constant. The space also changed in a differentiated function.
    """
    spaces = [mesh_error.richer(_pushed(jnp.asarray(1000.0))).scene.solve.volumetric]

    def estimate(mu: jax.Array) -> jax.Array:
        scene = _pushed(mu)
        x, rich = scene.mesh.points[None], mesh_error.richer(scene)
        spaces.append(rich.scene.solve.volumetric)
        return mesh_error.estimated_error(scene, rich, x, jnp.zeros_like(x)).positions[0]

    change, slope = jax.jvp(estimate, (1000.0,), (1000.0,))
    known = _pushed(jnp.asarray(1000.0))
    jax.jit(lambda load: spaces.append(mesh_error.richer(known).scene.solve.volumetric) or load)(1.0)
    assert spaces == ["element"] * 3 and jnp.max(jnp.abs(change)) > 1e-4
    assert jnp.max(jnp.abs(slope + change)) < 0.02 * jnp.max(jnp.abs(change))  # tolerance of the linear solve: 1e-2


def test_mesh_error_refuses_what_it_cannot_say():
    scene = _pull(1, 1)
    with pytest.raises(lj.InputError, match="remove start"):
        lj.simulate(scene, start=scene.mesh.points, mesh_error=True)
    with pytest.raises(lj.InputError, match="has an additional error"):
        lj.simulate(replace(scene, solve=lj.Solve(newton_iterations=1)), mesh_error=True)
    with pytest.raises(lj.InputError, match=r"cannot be estimated inside jax\.jit if the mesh is an argument"):
        jax.jit(lambda own: lj.simulate(own, mesh_error=True).mesh_error.positions)(scene)


@pytest.mark.slow
def test_the_mesh_bias_of_a_fitted_number_corrects_it():
    """Data of quadratic elements on a finer mesh are fitted with coarse linear ones. The bias shows the effect of the
    mesh.
    """
    from fitting.fits import scene_numbers
    from fitting.readers.displacements import Displacements

    def block(order: int, cells: int, mu: float) -> lj.Scene:
        mesh = lj.shapes.box((0.02, 0.01, 0.01), (2 * cells, cells, cells))
        mesh = lj.quadratic(mesh) if order == 2 else mesh
        return lj.Scene(
            mesh=mesh,
            law=lj.laws.NeoHookean(mu=mu, bulk=2400.0),
            fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
            body=lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -0.5])),
            solve=lj.Solve(linear_solver="cg"),
        )

    truth, coarse = block(2, 4, 800.0), block(1, 4, 700.0)
    corner = int(np.argmax(np.asarray(coarse.mesh.points) @ np.ones(3)))
    same = int(
        np.argmin(np.linalg.norm(np.asarray(truth.mesh.points) - np.asarray(coarse.mesh.points)[corner], axis=1))
    )
    moved = np.asarray(lj.simulate(truth).check().positions[-1] - truth.mesh.points)[same]
    data = Displacements(
        step=np.array([0]),
        nodes=np.full((1, 4), corner),
        weights=np.array([[1.0, 0.0, 0.0, 0.0]]),
        measured=moved[None],
        sd=np.full((1, 3), 1e-6),
    )
    problem = scene_numbers.Problem((coarse,), (data,))
    with pytest.warns(UserWarning, match="the error of the mesh changes .*law.mu by"):
        found = scene_numbers.fit_numbers(problem, ["law.mu"], mesh_error=True)
    off, left = found.values[0] - 800.0, found.values[0] - found.mesh_bias[0] - 800.0
    assert off < -20 and abs(left) < 0.3 * abs(off)


def test_forces_at_single_nodes_are_named_beside_the_mesh_error():
    """The corrected reaction of a ligament was three times as wrong as the uncorrected one, without a word."""
    scene = _pull(1, 2)
    result = lj.simulate(scene, mesh_error=True)
    top = scene.mesh.node_sets["z_max"]
    cable = Ligament(
        nodes=top[None], weights=jnp.ones((1, len(top))), to=jnp.array([0.0, 0.0, 0.1]), stiffness=1.0, pre_tension=0.0
    )
    springs = ElasticSupport(nodes=top, stiffness=1.0)
    for physics, said in ((cable, "[[ligament]] at single nodes"), (springs, "[[support]] at single nodes")):
        assert said in mesh_sentence(replace(scene, physics=(physics,)), result)
    assert "single nodes" not in mesh_sentence(scene, result)


@pytest.mark.ci
def test_the_command_refuses_before_the_run_and_never_loses_the_result(tmp_path, monkeypatch, capsys):
    """The mesh error was refused after the last step, and nothing was written."""
    text = """mesh = {shape = "box", size = [0.02, 0.02, 0.02], cells = [1, 1, 1]}
law = {name = "neo_hookean", mu = 770.0, bulk = 2200.0}
fixed = [{where = {z_max = 0.0}}]
displaced = [{where = {z_min = 0.02}, by = [0.0, 0.0, 0.001]}]
"""
    file, out = tmp_path / "scene.toml", tmp_path / "out"
    ask = ["simulate", str(file), "--mesh-error", "--out", str(out)]
    for line in ('newton = "one_step"', "newton_iterations = 1"):
        file.write_text(f"{text}[solve]\n{line}\n")
        with monkeypatch.context() as changed:
            changed.setattr(long_run, "run", lambda *_: pytest.fail("the scene must not run"))
            assert main(ask) == 2 and "has an additional error" in capsys.readouterr().err

    def refused(scene):
        raise lj.InputError("this mesh error is not known: use another scene")

    file.write_text(text)
    monkeypatch.setattr(mesh_error, "richer", refused)
    assert main(ask) == 0 and "caution: this mesh error is not known" in capsys.readouterr().out
    assert (out / "result.h5").exists()


def test_the_mesh_error_of_a_loaded_mesh_is_refused(tmp_path, monkeypatch, capsys):
    """The estimated error was 29 % of the length, although the run ends in the given shape on every mesh."""
    from fitting.fits import scene_numbers
    from fitting.readers.displacements import Displacements

    text = """mesh = {shape = "box", size = [0.02, 0.02, 0.02], cells = [1, 1, 1], is = "loaded"}
law = {name = "neo_hookean", mu = 800.0, bulk = 4000.0}
body = {density = 1000.0, gravity = [0.0, 0.0, -1.0]}
fixed = [{where = {x_max = 0.0}}]
"""
    file = tmp_path / "scene.toml"
    file.write_text(text)
    scene = lj.load_scene(file)
    monkeypatch.setattr(run, "_run", lambda *_: pytest.fail("the scene must not run"))
    monkeypatch.setattr(long_run, "run", lambda *_: pytest.fail("the scene must not run"))
    with pytest.raises(lj.InputError, match="the mesh error is unknown, because the reference shape"):
        lj.simulate(scene, mesh_error=True)
    assert main(["simulate", str(file), "--mesh-error", "--out", str(tmp_path / "out")]) == 2
    assert "the mesh error is unknown" in capsys.readouterr().err
    data = Displacements(
        step=np.array([0]),
        nodes=np.full((1, 4), 7),
        weights=np.array([[1.0, 0.0, 0.0, 0.0]]),
        measured=np.zeros((1, 3)),
        sd=np.full((1, 3), 1e-6),
    )
    problem = scene_numbers.Problem((scene,), (data,))
    for finer in (None, lambda mesh: {}):
        with pytest.warns(UserWarning, match=r"the effect of the mesh error on the fit is unknown: \[mesh\] is = "):
            assert scene_numbers.discretisation_errors(problem, {}, finer).mesh is None


def _column(cells: int, order: int) -> lj.Scene:
    """Return a column under its own weight. Its sides cannot move sideways."""
    mesh = lj.shapes.box((0.03, 0.03, 0.12), (1, 1, cells))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    sides = [lj.Fixed(nodes=mesh.node_sets[f"{a}_{end}"], axes=a) for a in "xy" for end in ("min", "max")]
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=5000.0, bulk=10000.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]), *sides),
        body=lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -1.0])),
    )


@pytest.mark.ci
def test_the_mesh_error_is_estimated_inside_elements():
    """The estimate inside linear elements was the interpolated error of the nodes: half as large, and unrelated."""
    from fitting.fits import scene_numbers
    from fitting.readers.displacements import Displacements, locate, predicted

    points = np.random.default_rng(0).uniform([0.001, 0.001, 0.001], [0.029, 0.029, 0.119], (40, 3))
    fine, coarse = _column(8, 2), _column(4, 1)

    def at(scene: lj.Scene) -> Displacements:
        nodes, weights, _ = locate(scene.mesh, points)
        none = np.zeros((len(points), 3))
        return Displacements(np.zeros(len(points), int), nodes, weights, none, none + 1e-6)

    moved = [np.asarray(predicted(at(s), s, lj.simulate(s).check().positions)) for s in (fine, coarse)]
    true = (moved[0] - moved[1]).ravel() / 1e-6
    found = scene_numbers.discretisation_errors(scene_numbers.Problem((coarse,), (at(coarse),)), {}).mesh
    assert np.linalg.norm(found - true) < 0.2 * np.linalg.norm(true)
