"""Supports: springs compared with the loads that they balance, sliding planes compared with the same body rotated."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.jobs.reactions import held_forces, reaction_table
from liverjax.mesh.tetrahedra import with_points
from liverjax.physics.base import Free, Step
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.sliding_support import SlidingSupport, on_plane
from liverjax.scenes.scene_checks import check_before_run
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

LAW = lj.laws.NeoHookean(mu=800.0, bulk=4000.0)
SIDE = 0.1


def box() -> lj.TetMesh:
    """A 10 cm cube."""
    return lj.shapes.box((SIDE, SIDE, SIDE), (2, 2, 2))


def part(mesh: lj.TetMesh, **where) -> np.ndarray:
    """Return the nodes of a region of the boundary."""
    return lj.boundary.select(mesh, where)


def springs(mesh: lj.TetMesh, nodes: np.ndarray, **stiffness) -> ElasticSupport:
    """Springs on the surface of these nodes."""
    return ElasticSupport(triangles=jnp.asarray(lj.boundary.boundary_triangles(mesh, nodes)), **stiffness)


def pulled(mesh: lj.TetMesh, value, **more) -> lj.Scene:
    """A cube under a traction on its top."""
    triangles = jnp.asarray(lj.boundary.boundary_triangles(mesh, part(mesh, z_min=SIDE)))
    traction = (lj.Traction(triangles=triangles, value=jnp.array(value)),)
    return lj.Scene(mesh=mesh, law=LAW, traction=traction, **more)


def test_a_physics_that_needs_the_time_step_says_so():
    """Without dt in the scene, a user-defined physics object ended in a TypeError."""

    @lj.struct
    class Damper(ElasticSupport):
        """A support that claims to need the time step."""

        in_time: ClassVar[bool] = True

    damper = Damper(triangles=lj.boundary.boundary_triangles(box()), normal=1.0, tangential=1.0)
    with pytest.raises(InputError, match=r"\[solve\] has no dt, which \w+.0 needs"):
        lj.simulate(pulled(box(), [0.0, 0.0, 30.0], physics=(damper,)))


@pytest.mark.slow
def test_springs_stiffer_than_the_digits_allow_are_told_as_roundoff():
    """1e14 Pa/m times the rounding of positions is above the tolerance. No shorter step helps, and none is tried."""
    mesh = box()
    scene = pulled(
        mesh, [0.0, 0.0, 30.0], physics=(springs(mesh, part(mesh, z_max=0.0), normal=1e14, tangential=1e14),)
    )
    glued = pulled(mesh, [0.0, 0.0, 30.0], fixed=(lj.Fixed(nodes=part(mesh, z_max=0.0)),))
    result, held = lj.simulate(scene), lj.simulate(glued).check().positions[-1]
    assert int(result.status[-1]) == status.STALLED and int(result.statistics.cuts[-1]) == 0
    # The remaining residual times the compliance of a tissue of 1 kPa.
    assert np.abs(result.positions[-1] - held).max() < 1e-5 * np.abs(held - mesh.points).max()


@pytest.mark.slow
def test_springs_along_the_normal_carry_the_whole_pull():
    """Traction p on top, springs k below, sliding sides: the stress is uniform, so the bottom moves by p/k in every
    mesh.
    """
    mesh = box()
    sides = (on_plane(mesh, part(mesh, x_max=0.0)), on_plane(mesh, part(mesh, y_max=0.0)))
    scene = pulled(mesh, [0.0, 0.0, 30.0], physics=(springs(mesh, part(mesh, z_max=0.0), normal=5e4), *sides))
    lj.check_scene(scene)

    def lift(k):
        found = lj.simulate(lj.with_parameters(scene, {"support.0.normal": k}))
        return found.positions[-1, part(mesh, z_max=0.0), 2]

    # The residual is 1e-8 of the acting forces, which are a few times the load.
    lifted, slope = jax.jvp(lift, (5e4,), (1.0,))
    assert np.allclose(lifted, 30.0 / 5e4, rtol=1e-6)
    assert np.allclose(slope, -30.0 / 5e4**2, rtol=1e-6)


def test_springs_of_quadratic_elements_are_integrated():
    """For u = c x^2 along the normal, the energy is k c^2/2 times the integral of x^4. Springs at the nodes gave 1.003
    times this.
    """
    mesh = lj.quadratic(box())
    support = springs(mesh, part(mesh, z_max=0.0), normal=5e4)
    step = Step(mesh, mesh.points, 1, 1, None, False, None, Free(jnp.ones_like(mesh.points)))
    x = mesh.points.at[:, 2].add(3.0 * mesh.points[:, 0] ** 2)
    energy = support.freeze(None, step).energy(mesh, x)
    assert np.isclose(energy, 0.5 * 5e4 * 9.0 * SIDE * SIDE**5 / 5, rtol=1e-12)


@pytest.mark.slow
def test_springs_along_the_surface_carry_shear():
    """A stiff cube is pushed sideways. The springs of its bottom yield by p/k; those of its unloaded top do not act."""
    mesh = box()
    sole = springs(mesh, part(mesh, z_max=0.0), tangential=2e3, normal=1e9)
    stiff = replace(pulled(mesh, [3.0, 0.0, 0.0]), law=lj.laws.NeoHookean(mu=1e8, bulk=1e9), physics=(sole,))
    lj.check_scene(stiff)
    moved = np.asarray(lj.simulate(stiff).check().positions[-1] - mesh.points)
    # The cube is rigid. Its shear adds p/mu, and its rotation some times p/(k_n side): together 1e-4.
    assert np.allclose(moved[part(mesh, z_max=0.0), 0], 3.0 / 2e3, rtol=1e-3)


@pytest.mark.slow
def test_springs_on_nodes():
    mesh = box()
    nodes = jnp.asarray(part(mesh, z_max=0.0))
    scene = pulled(mesh, [0.0, 0.0, 30.0], physics=(ElasticSupport(nodes=nodes, stiffness=2.0),))
    lj.check_scene(scene)
    result = lj.simulate(scene).check()
    carried = 2.0 * np.asarray(result.positions[-1] - mesh.points)[part(mesh, z_max=0.0)].sum(axis=0)
    assert np.allclose(carried, [0.0, 0.0, 30.0 * SIDE**2], atol=1e-6 * 30.0 * SIDE**2)


TURN = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3  # a rotation about none of the axes


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"linear_solver": "cg"},
        {"linear_solver": "direct"},
        {"robust": "projected"},
        {"kind": "dynamic", "dt": 0.02, "steps": 3, "integrator": "newmark"},
    ],
    ids=["cg", "direct", "robust", "newmark"],
)
def test_a_turned_body_slides_as_the_straight_one(changes):
    """The straight body slides along axes, which are left out of the unknowns. The rotated body slides along
    normals.
    """
    mesh = box()
    turned = lj.tet_mesh(np.asarray(mesh.points) @ TURN.T, mesh.tetrahedra)
    held = jnp.asarray(part(mesh, z_max=0.0, x_max=0.0, y_max=0.0))
    low, side = part(mesh, z_max=0.0), np.setdiff1d(part(mesh, x_max=0.0), part(mesh, z_max=0.0))
    pull, found = np.array([10.0, 5.0, 60.0]), []
    for body, R in ((mesh, np.eye(3)), (turned, TURN)):
        triangles = jnp.asarray(lj.boundary.boundary_triangles(mesh, part(mesh, z_min=SIDE)))
        scene = lj.Scene(
            mesh=body,
            law=LAW,
            body=lj.Body(density=1000.0, gravity=jnp.asarray(R @ [0.5, 0.0, -1.0])),
            traction=(lj.Traction(triangles=triangles, value=jnp.asarray(R @ pull)),),
            fixed=(lj.Fixed(nodes=held),),
            physics=(
                on_plane(body, low),
                on_plane(body, side),
                # Springs prevent a rotation about the normal of the low plane.
                ElasticSupport(nodes=jnp.asarray(low), stiffness=1.0),
            ),
            solve=lj.Solve(**changes),
        )
        lj.check_scene(scene)
        result = lj.simulate(scene).check()
        found.append(np.asarray(result.positions - body.points[None]) @ R)
        assert np.abs(found[-1][:, low, 2]).max() < 1e-15 and np.abs(found[-1][:, side, 0]).max() < 1e-15
    size = np.abs(found[0]).max()
    assert size > 1e-3 and np.abs(found[0] - found[1]).max() < 1e-6 * size


@pytest.mark.slow
def test_reactions_of_a_slide_are_along_its_normal():
    mesh = box()
    turned = lj.tet_mesh(np.asarray(mesh.points) @ TURN.T, mesh.tetrahedra)
    low = part(mesh, z_max=0.0)
    weight = lj.Body(density=1000.0, gravity=jnp.asarray(TURN @ [0.0, 0.0, -1.0]))
    hold = ElasticSupport(nodes=jnp.asarray(low), stiffness=1.0)
    scene = lj.Scene(mesh=turned, law=LAW, body=weight, physics=(on_plane(turned, low), hold))
    reactions = np.asarray(lj.simulate(scene).check().reactions[-1]) @ TURN
    assert np.allclose(reactions.sum(axis=0), [0.0, 0.0, 1000.0 * SIDE**3], atol=1e-7)
    assert np.abs(reactions[:, :2]).max() < 1e-12


def _forces(scene: lj.Scene) -> dict[str, np.ndarray]:
    """Return the forces (3,) [N] of all parts at the end of a run, from the table of reactions."""
    names, rows = reaction_table(scene, lj.simulate(scene).check())
    last = dict(zip(names, rows[-1], strict=True))
    parts = dict.fromkeys(name.rpartition(".")[0] for name in names if name.endswith("_N"))
    return {part: np.array([last[f"{part}.{axis}_N"] for axis in "xyz"]) for part in parts}


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_three_planes_of_symmetry_carry_what_pulls_at_them(order):
    """Uniaxial tension by 1 N: the plane perpendicular to the load carries all of it, the planes parallel to it
    nothing.
    """
    mesh = box() if order == 1 else lj.quadratic(box())
    planes = tuple(on_plane(mesh, part(mesh, **{f"{axis}_max": 0.0})) for axis in "xyz")
    scene = pulled(mesh, [0.0, 0.0, 100.0], physics=planes)
    found = _forces(scene)
    assert np.allclose([found[f"support.{k}"] for k in range(3)], [[0, 0, 0], [0, 0, 0], [0, 0, -1.0]], atol=1e-6)
    # The same with one plane fixed along its axis and sideways: what two supports fix counts once.
    shear = replace(
        pulled(mesh, [30.0, 0.0, 100.0], physics=planes[:2]),
        fixed=(
            lj.Fixed(nodes=jnp.asarray(part(mesh, z_max=0.0)), axes="xz"),
            lj.Fixed(nodes=planes[0].nodes, axes="xy"),
        ),
    )
    found = _forces(shear)
    assert np.allclose(sum(found.values()), [-0.3, 0.0, -1.0], atol=1e-6)
    assert (
        abs(found["fixed.0"][2] + 1.0) < 1e-6 and not found["support.0"].any() and not found["support.1"][[0, 2]].any()
    )


@pytest.mark.slow
def test_an_oblique_plane_has_a_force_along_its_normal_alone():
    """A cube rotated by 30 degrees about z, between planes. The oblique planes share edges with the base."""
    mesh, c, s = box(), np.cos(np.pi / 6), np.sin(np.pi / 6)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = with_points(mesh, mesh.points @ turn.T)
    planes = [on_plane(turned, part(mesh, **{f"{axis}_max": 0.0})) for axis in "xz"]
    corner = lj.Fixed(nodes=jnp.asarray(part(mesh, y_max=0.0, x_max=0.0, z_max=0.0)))
    pull = pulled(mesh, (turn @ [20.0, 0.0, 100.0]).tolist()).traction
    found = _forces(lj.Scene(mesh=turned, law=LAW, traction=pull, physics=tuple(planes), fixed=(corner,)))
    assert np.allclose(np.cross(found["support.0"], turn[:, 0]), 0, atol=1e-12) and not found["support.1"][:2].any()
    assert np.allclose(sum(found.values()), -turn @ [0.2, 0.0, 1.0], atol=1e-6)


@pytest.mark.ci
def test_a_derivative_that_moves_no_node_is_finite():
    """A body between plates that relaxes everywhere alike keeps its shape, so the forces are linear in the ratio of its
    relaxation. The right-hand side of the derivative's linear solve is roundoff, of which a part was along the normal
    of the oblique plane. No motion balances this part, so after some steps the derivative was NaN.
    """
    mesh, c, s = box(), np.cos(np.pi / 6), np.sin(np.pi / 6)
    turned = with_points(mesh, mesh.points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T)
    ends = [jnp.asarray(part(mesh, **where)) for where in ({"z_max": 0.0}, {"z_min": SIDE})]
    side = np.setdiff1d(part(mesh, x_max=0.0), np.concatenate(ends))
    strain = lj.Displaced(
        nodes=ends[1], by=jnp.array([0.0, 0.0, 0.2 * SIDE]), times=jnp.array([0.0, 0.5]), history=jnp.array([0.0, 1.0])
    )
    scene = lj.Scene(
        mesh=turned,
        law=LAW,
        fixed=(lj.Fixed(nodes=ends[0]),),
        displaced=(strain,),
        physics=(SlidingSupport(nodes=jnp.asarray(side), normal=jnp.array([c, s, 0.0])),),
        solve=lj.Solve(kind="static", dt=0.5, steps=24),
    )

    def force(ratio):
        viscosity = lj.Prony(ratios=ratio[None], relaxation_times=jnp.array([1.0]))
        result = lj.simulate(replace(scene, viscosity=viscosity))
        return jnp.sum(result.reactions[:, ends[1], 2], axis=1)

    low, slope = jax.jvp(force, (jnp.array(0.3),), (jnp.array(1.0),))
    elastic = low - 0.3 * slope  # the force without relaxation, at every step
    assert low[-1] < 0.75 * elastic[0] and np.allclose(elastic, elastic[0], rtol=1e-6, atol=0)


def scene_text(*support) -> dict:
    """Return the content of a scene file with these supports."""
    return {
        "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [2, 2, 2]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "body": {"density": 1000.0, "gravity": [0, 0, -1.0]},
        "support": list(support),
    }


def test_supports_of_a_scene_file():
    low = {"z_max": 0.0}
    scene = scene_from(scene_text({"where": low, "normal": 1e4, "tangential": 100.0}, {"where": low, "sliding": True}))
    assert [type(p).__name__ for p in scene.physics] == ["ElasticSupport", "SlidingSupport"]
    assert scene.physics[1].axis == "z"
    changed = lj.with_parameters(scene, {"support.0.normal": 2e4})
    assert changed.physics[0].normal == 2e4


@pytest.mark.parametrize(
    ("support", "words"),
    [
        (
            {"where": {"z_max": 0.0}},
            "support.0 contains only where or set: also give normal, tangential, stiffness, history or sliding",
        ),
        ({"where": {"z_max": 0.0}, "normal": -1.0}, "support.0.normal = -1.0 must be at least 0 Pa/m"),
        ({"where": {"z_max": 0.0}, "normal": "soft"}, "support.0.normal = 'soft' is not a number"),
        ({"where": {"z_max": 0.0}, "normal": 1.0, "stiffness": 1.0}, "support.0 needs either normal and tangential"),
        ({"where": {"z_max": 0.0}, "sliding": False}, "support.0 sliding = False is not true"),
        ({"where": {"z_max": 0.05}, "sliding": True}, "m from one plane"),
        ({"where": {"z_max": 0.0}, "norml": 1.0}, "did you mean normal"),
        ({"where": {"z_max": 0.0}, "sliding": True}, "do not prevent every rigid motion of the body"),
    ],
)
def test_bad_supports_are_refused(support, words):
    with pytest.raises(InputError, match=words.replace("(", r"\(")):
        scene_from(scene_text(support))


@pytest.mark.slow  # the default run of tests/test_pay_for_what_is_there.py compares the equations themselves
def test_a_scene_without_supports_pays_nothing():
    mesh = box()
    plain = pulled(mesh, [0.0, 0.0, 30.0], fixed=(lj.Fixed(nodes=jnp.asarray(part(mesh, z_max=0.0))),))
    one = replace(plain, physics=(springs(mesh, part(mesh, x_max=0.0), normal=1.0),))
    sizes = [len(str(jax.make_jaxpr(lj.simulate)(scene))) for scene in (plain, one)]
    assert sizes[0] < sizes[1]
    assert not plain.physics and len(jax.tree.leaves(one)) > len(jax.tree.leaves(plain))


@pytest.mark.parametrize("run", [lj.simulate, lambda scene: lj.harmonic(scene, [1.0]), lj.check_scene])
def test_two_planes_given_by_normals_share_no_node(run):
    """Only the last plane constrained the nodes of their edge. Scenes made in Python gave no message."""
    mesh = box()
    places = ({"x_max": 0.0}, [1.0, 0.0, 0.0]), ({"z_max": 0.0}, [0.0, 0.0, 1.0])
    slides = tuple(SlidingSupport(nodes=jnp.asarray(part(mesh, **w)), normal=jnp.asarray(n)) for w, n in places)
    scene = replace(pulled(mesh, [0.0, 0.0, 10.0]), fixed=(), physics=slides)
    with pytest.raises(InputError, match="can slide in only one oblique plane"):
        run(scene)
    unknown = replace(scene, physics=(replace(slides[0], nodes=jnp.array([0, 9999])), slides[1]))
    with pytest.raises(InputError, match=r"support\.0\.nodes"):
        run(unknown)

    # Traced normals, for derivatives, pass the check.
    def passed(normal):
        check_before_run(replace(scene, physics=(replace(slides[0], normal=normal), slides[1])))
        return normal

    jax.eval_shape(passed, slides[0].normal)


def test_a_normal_in_a_tuple_can_be_unknown():
    """The checks gave a tuple of JAX tracers to NumPy, so the derivative ended with a traceback."""
    mesh = box()
    slide = SlidingSupport(nodes=jnp.asarray(part(mesh, z_max=0.0)), normal=(0.0, 0.0, 1.0))
    scene = pulled(mesh, [0.0, 0.0, 10.0], physics=(slide,))
    for values in ({"support.0.normal": slide.normal}, {"support.0.normal.0": 0.0}):
        found = jax.eval_shape(lambda at: lj.simulate(lj.with_parameters(scene, at)).positions, values)
        assert found.shape[1:] == mesh.points.shape


def test_a_reaction_at_a_node_of_several_supports_counts_once():
    """An oblique support in front of a support along an axis took the force of the node a second time."""
    mesh, normal = box(), jnp.array([1.0, 0.0, 1.0]) / jnp.sqrt(2.0)
    slides = (SlidingSupport(nodes=jnp.array([0]), normal=normal), SlidingSupport(nodes=jnp.array([0]), axis="z"))
    scene = lj.Scene(mesh=mesh, law=LAW, fixed=(lj.Fixed(nodes=jnp.array([0]), axes="x"),), physics=slides)
    reactions = np.zeros((1, len(mesh.points), 3))
    reactions[0, 0] = 3.0, 0.0, 5.0
    found = {name: force[0].tolist() for name, force in held_forces(scene, reactions).items()}
    assert found == {"fixed.0": [3.0, 0.0, 0.0], "support.0": [0.0, 0.0, 0.0], "support.1": [0.0, 0.0, 5.0]}
    assert list(found) == ["fixed.0", "support.0", "support.1"]
