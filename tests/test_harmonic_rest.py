"""The state of rest about which a body oscillates: which loads act there, and which are amplitudes only."""

from functools import partial
from types import SimpleNamespace

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_porosity import column

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.jobs import output, waves
from liverjax.mesh.tetrahedra import with_points
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.porosity import Inlet
from liverjax.physics.prescribed import free_degrees
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene_file import scene_from
from liverjax.scenes.springpots import check_spring_at_rest, springpot_factors
from liverjax.simulation.equations import forces_at
from liverjax.simulation.run import prepared
from liverjax.simulation.unloaded import cautions_of_loaded, resting
from liverjax.waves.harmonic import _small
from liverjax.waves.rest import under_its_weight

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.slow
def test_inlets_are_amplitudes_and_no_loads_at_rest():
    """Twice the inlet gives twice the motion. The pressure of the inlet once swelled the body at rest, and the error of
    the motion was 42 %.
    """
    scene = column(6, 1, 1.0)
    base = np.flatnonzero(np.asarray(scene.mesh.points)[:, 2] < 1e-9)
    heavy = lj.Body(density=1060.0, gravity=jnp.array([0.0, 0.0, -1.0]))
    shapes, motions = [], []
    for pressure in (1.0, 400.0):
        sponge = replace(scene.porosity, inlet=(Inlet(nodes=base, pressure=pressure),))
        own = replace(scene, traction=(), porosity=sponge, body=heavy)
        shapes.append(under_its_weight(own))
        motions.append(lj.harmonic(own, [5.0], about=shapes[-1]).check().displacement / pressure)
    assert np.abs(shapes[0] - scene.mesh.points).max() > 1e-4  # the weight does act
    assert np.array_equal(*shapes)
    assert np.abs(motions[0] - motions[1]).max() < 1e-9 * np.abs(motions[0]).max()


LIGAMENT = """
[mesh]
shape = "box"
size = [0.02, 0.02, 0.06]
cells = [1, 1, 3]
[law]
name = "neo_hookean"
mu = 770.0
bulk = 2200.0
[viscosity]
ratios = [0.3]
relaxation_times = [0.3]
[body]
density = 1060.0
[[fixed]]
set = "z_min"
[[ligament]]
set = "z_max"
to = [0.01, 0.01, 0.1]
stiffness = 5.0
pre_tension = 0.15
[solve]
kind = "static"
dt = 100.0
steps = 4
"""


@pytest.mark.slow
def test_a_body_rests_under_the_tension_of_its_ligaments(tmp_path):
    """Without this tension the body oscillated about a shape that is not in equilibrium. The error was 18 %, without a
    warning.
    """
    (tmp_path / "scene.toml").write_text(LIGAMENT)
    scene = lj.load_scene(tmp_path / "scene.toml")
    x = under_its_weight(scene)
    # A transient run that ends long after the relaxation.
    rested = lj.simulate(scene).check().positions[-1]
    assert np.abs(x - rested).max() < 1e-6 * 0.06 and np.abs(rested - scene.mesh.points).max() > 0.005
    slack = replace(scene, physics=(replace(scene.physics[0], pre_tension=0.0),))
    assert under_its_weight(slack) is None and under_its_weight(replace(scene, physics=())) is None


@pytest.mark.slow
def test_a_run_whose_capsule_pulls_at_held_nodes_has_rested():
    """The body is elastic. The membrane's forces were once taken for stress that has not relaxed."""
    table = {
        "mesh": {"shape": "box", "size": [0.08, 0.04, 0.04], "cells": [2, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "body": {"density": 1000.0, "gravity": [0, 0, -2.0]},
        "fixed": [{"where": {"x_max": 0.0}}],
        "membrane": [{"thickness": 2e-4, "law": {"name": "neo_hookean", "mu": 1e5}}],
        "solve": {"tolerance": 1e-10},
    }
    scene = scene_from(table)
    found = lj.simulate(scene).check()
    at = (scene, found.positions[-1], np.asarray(found.reactions[-1]))
    assert waves._of_rest(*at, "--about run") == []
    assert waves._of_rest(at[0], at[1], 0.9 * at[2], "--about run")


def test_a_region_that_relaxes_slowly_counts_in_a_loaded_shape():
    table = {
        "mesh": {"shape": "box", "size": [0.08, 0.04, 0.04], "cells": [2, 1, 1], "is": "loaded"},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "viscosity": {"ratios": [0.1], "relaxation_times": [0.05]},
        "body": {"density": 1000.0, "gravity": [0, 0, -0.6]},
        "fixed": [{"where": {"x_min": 0.08}}],
        "solve": {"dt": 0.05, "steps": 10},
    }
    slow = {"where": {"x_min": 0.04}, "viscosity": {"ratios": [0.7], "relaxation_times": [20.0]}}
    for more, told in (({}, False), ({"region": [slow]}, True)):
        scene = scene_from(table | more)
        said = cautions_of_loaded(scene, jnp.asarray(0.05 * np.arange(1, 11)))
        assert bool(said) == told and (not told or "relaxation time is 20 s" in said[0])


@pytest.mark.ci
def test_a_run_whose_tractions_act_at_held_nodes_has_rested(tmp_path):
    """The body is elastic. Where a traction acts at a held node, the reaction was taken for unrelaxed stress."""
    (tmp_path / "push.toml").write_text("""mesh = {shape = "box", size = [0.02, 0.02, 0.02], cells = [2, 2, 2]}
law = {name = "neo_hookean", mu = 3000.0, bulk = 9000.0}
body = {density = 1000.0}
fixed = [{where = {z_max = 0.0}}]
traction = [{where = {x_min = 0.02}, value = [100.0, 0.0, 0.0]}]
""")
    assert main(["simulate", str(tmp_path / "push.toml"), "--out", str(tmp_path)]) == 0
    scene = lj.load_scene(tmp_path / "push.toml")
    x, reactions = waves._last_state(tmp_path / "result.h5", scene)
    assert waves._of_rest(scene, x, reactions, "--about run") == []
    far = Obstacle(triangles=scene.traction[0].triangles, position=jnp.array([-1.0, 0.0, 0.0]), axis=(1.0, 0.0, 0.0))
    for physics, told in (((), False), ((far,), True)):
        (said,) = waves._of_rest(replace(scene, physics=physics), x, 0.9 * reactions, "--about run")
        assert ("give each obstacle of this scene its last position in the run" in said) == told
    unknown = np.where(reactions == 0, 0.0, np.nan)
    assert "was not checked, because a traction of that run" in waves._of_rest(scene, x, unknown, "--about run")[0]


def test_a_run_with_another_reference_shape_is_refused(tmp_path):
    """The mesh of the run was loaded. Only the number of nodes was compared, so its stress was lost without a word."""
    table = {
        "mesh": {"shape": "box", "size": [0.02, 0.02, 0.04], "cells": [1, 1, 2]},
        "law": {"name": "neo_hookean", "mu": 500.0, "bulk": 5000.0},
        "solve": {"kind": "harmonic", "frequencies": [3.0]},
    }
    given = scene_from(table)
    x = np.asarray(given.mesh.points)
    run = replace(given, mesh=with_points(given.mesh, x * [1.0, 1.0, 0.97]))
    steps = SimpleNamespace(times=[1.0], positions=x[None], reactions=np.zeros((1, *x.shape)), pressure=None)
    with h5py.File(tmp_path / "result.h5", "w") as file:
        file["positions"], file["reactions"], file["reference"] = steps.positions, steps.reactions, run.mesh.points
        file.attrs["status"] = [0]
    said = r"another reference shape than the scene \(nodes differ by up to 0.0012 m.* select nodes and elements with"
    with pytest.raises(lj.InputError, match=said):
        waves._last_state(tmp_path / "result.h5", given)
    output.write_vtu(tmp_path / "vtu", run, steps)
    unloaded = scene_from(table | {"mesh": {"file": "vtu/step_00001.vtu"}}, tmp_path)
    assert np.array_equal(waves._last_state(tmp_path / "result.h5", unloaded)[0], x)
    assert not unloaded.mesh.node_sets and not unloaded.mesh.element_sets


@pytest.mark.parametrize("limits", [None, np.array([4.0, 4.0])])
def test_a_springpot_with_exponent_0_is_a_spring_at_rest(limits):
    """Only the spring counted at rest, so the sag was too large, and spring = 0 was refused. The stiffness at rest is
    that at frequency 0."""
    mesh, law = lj.shapes.box((0.02, 0.02, 0.02), (1, 1, 1)), lj.laws.NeoHookean(mu=2000.0, bulk=20000.0)
    for spring in (0.0, 0.5):
        own = lj.SpringpotSeries(times=[1.0, 1.0], exponents=jnp.array([0.0, 0.5]), limits=limits, spring=spring)
        scene = lj.Scene(mesh=mesh, law=law, springpots=own)
        check_spring_at_rest(own, "or do nothing")
        factor = spring + (1.0 if limits is None else 0.8)
        np.testing.assert_allclose(resting(scene).law.mu, factor * 2000.0, rtol=1e-12)
        np.testing.assert_allclose(springpot_factors(own, jnp.array([1e-14])), factor, atol=1e-6)


def test_a_springpot_without_spring_is_refused_inside_jit_too():
    """The stiffness at rest was computed with jnp. Inside jit it was a tracer, so it was not checked."""

    def check(mu, exponents):
        own = lj.SpringpotSeries(times=[1.0], exponents=exponents, spring=0.0)
        check_spring_at_rest(own, "or do nothing")
        return mu

    with pytest.raises(lj.InputError, match=r"springpots.spring = 0 leaves no shear stiffness at rest"):
        jax.jit(lambda mu: check(mu, np.array([0.5])))(2000.0)
    jax.jit(lambda mu: check(mu, np.array([0.0])))(2000.0)  # a spring
    jax.jit(check)(2000.0, jnp.array([0.5]))  # an unknown exponent may be 0


def test_a_slack_ligament_needs_no_state_of_rest_inside_jit_either():
    """Inside jit and grad, every ligament was regarded as tight, so a body without a spring had no derivatives."""
    mesh = lj.shapes.box((0.02, 0.02, 0.02), (1, 1, 1))
    springpots = lj.SpringpotSeries(times=[1.0], exponents=np.array([0.5]), spring=0.0)
    nodes, to = np.asarray(mesh.node_sets["z_max"])[None], np.array([0.01, 0.01, 0.06])
    given = {"nodes": nodes, "weights": np.ones(nodes.shape), "to": to, "stiffness": 5.0}

    def at_rest(mu, length):
        physics, law = (Ligament(**given, rest_length=length),), lj.laws.NeoHookean(mu=mu, bulk=20000.0)
        assert under_its_weight(lj.Scene(mesh=mesh, law=law, springpots=springpots, physics=physics)) is None

    jax.eval_shape(partial(at_rest, length=0.05), 2000.0)
    jax.jvp(lambda mu: (at_rest(mu, 0.05), mu)[1], (2000.0,), (1.0,))
    for tight in (partial(at_rest, length=0.03), lambda mu: at_rest(mu, 1e-5 * mu)):
        with pytest.raises(lj.InputError, match=r"springpots.spring = 0 leaves no shear stiffness at rest"):
            jax.eval_shape(tight, 2000.0)


def _quadratic_body(part: str) -> lj.Scene:
    """A viscous body with volumetric = "auto". For part = "all", this means "element"."""
    return lj.Scene(
        mesh=lj.quadratic(lj.shapes.box((0.02, 0.02, 0.02), (1, 1, 1))),
        law=lj.laws.NeoHookean(mu=770.0, bulk=77000.0),
        viscosity=lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([0.1]), part=part),
        solve=lj.Solve(kind="harmonic", frequencies=jnp.array([5.0]), volumetric="auto"),
    )


@pytest.mark.parametrize(("part", "form"), [("all", "element"), ("isochoric", "mixed")])
def test_rest_has_the_form_of_volumes_of_the_motion(part, form):
    """The form of "auto" was chosen again for rest, without viscosity. With gravity, the motion was wrong by 103 %."""
    viscous = _quadratic_body(part)
    springpots = lj.SpringpotSeries(times=jnp.array([0.1]), exponents=jnp.array([0.3]), spring=0.5, part=part)
    soft = replace(viscous, viscosity=None, springpots=springpots)
    for scene in (viscous, soft, replace(soft, solve=lj.Solve(volumetric="auto"))):
        assert _small(scene, "consistent").solve.volumetric == resting(scene).solve.volumetric == form


def test_forces_of_a_relaxed_body_have_the_form_of_volumes_of_the_run():
    """The forces of the run were compared with those of another form, and said not to be relaxed."""
    scene = _quadratic_body("all")
    x = scene.mesh.points * jnp.array([[1.0, 1.0, 1.1]]) + 3.0 * scene.mesh.points[:, :1] ** 2
    relaxed = lj.laws.NeoHookean(mu=0.7 * 770.0, bulk=0.7 * 77000.0)
    run = replace(scene, law=relaxed, viscosity=None, solve=lj.Solve(volumetric="element"))
    reactions = np.array(forces_at(prepared(run), x))
    assert waves._of_rest(scene, x, reactions, "--about run") == []


def test_a_body_on_an_obstacle_has_rested():
    """The contact forces at free components, and at nodes that are also fixed, were taken for unrelaxed stress."""
    mesh, law = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1)), lj.laws.NeoHookean(mu=5e3, bulk=2e4)
    plane = Obstacle(
        triangles=jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_min"])),
        position=jnp.array([0.0, 0.0, 2e-4]),
    )
    scene = lj.Scene(mesh=mesh, law=law, fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),), physics=(plane,))
    x = mesh.points + 1e-4 * mesh.points[:, :1]
    # Without `fixed`, the forces at nodes that touch the obstacle contain its push.
    forces = np.asarray(forces_at(prepared(replace(scene, fixed=())), x))
    reactions = np.where(np.asarray(free_degrees(mesh, scene.fixed, ())) > 0, 0.0, forces)
    assert np.abs(forces[reactions == 0]).max() > np.abs(reactions).max() / 2
    assert waves._of_rest(scene, x, reactions, "--about run") == []
    assert waves._of_rest(scene, x, 0.9 * reactions, "--about run")
    sliding = replace(scene, fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"], axes="x"),))
    assert waves._of_rest(sliding, x, reactions * np.array([1.0, 0.0, 0.0]), "--about run") == []


def test_a_loaded_mesh_is_unloaded_before_harmonic_motion():
    """lj.harmonic advised to call lj.unloaded, which refused every scene with harmonic motion. The traction is an
    amplitude, so it does not act in the given shape."""
    table = {
        "mesh": {"shape": "box", "size": [0.04, 0.01, 0.01], "cells": [2, 1, 1], "is": "loaded"},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "springpots": {"times": [0.01], "exponents": [0.3], "spring": 0.8},
        "body": {"density": 1000.0, "gravity": [0, 0, -1.0]},
        "fixed": [{"where": {"x_max": 0.0}}],
        "traction": [{"where": {"x_min": 0.04}, "value": [0, 0, 1.0]}],
        "solve": {"kind": "harmonic", "frequencies": [5.0], "tolerance": 1e-10},
    }
    scene = scene_from(table)
    with pytest.raises(lj.InputError, match=r"use the scene of lj.unloaded\(scene\).*vtu/step_00001.vtu"):
        lj.harmonic(scene)
    found = lj.unloaded(scene)
    given, points = np.asarray(scene.mesh.points), np.asarray(found.scene.mesh.points)
    assert np.abs(points - given).max() > 1e-3  # [m]
    assert found.scene.solve.kind == "harmonic" and len(found.scene.traction) == 1
    still = resting(by_element(replace(found.scene, traction=())))
    still = prepared(replace(still, solve=replace(still.solve, dt=None, frequencies=None)))
    force, whole = (np.asarray(jax.jit(forces_at)(still, x))[given[:, 0] > 0] for x in (given, points))
    assert np.abs(force).max() < 1e-8 * np.abs(whole).max()
    with pytest.raises(lj.InputError, match="kind = 'harmonic' has no time steps"):
        lj.simulate(found.scene)


def test_a_loaded_body_without_stiffness_at_rest_needs_a_spring():
    """lj.unloaded advised to use a stiffer law, which does not help."""
    mesh = lj.shapes.box((0.02, 0.02, 0.02), (1, 1, 1))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=800.0, bulk=4000.0),
        springpots=lj.SpringpotSeries(times=[0.01], exponents=[0.3], spring=0.0),
        body=lj.Body(density=1000.0, gravity=(0.0, 0.0, -1.0)),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        solve=lj.Solve(kind="harmonic", frequencies=[5.0]),
    )
    with pytest.raises(lj.InputError, match=r"no shear stiffness at rest.* spring above 0, or remove the gravity$"):
        lj.unloaded(scene)


def test_a_run_of_single_solves_that_is_not_in_equilibrium_is_refused(tmp_path):
    """With newton = "one_step" each residual was accepted, so the body oscillated about a shape out of balance."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
    scene, x = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1e3, bulk=1e4)), np.asarray(mesh.points)
    for residual, refused in ((1e-4, False), (0.02, True), (np.nan, True)):
        with h5py.File(tmp_path / "result.h5", "w") as file:
            file["positions"], file["reactions"], file["reference"] = x[None], 0 * x[None], x
            file.attrs["status"], file.attrs["residual"] = [status.ONE_STEP], [residual]
        if refused:
            with pytest.raises(lj.InputError, match="so the body is not in equilibrium: repeat the run"):
                waves._last_state(tmp_path / "result.h5", scene)
        else:
            assert np.array_equal(waves._last_state(tmp_path / "result.h5", scene)[0], x)


def test_a_state_of_rest_needs_several_iterations():
    """One iteration gave a run of single solves, and then the advice to fix the body."""
    scene = lj.Scene(
        mesh=lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1)),
        law=lj.laws.NeoHookean(mu=1e3, bulk=1e4),
        body=lj.Body(density=1e3, gravity=(0.0, 0.0, -1.0)),
        solve=lj.Solve(kind="harmonic", frequencies=(5.0,), newton_iterations=1),
    )
    with pytest.raises(lj.InputError, match="the state of rest needs several iterations"):
        under_its_weight(scene)
    assert under_its_weight(replace(scene, body=lj.Body(density=1e3))) is None
