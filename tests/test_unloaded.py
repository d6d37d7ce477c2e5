"""The unloaded shape: a run from it returns to the given shape; comparison with a column under its own weight."""

import json
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation.unloaded import cautions_of_loaded, unload

pytestmark = pytest.mark.quick_to_compile

TOLERANCE = 1e-12
SKIN = {"thickness": 1e-4, "law": {"name": "neo_hookean", "mu": 1e4}, "where": {"z_min": 0.01}}
SUPPORT = {"where": {"x_min": 0.04}, "normal": 200.0}
#: Under this load on its end, no reference body can have this length.
HEAVY = {"body.gravity": jnp.array([-600.0, 0, 0])}


def content(order: int = 1, **more) -> dict:
    return {
        "mesh": {"shape": "box", "size": [0.04, 0.01, 0.01], "cells": [2, 1, 1], "order": order, "is": "loaded"},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "body": {"density": 1000.0, "gravity": [3.0, 0, -1.5]},
        "fixed": [{"where": {"x_max": 0.0}}],
        "solve": {"tolerance": TOLERANCE},
    } | more


def there_and_back(scene: lj.Scene) -> None:
    """Check that the run from the reference shape ends in the given shape."""
    found = lj.unloaded(scene)
    assert found.status == 0 and found.residual <= TOLERANCE
    given, V = scene.mesh.points, scene.mesh.number_of_vertices
    moved = np.asarray(found.scene.mesh.points - given)[:V]
    assert np.linalg.norm(moved, axis=1).max() > 0.04 * 0.04  # a large displacement: at least 4 % of the length
    back = np.asarray(lj.simulate(found.scene).check().positions[-1] - given)[:V]
    # Two residuals of the tolerance times the forces, which cause the sag `moved`. In the softest motion a force may
    # cause ten times more.
    assert np.linalg.norm(back) < 10 * 2 * TOLERANCE * np.linalg.norm(moved)


@pytest.mark.ci
def test_there_and_back():
    """Linear elements. For a load that is far too large there is no reference shape, and a message says so."""
    scene = scene_from(content())
    there_and_back(scene)
    heavy = lj.with_parameters(scene, HEAVY)
    with pytest.raises(InputError, match=r"no reference shape was found for the given shape under these loads"):
        lj.simulate(heavy)


def test_a_residual_of_roundoff_is_told_as_roundoff(monkeypatch):
    """The advice was a stiffer law or smaller loads. With both, the roundoff is larger."""
    scene = scene_from(content())
    found = (scene.mesh.points, status.STALLED, 1e-4, 2e-4)
    monkeypatch.setattr("liverjax.simulation.unloaded._found_shape", lambda _: found)
    with pytest.raises(
        InputError, match=r"is only roundoff, but is above the tolerance: use a tolerance above 0\.0002"
    ):
        unload(scene)
    found = (scene.mesh.points.astype(jnp.float32), status.STALLED, 1e-4, 2e-4)
    with pytest.raises(InputError, match=r'use precision = "float64" or a tolerance above 0\.0002'):
        unload(scene)
    found = (scene.mesh.points, status.STALLED, 1e-3, 2e-4)
    with pytest.raises(InputError, match="smaller loads"):
        unload(scene)


def test_a_viscous_run_that_is_too_short_to_end_in_the_given_shape_is_told():
    viscosity, solve = {"ratios": [0.3], "relaxation_times": [0.3]}, {"dt": 0.05, "steps": 3}
    scene = scene_from(content(viscosity=viscosity, solve=solve))

    def said(lasts, **solve):
        at = replace(scene, solve=replace(scene.solve, **solve))
        return cautions_of_loaded(at, jnp.array([lasts]))

    (sentence,) = said(0.15, dt=0.05, steps=3)
    assert "lasts 0.15 s, but a relaxation time is 0.3 s" in sentence
    assert said(3.0, dt=1.0, steps=3) == said(0.15, dt=0.05, kind="dynamic") == []


def test_friction_in_several_steps_is_told():
    """After five steps, a body on a rough plane stayed 11 % of its motion away from the given shape."""
    plane = {"shape": "plane", "position": [0, 0, 1e-4], "axis": [0, 0, 1], "where": {"z_max": 0.0}, "friction": 0.3}
    scene = scene_from(content(obstacle=[plane], solve={"steps": 5}))
    (sentence,) = cautions_of_loaded(scene, jnp.zeros(5))
    assert "the friction of obstacle.0 depends on the steps" in sentence
    smooth = replace(scene, physics=(), solve=scene.solve)
    once = replace(scene, solve=replace(scene.solve, steps=1))
    assert cautions_of_loaded(smooth, jnp.zeros(5)) == cautions_of_loaded(once, jnp.zeros(1)) == []


@pytest.mark.slow
def test_the_command_tells_it_too(tmp_path, capsys):
    """The command runs the unloaded scene, whose points are the reference shape. There the warning was missing."""
    text = """mesh = {shape = "box", size = [0.02, 0.02, 0.02], cells = [1, 1, 1], is = "loaded"}
law = {name = "neo_hookean", mu = 770.0, bulk = 2200.0}
viscosity = {ratios = [0.3], relaxation_times = [0.3]}
body = {density = 1000.0, gravity = [0, 0, -5.0]}
fixed = [{where = {z_max = 0.0}}]
solve = {dt = 0.05, steps = 3}
"""
    (tmp_path / "scene.toml").write_text(text)
    assert main(["simulate", str(tmp_path / "scene.toml"), "--out", str(tmp_path)]) == 0
    assert "lasts 0.15 s, but a relaxation time is 0.3 s" in capsys.readouterr().out


@pytest.mark.slow
def test_inside_a_program_a_shape_that_is_not_found_is_not_a_number():
    """Such a run must not look like a run from a valid shape. Its status shows the failure."""
    heavy = lj.with_parameters(scene_from(content()), HEAVY)
    points, code, run = jax.jit(lambda s: (*unload(s)[:2], lj.simulate(s).status))(heavy)
    assert code != status.CONVERGED and np.isnan(points.mesh.points).any()
    assert run.tolist() == [status.NOT_FINITE]


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_there_and_back_with_a_capsule_and_a_support(order):
    scene = scene_from(content(order, membrane=[SKIN], support=[SUPPORT]))
    there_and_back(scene)
    # A run of the loaded scene itself begins in the reference shape.
    back = lj.simulate(scene).check().positions[-1] - scene.mesh.points
    assert np.abs(back[: scene.mesh.number_of_vertices]).max() < 1e-12


@pytest.mark.slow
def test_a_column_under_its_own_weight(verified):
    """With fixed sides, P(stretch) = rho g (L - X) at every height: one equation for the reference length L."""
    rho_g, length = 3000.0, 0.04
    table = content(2, body={"density": 1000.0, "gravity": [rho_g / 1000.0, 0, 0]})
    table["mesh"]["cells"] = [4, 1, 1]
    places = ({"y_max": 0.0}, {"y_min": 0.01}, {"z_max": 0.0}, {"z_min": 0.01})
    table["fixed"] += [{"where": w, "axes": next(iter(w))[0]} for w in places]
    scene = scene_from(table)
    reference = float(np.asarray(lj.unloaded(scene).scene.mesh.points)[:, 0].max())
    grid = np.linspace(1.0, 1.2, 2001)
    F = np.tile(np.eye(3), (len(grid), 1, 1))
    F[:, 0, 0] = grid
    stress = np.asarray(scene.law.first_piola(F))[:, 0, 0]

    def loaded(L):
        depth = (np.arange(400) + 0.5) / 400 * L
        return float(np.mean(np.interp(rho_g * depth, stress, grid)) * L)

    low, high = 0.9 * length, length
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if loaded(middle) < length else (low, middle)
    change = abs((reference - low) / (length - low))
    verified("reference length of a column under its weight", "analytic", change, 0.001)
    # For a linear column, quadratic elements are exact at their ends. The stretch of 2 % causes the rest.
    assert change < 0.001


@pytest.mark.slow
def test_a_block_is_as_another_program_finds_it_in_the_given_shape(verified):
    """Mazier's block of 2 m is computed by the method of Govindjee and Mihalic (`experiments.sources.unloaded_block`).
    For linear elements, equilibrium in the given shape and in the reference shape are the same equations.
    """
    file = Path(__file__).parents[1] / "experiments" / "results" / "unloaded_block.json"
    points, tets, theirs = (np.array(json.loads(file.read_text())[key]) for key in ("points", "tetrahedra", "unloaded"))
    inside_out = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) < 0
    tets[inside_out] = tets[inside_out][:, [0, 2, 1, 3]]
    scene = lj.Scene(
        mesh=lj.tet_mesh(points, tets),
        law=lj.laws.create("neo_hookean_compressible", mu=25e3, lame_lambda=8e5),
        body=lj.Body(density=1000.0, gravity=(0.0, 0.0, -9.81)),
        fixed=(lj.Fixed(nodes=jnp.asarray(np.flatnonzero(points[:, 2] < 1e-9))),),
        solve=lj.Solve(tolerance=TOLERANCE),
    )
    ours = lj.unloaded(scene).scene.mesh.points
    off = float(np.abs(ours - theirs).max() / np.abs(theirs - points).max())
    # A residual of 1e-12 of the forces, and in the other program Newton's last change of 1e-13 of the side.
    assert off < 1e-10
    verified("shape of a block before its weight", "scikit-fem", off, 1e-10)


def _tip(scene: lj.Scene, positions: jax.Array) -> jax.Array:
    return jnp.mean(positions[lj.boundary.select(scene.mesh, {"x_min": 0.04}), 0])


def _length_of(scene: lj.Scene) -> Callable[[float], jax.Array]:
    """Return a function for the length [m] of the reference shape as a function of mu."""

    def length(mu):
        return _tip(scene, lj.unloaded(lj.with_parameters(scene, {"law.mu": mu})).scene.mesh.points)

    return jax.jit(length)


@pytest.mark.slow
def test_derivatives_of_the_reference_shape():
    """The derivative of its length with respect to mu is compared with differences."""
    length = _length_of(scene_from(content()))
    by = jax.grad(length)(800.0)
    errors = [abs((length(800.0 + h) - length(800.0 - h)) / (2 * h) / by - 1) for h in (80.0, 0.8, 8e-7)]
    assert errors[1] < 1e-5 and errors[0] > 1e-4 and errors[2] > errors[1]


@pytest.mark.slow
def test_derivative_with_respect_to_the_direction_of_a_sliding_plane():
    """The derivative of the reference points along the normal of the plane was 0 at the sliding nodes."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
    left, right = (lj.boundary.boundary_triangles(mesh, mesh.node_sets[name]) for name in ("x_min", "x_max"))
    low = mesh.node_sets["z_min"]
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1000.0, bulk=3000.0),
        physics=(
            ElasticSupport(triangles=left, normal=3000.0),
            SlidingSupport(nodes=low, normal=jnp.array([0, 0, 1.0])),
        ),
        traction=(lj.Traction(triangles=right, value=jnp.array([60.0, 0, 0])),),
        solve=lj.Solve(tolerance=TOLERANCE),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"], axes="y"),),
        points_are="loaded",
    )

    def points(angle):
        normal = jnp.stack([jnp.sin(angle), 0.0 * angle, jnp.cos(angle)])
        return lj.unloaded(lj.with_parameters(scene, {"support.1.normal": normal})).scene.mesh.points

    # One program for points and derivatives: a second program would have to be compiled, too.
    both = jax.jit(lambda angle: jax.jvp(points, (angle,), (1.0,)))
    h = 1e-4
    (less, _), (_, by), (more, _) = (both(angle) for angle in (-h, 0.0, h))
    expected = np.asarray(more - less) / (2 * h)
    assert np.abs(expected[np.asarray(low), 2]).min() > 0.01  # [m]
    np.testing.assert_allclose(by, expected, atol=1e-6)


@pytest.mark.slow
def test_both_modes_of_derivatives_of_the_reference_shape_agree():
    length = _length_of(scene_from(content()))
    assert np.isclose(jax.jacfwd(length)(800.0), jax.grad(length)(800.0), rtol=1e-7)


@pytest.mark.slow
def test_the_end_of_a_run_from_the_reference_shape_does_not_depend_on_the_modulus():
    scene = scene_from(content())

    @jax.jit
    def end(mu):
        return _tip(scene, lj.simulate(lj.with_parameters(scene, {"law.mu": mu})).positions[-1])

    assert abs(jax.grad(end)(800.0)) < 1e-6 * abs(jax.jacfwd(_length_of(scene))(800.0))


@pytest.mark.slow
def test_the_relaxed_body_lies_as_given():
    """After a long time, a viscous body is in the given shape."""
    table = content(viscosity={"ratios": [0.4], "relaxation_times": [0.1]})
    table["solve"] |= {"dt": 0.5, "steps": 16}
    scene = scene_from(table)
    positions = np.asarray(lj.simulate(scene).check().positions)
    off = np.abs(positions - np.asarray(scene.mesh.points)).max(axis=(1, 2))
    # The recursion decays with exp(-dt/tau) = 0.7 % per step, in creep more slowly by 1/0.6.
    assert off[0] > 1e-5 and off[-1] < 1e-8


@pytest.mark.slow
def test_mixed_elements_of_a_viscous_body_return_to_the_given_shape():
    """The part of the bulk modulus in the displacement terms depends on the shear modulus. The search used the relaxed
    modulus, the run used the other one: the body stayed 6 % of its motion away from the given shape.
    """
    table = content(2, viscosity={"ratios": [0.8], "relaxation_times": [0.01], "part": "isochoric"})
    table["law"] |= {"mu": 3000.0, "bulk": 1e5}
    table["mesh"]["size"] = [0.06, 0.03, 0.03]
    table["solve"] |= {"dt": 0.5, "steps": 30, "volumetric": "mixed"}
    scene = scene_from(table)
    found = lj.unloaded(scene)
    back = lj.simulate(found.scene).check().positions[-1] - scene.mesh.points
    assert np.abs(np.asarray(back)[: scene.mesh.number_of_vertices]).max() < 1e-9


@pytest.mark.slow
def test_the_default_stiffness_of_an_obstacle_is_that_of_the_run():
    """The search used the stiffness that follows from the relaxed modulus, which was five times smaller."""
    plane = {"shape": "plane", "position": [0, 0, 1.5e-6], "axis": [0, 0, 1], "where": {"x_min": 0.02, "z_max": 0.0}}
    table = content(viscosity={"ratios": [0.8], "relaxation_times": [0.1]}, obstacle=[plane])
    table["mesh"] |= {"size": [0.06, 0.04, 0.03], "cells": [3, 2, 2]}
    table["body"]["gravity"] = [0, 0, -3.0]
    table["solve"]["dt"] = 0.5
    scene = scene_from(table)
    stiffness = scene.physics[0].in_body(scene.mesh, scene.law).stiffness
    given = replace(scene, physics=(replace(scene.physics[0], stiffness=stiffness),))
    own, same = (np.asarray(lj.unloaded(s).scene.mesh.points - s.mesh.points) for s in (scene, given))
    # The stiffness depends on the size of the triangles, which differs a little between the two shapes.
    assert np.abs(own - same).max() < 0.05 * np.abs(same).max()


@pytest.mark.slow
def test_a_loaded_shape_with_inverted_elements_is_refused():
    """The edges of loaded quadratic elements are curved. The elements were checked with straight edges."""
    table = content(2, law={"name": "neo_hookean", "mu": 600.0, "bulk": 6e5})
    table["mesh"] |= {"size": [0.1, 0.04, 0.04], "cells": [4, 2, 2]}
    table["body"]["gravity"] = [2.8, 0, -2.1]
    table["solve"] |= {"volumetric": "mixed"}
    with pytest.raises(InputError, match="no reference shape was found"):
        lj.unloaded(scene_from(table))


@pytest.mark.slow
def test_an_obstacle_that_comes_later_changes_nothing():
    """A sphere that presses on the body during the run is not part of the load in the scan."""
    sphere = {"shape": "sphere", "radius": 0.01, "position": [0.03, 0.005, 0.021], "by": [0, 0, -0.004]}
    touched, free = (lj.unloaded(scene_from(content(**more))) for more in ({"obstacle": [sphere]}, {}))
    assert np.allclose(touched.scene.mesh.points, free.scene.mesh.points, atol=1e-14)


def test_the_command_refuses_a_reduced_model_of_a_loaded_shape(tmp_path, capsys):
    """The message said that reduced models are only for the command that was used."""
    text = """mesh = {shape = "box", size = [0.02, 0.02, 0.02], cells = [1, 1, 1], is = "loaded"}
law = {name = "neo_hookean", mu = 770.0, bulk = 2200.0}
fixed = [{where = {z_max = 0.0}}]
solve = {reduced = "model.h5"}
"""
    (tmp_path / "scene.toml").write_text(text)
    assert main(["simulate", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert '[mesh] is = "loaded" cannot be used with reduced models' in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("option", "blocked", "words"),
    [
        ("--vtu", "vtu", "contains a file vtu"),
        ("--png", "result.png/", "contains a folder result.png"),
        ("--reactions", "reactions.csv/", "contains a folder reactions.csv"),
        ("--every=0", "", "--every 0 must be above 0"),
        ("--vtu", "result.h5.parts/", "contains an unfinished run"),
    ],
)
def test_outputs_are_checked_before_the_unloaded_shape_is_sought(option, blocked, words, tmp_path, monkeypatch, capsys):
    """The checks came after the search, and those of the side files after the run, with a traceback."""

    def sought(_):
        raise AssertionError("the search begins")

    monkeypatch.setattr("liverjax.simulation.run.unloaded", sought)
    (tmp_path / "scene.toml").write_text(
        """mesh = {shape = "box", size = [0.02, 0.02, 0.02], cells = [1, 1, 1], is = "loaded"}
law = {name = "neo_hookean", mu = 770.0, bulk = 2200.0}
fixed = [{where = {z_max = 0.0}}]
"""
    )
    if blocked.endswith("/"):
        (tmp_path / blocked).mkdir()
    elif blocked:
        (tmp_path / blocked).write_text("")
    assert main(["simulate", str(tmp_path / "scene.toml"), option, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1


def test_what_cannot_be_is_said():
    with pytest.raises(InputError, match="is = 'slack' is not known"):
        scene_from(content(mesh=content()["mesh"] | {"is": "slack"}))
    sponge = {"bulk": 400.0, "limit_bulk": 2200.0, "fluid_fraction": 0.5, "permeability": 1e-6}
    with pytest.raises(InputError, match="cannot be used with a fluid"):
        scene_from(content(porosity=sponge, solve={"dt": 0.1}))
    with pytest.raises(InputError, match="cannot be used in harmonic motion"):
        lj.harmonic(scene_from(content()), [60.0])
    with pytest.raises(InputError, match="cannot be used with reduced models"):
        lj.reduce_scene(scene_from(content()), {"law.mu": [800.0]})
