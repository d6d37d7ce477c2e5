"""The mesh error of porous runs, including the fluid pressures, against closed forms and finer meshes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.nodal import nodal_volumes
from liverjax.mesh.refinement import places_in, quarters, refined
from liverjax.mesh.selection import boundary_triangles
from liverjax.mesh.surface import areas
from liverjax.physics.attached import vessel
from liverjax.physics.darcy import unknown_pressures
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.porosity import Inlet, inflow
from liverjax.scenes.refined import can_be_refined, on_refined_mesh
from liverjax.simulation.cautions.of_mesh import mesh_sentence
from liverjax.simulation.equations import forces_at
from liverjax.simulation.run import prepared

pytestmark = pytest.mark.quick_to_compile

HEIGHT, SHEAR, BULK, LIMIT, FLOW, LOAD = 0.01, 1000.0, 2000.0, 1e6, 1e-11, 1.0
#: Longitudinal modulus [Pa] of the porous body, and storage [1/Pa] of the fluid.
M = BULK + 4 / 3 * SHEAR
STORE = 1 / LIMIT + 1 / M
#: Time [s] in which the fluid leaves the column.
LONG = STORE * HEIGHT**2 / FLOW


def column(cells, order, **solve):
    """A column between smooth walls, loaded and drained at the top (Terzaghi)."""
    mesh = lj.shapes.box((HEIGHT / cells, HEIGHT / cells, HEIGHT), (1, 1, cells))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    top = mesh.node_sets["z_max"]
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=SHEAR, bulk=BULK),
        porosity=lj.Porosity(bulk=BULK, limit_bulk=LIMIT, fluid_fraction=0.8, permeability=FLOW, drained=top),
        body=lj.Body(density=1e-6),
        fixed=(
            lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes), axes="xy"),
            lj.Fixed(nodes=mesh.node_sets["z_min"], axes="z"),
        ),
        traction=(lj.Traction(triangles=boundary_triangles(mesh, np.asarray(top)), value=jnp.array([0, 0, -LOAD])),),
        solve=lj.Solve(**solve),
    )


def swinging(z, omega):
    """Return displacement and pressure at heights z of the column under a load of exp(i omega t), in closed form."""
    wave, pressure = np.sqrt(1j * omega * STORE / FLOW), LOAD / (M * STORE)
    P = pressure * (1 - np.cosh(wave * z) / np.cosh(wave * HEIGHT))
    return (pressure * (z - np.sinh(wave * z) / (wave * np.cosh(wave * HEIGHT))) - LOAD * z) / M, P


@pytest.mark.ci
@pytest.mark.parametrize(
    ("order", "omega"),
    [
        (2, 3.0),
        *(pytest.param(o, w, marks=pytest.mark.slow) for o, w in ((1, 3.0), (1, 300), (1, 3e4), (2, 300), (2, 3e4))),
    ],
)
def test_harmonic_error_against_the_closed_form(order, omega, verified):
    """The thickness of the draining layer goes from the height of the column to a twentieth of an element."""
    scene = column(12, order)
    hertz = omega / LONG / (2 * np.pi)
    found = lj.harmonic(scene, [hertz]).check()
    error = lj.harmonic_errors(scene, found)
    exact = swinging(np.asarray(scene.mesh.points)[:, 2], omega / LONG)
    pairs = [(found.displacement[0, :, 2], error.displacement[0, :, 2]), (found.pressure[0], error.pressure[0])]
    for (value, stated), truth in zip(pairs, exact, strict=True):
        effectivity = np.linalg.norm(stated) / np.linalg.norm(truth - value)
        assert 0.5 < effectivity < 2
    verified(
        f"harmonic mesh error with a fluid, order {order}, omega {omega:g}", "closed form", abs(effectivity - 1), 1.0
    )


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("time", [1e-4, 1e-2, 1.0])
def test_error_of_a_run_against_twice_refined_meshes(order, time):
    scene = column(8, order, dt=time * LONG / 5, steps=5)
    found = lj.simulate(scene, mesh_error=True).check()
    assert bool(found.mesh_error.found.all())
    fine = lj.simulate(on_refined_mesh(on_refined_mesh(scene)[0])[0]).check()
    nodes = scene.mesh.number_of_nodes
    for name, value in (("positions", found.positions), ("pressure", found.pressure)):
        truth = np.asarray(getattr(fine, name))[-1, :nodes] - np.asarray(value)[-1]
        assert 0.5 < np.linalg.norm(getattr(found.mesh_error, name)[-1]) / np.linalg.norm(truth) < 2
    assert "; pressures are wrong by up to" in mesh_sentence(scene, found)


def inside_column(mesh, stiffness):
    """A bent vessel in the column of 3 cells. It becomes thinner towards the top."""
    line = HEIGHT * (np.array([[0, 0, 0.2], [0.05, 0, 0.5], [0, 0.1, 0.8]]) + np.array([1, 1, 0]) / 12)
    law = lj.laws.NeoHookean(mu=stiffness, bulk=2 * stiffness)
    return vessel.along(mesh, line, 1e-4 * np.array([3.0, 2.0, 1.0]), law, wall=5e-5)


@pytest.mark.parametrize("order", [1, 2])
def test_a_vessel_is_cut_at_the_elements_of_the_refined_mesh(order):
    mesh = column(3, order).mesh
    own, fine = inside_column(mesh, SHEAR), refined(mesh)
    again, parts = inside_column(fine, SHEAR), own.in_parts(mesh)
    assert sorted(np.asarray(parts.element)) == sorted(np.asarray(again.element))
    lengths = [each.freeze(None, None)._lengths(of) for each, of in ((own, mesh), (parts, fine))]
    assert np.isclose(lengths[0].sum(), lengths[1].sum(), rtol=1e-12)
    volumes = [(each.area() * length).sum() for each, length in zip((own, parts), lengths, strict=True)]
    assert np.isclose(*volumes, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_error_of_a_run_with_a_vessel_against_twice_refined_meshes(order):
    scene = column(3, order, dt=1e-2 * LONG, steps=3)
    scene = replace(scene, physics=(inside_column(scene.mesh, 300 * SHEAR),))
    assert can_be_refined(scene)
    found = lj.simulate(scene, mesh_error=True).check()
    fine = lj.simulate(on_refined_mesh(on_refined_mesh(scene)[0])[0]).check()
    for name, value in (("positions", found.positions), ("pressure", found.pressure)):
        truth = np.asarray(getattr(fine, name))[-1, : value.shape[1]] - np.asarray(value)[-1]
        assert 0.5 < np.linalg.norm(getattr(found.mesh_error, name)[-1]) / np.linalg.norm(truth) < 2
    assert "; pressures are wrong by up to" in mesh_sentence(scene, found)


@pytest.mark.parametrize("order", [1, 2])
def test_fields_keep_their_function_on_the_refined_mesh(order):
    mesh = lj.shapes.box((2.0, 1.0, 1.0), (2, 1, 1))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    fine = refined(mesh)
    element, place = places_in(mesh, fine)
    corners = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)[element]]
    assert np.allclose(np.einsum("am,mai->mi", place.T.T, corners), fine.points, atol=1e-15)
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1.0, bulk=2.0))
    _, within = on_refined_mesh(scene)
    X, Y = np.asarray(mesh.points), np.asarray(fine.points)
    power = 1 + (order > 1)
    assert np.allclose(within.field(jnp.asarray(X**power)), Y**power, atol=1e-14)  # squares are quadratic functions
    f = np.random.default_rng(0).normal(size=Y.shape)
    work = np.sum(np.asarray(within.forces(jnp.asarray(f), len(X))) * X**power)
    assert np.isclose(work, np.sum(f * Y**power), rtol=1e-13)


@pytest.mark.ci
@pytest.mark.parametrize("order", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_scene_on_the_refined_mesh_has_its_regions_places_and_loads(order):
    mesh = lj.shapes.box((0.02, 0.01, 0.01), (2, 1, 1))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    E, left = mesh.number_of_elements, mesh.node_sets["x_min"]
    half = np.flatnonzero(np.asarray(mesh.points)[np.asarray(mesh.tetrahedra), 0].mean(axis=1) < 0.01)
    right = boundary_triangles(mesh, np.asarray(mesh.node_sets["x_max"]))
    stiff = jnp.linspace(1.0, 2.0, E)
    by = 1e-3 * np.asarray(mesh.points)[np.asarray(left)]
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=stiff, bulk=2.0),
        region=(lj.Region(elements=half, law=lj.laws.Yeoh(c1=1.0, c2=0.1, c3=0.0, bulk=3.0)),),
        displaced=(lj.Displaced(nodes=left, by=jnp.asarray(by)),),
        traction=(lj.Traction(triangles=right, value=jnp.array([1.0, 0.0, 0.0])),),
        porosity=lj.Porosity(
            bulk=1.0, limit_bulk=9.0, fluid_fraction=0.5, permeability=1e-3, drained=left,
            inlet=(Inlet(triangles=right, flux=1e-6),),
        ),
        solve=lj.Solve(dt=1.0),
    )  # fmt: skip
    fine = on_refined_mesh(scene)[0]
    middle = np.asarray(fine.mesh.points)[np.asarray(fine.mesh.tetrahedra)].mean(axis=1)
    assert set(np.asarray(fine.region[0].elements)) == set(np.flatnonzero(middle[:, 0] < 0.01))
    assert np.allclose(fine.law.mu, np.repeat(stiff, 8)) and fine.mesh.number_of_elements == 8 * E
    assert np.isclose(fine.mesh.volumes.sum(), 2e-6) and np.all(fine.mesh.volumes > 0)
    ends = set(np.flatnonzero(np.asarray(fine.mesh.points)[:, 0] < 1e-12))
    assert set(np.asarray(fine.displaced[0].nodes)) == ends == set(np.asarray(fine.porosity.drained))
    nodes = np.asarray(fine.displaced[0].nodes)
    assert np.allclose(fine.displaced[0].by, 1e-3 * np.asarray(fine.mesh.points)[nodes], atol=1e-16)
    for load in (fine.traction[0], fine.porosity.inlet[0]):
        assert np.allclose(areas(fine.mesh.points, load.triangles).sum(axis=0), [1e-4, 0, 0])
    # The prepared scene has one law for each kind of element. Its forces are those of the scene with regions.
    ready = on_refined_mesh(prepared(scene))[0]
    x = fine.mesh.points * jnp.array([[1.1, 0.95, 1.0]])
    assert np.allclose(volume_ratios(ready.mesh, x), 1.1 * 0.95)
    one, other = (np.asarray(jax.jit(forces_at)(s, x)) for s in (prepared(fine), ready))
    assert np.abs(one - other).max() < 1e-12 * np.abs(one).max()


def test_the_parts_of_triangles_and_element_sets():
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    mesh = replace(mesh, element_sets={"first": np.array([0, 2])})
    assert set(refined(mesh).element_sets["first"].tolist()) == {*range(8), *range(16, 24)}
    whole = boundary_triangles(mesh)
    parts = np.asarray(quarters(mesh, whole)).reshape(len(whole), 4, 3)
    each = np.asarray(areas(refined(mesh).points, parts.reshape(-1, 3))).reshape(len(whole), 4, 3)
    assert np.allclose(each, np.asarray(areas(mesh.points, whole))[:, None] / 4)


@pytest.mark.parametrize("order", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_places_that_meet_at_an_edge_keep_their_size(order):
    """In one set of nodes, some inner faces and the triangle at a corner had all vertices in the set, and were drained
    too.
    """
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (2, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    x = np.asarray(mesh.points)

    def place(x):
        return np.flatnonzero((x[:, 2] > 1 - 1e-9) | (x[:, 0] < 1e-9))

    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1.0, bulk=2.0),
        fixed=(lj.Fixed(nodes=jnp.asarray(place(x))), lj.Fixed(nodes=jnp.flatnonzero(x[:, 1] == 0.5), axes="y")),
    )
    fine = on_refined_mesh(scene)[0]
    y = np.asarray(fine.mesh.points)
    assert set(np.asarray(fine.fixed[0].nodes)) == set(place(y))
    assert set(np.asarray(fine.fixed[1].nodes)) == set(np.flatnonzero(np.abs(y[:, 1] - 0.5) < 1e-9))  # inside


@pytest.mark.parametrize("order", [1, 2])
def test_pressures_between_drained_nodes_and_inlets_are_known(order):
    """A top that is drained up to its last row of nodes, where an inlet gives the pressure: the pressures of the new
    nodes between them were unknown.
    """
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    x = np.asarray(mesh.points)
    top = np.flatnonzero(x[:, 2] > 0.099)
    drained, row = top[x[top, 0] < 0.06], top[x[top, 0] > 0.09]
    clock = {"times": jnp.array([0.0, 1.0]), "history": jnp.array([0.0, 1.0])}
    at_row = Inlet(nodes=row, pressure=4.0, **clock)
    sponge = lj.Porosity(bulk=1.0, limit_bulk=9.0, fluid_fraction=0.5, permeability=1e-3, drained=drained)
    law = lj.laws.NeoHookean(mu=1.0, bulk=2.0)

    def pressures(**own):
        scene = lj.Scene(mesh=mesh, law=law, porosity=replace(sponge, **own))
        fine = on_refined_mesh(scene)[0]
        assert can_be_refined(fine)
        known = unknown_pressures(fine.porosity, fine.mesh, jnp.float64) == 0
        y = np.asarray(fine.mesh.points)[: fine.mesh.number_of_vertices]
        return y, np.asarray(known), np.asarray(inflow(fine.porosity, fine.mesh, 0.5, 1.0)[0])

    y, known, given = pressures(inlet=(at_row,))
    assert np.array_equal(known, y[:, 2] > 0.099) and known.sum() == 25
    assert np.allclose(given, np.where(known, np.clip((y[:, 0] - 0.05) / 0.05, 0.0, 1.0) * 2.0, 0.0))
    # Two inlets: the pressure between them is known if they have one history.
    rest = Inlet(nodes=drained, pressure=2.0, **clock)
    y, known, given = pressures(drained=None, inlet=(rest, at_row))
    assert known.sum() == 25 and np.allclose(given[known & (np.abs(y[:, 0] - 0.075) < 0.01)], 1.5)
    assert pressures(drained=None, inlet=(rest, replace(at_row, history=jnp.ones(2))))[1].sum() == 20
    # The row of the inlet is also drained: the pressure of the new nodes beside this row was 0.
    y, known, given = pressures(drained=top, inlet=(at_row,))
    assert known.sum() == 25 and np.allclose(given, np.where(known, np.clip((y[:, 0] - 0.05) / 0.05, 0.0, 1.0) * 2, 0))


@pytest.mark.parametrize("low", [100.0, 500.0])
def test_a_density_with_a_jump_keeps_its_mass_on_the_refined_mesh(low):
    """Quadratic shape functions made the density negative, and changed the mass by 7 %."""
    mesh = lj.quadratic(lj.shapes.box((0.02, 0.02, 0.07), (1, 1, 2)))
    z = mesh.points[:, 2]

    def refined_body(density):
        scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1.0, bulk=2.0), body=lj.Body(density=density))
        fine = on_refined_mesh(scene)[0]
        return fine.mesh, fine.body.density

    density = jnp.where(z > 0.035, 1060.0, low)
    fine, found = refined_body(density)
    assert np.isclose(found @ nodal_volumes(fine), density @ nodal_volumes(mesh), rtol=1e-12)
    assert found.min() > 0.9 * low and found.max() < 1.1 * 1060.0
    fine, found = refined_body(500.0 + 1e4 * z)  # a linear density is kept
    assert np.allclose(found, 500.0 + 1e4 * fine.points[:, 2], rtol=1e-12)


def test_free_midside_nodes_stay_free_on_the_refined_mesh():
    """If only the vertices of a face had a motion, all new nodes of the face were prescribed, with wrong values."""
    mesh = lj.quadratic(lj.shapes.box((1.0, 1.0, 1.0), (2, 2, 2)))
    x, V = np.asarray(mesh.points), mesh.number_of_vertices
    top = np.flatnonzero(x[:V, 2] > 0.99)
    edge = np.flatnonzero((x[:, 2] < 0.01) & (x[:, 0] < 0.01))  # with the midside nodes
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1.0, bulk=2.0),
        fixed=(lj.Fixed(nodes=jnp.asarray(edge)),),
        displaced=(lj.Displaced(nodes=jnp.asarray(top), by=jnp.tile(jnp.array([0.0, 0.0, -1e-3]), (len(top), 1))),),
    )
    fine = on_refined_mesh(scene)[0]
    assert np.array_equal(fine.displaced[0].nodes, top) and np.all(fine.displaced[0].by[:, 2] == -1e-3)
    y = np.asarray(fine.mesh.points)
    assert set(np.asarray(fine.fixed[0].nodes)) == set(np.flatnonzero((y[:, 2] < 0.01) & (y[:, 0] < 0.01)))


def test_node_sets_keep_their_midside_nodes_on_the_refined_mesh():
    """A set of an edge of the body lost its midside nodes, because the edge is no face."""
    mesh = lj.quadratic(lj.shapes.box((1.0, 1.0, 1.0), (2, 2, 2)))
    x = np.asarray(mesh.points)
    edge = np.flatnonzero((x[:, 2] < 0.01) & (x[:, 0] < 0.01))
    mesh = replace(mesh, node_sets={"edge": edge})
    assert len(edge) == 5 and np.array_equal(np.sort(refined(mesh).node_sets["edge"]), edge)
    near = refined(mesh, near=edge)
    assert np.allclose(np.asarray(near.points)[near.node_sets["edge"]], x[edge])


def test_only_numbers_by_element_are_given_to_the_parts():
    """If there are as many triangles as elements, they were taken for values per element. The inflow was eight times
    too large.
    """
    mesh = lj.shapes.box((0.1, 0.1, 0.025), (4, 4, 1))
    whole = boundary_triangles(mesh)
    assert len(whole) == mesh.number_of_elements
    flux = Inlet(triangles=whole, flux=1e-6)
    sponge = lj.Porosity(bulk=1.0, limit_bulk=9.0, fluid_fraction=0.5, permeability=1e-3, inlet=(flux,))
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1.0, bulk=2.0), porosity=sponge)
    assert len(on_refined_mesh(scene)[0].porosity.inlet[0].triangles) == 4 * len(whole)
    each = replace(flux, flux=jnp.full(len(whole), 1e-6))
    assert can_be_refined(scene) and not can_be_refined(replace(scene, porosity=replace(sponge, inlet=(each,))))


@pytest.mark.parametrize("steps", [7, 8])
def test_a_history_with_a_row_for_each_triangle_is_no_number_by_triangle(steps):
    """With as many times as triangles, the history counted as numbers by triangle. The pressure error was missing."""
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (2, 2, 2))
    top = boundary_triangles(mesh, np.asarray(mesh.node_sets["z_max"]))
    assert len(top) == 8
    times, fluid = jnp.arange(float(steps)), column(1, 1).porosity
    support = ElasticSupport(triangles=top, normal=1.0, times=times, history=jnp.ones(steps))
    plane = lj.Obstacle(triangles=top, by=jnp.ones(3), times=times, history=jnp.ones(steps))
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1.0, bulk=2.0), porosity=fluid, physics=(support, plane))
    assert can_be_refined(scene)
    assert not can_be_refined(replace(scene, physics=(replace(support, normal=jnp.ones(8)), plane)))
    assert not can_be_refined(replace(scene, physics=(support, replace(plane, stiffness=jnp.ones(8)))))


def test_vectors_of_an_obstacle_are_no_numbers_by_triangle():
    """Three triangles had as many entries as a position. The pressure error was missing."""
    scene = column(1, 1)
    three = lj.Obstacle(triangles=scene.traction[0].triangles[jnp.array([0, 1, 0])], by=jnp.ones(3))
    assert can_be_refined(replace(scene, physics=(three,)))


@pytest.mark.slow
def test_a_first_pressure_of_each_node_leaves_the_pressures_out_of_the_error():
    """Such pressures are not converted to the refined mesh. The message says what is missing."""
    scene = column(3, 1, dt=1.0)
    first = jnp.zeros(scene.mesh.number_of_nodes)
    scene = replace(scene, porosity=replace(scene.porosity, initial_pressure=first))
    assert not can_be_refined(scene)
    found = lj.simulate(scene, mesh_error=True)
    assert found.mesh_error.pressure is None
    assert "without the error of the fluid's pressures" in mesh_sentence(scene, found)


@pytest.mark.slow
def test_the_estimate_inside_a_traced_function():
    scene = column(2, 1, dt=LONG)

    def top(mu):
        run = lj.simulate(lj.with_parameters(scene, {"law.mu": mu}), mesh_error=True)
        return run.mesh_error.positions[-1, scene.mesh.node_sets["z_max"], 2].mean()

    outside = float(top(SHEAR))
    assert float(jax.jit(top)(SHEAR)) == pytest.approx(outside, rel=1e-5)

    def estimate(x):
        run = lj.simulate(lj.with_parameters(scene, {"mesh.points": x}), mesh_error=True)
        return run.mesh_error.positions

    x = scene.mesh.points
    assert np.allclose(jax.jit(estimate)(x), estimate(x), rtol=1e-5, atol=1e-12)
    with pytest.raises(lj.InputError, match=r"cannot be estimated inside jax\.jit if the mesh is an argument"):
        jax.jit(lambda own: lj.simulate(own, mesh_error=True).positions)(scene)
