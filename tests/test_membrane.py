"""A membrane compared with a thin layer: analytic tension, a balloon, a layer of elements."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.laws import homogeneous
from liverjax.physics.attached.membrane import Membrane
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation import tangent
from liverjax.simulation.equations import equations, initial_state, positions, residual
from liverjax.solvers.block_matrix import flat

pytestmark = pytest.mark.quick_to_compile

SOFT = lj.laws.NeoHookean(mu=800.0, bulk=4000.0)
RUBBER = lj.laws.MooneyRivlin(c10=40e3, c01=4e3, bulk=1e6)
ORDERS = pytest.mark.parametrize("order", [1, 2])


def box(order: int, cells=(2, 2, 1), size=(0.04, 0.03, 0.01)) -> lj.TetMesh:
    mesh = lj.shapes.box(size, cells)
    return lj.quadratic(mesh) if order == 2 else mesh


def capsule(mesh: lj.TetMesh, law: lj.Law, thickness=1e-4, **where) -> Membrane:
    """A membrane on a region of the surface."""
    triangles = lj.boundary.boundary_triangles(mesh, lj.boundary.select(mesh, where))
    return Membrane(triangles=jnp.asarray(triangles), thickness=thickness, law=law)


def stretched(mesh: lj.TetMesh, first: float, second: float, shear: float = 0.0) -> jax.Array:
    F = jnp.array([[first, shear, 0.0], [0.0, second, 0.0], [0.0, 0.0, 1.0]])
    return mesh.points @ F.T


LAWS = {
    "neo_hookean": lj.laws.NeoHookean(mu=8e4, bulk=1e6),
    "mooney_rivlin": RUBBER,
    "yeoh": lj.laws.create("yeoh", c1=4e4, c2=1e3, c3=10.0, bulk=1e6),
    "fung_demiray": lj.laws.create("fung_demiray", c1=4e4, c2=2.0, bulk=1e6),
    "ogden": lj.laws.create("ogden", mu=[8e4], alpha=[3.0], bulk=1e6),
    "nearly incompressible": lj.laws.create("neo_hookean_compressible", mu=8e4, lame_lambda=8e9),
}


@ORDERS
@pytest.mark.parametrize("name", [n if n != "ogden" else pytest.param(n, marks=pytest.mark.slow) for n in LAWS])
def test_a_patch_in_tension_takes_the_stress_of_an_incompressible_sample(order, name):
    """The force on a straight edge is thickness times nominal stress (`laws.homogeneous`, an independent
    computation).
    """
    mesh = box(order)
    own = capsule(mesh, LAWS[name], z_min=0.01).freeze(None, None)
    edge = lj.boundary.select(mesh, {"x_min": 0.04, "z_min": 0.01})
    F = np.array([[1.3, 0.1, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1 / (1.3 * 0.9)]])
    force = np.asarray(own.force(mesh, stretched(mesh, 1.3, 0.9, 0.1), 1.0))[edge].sum(axis=0)
    P = np.asarray(homogeneous.nominal_stress(LAWS[name], jnp.asarray(F)))
    # For the compressible law, an error of mu / lambda remains.
    allowed = 1e-4 if name == "nearly incompressible" else 1e-11
    assert np.allclose(force, 1e-4 * 0.03 * P[:, 0], rtol=allowed, atol=allowed * abs(P).max() * 3e-6)


def test_saint_venant_in_plane_stress(verified):
    """E_33 = -nu/(1-nu) (E_11 + E_22) is exact. The energy of a plate is t mu (|E|^2 + nu/(1-nu) (tr E)^2)."""
    mu, lame = 5e4, 7e4
    nu = lame / (2 * (lame + mu))
    mesh = box(1)
    own = capsule(mesh, lj.laws.create("saint_venant_kirchhoff", mu=mu, lame_lambda=lame), z_min=0.01).freeze(
        None, None
    )
    F = np.array([[1.1, 0.05], [0.0, 0.97]])
    E = 0.5 * (F.T @ F - np.eye(2))
    plate = 1e-4 * 0.04 * 0.03 * mu * (np.sum(E * E) + nu / (1 - nu) * np.trace(E) ** 2)
    found = own.energy(mesh, stretched(mesh, 1.1, 0.97, 0.05))
    assert np.isclose(found, plate, rtol=1e-12)
    verified("membrane, Saint Venant-Kirchhoff, plane stress", "analytic", abs(found / plate - 1), 1e-12)


def patch_of_sphere(order: int, n: int) -> lj.TetMesh:
    """Return a sixth of a thick sphere with inner radius 1."""
    flat_box = lj.shapes.box((2.0, 2.0, 0.5), (n, n, 1))
    a, b, r = np.asarray(flat_box.points).T
    # The angles are as equal as possible (equiangular cubed sphere).
    at = np.stack([np.tan((a - 1) * np.pi / 4), np.tan((b - 1) * np.pi / 4), np.ones(len(a))], axis=1)
    points = (1 + r)[:, None] * at / np.linalg.norm(at, axis=1, keepdims=True)
    mesh = lj.tet_mesh(points, flat_box.tetrahedra)
    return lj.quadratic(mesh) if order == 2 else mesh


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_a_balloon_through_its_limit_point(order, verified):
    """A thin Mooney-Rivlin sphere under volume control: p = 4 t/(R l^2) (c10 (l - l^-5) + c01 (l^3 - l^-3))."""
    c10, c01, t, errors = RUBBER.c10, RUBBER.c01, 1e-3, []
    for n in (4, 8):
        mesh = patch_of_sphere(order, n)
        inner = np.flatnonzero(np.linalg.norm(np.asarray(mesh.points)[: mesh.number_of_vertices], axis=1) < 1 + 1e-9)
        outside = lj.boundary.boundary_triangles(mesh)
        triangles = jnp.asarray(outside[np.isin(outside, inner).all(axis=1)])
        own = Membrane(triangles=triangles, thickness=t, law=RUBBER).freeze(None, None)
        total = {}
        for stretch in (1.1, 1.3, 1.38, 1.5, 2.0, 3.0):
            x = stretch * mesh.points
            work = np.sum(np.asarray(own.force(mesh, x, 1.0) * mesh.points))
            area = np.sum(
                np.asarray(
                    lj.boundary.follower_forces((lj.Traction(triangles=triangles, pressure=1.0),), x, mesh)
                    * mesh.points
                )
            )
            # The edges of the patch are loaded along the surface. The work of a uniform growth is a sixth of that of
            # the sphere.
            total[stretch] = work / area
        exact = {k: 4 * t / k**2 * (c10 * (k - k**-5) + c01 * (k**3 - k**-3)) for k in total}
        assert total[1.38] > total[1.1] and total[1.38] > total[2.0]  # there is a limit point in between
        errors.append(max(abs(abs(total[k]) / exact[k] - 1) for k in exact))
    assert errors[1] < 0.011 and np.log2(errors[0] / errors[1]) > 1.8  # flat triangles are of second order
    verified(
        f"balloon, Mooney-Rivlin, order {order}", "analytic", errors[1], 0.011, order=np.log2(errors[0] / errors[1])
    )


def scene_of(mesh: lj.TetMesh, *physics, **solve) -> lj.Scene:
    """A cantilever under its weight."""
    held = lj.Fixed(nodes=jnp.asarray(lj.boundary.select(mesh, {"x_max": 0.0})))
    body = lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -2.0]))
    return lj.Scene(mesh=mesh, law=SOFT, fixed=(held,), body=body, physics=physics, solve=lj.Solve(**solve))


@pytest.mark.parametrize(
    ("order", "kind"),
    [
        pytest.param(*c, marks=pytest.mark.slow)  # the default run of tests/test_quadratic.py tests one of them
        for c in ((1, "projected"), (1, "true"), (2, "true"), (2, "projected"))
    ],
)
def test_the_tangent_is_the_derivative(order, kind):
    mesh = box(order)
    scene = scene_of(mesh, capsule(mesh, LAWS["fung_demiray"], z_min=0.01))
    e = equations(scene, initial_state(scene), 1.0)
    x = positions(e, flat(mesh.points * jnp.array([[1.1, 1.05, 0.97]])), 1.0)
    v = flat(e.free.vectors(jnp.asarray(np.random.default_rng(1).standard_normal(x.shape))))
    K = tangent.tangent(e, None, x, jnp.ones(()), None, kind)
    exact = jax.jvp(lambda q: residual(e, q, jnp.ones(()))[0], (flat(x),), (v,))[1]
    # In tension, the projection changes nothing.
    assert np.abs(tangent.product(e, K)(v) - exact).max() < 1e-12 * np.abs(exact).max()
    again = tangent.solve(e._replace(scene=replace(scene, solve=lj.Solve(linear_solver="direct"))), K, exact, 0.0, 1)
    assert np.abs(again[0] - v).max() < 1e-8 * np.abs(v).max()


@pytest.mark.slow
def test_a_capsule_is_a_thin_layer_of_elements(verified):
    """A cantilever with a stiff skin on top is compared with a layer of quadratic elements."""
    height, t, mu = 0.01, 1e-4, 2e5
    skin = lj.laws.NeoHookean(mu=mu, bulk=20 * mu)
    plain = box(2, (6, 2, 2), (0.04, 0.02, height))
    thin = scene_of(plain, capsule(plain, skin, t, z_min=height))
    layered = lj.shapes.box((0.04, 0.02, 4.0), (6, 2, 4))
    z = np.interp(
        np.asarray(layered.points)[:, 2], [0, 1, 2, 3, 4], [0, height / 2, height, height + t / 2, height + t]
    )
    points = np.asarray(layered.points) * [1, 1, 0] + z[:, None] * [0, 0, 1]
    layered = lj.quadratic(lj.tet_mesh(points, layered.tetrahedra))
    middle = points[np.asarray(layered.tetrahedra), 2].mean(axis=1)
    elements = jnp.asarray(np.flatnonzero(middle > height))
    stiff = (lj.Region(elements=elements, law={"mu": mu, "bulk": 20 * mu}),)
    resolved = replace(scene_of(layered, linear_solver="direct"), region=stiff)

    def sinks(scene):
        mesh = scene.mesh
        tip = lj.boundary.select(mesh, {"x_min": 0.04, "z_max": 0.0})
        return float(np.mean(np.asarray(lj.simulate(scene).check().positions[-1] - mesh.points)[tip, 2]))

    bare, membrane, layer = sinks(replace(thin, physics=())), sinks(thin), sinks(resolved)
    assert bare < 1.5 * layer  # the skin has a large effect
    verified("capsule against a layer of elements", "finer model", abs(membrane / layer - 1), 0.02)
    assert abs(membrane / layer - 1) < 0.02


@pytest.mark.slow
@ORDERS
def test_derivatives_by_the_numbers_of_a_membrane(order):
    mesh = box(order)
    scene = scene_of(mesh, capsule(mesh, lj.laws.NeoHookean(mu=2e4, bulk=None), z_min=0.01), tolerance=1e-11)
    tip = lj.boundary.select(mesh, {"x_min": 0.04})

    def sinks(result):
        return jnp.mean(result.positions[-1, tip, 2])

    m = len(scene.physics[0].triangles)
    at = {"membrane.0.law.mu": 2e4, "membrane.0.thickness": jnp.full(m, 1e-4)}
    found = lj.value_and_gradient(sinks, scene, at)
    assert found.status == 0
    by_mu, by_thickness = (np.asarray(found.gradient[k]) for k in at)
    # Only the product of mu and thickness counts.
    assert np.isclose(2e4 * by_mu, 1e-4 * by_thickness.sum(), rtol=1e-7)

    def quotient(step):
        high, low = (
            sinks(lj.simulate(lj.with_parameters(scene, {"membrane.0.law.mu": 2e4 * (1 + s)}))) for s in (step, -step)
        )
        return abs((high - low) / (2 * step * 2e4) / by_mu - 1)

    wide, good = quotient(3e-1), quotient(1e-3)
    assert good < 1e-6 < 1e-3 < wide < 0.1


def content(**membrane) -> dict:
    return {
        "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "fixed": {"where": {"z_max": 0.0}},
        "membrane": [membrane],
    }


LAW = {"name": "neo_hookean", "mu": 1e6}


def test_a_membrane_of_a_scene_file():
    scene = scene_from(content(thickness=5e-5, law=LAW, where={"z_min": 0.1}))
    assert len(scene.physics[0].triangles) == 2 and scene.physics[0].law.bulk is None
    assert len(scene_from(content(thickness=5e-5, law=LAW)).physics[0].triangles) == 12
    assert lj.with_parameters(scene, {"membrane.0.law.mu": 2e6}).physics[0].law.mu == 2e6


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"thickness": 5e-5}, "membrane.0 needs law: write"),
        ({"law": LAW}, "membrane.0 needs thickness: write thickness = 5e-5, in m"),
        ({"thickness": -1.0, "law": LAW}, "membrane.0.thickness = -1.0 must be above 0 m"),
        ({"thickness": 5e-5, "law": LAW | {"mu": -1.0}}, "membrane.0: law neo_hookean: mu = -1.0 must be above 0 Pa"),
        ({"thickness": 5e-5, "law": LAW | {"nu": 1.0}}, "has no parameter 'nu'"),
        (
            {
                "thickness": 5e-5,
                "law": {"name": "costa"}
                | dict.fromkeys(("c", "b_ff", "b_ss", "b_nn", "b_fs", "b_fn", "b_sn", "bulk"), 1.0),
            },
            "membrane.0.law cannot be used, because a layer or bar needs an isotropic law",
        ),
        ({"thickness": 5e-5, "law": LAW, "where": {"z_min": 0.1, "x_min": 0.1}}, "no triangle of the boundary"),
    ],
)
def test_bad_membranes_are_refused(table, words):
    with pytest.raises(InputError, match=words):
        scene_from(content(**table))


@pytest.mark.slow  # the default run of tests/test_pay_for_what_is_there.py compares the equations themselves
def test_a_scene_without_membranes_has_a_shorter_program():
    mesh = box(1)
    sizes = [
        len(str(jax.make_jaxpr(lj.simulate)(s)))
        for s in (scene_of(mesh), scene_of(mesh, capsule(mesh, SOFT, z_min=0.01)))
    ]
    assert sizes[0] < sizes[1]


def test_a_scene_without_membranes_pays_nothing():
    mesh = box(1)
    scene = scene_of(mesh)
    e = equations(scene, initial_state(scene), 1.0)
    assert jax.eval_shape(lambda x: tangent.tangent(e, None, x, jnp.ones(())), mesh.points).attached == ()
