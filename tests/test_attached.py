"""Ligaments and vessels: compared with springs and bars by hand, and with a vessel made of elements."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.laws import homogeneous
from liverjax.mesh import locate
from liverjax.physics.attached import ligament, vessel
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

SIDE = 0.1
LAW = lj.laws.NeoHookean(mu=800.0, bulk=4000.0)
ORDERS = pytest.mark.parametrize("order", [1, 2])


def box(order: int, cells=(2, 2, 2)) -> lj.TetMesh:
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), cells)
    return lj.quadratic(mesh) if order == 2 else mesh


# -- lines through a mesh --------------------------------------------------------------------------------------------


def test_a_line_is_cut_where_it_leaves_an_element():
    mesh = box(1, (3, 2, 2))
    begin, end = np.array([[0.013, 0.021, 0.034]]), np.array([[0.081, 0.0673, 0.15]])
    cut = locate.pieces(mesh, begin, end)
    inside = (SIDE - 0.034) / (0.15 - 0.034)
    assert np.isclose(np.sum(cut.end - cut.begin), inside) and np.allclose(cut.begin[1:], cut.end[:-1])
    for at in (0.01, 0.5, 0.99):
        points = begin + (cut.begin + at * (cut.end - cut.begin))[:, None] * (end - begin)
        L = locate.barycentric(mesh, points)[:, np.arange(len(points)), cut.element]
        assert L.min() > -1e-9
    # Along an edge and in a face, every length counts only once.
    edge = locate.pieces(mesh, np.zeros((1, 3)), np.array([[SIDE, SIDE, SIDE]]))
    assert np.isclose(np.sum(edge.end - edge.begin), 1.0)


@ORDERS
def test_functions_at_points_are_those_of_the_elements(order):
    mesh = box(order)
    points = np.array([[0.013, 0.021, 0.034], [0.077, 0.061, 0.09]])
    nodes, values = locate.weights(mesh, *locate.elements_at(mesh, points, "points"))
    field = (
        np.asarray(mesh.points) @ [1.0, 2.0, -1.0] + (0.0 if order == 1 else 1.0) * np.asarray(mesh.points)[:, 0] ** 2
    )
    exact = points @ [1.0, 2.0, -1.0] + (0.0 if order == 1 else 1.0) * points[:, 0] ** 2
    assert np.allclose((values * field[nodes]).sum(axis=0), exact, atol=1e-12)


# -- ligaments -------------------------------------------------------------------------------------------------------


def content(**more) -> dict:
    return {
        "mesh": {"shape": "box", "size": [SIDE] * 3, "cells": [2, 2, 2]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "body": {"density": 1000.0, "gravity": [0, 0, -1.0]},
        "fixed": [{"where": {"z_max": 0.0}}],
    } | more


@pytest.mark.parametrize("given", [{"pre_tension": 0.5}, {"rest_length": 0.05}])
def test_fibres_pull_as_springs_of_their_stretch(given):
    """Forces by hand: k/n (l - l0) along every fibre, and none in slack fibres."""
    table = {"where": {"z_min": SIDE}, "to": [0.03, 0.05, 0.16], "stiffness": 90.0, **given}
    scene = scene_from(content(ligament=[table]))
    mesh, own = scene.mesh, scene.physics[0].freeze(None, type("Step", (), {"mesh": scene.mesh}))
    top = lj.boundary.select(mesh, {"z_min": SIDE})
    X = np.asarray(mesh.points)
    x = X + 0.01 * np.random.default_rng(3).standard_normal(X.shape) + np.where(X[:, :1] > 0.05, 0.03, 0.0)
    L, f = np.linalg.norm(X[top] - table["to"], axis=1), x[top] - table["to"]
    length = np.linalg.norm(f, axis=1)
    rest = L - 0.5 / 90 if "pre_tension" in given else 0.05
    pull = 90.0 / len(top) * np.maximum(length - rest, 0)
    assert (pull > 0).any()
    exact = np.zeros_like(X)
    exact[top] = pull[:, None] * f / length[:, None]
    assert np.allclose(own.force(mesh, jnp.asarray(x), 1.0), exact, atol=1e-12)
    assert np.isclose(own.energy(mesh, jnp.asarray(x)), np.sum(pull**2) / (2 * 90.0 / len(top)), rtol=1e-12)
    K = own.attached(mesh, jnp.asarray(x), 1.0)
    exact = jax.vmap(
        jax.jacfwd(
            lambda y, L0: (
                90.0
                / len(top)
                * jnp.maximum(1 - L0 / jnp.linalg.norm(y - jnp.array(table["to"])), 0)
                * (y - jnp.array(table["to"]))
            )
        )
    )(jnp.asarray(x[top]), jnp.broadcast_to(jnp.asarray(rest), len(top)))
    assert np.allclose(np.moveaxis(K.blocks[0, :, 0], -1, 0), exact, atol=1e-9)


@pytest.mark.parametrize("given", [{"pre_tension": 0.0}, {"rest_length": 0.06}])
def test_a_straight_fibre_without_tension_has_its_whole_stiffness(given):
    """At the length at which it becomes taut, the fibre acts as a spring along its line. Differentiation of max(l - l0,
    0)^2 / 2 at this point would give a quarter of the stiffness.
    """
    corner = {"x_min": SIDE, "y_min": SIDE, "z_min": SIDE}
    table = {"where": corner, "to": [SIDE, SIDE, SIDE + 0.06], "stiffness": 90.0, **given}
    scene = scene_from(content(ligament=[table]))
    mesh, own = scene.mesh, scene.physics[0].freeze(None, type("Step", (), {"mesh": scene.mesh}))
    assert scene.physics[0].is_straight_without_tension(mesh, mesh.points)
    assert not scene.physics[0].is_straight_without_tension(mesh, 1.01 * mesh.points)
    K = own.attached(mesh, mesh.points, 1.0).blocks[0, :, 0, :, 0]
    assert np.allclose(K, np.diag([0.0, 0.0, 90.0]), atol=1e-9)
    assert np.allclose(own.force(mesh, mesh.points, 1.0), 0.0, atol=1e-12)


@pytest.mark.slow
@ORDERS
def test_a_stiff_cube_hangs_from_its_ligament(order):
    """A cube of weight W with sliding sides hangs from one ligament with tension T0. It sinks by (W - T0)/k, and the
    derivative with respect to T0 is 1/k.
    """
    table = content(
        law={"name": "neo_hookean", "mu": 1e7, "bulk": 4e7},
        ligament=[{"where": {"z_min": SIDE}, "to": [0.05, 0.05, 1000.0], "stiffness": 40.0, "pre_tension": 0.3}],
        fixed=[{"where": {"x_max": 0.0}, "axes": "xy"}],
    )
    table["mesh"] |= {"cells": [1, 1, 1], "order": order}
    scene = scene_from(table)

    def sinks(tension):
        changed = lj.with_parameters(scene, {"ligament.0.pre_tension": tension})
        return jnp.mean((lj.simulate(changed).positions[-1] - scene.mesh.points)[:, 2])

    value, slope = jax.jvp(sinks, (0.3,), (1.0,))
    # The strain of the cube adds 1e-6 of its side.
    assert np.isclose(value, -(1.0 - 0.3) / 40.0, rtol=1e-4) and np.isclose(slope, 1 / 40.0, rtol=1e-4)


def test_a_tie_between_two_points_changes_no_balance():
    mesh = box(2)
    tie = ligament.between(
        mesh, np.array([[0.013, 0.021, 0.034], [0.077, 0.061, 0.09]]), stiffness=50.0, pre_tension=0.4
    )
    tie.check(mesh, "ligament.0")
    own = tie.freeze(None, type("Step", (), {"mesh": mesh}))
    x = mesh.points * jnp.array([[1.2, 0.9, 1.1]])
    force = np.asarray(own.force(mesh, x, 1.0))
    moment = np.cross(np.asarray(x), force).sum(axis=0)
    assert np.abs(force).max() > 0.1 and np.abs(force.sum(axis=0)).max() < 1e-14 and np.abs(moment).max() < 1e-14
    d = np.array([0.064, 0.04, 0.056])
    stretch = np.linalg.norm(d * [1.2, 0.9, 1.1]) - np.linalg.norm(d)
    assert np.isclose(own.energy(mesh, x), 25.0 * (stretch + 0.4 / 50) ** 2, rtol=1e-12)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"stiffness": 1.0, "pre_tension": 0.0}, "ligament.0 needs either to = "),
        ({"to": [0, 0, 1], "where": {"z_min": SIDE}, "pre_tension": 0.1}, "ligament.0 needs stiffness in N/m"),
        ({"to": [0, 0, 1], "where": {"z_min": SIDE}, "stiffness": 1.0}, "ligament.0 needs either pre_tension in N"),
        ({"to": [0, 0], "where": {"z_min": SIDE}, "stiffness": 1.0}, "ligament.0 to = .* is not a point"),
        ({"to": [True, 0.1, 0.1], "where": {"z_min": SIDE}, "stiffness": 1.0}, "ligament.0 to = True is not a number"),
        (
            {"to": [0, 0, 0.2], "where": {"z_min": SIDE}, "stiffness": 1.0, "pre_tension": 50.0},
            "N: give a smaller tension",
        ),
        ({"to": [0, 0, 0.1], "where": {"z_min": SIDE}, "stiffness": 1.0, "rest_length": 0.1}, "fibre of length 0"),
        ({"points": [[0, 0, 0], [0, 0, 1]], "stiffness": 1.0, "rest_length": 0.1}, "is outside the body"),
        ({"points": [[0, 0, 0]], "stiffness": 1.0, "rest_length": 0.1}, "must be two points of the body"),
    ],
)
def test_bad_ligaments_are_refused(table, words):
    with pytest.raises(InputError, match=words):
        scene_from(content(ligament=[table]))


#: One node of the top face.
CORNER = {"x_max": 0.0, "y_max": 0.0, "z_min": SIDE}


@pytest.mark.parametrize(("rest", "holds"), [(0.05, True), (0.1, True), (0.100001, False), (0.2, False)])
def test_slack_fibres_hold_nothing(rest, holds):
    """A body that slides along z hangs from fibres of 0.1 m. If their rest length is larger, they are slack, and the
    body is not supported.
    """
    table = content(
        fixed=[{"where": {"x_max": 0.0}, "axes": "xy"}],
        ligament=[{"where": CORNER, "to": [0.0, 0.0, 0.2], "stiffness": 40.0, "rest_length": rest}],
    )
    if holds:
        scene_from(table)
    else:
        with pytest.raises(InputError, match="do not prevent every rigid motion of the body"):
            scene_from(table)


# -- vessels ---------------------------------------------------------------------------------------------------------


@pytest.mark.ci
@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_vessel_in_a_stretched_body_pulls_as_a_bar(order):
    """In a uniform deformation every piece has the stretch |F t|, so energy and force are those of one straight bar."""
    mesh, law = box(order), lj.laws.create("yeoh", c1=4e4, c2=1e4, c3=10.0, bulk=1e6)
    line = np.array([[0.01, 0.02, 0.03], [0.05, 0.04, 0.06], [0.09, 0.03, 0.08]])
    tube = vessel.along(mesh, line, 2e-3, law, wall=5e-4)
    tube.check(mesh, "vessel.0")
    own = tube.freeze(None, None)
    F = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, 0.0, 1.1]])
    x = mesh.points @ F.T
    area, energy = np.pi * (4e-6 - 2.25e-6), 0.0
    for t in np.diff(line, axis=0):
        stretch = np.linalg.norm(F @ t) / np.linalg.norm(t)
        energy += area * np.linalg.norm(t) * float(law.energy(np.diag([stretch, stretch**-0.5, stretch**-0.5])))
    assert np.isclose(own.energy(mesh, x), energy, rtol=1e-12)
    # Virtual work of an extension along the bars, with the nominal stress of a sample in tension.
    along = sum(
        area
        * np.linalg.norm(t)
        * l
        * float(homogeneous.nominal_stress(law, homogeneous.deformation_gradient("uniaxial", l))[0, 0])
        for t in np.diff(line, axis=0)
        for l in [np.linalg.norm(F @ t) / np.linalg.norm(t)]
    )
    force = own.force(mesh, x, 1.0)
    assert np.isclose(np.sum(np.asarray(force * x)), along, rtol=1e-11)
    v = jnp.asarray(np.random.default_rng(0).standard_normal(x.shape))
    K = own.attached(mesh, x, 1.0)
    from liverjax.solvers import attached

    exact = jax.jvp(lambda x: own.force(mesh, x, 1.0), (x,), (v,))[1]
    assert np.allclose(jnp.stack(attached.product(K, tuple(v.T)), axis=1), exact, atol=1e-10 * np.abs(exact).max())


@pytest.mark.slow
def test_a_vessel_stiffens_as_one_of_elements(verified):
    """A block is stretched along a stiff core of 1 % of its section. Bars in a coarse mesh are compared with elements
    in a fine one.
    """
    stiff, cells = lj.laws.NeoHookean(mu=8e4, bulk=4e5), 10
    fine = lj.quadratic(lj.shapes.box((SIDE, SIDE, SIDE), (cells, cells, 4)))
    centre = np.asarray(fine.points)[np.asarray(fine.tetrahedra)].mean(axis=1)
    core = np.flatnonzero((np.abs(centre[:, :2] - 0.045) < 0.005).all(axis=1) & (centre[:, 2] < 0.075))
    region = (lj.Region(elements=jnp.asarray(core), law={"mu": 8e4, "bulk": 4e5}),)

    def pulled(mesh, **more):
        low, top = (jnp.asarray(lj.boundary.select(mesh, w)) for w in ({"z_max": 0.0}, {"z_min": SIDE}))
        triangles = jnp.asarray(lj.boundary.boundary_triangles(mesh, np.asarray(top)))
        load = lj.Traction(triangles=triangles, value=jnp.array([0.0, 0.0, 100.0]))
        scene = lj.Scene(mesh=mesh, law=LAW, fixed=(lj.Fixed(nodes=low),), traction=(load,), **more)
        x = lj.simulate(scene).check().positions[-1]
        return float(jnp.mean((x - mesh.points)[top, 2]))

    coarse = lj.quadratic(lj.shapes.box((SIDE, SIDE, SIDE), (5, 5, 4)))
    line = np.array([[0.045, 0.045, 0.0], [0.045, 0.045, 0.075]])
    # The displaced tissue is not removed, so the modulus of the vessel is its excess over that of the tissue.
    tube = vessel.along(coarse, line, 0.01 / np.sqrt(np.pi), replace(stiff, mu=8e4 - 800.0))
    bare, bars, elements = pulled(coarse), pulled(coarse, physics=(tube,)), pulled(fine, region=region)
    effect = (bare - bars) / (bare - elements)
    verified("vessel, bars against elements: what it changes", "finer model", abs(effect - 1), 0.2)
    assert bare > 1.1 * elements and abs(bars / elements - 1) < 0.05


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"radius": 1e-3, "law": {"name": "neo_hookean", "mu": 1e5}}, "vessel.0 needs line"),
        ({"line": [[0, 0, 0], [0, 0, "1"]], "radius": 1e-3, "law": {"name": "neo_hookean", "mu": 1e5}}, "needs line"),
        (
            {"line": [[0, 0, 0], [0, 0, 1]], "radius": True, "law": {"name": "neo_hookean", "mu": 1e5}},
            "radius as one number",
        ),
        ({"line": [[0, 0, 0], [0, 0, 10**400]], "radius": 1, "law": {"name": "neo_hookean", "mu": 1e5}}, "needs line"),
        (
            {"line": [[0, 0, 0], [0, 0, np.nan]], "radius": 1e-3, "law": {"name": "neo_hookean", "mu": 1e5}},
            "one number per point: correct line and radius",
        ),
        ({"line": [[0, 0, 0]], "radius": 1e-3, "law": {"name": "neo_hookean", "mu": 1e5}}, "two or more points"),
        (
            {"line": [[0, 0, 0]] * 2, "radius": 1e-3, "law": {"name": "neo_hookean", "mu": 1e5}},
            "the same point twice in succession",
        ),
        (
            {"line": [[0, 0, 1], [0, 0, 2]], "radius": 1e-3, "law": {"name": "neo_hookean", "mu": 1e5}},
            "outside the body",
        ),
        (
            {"line": [[0, 0, 0], [0, 0, 0.1]], "radius": 1e-3, "wall": 2e-3, "law": {"name": "neo_hookean", "mu": 1e5}},
            "thicker than the radius",
        ),
    ],
)
def test_bad_vessels_are_refused(table, words):
    with pytest.raises(InputError, match=words):
        scene_from(content(vessel=[table]))
