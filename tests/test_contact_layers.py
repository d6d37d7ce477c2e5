"""Sphere, cone and smooth flat punch on a bonded layer with quadratic elements, against the contact's integral
equation.

Strains are about a thousandth, because the equation assumes small strains. For nearly incompressible layers the contact
is four times as stiff as by default, because its penetration matters there. The linear systems are factorised, for run
and estimate. Layers of nearly any thickness have equally many elements, so one program serves all layers of a shape.
"""

import time
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from fitting.methods.contact_point import fit_contact
from fitting.rigs.thin_layer import Indenter, Layer, _contact
from liverjax.core.struct import replace
from liverjax.mesh import cylinders
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.simulation.mesh_error import BAR

A, MU, STRAIN = 0.01, 800.0, 2e-3
#: Stiffness of the contact over its default value, for each K/mu.
HARDER = {3.0: 1.0, 1e3: 4.0}
FORMS = {
    3.0: {"volumetric": "element", "linear_solver": "cg"},
    1e3: {"volumetric": "mixed", "linear_solver": "direct"},
}
#: Numbers of rings within the contact and outside, and of layers. FINER is for a thick layer under the sharp edge of a
#: punch.
CELLS, FINER = (6, 8, 8), (8, 12, 12)


def growing(first: float, length: float, n: int) -> np.ndarray:
    """Return positions from 0 to `length` in n parts. The first part is about `first`; the lengths grow by a constant
    factor.
    """
    low, high = 1e-3, 1e3
    for _ in range(200):
        ratio = np.sqrt(low * high)
        low, high = (ratio, high) if first * np.sum(ratio ** np.arange(n)) < length else (low, ratio)
    return length * np.append(0.0, np.cumsum(ratio ** np.arange(n)) / np.sum(ratio ** np.arange(n)))


def layer(shape: str, thickness: float) -> tuple[cylinders.Sector, int]:
    """Return a sector of the layer in units of the contact radius, and the number of rings that may touch.

    The mesh is fine at the edge of the contact and at the tip of a cone.
    """
    edge = {"sphere": 0.12, "cone": 0.12, "punch": 0.02}[shape] * A
    rings, around, layers = FINER if shape == "punch" and thickness > 3 else CELLS
    inside = np.append(0.0, A - growing(edge, A, rings)[-2::-1])
    if shape == "cone":
        # The mesh is as fine at the tip, where the pressure is singular.
        half = growing(edge / 2, A / 2, rings // 2)
        inside = np.append(half, A - half[-2::-1])
    h = thickness * A
    outside = A + growing(edge, 4 * h + 2 * A, around)
    heights = np.append(0.0, h - growing(min(edge, h / layers), h, layers)[-2::-1])
    return cylinders.sector(np.append(inside, outside[1:]), heights, 24), rings + (0 if shape == "punch" else 3)


def pressed(shape: str, ratio: float, thickness: float) -> tuple[lj.Scene, float, float, float]:
    """Return the scene, the number of such sectors in a layer, the depth [m] and the force [N] of the integral
    equation.
    """
    h, poisson = thickness * A, (3 * ratio - 2) / (2 * (3 * ratio + 1))
    deeper = _contact(1 / thickness, poisson, shape)[0]
    up, at = jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, h])
    if shape == "sphere":
        R = A / STRAIN
        depth, rig = deeper * A**2 / R, Indenter(shape, h, poisson, radius=R)
        place = {"radius": R, "position": at + R * up}
    elif shape == "cone":
        angle = float(np.rad2deg(np.arctan(1 / STRAIN)))
        depth, rig = deeper * np.pi / 2 * A * STRAIN, Indenter(shape, h, poisson, half_angle=angle)
        place = {"half_angle": angle, "axis": up, "position": at}
    else:
        # A smooth punch is a plane under which only the surface within the punch's edge may touch.
        depth, rig, place = STRAIN * A, Indenter(shape, h, poisson, radius=A), {"axis": -up, "position": at}
    (mesh, normal, parts, _), rings = layer(shape, thickness)
    radii = np.unique(np.round(np.hypot(*np.asarray(mesh.points)[np.asarray(mesh.node_sets["top"]), :2].T), 12))
    top = lj.boundary.boundary_triangles(mesh, mesh.node_sets["top"])
    far = np.hypot(*np.asarray(mesh.points)[top][..., :2].transpose(2, 0, 1)).max(axis=1)
    mesh = lj.quadratic(mesh)
    sets = {name: jnp.asarray(nodes) for name, nodes in mesh.node_sets.items()}
    axis = jnp.asarray(np.intersect1d(sets["start"], sets["end"]))
    law = lj.laws.NeoHookean(mu=MU, bulk=ratio * MU)
    indenter = Obstacle(
        triangles=jnp.asarray(top[far < 1.0001 * radii[rings]]),
        shape="plane" if shape == "punch" else shape,
        by=-depth * up,
        **place,
    )
    indenter = replace(indenter, stiffness=HARDER[ratio] * indenter.in_body(mesh, law).stiffness)
    scene = lj.Scene(
        mesh=mesh,
        law=law,
        fixed=(
            lj.Fixed(nodes=sets["bottom"]),
            lj.Fixed(nodes=sets["start"], axes="y"),
            lj.Fixed(nodes=axis, axes="xy"),
        ),
        physics=(SlidingSupport(nodes=sets["end"], normal=jnp.asarray(normal)), indenter),
        solve=lj.Solve(tolerance=1e-6, **FORMS[ratio]),
    )
    exact = 2 * MU * (1 + poisson) * float(Layer(rig).force(np.array([depth]))[0])
    return scene, parts, depth, exact


def carried(scene: lj.Scene, x, reactions):
    """Return the force of the base at the end of the run [N]."""
    return jnp.sum(reactions[-1, scene.mesh.node_sets["bottom"], 2])


CASES = [(ratio, shape, t) for ratio in FORMS for shape in ("sphere", "cone", "punch") for t in (0.5, 1.0, 3.0, 10.0)]
#: The finer mesh of this case has too many cubic functions for a factorisation. The estimate takes over ten minutes.
WITHOUT_ESTIMATE = (1e3, "punch", 10.0)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "shape", "thickness"), CASES)
def test_the_force_on_a_layer_is_that_of_its_integral_equation(shape, ratio, thickness, verified):
    """The force is exact within 1 %, and the estimated mesh error covers the rest. K/mu = 1000 is a Poisson's ratio of
    0.4995.
    """
    scene, parts, depth, exact = pressed(shape, ratio, thickness)
    lj.check_scene(scene)
    asked = (ratio, shape, thickness) != WITHOUT_ESTIMATE
    result = lj.simulate(scene, mesh_error=asked).check()
    off = parts * float(carried(scene, result.positions, result.reactions)) / exact - 1
    name = f"{shape} on a layer of {thickness:g} contact radii, K/mu = {ratio:g}"
    if not asked:
        assert abs(off) < 0.01
        verified(name, "integral equation", abs(off), 0.01)
        return
    change = result.mesh_error.change(partial(carried, scene), result)[1]
    bar = BAR * parts * abs(float(change)) / exact
    left = float(lj.obstacle_forces(scene, result).depth[0, -1]) / depth
    print(f"{shape} {ratio:g} {thickness:g}: off {100 * off:.3f} %, bar {100 * bar:.3f} %, left {100 * left:.3f} %")
    # Finite strain and the penetration of the contact are a thousandth each.
    assert abs(off) < 0.01 and abs(off) < bar + 0.002
    assert bool(jnp.all(result.mesh_error.found))
    verified(name, "integral equation", abs(off), 0.01, bar=bar)


@pytest.mark.slow
def test_noisy_curves_of_finite_elements_give_the_modulus_back(verified):
    """200 curves with 5 % of noise are fitted: the median is within 5 %, intervals cover 90 to 99 %, a curve takes
    below 5 s.
    """
    scene, parts, depth, _ = pressed("sphere", 3.0, 1.0)
    steps, start = 20, 0.3 * depth
    scene = replace(scene, solve=replace(scene.solve, steps=steps))
    result = lj.simulate(scene).check()
    moved = np.linspace(-start, depth, 27)
    known = np.append(0.0, -parts * np.asarray(result.reactions[:, scene.mesh.node_sets["bottom"], 2].sum(axis=1)))
    force = np.interp(moved, depth * np.arange(steps + 1) / steps, np.abs(known))
    poisson, rng, found = 7 / 20, np.random.default_rng(0), []
    rig = Layer(Indenter("sphere", A, poisson, radius=A / STRAIN))
    begin = time.perf_counter()
    for _ in range(200):
        noisy = force + 0.05 * force.max() * rng.normal(size=len(force))
        found.append(fit_contact(moved + 2 * start, noisy, rig.force))
    assert time.perf_counter() - begin < 5 * 200
    exact = (2 * MU * (1 + poisson), 2 * start)
    for k, (name, true) in enumerate(zip(("modulus", "contact_point"), exact, strict=True)):
        values = np.array([getattr(f, name) for f in found])
        covered = np.mean(np.abs(values - true) < [f.quantile * f.standard_errors[k] for f in found])
        assert 0.90 <= covered <= 0.99, (name, covered)
        off = abs(np.median(values) - true) / (true if k == 0 else depth)
        assert off < 0.05
        verified(f"{name} of noisy finite-element curves of a sphere", "integral equation", off, 0.05)
