"""Three waves in closed form with ten quadratic elements per wavelength: errors without and with the estimate added."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_harmonic import DENSITY, FREQUENCIES, MU, PRONY, around_a_sphere, modulus, standing

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.mesh import cylinders
from liverjax.scenes.checks.choices import check_volumetric
from liverjax.scenes.enriched import enriched
from liverjax.simulation.automatic import form_of_volumes
from liverjax.tensors.matrices import deformation_gradient
from liverjax.waves.harmonic import element_operator
from liverjax.waves.mesh_error import _padded, _richer_elements, _with_own_stress
from liverjax.waves.pressures import scalars_and_pressures

pytestmark = pytest.mark.quick_to_compile

HERTZ = FREQUENCIES[1:]
#: Wavelength [m].
WAVE = float((2 * np.pi / (2 * np.pi * HERTZ * np.sqrt(DENSITY / modulus()[1:])).real)[0])


def scene_of(mesh, displaced, **changes):
    body = lj.Body(density=DENSITY)
    law = lj.laws.NeoHookean(mu=MU, bulk=10 * MU)
    return lj.Scene(mesh=mesh, law=law, viscosity=PRONY, body=body, displaced=(displaced,), **changes)


def plane(edge):
    """A column of cells between a driven and a free face, 1.8 wavelengths long.

    Returns the scene, prescribed and exact motion, and nodes.
    """
    n = round(1.8 * WAVE / edge)
    mesh = lj.quadratic(lj.shapes.box((edge, edge, n * edge), (1, 1, n)))
    exact = np.zeros((mesh.number_of_nodes, 3), complex)
    exact[:, 0] = standing(np.asarray(mesh.points)[:, 2], modulus(), n * edge)[1]
    low = lj.Displaced(nodes=mesh.node_sets["z_min"], by=jnp.array([1e-4, 0.0, 0.0]), axes="x")
    held = (lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes), axes="yz"),)
    return scene_of(mesh, low, fixed=held), None, exact, slice(None)


def torsional(edge):
    """A quarter of a cylinder with 40 sides, turned at its bottom. The polygon causes an error of 0.02 %."""
    n, radius = round(0.6 * WAVE / edge), 0.004
    mesh = lj.quadratic(cylinders.sector(np.linspace(0, radius, 3), edge * np.arange(n + 1), 40, 10).mesh)
    X, low = np.asarray(mesh.points), np.asarray(mesh.node_sets["bottom"])
    turn = np.stack([-X[:, 1], X[:, 0], 0 * X[:, 0]], axis=1) / radius
    held = tuple(lj.Fixed(nodes=mesh.node_sets[s], axes=a) for s, a in (("start", "xz"), ("end", "yz")))
    turned = lj.Displaced(nodes=jnp.asarray(low), by=jnp.asarray(1e-4 * turn[low]))
    exact = turn * standing(X[:, 2], modulus(), n * edge)[1][:, None]
    return scene_of(mesh, turned, fixed=held), None, exact, slice(None)


def about_a_sphere(edge):
    """A box of 0.8 wavelengths beside an oscillating sphere, driven at its surface by the closed form (Oestreicher).

    The drive is known at nodes only, which causes an error of 0.13 % near the surface. So the outermost cells are left
    out.
    """
    n = round(0.8 * WAVE / edge)
    mesh = lj.quadratic(lj.shapes.box((n * edge,) * 3, (n,) * 3))
    X = np.asarray(mesh.points)
    G = modulus()[1]
    exact = around_a_sphere(X + np.array([0.002, -0.004, 0.005]), G, 10 * G, 2 * np.pi * HERTZ[0], 0.003)
    depth = np.minimum(X, n * edge - X).min(axis=1)
    driven = lj.Displaced(nodes=jnp.asarray(np.flatnonzero(depth < 1e-9)), by=jnp.zeros(3))
    return scene_of(mesh, driven), jnp.asarray(exact), exact, depth > 0.99 * edge


def off(wave, elements):
    """Return the largest error over the largest motion, without and with the estimate, and the root mean square error
    of the estimate over the true error.
    """
    scene, motion, exact, where = wave(WAVE / elements)
    found = lj.harmonic(scene, HERTZ, motion=motion).check()
    estimate = np.asarray(lj.harmonic_mesh_error(scene, found, motion=motion))[0]
    missing, size = exact - np.asarray(found.displacement[0]), np.abs(exact).max()
    left = missing - estimate
    ratio = np.linalg.norm(left) / np.linalg.norm(missing)
    return np.abs(missing).max() / size, np.abs(left[where]).max() / size, ratio


@pytest.mark.parametrize(
    "wave",
    [pytest.param(w, marks=pytest.mark.slow) for w in (plane, torsional, about_a_sphere)],
)
def test_ten_quadratic_elements_a_wave(wave, verified):
    """The error is a few thousandths of the motion, of order h^3. The estimate shows its size and position."""
    coarse, fine = (off(wave, elements) for elements in (5, 10))
    order = float(np.log2(coarse[0] / fine[0]))
    assert 2.5 < order < 4.2 and fine[0] < 6e-3
    assert fine[1] < 1e-3 and fine[2] < 0.3
    name = {plane: "plane wave", torsional: "torsional wave", about_a_sphere: "waves about a sphere"}[wave]
    verified(f"{name}, ten quadratic elements a wave", "closed form", fine[0], 6e-3, order)
    verified(f"{name}, ten quadratic elements a wave, with the mesh's estimate", "closed form", fine[1], 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("bulk", [1e4, 2e8])
def test_mixed_elements_of_a_clamped_body(bulk):
    """A loaded cantilever, compared with elements of a third of the size. The cubic elements of the estimate had no
    unknown pressures: the estimate was 0.64 to 0.84 of the error.
    """

    def scene(cells):
        mesh = lj.quadratic(lj.shapes.box((0.04, 0.02, 0.02), cells))
        top = lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_min"])
        push = lj.Traction(triangles=top, value=jnp.array([0.0, 0.0, -5.0]))
        return lj.Scene(
            mesh=mesh,
            law=lj.laws.NeoHookean(mu=2000.0, bulk=bulk),
            viscosity=replace(PRONY, part="isochoric"),
            body=lj.Body(density=DENSITY),
            fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
            traction=(push,),
            solve=lj.Solve(kind="harmonic", frequencies=jnp.array([5.0]), volumetric="mixed"),
        )

    coarse, fine = scene((4, 2, 2)), scene((12, 6, 6))
    found = lj.harmonic(coarse)
    places = {tuple(np.round(x, 9)): k for k, x in enumerate(np.asarray(fine.mesh.points))}
    same = [places[tuple(np.round(x, 9))] for x in np.asarray(coarse.mesh.points)]
    missing = np.asarray(lj.harmonic(fine).displacement)[0][same] - np.asarray(found.displacement)[0]
    estimate = np.asarray(lj.harmonic_mesh_error(coarse, found))[0]
    assert 0.9 < np.linalg.norm(estimate) / np.linalg.norm(missing) < 1.2
    assert np.linalg.norm(missing - estimate) < 0.2 * np.linalg.norm(missing)


@pytest.mark.ci
def test_quadratic_elements_keep_the_stress_of_mixed_linear_elements():
    """Their own pressures were those without stabilisation. Under gravity an estimate was 38 times the true error."""
    scene = lj.Scene(
        mesh=lj.shapes.box((0.04, 0.02, 0.02), (4, 2, 2)),
        law=lj.laws.NeoHookean(mu=2000.0, bulk=2e7),
        solve=lj.Solve(volumetric="mixed"),
    )
    x, rich = np.array(scene.mesh.points), _richer_elements(scene)
    x[:, 2] += 0.001 * x[:, 2] * (x[:, 2] - 0.04)  # [m] strain as under gravity
    state = _with_own_stress(scene, jnp.asarray(x), _padded(rich.mesh, None, jnp.asarray(x)))

    def stress(scene, x, *own):
        volume = scalars_and_pressures(scene, x, deformation_gradient(scene.mesh, x), *own)[0]
        return np.atleast_2d(volume.first["J"]).mean(axis=0)

    own = stress(scene, jnp.asarray(x), None)
    alike, other = (stress(rich, state.positions, given) for given in (state.stress, None))
    # The part of the stress outside the pressures is averaged at the vertices.
    assert np.linalg.norm(alike - own) < 0.05 * np.linalg.norm(own - own.mean())
    assert np.linalg.norm(other - own) > np.linalg.norm(own - own.mean())


@pytest.mark.parametrize(("part", "form"), [("isochoric", "mixed"), ("all", "element")])
def test_cubic_elements_keep_the_form_that_auto_chose(part, form):
    """With volumetric = "auto", the cubic elements had no unknown pressures: an estimate was 17 % too small."""
    mesh = lj.quadratic(lj.shapes.box((0.02, 0.02, 0.02), (1, 1, 1)))
    viscosity, solve = replace(PRONY, part=part), lj.Solve(volumetric="auto")
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=770.0, bulk=770000.0), viscosity=viscosity, solve=solve)
    assert _richer_elements(scene).solve.volumetric == form


@pytest.mark.parametrize(("below", "form"), [(None, "mixed"), (0.1, "element")])
def test_nodal_volumes_become_what_quadratic_elements_allow(below, form):
    """They became "mixed" always. A law that is continued below a volume ratio does not allow it: an InputError."""
    law = lj.laws.NeoHookean(mu=770.0, bulk=7700.0)
    scene = lj.Scene(
        mesh=lj.shapes.box((0.02, 0.02, 0.02), (1, 1, 1)),
        law=law if below is None else lj.laws.continued(law, below),
        solve=lj.Solve(kind="harmonic", frequencies=jnp.array([40.0]), volumetric="nodal"),
    )
    assert form_of_volumes(_richer_elements(scene)) == form
    if below is not None:
        with pytest.raises(lj.InputError, match="cannot be used with continued_below: remove continued_below, or use"):
            check_volumetric(replace(scene, solve=lj.Solve(volumetric="mixed")))


@pytest.mark.ci
def test_a_body_whose_density_varies_keeps_it_in_the_richer_space():
    """Added shape functions once had the mean density of the body, and a stated error was four times the true one."""
    mesh = lj.quadratic(lj.shapes.box((0.1, 0.03, 0.03), (4, 1, 1)))
    density = 2000.0 + 1500.0 * jnp.tanh((mesh.points[:, 0] - 0.05) / 0.02)
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=3000.0, bulk=9000.0),
        body=lj.Body(density=density),
        solve=lj.Solve(kind="harmonic", frequencies=jnp.array([2.0])),
    )
    richer = enriched(scene)
    # The functions of vertices and middle nodes add up to one in both spaces, and so do the masses of every element.
    own, more = (np.asarray(element_operator(s).mass)[:10, :10].sum(axis=(0, 1)) for s in (scene, richer))
    np.testing.assert_allclose(more, own, rtol=1e-12)
    # The mass of an element is the sum of its lumped masses.
    lumped = np.array([1 / 36] * 4 + [4 / 27] * 6) @ np.asarray(density)[np.stack(mesh.element_nodes)]
    exact = np.asarray(mesh.volumes) * lumped
    np.testing.assert_allclose(own, exact, rtol=1e-12)
    added = np.asarray(richer.body.density)[mesh.number_of_nodes :]
    nodes = np.stack([np.asarray(n) for n in richer.mesh.element_nodes])[10:] - mesh.number_of_nodes
    of_element = exact / np.asarray(mesh.volumes)
    for k, value in enumerate(added):  # between the densities of the surrounding elements
        around = of_element[np.any(nodes == k, axis=0)]
        assert around.min() - 1e-9 <= value <= around.max() + 1e-9
