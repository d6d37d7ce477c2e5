"""Scenes made in Python with wrong nodes, triangles, weights or shapes: one sentence instead of a wrong number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.porosity import Inlet
from liverjax.physics.rigid_plate import RigidPlate
from liverjax.scenes.scene_checks import check_before_run
from liverjax.simulation.equations import initial_state

pytestmark = pytest.mark.quick_to_compile

MESH = lj.shapes.box((0.02, 0.02, 0.02), (2, 2, 2))
POINTS, E = np.asarray(MESH.points), MESH.number_of_elements
LAW = lj.laws.NeoHookean(mu=770.0, bulk=7700.0)
TOP = np.asarray(MESH.node_sets["z_max"])
FACES = lj.boundary.boundary_triangles(MESH, TOP)
INNER = np.array([[13, 12, 3]])  # between two elements
PLATE = RigidPlate(nodes=TOP, turn=1e-4, by="torque", centre=(0.01, 0.01, 0.0))
SPONGE = lj.Porosity(bulk=10.0, limit_bulk=100.0, fluid_fraction=0.5, permeability=1e-9)


def scene(**parts):
    bottom = lj.Fixed(nodes=MESH.node_sets["z_min"])
    return lj.Scene(**{"mesh": MESH, "law": LAW, "fixed": (bottom,)} | parts)


def pressed(triangles):
    return scene(traction=(lj.Traction(triangles=triangles, pressure=50.0),))


def held(physics):
    return scene(physics=(physics,))


WRONG = {
    "traction.0.triangles: the triangle .* points inward or lies inside": lambda: pressed(FACES[:, ::-1]),
    "points inward or lies inside the body": lambda: pressed(INNER),
    "traction.0.triangles contains the triangle .* more than once": lambda: pressed(np.vstack([FACES, FACES[:1]])),
    "traction.0.triangles has shape \\(3, 8\\)": lambda: pressed(FACES.T),
    "plate.0.nodes contains node .* more than once": lambda: held(replace(PLATE, nodes=FACES.ravel())),
    "plate.0.nodes has numbers of type float": lambda: held(replace(PLATE, nodes=TOP + 0.0)),
    "plate.0.centre has shape": lambda: held(replace(PLATE, centre=(0.01, 0.01))),
    "support.0.nodes contains node .* more than once": lambda: held(
        ElasticSupport(nodes=FACES.ravel(), stiffness=10.0)
    ),
    "ligament.0.weights of each fibre must add up to 1": lambda: held(
        Ligament(nodes=np.array([[2], [1]]), weights=np.ones((2, 1)), to=(0, 0, 0.05), stiffness=10.0, pre_tension=0.01)
    ),
    "displaced.0.nodes contains node 26 more than once": lambda: scene(
        displaced=(lj.Displaced(nodes=np.array([26, 26]), by=np.array([[0, 0, 1e-3], [0, 0, 2e-3]])),)
    ),
    "has gravity, and also a history of gravity": lambda: scene(
        body=lj.Body(density=1e3, gravity=(0, 0, -9.81), times=[0, 1], history=np.zeros((2, 3)))
    ),
    "porosity.inlet.0 history must have increasing times": lambda: scene(
        porosity=replace(SPONGE, inlet=(Inlet(nodes=TOP, pressure=1.0, times=[0, 3, 1], history=[1, 2, 3.0]),))
    ),
    "porosity.inlet.0 needs nodes for a pressure": lambda: scene(
        porosity=replace(SPONGE, inlet=(Inlet(nodes=TOP, flux=1.0),))
    ),
    "region.0 has element numbers of type bool": lambda: scene(
        region=(lj.Region(elements=np.arange(E) < 5, law=lj.laws.NeoHookean(mu=1.0, bulk=2.0)),)
    ),
    "by = .* is not a number": lambda: scene(
        displaced=(lj.Displaced(nodes=TOP, by=np.array([0, 0, 1e-5 + 1e-5j])),),
    ),
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_scene_gets_one_sentence_before_a_run(words):
    with pytest.raises(lj.InputError, match=words) as caught:
        check_before_run(WRONG[words]())
    assert "\n" not in str(caught.value)


CALLS = {
    "F has shape \\(2, 2\\)": lambda: LAW.energy(jnp.eye(2)),
    "F has shape \\(3, 3, 4\\)": lambda: LAW.first_piola(jnp.ones((3, 3, 4))),
    "boundary_triangles: nodes has numbers of type bool": lambda: lj.boundary.boundary_triangles(
        MESH, POINTS[:, 2] > 0
    ),
    "refined: near contains node 500": lambda: lj.refined(MESH, near=[500]),
    "rim: nodes has numbers of type bool": lambda: lj.rim(MESH, POINTS[:, 2] > 0),
    "the set 'a' has numbers of type float": lambda: lj.tet_mesh(POINTS, MESH.tetrahedra, {"a": [0.5]}),
    "history = .* is not an array of numbers": lambda: lj.Displaced(nodes=[0], times=[0, 1], history=[[0, 0], [1]]),
    "box size has 2 numbers": lambda: lj.shapes.box((0.1, 0.1), (2, 2, 2)),
    "first = 0 must be 1 or more": lambda: lj.simulation.run.simulate_part(scene(), initial_state(scene()), 0, 1),
    "needs: give the time step": lambda: lj.simulate(held(replace(PLATE, times=[0, 1], turn=[0, 1e-4]))),
    "parameter set 1 .* must be of length 1": lambda: lj.simulate_batch(
        held(lj.Obstacle(triangles=FACES, axis=jnp.array([0, 0, -1.0]), position=(0, 0, 0.03))),
        {"obstacle.0.axis": jnp.array([[0, 0, -1.0], [0, 0, -2.0]])},
    ),
    "body.gravity has shape \\(\\): give 3 numbers, or name one .* body.gravity.2": lambda: lj.value_and_gradient(
        lambda result: jnp.sum(result.positions), scene(body=lj.Body(density=1e3)), {"body.gravity": -9.81}
    ),
    # Gravity is 0, but inside jit the function cannot know this.
    "body.gravity is unknown inside jit, .* or give porosity.drained": lambda: jax.eval_shape(
        lambda own: lj.harmonic(own, [5.0]).displacement,
        scene(porosity=SPONGE, body=lj.Body(density=1e3, gravity=(0.0, 0.0, 0.0))),
    ),
}


@pytest.mark.parametrize("words", CALLS)
def test_a_wrong_argument_gets_one_sentence(words):
    with pytest.raises(lj.InputError, match=words) as caught:
        CALLS[words]()
    assert "\n" not in str(caught.value)


def test_right_scenes_pass():
    for own in (pressed(FACES), held(PLATE), scene(body=lj.Body(density=1e3, times=[0, 1], history=np.zeros((2, 3))))):
        check_before_run(own)
    check_before_run(scene(traction=(lj.Traction(triangles=FACES[:, ::-1], value=(0.0, 0.0, 50.0)),)))


@pytest.mark.ci
def test_masks_and_lists_are_taken_as_their_numbers():
    mask, half = POINTS[:, 2] < 1e-9, np.arange(E) < 5
    mesh = lj.tet_mesh(POINTS, MESH.tetrahedra, {"bottom": mask}, {"half": half})
    assert np.array_equal(mesh.node_sets["bottom"], np.flatnonzero(mask))
    assert np.array_equal(mesh.element_sets["half"], np.arange(5))
    assert isinstance(lj.Fixed(nodes=[0, 1]).nodes, np.ndarray) and lj.Fixed(nodes=[]).nodes.dtype.kind == "i"
    moved = lj.Displaced(nodes=[0], by=(0.0, 0.0, 1e-3), times=[0, 1], history=[0, 1])
    assert moved.history.dtype.kind == "f"
    traced = jax.jit(lambda a: lj.Displaced(nodes=[0], times=[0.0, 1.0], history=[[0, 0, 0], [0, 0, a]]).history)
    np.testing.assert_array_equal(traced(2.0), [[0, 0, 0], [0, 0, 2]])
    load = lj.Traction(triangles=FACES.tolist(), value=(0.0, 0.0, 50.0))
    own = scene(fixed=(lj.Fixed(nodes=np.flatnonzero(mask).tolist()),), traction=(load,))
    exact = lj.simulate(scene(traction=(replace(load, value=jnp.array([0.0, 0.0, 50.0])),))).check().positions
    np.testing.assert_array_equal(jax.jit(lj.simulate)(own).positions, exact)


def test_tuples_are_histories_as_lists_are():
    """Times and histories in tuples passed the checks, and then the run ended with a TypeError."""
    rows = {"times": (0.0, 1.0), "history": (0.0, 1.0)}
    path = ((0.0, 0.0, 0.0), (0.0, 0.0, -1e-3))
    inlet = Inlet(nodes=tuple(TOP.tolist()), pressure=1.0, **rows)
    own = scene(
        body=lj.Body(density=1e3, gravity=(0.0, 0.0, -1.0), **rows),
        traction=(lj.Traction(triangles=FACES, value=(0.0, 0.0, 5.0), **rows),),
        displaced=(lj.Displaced(nodes=(int(TOP[0]),), times=(0.0, 1.0), history=path),),
        porosity=replace(SPONGE, inlet=(inlet,)),
        physics=(lj.Obstacle(triangles=FACES, axis=(0.0, 0.0, -1.0), position=(0.0, 0.0, 0.03), by=path[1], **rows),),
        solve=lj.Solve(dt=0.1, steps=1),
    )
    check_before_run(own)
    values = {
        "traction.0.times": jnp.array([0.0, 2.0]),
        "body.times.1": 2.0,
        "displaced.0.history.1.2": -2e-3,
        "porosity.inlet.0.history.1": 0.5,
        "obstacle.0.history": jnp.array([0.0, 0.5]),
    }
    jax.eval_shape(lambda at: lj.simulate(lj.with_parameters(own, at)).positions, values)
