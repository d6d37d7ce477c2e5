"""Bounds of parameters: one function checks them, for scenes made in Python and from files, before compilation."""

import cProfile
import pstats
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core import bounds
from liverjax.core.struct import replace
from liverjax.physics import porosity, viscosity
from liverjax.physics.attached import vessel
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.porosity import Inlet
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes import scene_checks
from liverjax.scenes.checks.numbers import check_bounds

pytestmark = pytest.mark.quick_to_compile

MESH = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
SOUND = lj.Scene(
    mesh=MESH,
    law=lj.laws.Sum(
        laws=(
            lj.laws.continued(lj.laws.NeoHookean(mu=770.0, bulk=2200.0), 0.1),
            lj.laws.Ogden(mu=(200.0, -30.0), alpha=(2.0, -4.0), bulk=100.0),
        )
    ),
    region=(lj.Region(elements=jnp.array([0, 1]), law={"0.mu": 2000.0}),),
    viscosity=lj.Prony(ratios=jnp.array([0.2, 0.3]), relaxation_times=jnp.array([0.27, 0.03])),
    porosity=lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-5),
    body=lj.Body(density=1060.0),
    fixed=(lj.Fixed(nodes=MESH.node_sets["z_min"]),),
    displaced=(lj.Displaced(nodes=MESH.node_sets["z_max"], by=jnp.zeros(3)),),
    traction=(lj.Traction(triangles=jnp.array([[0, 1, 3]]), pressure=4.0),),
    solve=lj.Solve(dt=0.05, steps=2, newton_iterations=3),
)

#: A dotted name, a value that its field does not allow, and the message.
REFUSED = (
    ("law.0.mu", -1.0, "law.0.mu = -1.0 must be above 0 Pa: give e.g. 770"),
    ("law.0.bulk", float("nan"), "law.0.bulk = nan is not finite: give a number in Pa"),
    ("law.1.alpha.1", 0.0, "law.1.alpha = [2.0, 0.0] must not be 0: give another exponent"),
    ("region.0.law.0.mu", -5.0, "region.0: law.0.mu = -5.0 must be above 0 Pa: give e.g. 770"),
    ("viscosity.relaxation_times", (0.3, 0.0), "viscosity.relaxation_times = [0.3, 0.0] must be above 0 s"),
    ("viscosity.ratios.0", -0.1, "viscosity.ratios = [-0.1, 0.3] must be at least 0: give a larger value"),
    ("porosity.fluid_fraction", 1.5, "porosity.fluid_fraction = 1.5 must be at most 1: give a smaller value"),
    ("porosity.permeability", -1.0, "porosity.permeability = -1.0 must be at least 0 m^4/(N s): give a larger value"),
    ("body.density", -1, "body.density = -1 must be above 0 kg/m^3: give e.g. 1060"),
    ("body.density", "heavy", "body.density = 'heavy' is not a number: give a value in kg/m^3"),
    ("body.gravity", (0.0, 0.0, np.inf), "body.gravity = [0.0, 0.0, inf] is not finite: give a number in m/s^2"),
    ("displaced.0.by.2", np.nan, "displaced.0.by = [0.0, 0.0, nan] is not finite: give a number in m"),
    ("traction.0.pressure", np.nan, "traction.0.pressure = nan is not finite: give a number in Pa"),
    ("fixed.0.nodes.0", -1, "fixed.0.nodes = [-1, "),
    ("solve.dt", -0.1, "solve.dt = -0.1 must be above 0 s: give a larger value"),
    ("solve.tolerance", 0.0, "solve.tolerance = 0.0 must be above 0: give e.g. 1e-08"),
    ("solve.tolerance", 10.0, "solve.tolerance = 10.0 must be at most 0.5: give e.g. 1e-08"),
)
COUNTS = (
    ("steps", 0, "solve.steps = 0 must be a whole number above 0: give 1 or more"),
    ("steps", 2.5, "solve.steps = 2.5 must be a whole number above 0"),
    ("newton_iterations", True, "solve.newton_iterations = True must be a whole number above 0"),
)


def spoiled() -> list:
    """Return every scene with one number out of bounds, and its message."""
    cases = []
    for name, value, sentence in REFUSED:
        cases.append(pytest.param(lj.with_parameters(SOUND, {name: value}), sentence, id=f"{name}={value}"))
    for name, value, sentence in COUNTS:
        scene = replace(SOUND, solve=replace(SOUND.solve, **{name: value}))
        cases.append(pytest.param(scene, sentence, id=f"{name}={value}"))
    return cases


@pytest.mark.parametrize(("scene", "sentence"), spoiled())
def test_scenes_made_in_python_are_refused_before_any_compile(scene, sentence, monkeypatch):
    monkeypatch.setattr(scene_checks, "check_mesh", lambda mesh: pytest.fail("bounds come first"))
    monkeypatch.setattr("liverjax.simulation.run._run", lambda *_: pytest.fail("it was run"))
    for refuse in (lj.check_scene, lj.simulate):
        with pytest.raises(lj.InputError, match=re.escape(sentence)) as caught:
            refuse(scene)
        assert "\n" not in str(caught.value)


def test_a_sound_scene_passes_and_traced_numbers_are_left_alone(monkeypatch):
    monkeypatch.setattr("liverjax.simulation.run._run", lambda scene, *_: scene.law.laws[0].law.mu)
    assert np.asarray(lj.simulate(SOUND)).shape == (MESH.number_of_elements,)

    def traced(mu):
        return jnp.sum(lj.simulate(lj.with_parameters(SOUND, {"law.0.mu": mu, "body.density": mu})))

    assert np.isfinite(jax.jit(jax.grad(traced))(-1.0))
    with pytest.raises(lj.InputError, match=r"law\.0\.bulk"):  # a second parameter with an ordinary value is not traced
        jax.jit(lambda mu: traced(mu) + jnp.sum(lj.simulate(lj.with_parameters(SOUND, {"law.0.bulk": -1.0}))))(1.0)


def test_one_of_many_numbers_is_named_by_its_place():
    density = np.full(MESH.number_of_nodes, 1060.0)
    bounds.check_fields(lj.Body(density=density))
    mu = np.full(1000, 770.0)
    mu[416] = 0.0
    with pytest.raises(lj.InputError, match=r"^law\.mu, number 417 of 1000, = 0 must be above 0 Pa"):
        bounds.check_fields(lj.laws.NeoHookean(mu=mu, bulk=2200.0), "law")
    mu[416], mu[5] = 770.0, np.nan
    with pytest.raises(lj.InputError, match=r"^law\.mu, number 6 of 1000, = nan is not finite"):
        bounds.check_fields(lj.laws.NeoHookean(mu=jnp.asarray(mu), bulk=2200.0), "law")


@lj.struct
class Mine:
    """A user-defined struct with a field without bounds."""

    count: int = lj.static(default=3, lower=2)
    share: Any = lj.param("1", lower=0.0, upper=1.0, default=0.5)
    notes: Any = None


def test_structs_of_a_users_own_are_read_alike():
    bounds.check_fields(Mine(notes="anything"), "mine")
    for of, sentence in (
        (Mine(count=1), "mine.count = 1 must be a whole number above 1: give 2 or more"),
        (Mine(share=(0.5, 1.5)), "mine.share = [0.5, 1.5] must be at most 1: give e.g. 0.5"),
    ):
        with pytest.raises(lj.InputError, match=re.escape(sentence)):
            bounds.check_fields(of, "mine")


def test_a_bound_that_is_misspelt_is_no_bound():
    with pytest.raises(TypeError, match="param has no argument 'lowest': use lower, upper, above, nonzero"):
        lj.param("Pa", lowest=0.0)


def test_parts_of_a_scene_checked_alone_use_the_same_place():
    prony = lj.Prony(ratios=(0.5,), relaxation_times=(np.nan,))
    with pytest.raises(lj.InputError, match=r"viscosity\.relaxation_times = \[nan\] is not finite"):
        viscosity.check_viscosity(prony, SOUND.law)
    with pytest.raises(lj.InputError, match=r"porosity\.bulk = 0 must be above 0 Pa"):
        porosity.check_porosity(replace(SOUND.porosity, bulk=0))
    with pytest.raises(lj.InputError, match="2 values of mu and 1 values of alpha"):
        lj.check_scene(replace(SOUND, region=(), law=lj.laws.Ogden(mu=(1.0, 2.0), alpha=(2.0,), bulk=10.0)))


def test_bounds_are_cheap():
    """The check runs at every call of `simulate`. With this few function calls it takes less than a millisecond."""
    check_bounds(SOUND)
    counted = cProfile.Profile()
    counted.runcall(check_bounds, SOUND)
    calls = pstats.Stats(counted).total_calls
    assert calls < 2500


FINE = lj.quadratic(MESH)
TOP = jnp.asarray(lj.boundary.boundary_triangles(FINE, FINE.node_sets["z_max"]))
LAYER = lj.laws.NeoHookean(mu=1e4, bulk=1e5)
BAR = vessel.along(FINE, np.array([[0.05, 0.05, 0.01], [0.05, 0.06, 0.09]]), 1e-3, LAYER)
FIBRE = Ligament(
    nodes=jnp.array([[7]]), weights=jnp.ones((1, 1)), to=jnp.array([0.1, 0.1, 0.2]), stiffness=1.0, rest_length=0.1
)
#: A triangle of three vertices of the mesh that is not a face of an element. In a quadratic mesh, its edges have no
#: middle nodes.
LOST = jnp.array([[1, 2, 4]])


def _plate(**given) -> dict:
    plane = Obstacle(triangles=TOP, position=jnp.array([0.0, 0.0, 0.2]), axis=jnp.array([0.0, 0.0, -1.0]))
    return {"physics": (replace(plane, **given),)}


def _spring(**given) -> dict:
    return {"physics": (ElasticSupport(**given),)}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"fixed": (lj.Fixed(nodes=jnp.array([999])),)},
            "fixed.0.nodes contains node 999, but the mesh has only the nodes 0 to 26: give node numbers in this range",
        ),
        ({"fixed": (lj.Fixed(nodes=jnp.array([0.0, 1.0])),)}, "fixed.0.nodes has numbers of type float64: give a list"),
        ({"fixed": (lj.Fixed(nodes=TOP),)}, "fixed.0.nodes has shape (2, 3): give a list (n,) of whole node numbers"),
        (
            {"displaced": (lj.Displaced(nodes=jnp.array([27]), by=jnp.zeros(3)),)},
            "displaced.0.nodes contains node 27, but the mesh has only the nodes",
        ),
        (
            {"traction": (lj.Traction(triangles=LOST, pressure=1.0),)},
            "traction.0.triangles contains the triangle [1, 2, 4], which is not a",
        ),
        (
            {"traction": (lj.Traction(triangles=TOP.ravel(), pressure=1.0),)},
            "traction.0.triangles has shape (6,): give",
        ),
        (
            {"porosity": replace(SOUND.porosity, drained=jnp.array([27]))},
            "porosity.drained contains node 27, but the mesh has only the nodes",
        ),
        (
            {"porosity": replace(SOUND.porosity, inlet=(Inlet(nodes=jnp.array([99]), pressure=1.0),))},
            "porosity.inlet.0.nodes contains node 99, but the mesh has only the nodes 0 to 26",
        ),
        (
            {"porosity": replace(SOUND.porosity, inlet=(Inlet(triangles=LOST, flux=1.0),))},
            "porosity.inlet.0.triangles contains the triangle [1, 2, 4], which is not a face of an element",
        ),
        (_plate(triangles=LOST), "obstacle.0.triangles contains the triangle [1, 2, 4], which is not a face"),
        (
            _plate(triangles=jnp.zeros((0, 3), int)),
            "obstacle.0.triangles contains no node: give node numbers from 0 to 7",
        ),
        (_plate(position=jnp.zeros(2)), "obstacle.0.position has shape (2,): give shape (3,)"),
        (_plate(by=jnp.array(0.1)), "obstacle.0.by has shape (): give shape (3,)"),
        (_plate(stiffness=jnp.ones(3)), "obstacle.0.stiffness has shape (3,): give one number or shape (2,)"),
        (
            _plate(times=jnp.array([1.0, 0.0]), history=jnp.zeros((2, 3))),
            "obstacle.0 history must have increasing times, but has 0 s after 1 s: sort the times",
        ),
        (
            _spring(triangles=LOST, normal=1.0),
            "support.0.triangles contains the triangle [1, 2, 4], which is not a face of an element",
        ),
        (_spring(triangles=TOP, normal=jnp.ones(5)), "support.0.normal has shape (5,): give one number or shape (2,)"),
        (
            _spring(nodes=jnp.array([99]), stiffness=1.0),
            "support.0.nodes contains node 99, but the mesh has only the nodes 0 to 26: give node numbers in",
        ),
        (
            _spring(triangles=TOP, normal=1.0, times=jnp.array([0.0, 1.0]), history=jnp.array([1.0, -1.0])),
            "support.0 history = [1.0, -1.0] must be at least 0",
        ),
        ({"physics": (SlidingSupport(nodes=jnp.array([[0, 1]]), axis="z"),)}, "support.0.nodes has shape (1, 2): give"),
        ({"physics": (SlidingSupport(nodes=jnp.array([0]), normal=jnp.ones(2)),)}, "support.0.normal has shape (2,)"),
        (
            {"physics": (Membrane(triangles=LOST, thickness=1e-5, law=LAYER),)},
            "membrane.0.triangles contains the triangle [1, 2, 4], which is not",
        ),
        ({"physics": (Membrane(triangles=TOP, thickness=jnp.ones(3), law=LAYER),)}, "membrane.0.thickness has shape"),
        (
            {"physics": (replace(FIBRE, nodes=jnp.array([7])),)},
            "ligament.0.nodes has shape (1,): give an array (n, m) with the nodes",
        ),
        (
            {"physics": (replace(FIBRE, weights=jnp.ones((2, 1))),)},
            "ligament.0.weights has shape (2, 1): give shape (1",
        ),
        ({"physics": (replace(FIBRE, to=jnp.ones(2)),)}, "ligament.0.to has shape (2,): give shape (3,)"),
        ({"physics": (replace(BAR, enters=BAR.enters[:3]),)}, "vessel.0.enters has shape (3, "),
        (
            {"physics": (replace(BAR, radius=jnp.ones(99)),)},
            "vessel.0.radius has shape (99,): give one number or shape",
        ),
    ],
)
def test_places_and_shapes_made_in_python_are_refused_in_one_sentence(change, sentence):
    """The elements are quadratic. There, a triangle that is not a face would silently use the middle node of another
    edge.
    """
    scene = lj.Scene(
        mesh=FINE, law=LAYER, fixed=(lj.Fixed(nodes=FINE.node_sets["z_min"]),), solve=lj.Solve(dt=0.1, steps=2)
    )
    lj.check_scene(replace(scene, physics=(BAR, FIBRE, *_plate()["physics"])))
    with pytest.raises(lj.InputError, match="^" + re.escape(sentence)) as caught:
        lj.check_scene(replace(scene, **change))
    assert "\n" not in str(caught.value)


PULLED = lj.Scene(
    mesh=MESH,
    law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0),
    viscosity=lj.Prony(ratios=jnp.array([0.5]), relaxation_times=jnp.array([0.05])),
    fixed=(lj.Fixed(nodes=MESH.node_sets["z_min"]),),
    displaced=(lj.Displaced(nodes=MESH.node_sets["z_max"], by=jnp.array([0.0, 0.0, 0.01])),),
    solve=lj.Solve(dt=0.05, steps=2),
)
SPONGE = replace(SOUND.porosity, drained=MESH.node_sets["z_max"])


def _moved(**given) -> dict:
    return {"displaced": (replace(PULLED.displaced[0], **given),)}


#: Meaningless settings. Each of them once ran to the end, with another model, motion or number of nodes.
MEANINGLESS = (
    (
        {"viscosity": replace(PULLED.viscosity, part="volumetric")},
        "viscosity.part = 'volumetric' is not known: use all or",
    ),
    (
        {"viscosity": replace(PULLED.viscosity, scheme="backward-euler")},
        "viscosity.scheme = 'backward-euler' is not known",
    ),
    (
        {"viscosity": lj.Prony(ratios=0.5, relaxation_times=0.1)},
        "viscosity.ratios = 0.5 is one number: give a list with one number per mode",
    ),
    (
        {"law": lj.laws.typical("saint_venant_kirchhoff"), "viscosity": replace(PULLED.viscosity, part="isochoric")},
        "viscosity part = 'isochoric' needs a law with an isochoric part",
    ),
    (
        {"porosity": replace(SPONGE, scheme="Implicit")},
        "porosity.scheme = 'Implicit' is not known: use implicit or lagged",
    ),
    ({"porosity": replace(SPONGE, limit_bulk=300.0)}, "porosity limit_bulk = 300 must be above bulk = 400"),
    ({"porosity": replace(SPONGE, bulk=jnp.array([400.0] * 5 + [2300.0]))}, "porosity limit_bulk = 2200 must be above"),
    (
        {"porosity": replace(SPONGE, drained=jnp.array([1, 990]))},
        "porosity.drained contains node 990, but the mesh has only the nodes 0 to 7",
    ),
    ({"solve": lj.Solve(steps=2)}, "[solve] has no dt, which viscosity needs"),
    ({"solve": lj.Solve(steps=2, kind="dynamic", dt=0.05)}, "[solve] kind = 'dynamic' needs mass"),
    ({"solve": lj.Solve(steps=2, kind="dynamic"), "viscosity": None}, "[solve] kind = 'dynamic' needs dt"),
    (_moved(by=jnp.array([0.01, 0.02])), "displaced.0 'by' has shape (2,): give three numbers in m, or three per node"),
    (_moved(by=jnp.zeros(4)), "displaced.0 'by' has shape (4,)"),
    (_moved(by=[0.01, 0.02]), "displaced.0 'by' has shape (2,)"),
    (_moved(by=0.01), "displaced.0 'by' has shape ()"),
    (_moved(by=jnp.zeros((3, 3))), "displaced.0 'by' has shape (3, 3)"),
    (_moved(nodes=jnp.array([4, 700])), "displaced.0.nodes contains node 700, but the mesh has only the nodes 0 to 7"),
    (_moved(axes="XYZ"), "displaced.0 axes = 'XYZ' is not known: give one or more of the letters x, y and z"),
    ({"fixed": (lj.Fixed(nodes=jnp.array([0, 1]), axes=""),)}, "fixed.0 axes = '' is not known"),
    ({"fixed": (lj.Fixed(nodes=jnp.array([0.0, 1.0])),)}, "fixed.0.nodes has numbers of type float64"),
    (
        {"traction": (lj.Traction(triangles=jnp.array([[0, 1, 30]]), pressure=4.0),)},
        "traction.0.triangles contains node 30",
    ),
    (
        {"physics": (Obstacle(triangles=jnp.array([[0, 1, 3]]), shape="Plane", position=jnp.zeros(3)),)},
        "obstacle.0.shape",
    ),
    (
        {"physics": (Obstacle(triangles=jnp.array([[0, 1, 3]]), axis=jnp.array([0, 0, 2.0])),)},
        "obstacle.0 axis = [0. 0. 2.] must be of length 1",
    ),
    (
        {"region": (lj.Region(elements=np.array([0, 1]), law=PULLED.law), lj.Region(elements=[1], law={"mu": 3.0}))},
        "region.1 changes parameters of elements whose whole law is given by region.0",
    ),
    (
        {"physics": (SlidingSupport(nodes=jnp.array([0]), axis="Z"),)},
        "support.0.axis = 'Z' is not known: use x, y or z",
    ),
    (
        {"mesh": lj.tet_mesh(np.asarray(MESH.points), np.asarray(MESH.tetrahedra)[:, [1, 0, 2, 3]])},
        "the mesh has 6 elements",
    ),
)


@pytest.mark.parametrize(("change", "sentence"), MEANINGLESS, ids=[sentence[:40] for _, sentence in MEANINGLESS])
def test_runs_refuse_what_means_nothing(change, sentence):
    with pytest.raises(lj.InputError, match="^" + re.escape(sentence)):
        lj.simulate(replace(PULLED, **change))


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"law.mu": [770.0, -100.0]}, "parameter set 1 (counted from 0): law.mu = -100.0 must be above 0 Pa"),
        (
            {"viscosity.ratios.0": [0.5, 1.7]},
            "parameter set 1 (counted from 0): viscosity.ratios = [1.7] must be at most 1",
        ),
        (
            {"displaced.0.by": [[0.01, 0.02], [0.0, 0.01]]},
            "parameter set 0 (counted from 0): displaced.0 'by' has shape (2,)",
        ),
    ],
)
def test_every_lane_of_a_batch_is_checked(parameters, sentence):
    with pytest.raises(lj.InputError, match="^" + re.escape(sentence)):
        lj.simulate_batch(PULLED, parameters)


def test_numbers_to_differentiate_by_are_checked():
    with pytest.raises(lj.InputError, match=r"^law\.bulk = -500\.0 must be above 0 Pa"):
        lj.value_and_gradient(lambda result: result.reactions.sum(), PULLED, {"law.bulk": -500.0})


def _turned(about_end: bool) -> np.ndarray:
    """Return displacements (n, 3) along x: a rotation of the nodes of x_max about their edge at z = 0, or at z
    = 0.1.
    """
    z = np.asarray(MESH.points)[np.asarray(MESH.node_sets["x_max"]), 2]
    return np.stack([0.1 * (z - (z.max() if about_end else 0.0)), 0 * z, 0 * z], axis=1)


@pytest.mark.parametrize(
    ("by", "refused"),
    [((0.01, 0.0, 0.0), True), ((0.0, 0.0, 0.0), False), (_turned(False), False), (_turned(True), True)],
)
def test_nodes_that_are_fixed_are_not_moved_before_a_run(by, refused):
    """A displacement of 0 contradicts nothing. Any other displacement would silently override the fixed nodes."""
    mesh = MESH
    moved = lj.Displaced(nodes=mesh.node_sets["x_max"], by=jnp.array(by))
    held = lj.Fixed(nodes=mesh.node_sets["z_min"])
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=800.0, bulk=4000.0), fixed=(held,), displaced=(moved,))
    if refused:
        with pytest.raises(lj.InputError, match=r"fixed.0 and displaced.0 both prescribe node \d+ along x"):
            scene_checks.check_before_run(scene)
    else:
        scene_checks.check_before_run(scene)
    scene_checks.check_before_run(replace(scene, fixed=(replace(held, axes="yz"),)))
