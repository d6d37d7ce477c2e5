"""Warnings after a converged run, in the report and in result.h5: unusual sizes, slivers and volume changes."""

import json
from types import SimpleNamespace

import h5py
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.mesh.locate import doubled_vertices
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.scenes.checks.choices import check_choices
from liverjax.simulation.cautions import of_contacts, of_mesh, of_run
from liverjax.simulation.cautions.of_mesh import cautions_of_mesh, mesh_sentence
from liverjax.simulation.cautions.of_run import cautions_of_run
from liverjax.simulation.mesh_error import MeshError
from liverjax.simulation.run import Result
from liverjax.waves.cautions import cautions_of_waves

pytestmark = pytest.mark.quick_to_compile


def scene(mesh: lj.TetMesh, **solve) -> lj.Scene:
    return lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0), solve=lj.Solve(**solve))


def run(mesh: lj.TetMesh, gradients: list[np.ndarray], times: list[float]) -> Result:
    """Return the result of a run that ends every step with a given uniform deformation gradient."""
    positions = np.stack([np.asarray(mesh.points) @ F.T for F in gradients])
    return Result(times=np.array(times), positions=positions, reactions=None, status=None, statistics=None)


BOX = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))


def test_a_failed_run_with_a_sharp_cone_names_its_tip():
    mesh = lj.quadratic(BOX)
    cone = Obstacle(triangles=lj.boundary.boundary_triangles(mesh), shape="cone", position=(0.05, 0.05, 0.1))
    failed, ended = (
        SimpleNamespace(statistics=SimpleNamespace(status=np.array([code])))
        for code in (status.STALLED, status.CONVERGED)
    )
    pressed = replace(scene(mesh), physics=(cone,))
    assert "obstacle.0 is a cone with a sharp tip" in of_contacts.of_sharp_cones(pressed, failed)[0]
    assert not of_contacts.of_sharp_cones(pressed, ended)
    round_tip = replace(pressed, physics=(replace(cone, radius=1e-3),))
    assert not of_contacts.of_sharp_cones(round_tip, failed)
    assert not of_contacts.of_sharp_cones(replace(pressed, mesh=BOX), failed)


def test_a_sound_run_has_none():
    # Values at the bounds are allowed: J = 1/4 and 4 are exact in binary. A box of 1 m is not too long for an organ.
    gradients = [np.diag([0.25, 1.0, 1.0]), np.diag([1.0, 4.0, 1.0])]
    assert cautions_of_run(scene(BOX), run(BOX, gradients, [1.0, 2.0])) == []
    one = lj.shapes.box((1.0, 0.1, 0.1), (1, 1, 1))
    assert cautions_of_run(scene(one), run(one, gradients[:1], [1.0])) == []


@pytest.mark.parametrize(
    ("dt", "grows", "plane"),
    [(0.01, True, False), pytest.param(0.01, True, True, marks=pytest.mark.slow), (0.002, False, False)],
)
def test_motion_that_grows_by_long_steps_of_newmark_is_told(dt, grows, plane):
    """A block with a period of 12 ms is under constant gravity, so its energy is known. With steps of 10 ms it
    grows.
    """
    mesh = lj.shapes.box((0.002, 0.002, 0.006), (1, 1, 3))
    own = _falling(mesh, dt, 85, lj.Body(density=1060.0, gravity=np.array([0.0, 0.0, 40.0])))
    if plane:  # a plane far below
        below = lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_min"])
        own = replace(own, physics=(Obstacle(triangles=jnp.asarray(below), position=jnp.array([0.0, 0.0, -1.0])),))
    assert bool(_grown(own)) == grows


@pytest.mark.slow
@pytest.mark.parametrize(("dt", "grows"), [(0.2, True), (0.02, False)])
def test_motion_that_grows_is_told_for_consistent_masses_too(dt, grows):
    body = lj.Body(density=1060.0, gravity=np.array([6.0, 0.0, -2.0]), mass="consistent")
    own = _falling(lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)), dt, 40, body)
    assert bool(_grown(own)) == grows


def _falling(mesh: lj.TetMesh, dt: float, steps: int, body: lj.Body) -> lj.Scene:
    solve = lj.Solve(kind="dynamic", integrator="newmark", dt=dt, steps=steps)
    return replace(scene(mesh), body=body, fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),), solve=solve)


def _grown(own: lj.Scene) -> list[str]:
    result = lj.simulate(own)
    assert not np.any(result.status)
    return [sentence for sentence in cautions_of_run(own, result) if "exceeds the work of its loads" in sentence]


def test_volumes_name_how_many_which_and_when():
    x = np.asarray(BOX.points)
    result = run(BOX, [np.diag([0.5, 0.08, 1.0]), np.diag([24.0, 1.0, 1.0]), np.eye(3)], [0.1, 0.2, 0.3])
    small, large = cautions_of_run(scene(BOX, dt=0.1), result)
    assert small.startswith("6 of 6 elements shrank below J = 0.2 (worst: element ") and "J = 0.04 at 0.1 s)" in small
    assert large.startswith("6 of 6 elements grew above J = 5 (worst: element ") and "J = 24 at 0.2 s)" in large
    # One node is pushed through. Only its elements are counted, and the worst is found by a separate volume formula.
    moved = x.copy()
    moved[7] = x[0] + 0.05 * (x[7] - x[0])
    tets = np.asarray(BOX.tetrahedra)
    J = np.array([np.dot(*(lambda a, b, c: (np.cross(a, b), c))(*(moved[t[1:]] - moved[t[0]]))) for t in tets])
    J /= 6 * np.asarray(BOX.volumes)
    found = cautions_of_run(scene(BOX), replace(result, positions=moved[None], times=np.array([1.0])))
    worst = int(np.argmin(J))
    assert found[0].startswith(f"{np.sum(J < 0.2)} of 6 elements") and np.sum(J < 0.2) > 0
    assert f"worst: element {worst}, J = {J[worst]:.2g} at load step 1)" in found[0]


def test_long_bodies_and_slivers():
    long = lj.shapes.box((6.0, 3.0, 3.0), (2, 1, 1))
    assert cautions_of_run(scene(long), run(long, [np.eye(3)], [1.0])) == [
        "the body is 6 m long: check the unit of the mesh, e.g. write unit = 'mm'"
    ]
    # Four corners of a square, one lifted by h: volume a^2 h / 6, mean square edge (4 + 2 * 2)/6 a^2 apart from h.
    a, h = 0.1, 1e-4
    flat = lj.tet_mesh([[0, 0, 0], [a, 0, 0], [a, a, h], [0, a, 0]], [[0, 1, 3, 2]])
    quality = 6 * np.sqrt(2) * a * a * h / 6 / ((4 / 3) ** 0.5 * a) ** 3  # up to order (h/a)^2
    (found,) = cautions_of_run(scene(flat), run(flat, [np.eye(3)], [1.0]))
    assert found.startswith("1 of 1 elements are slivers, with a quality below 0.01 (worst: element 0 with ")
    assert f"{quality:.2g}; a regular tetrahedron has 1)" in found


def test_short_bodies_and_nodes_in_one_place():
    short = lj.shapes.box((2e-4, 1e-4, 1e-4), (1, 1, 1))
    assert cautions_of_run(scene(short), run(short, [np.eye(3)], [1.0])) == [
        "the body is 0.0002 m long: check this size, and remove unit if the coordinates of the mesh are in m"
    ]
    x, tets = np.asarray(BOX.points), np.asarray(BOX.tetrahedra)
    two = lj.tet_mesh(np.concatenate([x, x + np.array([0.1, 0, 0])]), np.concatenate([tets, tets + len(x)]))
    (found,) = cautions_of_run(scene(two), run(two, [np.eye(3)], [1.0]))
    assert found.startswith(
        "4 nodes have the same coordinates as another node, up to roundoff, so the body is not connected there"
    )


@pytest.mark.parametrize("shift", [1e-9, 1.5e-8, 8e-7, "float32"])
def test_nodes_in_nearly_one_place_are_told(shift):
    """Vertices that were apart by the roundoff of a file were neither doubled nor hanging."""
    x, tets = np.asarray(BOX.points), np.asarray(BOX.tetrahedra)
    moved = x + np.array([0.21, 0, 0])
    moved = moved.astype(np.float32) if shift == "float32" else moved + np.array([shift, 0, 0])
    both = np.concatenate([x + np.array([0.11, 0, 0]), moved])
    assert doubled_vertices(lj.tet_mesh(both, np.concatenate([tets, tets + len(x)]))) == 4
    fine = lj.shapes.cylinder(0.01, 0.004, 0.0025)
    assert doubled_vertices(lj.tet_mesh(np.asarray(fine.points) + 1e3, fine.tetrahedra)) == 0  # far from the origin


@pytest.mark.parametrize("cells", [(2, 2, 2), (1, 2, 2), (3, 3, 3), (1, 1, 1)])
def test_hanging_nodes_are_told(cells):
    """One cell beside a box with the same outline and n x n cells on the common face: all new nodes on it hang."""
    x, tets = np.asarray(BOX.points), np.asarray(BOX.tetrahedra)
    beside = lj.shapes.box((0.1, 0.1, 0.1), cells)
    both = np.concatenate([x, np.asarray(beside.points) + np.array([0.1, 0, 0])])
    points, number = np.unique(np.round(both, 6), axis=0, return_inverse=True)
    cells_of = number[np.concatenate([tets, np.asarray(beside.tetrahedra) + len(x)])]
    hanging = (cells[1] + 1) * (cells[2] + 1) - 4
    # Six digits of a turned mesh
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0] * [[1, 1, -1]]
    turn *= np.sign(np.linalg.det(turn))
    rounded = np.array([[float(f"{v:.5e}") for v in row] for row in points @ turn.T])
    meshes = [lj.tet_mesh(x, cells_of) for x in (points, rounded)]
    for mesh in (*meshes, lj.quadratic(meshes[0])):
        said = [sentence for sentence in cautions_of_mesh(mesh) if "hanging" in sentence]
        assert [sentence.split(" nodes")[0] for sentence in said] == [str(hanging)] * (hanging > 0)


def test_waves_without_a_mass_are_told():
    push = lj.Traction(triangles=lj.boundary.boundary_triangles(BOX)[:1], value=np.array([0.0, 0.0, 5.0]))
    bare = replace(scene(BOX, kind="harmonic", frequencies=np.array([60.0])), traction=(push,))
    assert cautions_of_waves(bare) == [
        "the scene has no [body], so the body has no inertia: write density = 1060.0 in [body]"
    ]
    heavy = replace(bare, body=lj.Body(density=1060.0))
    (said,) = cautions_of_waves(heavy)
    wave = np.sqrt(float(heavy.law.shear_modulus()) / 1060.0) / 60
    assert said.startswith(f"at 60 Hz shear waves are about {wave:.2g} m long")
    slow = replace(heavy, solve=replace(heavy.solve, frequencies=np.array([1.0])))
    assert cautions_of_waves(slow) == []
    # A soft region has shorter waves.
    soft = lj.Region(elements=np.array([0, 1]), law={"mu": 1e-4 * float(heavy.law.shear_modulus())})
    (said,) = [s for s in cautions_of_waves(replace(slow, region=(soft,))) if "shear waves" in s]
    assert said.startswith(f"at 1 Hz shear waves are about {0.6 * wave:.2g} m long")
    quadratic = lj.quadratic(BOX)
    points = np.full((4, quadratic.number_of_elements), float(heavy.law.shear_modulus()))  # one at each point
    push = replace(push, triangles=lj.boundary.boundary_triangles(quadratic)[:1])
    varied = replace(slow, mesh=quadratic, law=replace(slow.law, mu=points), traction=(push,))
    assert cautions_of_waves(varied) == []


def test_waves_in_a_stiff_part_with_coarse_elements_are_told():
    """Only the elements with the shortest waves were compared with these waves."""
    fine, coarse = lj.shapes.box((0.005, 0.005, 0.005), (1, 1, 1)), lj.shapes.box((0.15, 0.15, 0.15), (1, 1, 1))
    points = np.concatenate([fine.points, np.asarray(coarse.points) + np.array([1.0, 0.0, 0.0])])
    mesh = lj.tet_mesh(points, np.concatenate([fine.tetrahedra, coarse.tetrahedra + len(fine.points)]))
    law = lj.laws.NeoHookean(mu=np.repeat([800.0, 12800.0], fine.number_of_elements), bulk=1e5)
    solve = lj.Solve(kind="harmonic", frequencies=jnp.array([20.0, 1.0]))
    whole = lj.Scene(mesh=mesh, law=law, body=lj.Body(density=1060.0), solve=solve)
    (said,) = [s for s in cautions_of_waves(whole) if "Hz" in s]
    assert said.startswith("at 20 Hz shear waves are about 0.17 m long where the edges of the elements are 0.18 m long")
    slow = replace(whole, solve=replace(solve, frequencies=jnp.array([5.0])))
    assert not any("Hz" in s for s in cautions_of_waves(slow))


@pytest.mark.parametrize(
    ("change", "mu", "hertz", "said"),
    [
        # G*/G0 = 0.101 + 0.034i: the relaxed body has short waves.
        (
            {"viscosity": lj.Prony(ratios=jnp.array([0.9]), relaxation_times=jnp.array([1e-4]))},
            1e4,
            [60.0],
            "at 60 Hz shear waves are about",
        ),
        # |G*/G0| = 6.9: the waves are 45 mm long.
        ({"springpots": lj.SpringpotSeries(times=jnp.array([0.1]), exponents=jnp.array([0.5]))}, 1e3, [60.0], ""),
        ({}, 1e4, [600.0, 60.0, 20.0], "at 600 Hz shear waves are about 0.0051 m long"),
    ],
)
def test_viscosity_makes_waves_shorter_or_longer(change, mu, hertz, said):
    """The length of the waves was that of the elastic body."""
    body, mesh = lj.Body(density=1060.0), lj.shapes.box((0.036, 0.012, 0.012), (3, 1, 1))
    law = lj.laws.NeoHookean(mu=mu, bulk=10 * mu)
    solve = lj.Solve(kind="harmonic", frequencies=jnp.asarray(hertz))
    found = [s for s in cautions_of_waves(lj.Scene(mesh=mesh, law=law, body=body, solve=solve, **change)) if "Hz" in s]
    assert len(found) == bool(said) and all(s.startswith(said) for s in found)


SCENE = """
[mesh]
shape = "box"
size = [3.0, 1.0, 1.0]
cells = [1, 1, 1]
[law]
name = "neo_hookean"
mu = 770.0
bulk = 100.0
[[fixed]]
where = {x_max = 0.0}
[[displaced]]
where = {x_min = 3.0}
by = [21.0, 0.0, 0.0]
[solve]
steps = 7
"""


@pytest.mark.ci
def test_they_stand_in_the_report_and_in_the_results(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    assert main(["simulate", str(tmp_path / "scene.toml"), "--out", str(tmp_path)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("caution: ")]
    assert len(lines) == 2 and "3 m long" in lines[0] and "grew above J = 5" in lines[1] and "load step 7" in lines[1]
    with h5py.File(tmp_path / "result.h5") as file:
        assert [f"caution: {s}" for s in json.loads(file.attrs["warnings"])] == lines


@pytest.mark.parametrize(
    ("times", "history", "told"),
    [
        (
            [0.1, 0.15, 0.3],
            [0.0, 1.0, 0.0],
            "has a peak at 0.15 s between two steps, and the run misses 33 % of this peak",
        ),
        ([0.1, 0.2, 0.3], [0.0, 1.0, 0.0], None),
        (
            [0.0, 0.19, 0.191],
            [1.0, 1.0, 0.0],
            "is not linear within steps, but the run uses only the values at the ends of steps",
        ),
        ([0.0, 0.001], [0.0, 1.0], "is not linear within steps"),
        ([0.0, 0.1], [0.0, 1.0], None),
        ([0.5, 0.9], [0.0, 1.0], "begins at 0.5 s, but the run ends at 0.3 s"),
        ([0.5], [1.0], None),
    ],
)
def test_a_history_that_changes_within_a_step_is_told(times, history, told):
    """Steps end at 0.1, 0.2 and 0.3 s. The run uses the history at these times and is linear in between."""
    top = lj.boundary.boundary_triangles(BOX)[:1]
    value = np.array([0.0, 0.0, 5.0])
    load = lj.Traction(triangles=top, value=value, times=np.array(times), history=np.array(history))
    pulled = replace(scene(BOX, dt=0.1, steps=3), traction=(load,))
    said = cautions_of_run(pulled, run(BOX, [np.eye(3)] * 3, [0.1, 0.2, 0.3]))
    assert [sentence.startswith("the history of traction.0") for sentence in said] == [True] * (told is not None)
    assert told is None or told in said[0]


@pytest.mark.parametrize(("cells", "told"), [(1, True), (20, False)])
def test_a_sphere_between_the_points_of_contact_is_told(cells, told):
    """A sphere of 10 mm is 4 mm deep in a face with triangles of 100 or 5 mm width; the body does not move."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (cells, cells, 1))
    sphere = lj.Obstacle(
        triangles=lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_max"]),
        shape="sphere",
        radius=0.01,
        position=np.array([0.05, 0.05, 0.111]),
        by=np.array([0.0, 0.0, -0.005]),
    )
    said = cautions_of_run(replace(scene(mesh), physics=(sphere,)), run(mesh, [np.eye(3)], [1.0]))
    assert any("m between the points at which contact is tested" in sentence for sentence in said) == told


@pytest.mark.parametrize(
    ("shape", "start", "way", "told"),
    [
        (
            "sphere",
            [0.05, 0.05, 0.125],
            -0.075,
            "obstacle.0 has its centre in the body in step 1. The obstacle moves 0.075",
        ),
        ("sphere", [0.05, 0.05, 0.125], -0.15, "obstacle.0 went through the body in step 1"),
        ("cylinder", [0.05, 0.05, 0.125], -0.075, "obstacle.0 has its centre in the body"),
        ("cylinder", [0.3, 0.05, 0.125], -0.15, "obstacle.0 went through the body"),
        ("sphere", [0.05, 0.05, 0.125], -0.006, None),
        ("cone", [0.05, 0.05, 0.125], -0.15, None),
        ("sphere", [0.15, 0.05, 0.125], -0.15, None),
        ("cylinder", [0.05, 0.15, 0.125], -0.15, None),
    ],
)
def test_an_obstacle_that_passes_the_surface_within_a_step_is_told(shape, start, way, told):
    """A sphere of 20 mm inside a cube of 100 mm touches nothing. Without this warning, the force was 0 N and nothing
    was reported.
    """
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (8, 8, 8))
    obstacle = lj.Obstacle(
        triangles=lj.boundary.boundary_triangles(mesh),
        shape=shape,
        radius=0.02,
        position=np.array(start),
        axis=np.array([1.0, 0.0, 0.0]) if shape == "cylinder" else np.array([0.0, 0.0, 1.0]),
        by=np.array([0.0, 0.0, way]),
    )
    said = cautions_of_run(replace(scene(mesh), physics=(obstacle,)), run(mesh, [np.eye(3)], [1.0]))
    said = [sentence for sentence in said if "it passed the surface between two steps" in sentence]
    assert len(said) == (told is not None)
    assert told is None or said[0].startswith(told)


def sphere(mesh: lj.TetMesh, at: list[float], **more) -> lj.Obstacle:
    """A sphere of 20 mm that may touch the whole surface."""
    triangles = lj.boundary.boundary_triangles(mesh)
    return lj.Obstacle(**{"triangles": triangles, "shape": "sphere", "radius": 0.02, "position": np.array(at)} | more)


def passed(mesh: lj.TetMesh, *physics: lj.Obstacle, positions: np.ndarray | None = None, dt: float = 1.0) -> list[str]:
    """Return the warnings on obstacles that pass the surface of a mesh in one step."""
    result = run(mesh, [np.eye(3)], [1.0])
    result = result if positions is None else replace(result, positions=positions[None])
    said = cautions_of_run(replace(scene(mesh, dt=dt, steps=1), physics=physics), result)
    return [sentence for sentence in said if "it passed the surface between two steps" in sentence]


def test_a_thin_plate_that_a_sphere_goes_through_and_touches_from_below_is_told():
    plate = lj.shapes.box((0.1, 0.1, 0.005), (10, 10, 1))
    assert passed(plate, sphere(plate, [0.05, 0.05, 0.03], by=np.array([0.0, 0.0, -0.045])))
    assert not passed(plate, sphere(plate, [0.05, 0.05, 0.03], by=np.array([0.0, 0.0, -0.012])))


def test_a_body_that_comes_into_the_way_afterwards_is_not_told():
    """The sphere falls beside the body. The body is outside its path at the beginning of the step, and inside at the
    end.
    """
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (4, 4, 4))
    ball = sphere(mesh, [0.15, 0.05, 0.2], by=np.array([0.0, 0.0, -0.3]))
    assert not passed(mesh, ball, positions=np.asarray(mesh.points) + np.array([0.1, 0.0, 0.0]))


def test_an_obstacle_that_another_body_of_the_mesh_stands_in_the_way_of_is_not_told():
    """The triangles of the obstacle belong to the body that it may touch; only this body counts."""
    box = lj.shapes.box((0.1, 0.1, 0.1), (4, 4, 4))
    one, tets = np.asarray(box.points), np.asarray(box.tetrahedra)
    two = one + np.array([0.2, 0.0, 0.0])
    both = lj.tet_mesh(np.concatenate([one, two]), np.concatenate([tets, tets + len(one)]))
    surface = lj.boundary.boundary_triangles(both)
    first, second = surface[surface[:, 0] < len(one)], surface[surface[:, 0] >= len(one)]
    way = np.array([0.0, 0.0, -0.075])
    assert passed(both, sphere(both, [0.05, 0.05, 0.125], by=way, triangles=first))
    assert not passed(both, sphere(both, [0.05, 0.05, 0.125], by=way, triangles=second))


def test_a_history_begins_where_it_begins_beside_a_pressed_obstacle():
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (4, 4, 4))
    history = np.array([[0.0, 0.0, -0.45], [0.0, 0.0, -0.45]])
    below = sphere(mesh, [0.05, 0.05, 0.3], times=np.array([0.0, 1.0]), history=history)
    above = PressedObstacle(
        triangles=lj.boundary.boundary_triangles(mesh), position=np.array([0.0, 0.0, 0.2]), force=np.array([0, 0, -1.0])
    )
    assert not passed(mesh, below) and not passed(mesh, below, above)


def test_a_dent_of_curved_elements_is_outside_of_the_body():
    """The middle node of an edge is 12 mm below the straight edge. A sphere of 10 mm moves into this dent."""
    mesh = lj.quadratic(lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)))
    x = np.array(mesh.points)
    at = int(np.argmin(np.linalg.norm(x - [0.05, 0.025, 0.1], axis=1)))
    x[at, 2] -= 0.012
    ball = sphere(mesh, [0.05, 0.025, 0.2], radius=0.01, by=np.array([0.0, 0.0, -0.102]))
    assert not passed(mesh, ball, positions=x)
    assert passed(mesh, ball)


def test_a_lagged_pressure_that_goes_up_and_down_is_told():
    sponge = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-5, scheme="lagged")
    still = replace(scene(BOX, dt=0.1, steps=6), porosity=sponge)
    times = [0.1 * k for k in range(1, 7)]
    rising = np.linspace(0.5, 1.0, 6)[:, None] * np.ones(BOX.number_of_nodes)
    falling = np.array([0.0, 0.95, 0.05, 0.9, 0.1, 0.8])[:, None] * np.ones(BOX.number_of_nodes)
    for pressure, told in ((rising, False), (falling, True)):
        result = replace(run(BOX, [np.eye(3)] * 6, times), pressure=pressure)
        assert any("scheme = 'lagged' is unstable here" in s for s in cautions_of_run(still, result)) == told


def test_a_body_whose_estimate_is_not_found_is_not_said_to_be_at_rest():
    error = MeshError(positions=np.full((1, 8, 3), 1e-4), reactions=np.zeros((1, 8, 3)), found=np.array([False]))
    result = replace(run(BOX, [np.eye(3)], [1.0]), mesh_error=error, status=np.array([status.CONVERGED]))
    assert "does not move" not in mesh_sentence(scene(BOX), result) and "no estimate was found" in mesh_sentence(
        scene(BOX), result
    )
    two = MeshError(positions=np.full((2, 8, 3), 1e-4), reactions=np.zeros((2, 8, 3)), found=np.array([False, True]))
    done = np.full(2, status.CONVERGED)
    said = mesh_sentence(scene(BOX), replace(run(BOX, [np.eye(3)] * 2, [1.0, 2.0]), mesh_error=two, status=done))
    assert said.startswith("mesh error (estimate, last step)") and "At 1 earlier step no estimate was found" in said
    with pytest.warns(UserWarning, match="not reliable in 1 of 2 steps .the first is step 1."):
        two.change(lambda x, _: x[-1, 0, 0], replace(result, positions=two.positions, reactions=two.reactions))
    nothing = replace(error, positions=np.zeros((1, 8, 3)), found=np.array([True]))
    assert "the body does not move" in mesh_sentence(scene(BOX), replace(result, mesh_error=nothing))
    failed = replace(result, status=np.array([status.NOT_FINITE]))
    assert mesh_sentence(scene(BOX), failed).startswith("the mesh error is unknown, because the last step failed")


def test_quadratic_elements_that_cannot_have_pressures_are_told_that_they_lock():
    """With volumetric = "auto" nothing was said. With "element" the advice was a setting that is refused here."""
    stiff = replace(scene(lj.quadratic(BOX), volumetric="auto"), law=lj.laws.NeoHookean(mu=770.0, bulk=770000.0))
    viscosity = lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([0.1]))
    assert of_mesh.of_locking(stiff) == []  # "auto" chooses "mixed"
    for volumetric in ("auto", "element"):
        viscous = replace(stiff, viscosity=viscosity, solve=lj.Solve(volumetric=volumetric))
        (said,) = of_mesh.of_locking(viscous)
        assert said.endswith("write volumetric = 'mixed' in [solve] and part = 'isochoric' in [viscosity]")
    followed = replace(viscosity, part="isochoric")
    check_choices(replace(stiff, viscosity=followed, solve=lj.Solve(volumetric="mixed")))
    springpots = lj.SpringpotSeries(times=jnp.array([0.01]), exponents=jnp.array([0.3]))
    waves = replace(
        stiff, springpots=springpots, solve=lj.Solve(kind="harmonic", frequencies=[60.0], volumetric="auto")
    )
    assert of_mesh.of_locking(waves)[0].endswith("part = 'isochoric' in [springpots]")
    continued = replace(stiff, law=lj.laws.continued(stiff.law, 0.1))
    assert of_mesh.of_locking(continued)[0].endswith("too stiff: use a finer mesh")


def test_the_locking_warning_uses_the_moduli_of_each_region():
    """The law of the scene was asked, also where a region changes its bulk modulus or replaces it."""
    soft = replace(scene(lj.quadratic(BOX), volumetric="element"), law=lj.laws.NeoHookean(mu=1000.0, bulk=5000.0))
    E = soft.mesh.number_of_elements
    half, stiff = np.arange(E // 2), replace(soft.law, bulk=1e6)
    for law in ({"bulk": 1e6}, stiff):
        (said,) = of_mesh.of_locking(replace(soft, region=(lj.Region(elements=half, law=law),)))
        assert said.startswith("the bulk modulus is 1e+03 times the shear modulus")
    covered = replace(soft, law=stiff, region=(lj.Region(elements=np.arange(E), law=soft.law),))
    assert of_mesh.of_locking(soft) == of_mesh.of_locking(covered) == []


@pytest.mark.parametrize(
    ("precision", "dt", "told"), [("float32", 1e-5, True), ("float32", 1e-3, False), ("float64", 1e-5, False)]
)
def test_a_time_step_too_short_for_float32_is_told(precision, dt, told):
    """The body stood still, and every second step had converged."""
    body = lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -9.81]))
    solve = lj.Solve(kind="dynamic", dt=dt, precision=precision)
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
    falling = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1e3, bulk=1e4), body=body, solve=solve)
    still = SimpleNamespace(positions=np.stack([mesh.points] * 3))
    said = of_run._of_unresolved_motion(falling, still)
    assert [" is too short for float32" in words for words in said] == [True] * told
