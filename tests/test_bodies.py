"""Every physics object in one body, by element order: motion, viscosity and porosity; sweeps, gradients, robust steps.

One body contains all objects, so that few compiled programs test all combinations. In motion it is viscous and porous;
at rest it is elastic. The results of each object are verified in its own tests. Here one body is run in different ways.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements.gradients import volume_ratios
from liverjax.jobs.reactions import reaction_table
from liverjax.physics.attached import ligament, vessel
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.attached.vessel import Vessel
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.porosity import Inlet
from liverjax.physics.sliding_support import SlidingSupport, on_plane
from liverjax.scenes.scene import numbers_at

pytestmark = pytest.mark.quick_to_compile

SIZE = (0.02, 0.01, 0.01)
LAW = lj.laws.NeoHookean(mu=800.0, bulk=4000.0)
LAYER = lj.laws.NeoHookean(mu=1e4, bulk=1e5)
PRONY = lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([0.1]))
#: Two points inside the body.
LINE = np.array([[0.002, 0.004, 0.003], [0.017, 0.006, 0.007]])
TIMES = jnp.array([0.0, 0.05, 0.1])
#: Centre of a ball of 5 mm that touches the top face.
ABOVE = jnp.array([0.012, 0.005, SIZE[2] + 0.005])


def everything(mesh: lj.TetMesh) -> tuple:
    """Return every physics object that has a table in scene files, once."""

    def side(name: str) -> jax.Array:
        return jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets[name]), jnp.int32)

    ball = {"triangles": side("z_max"), "shape": "sphere", "radius": 0.005}
    plate = {"axis": jnp.array([0.0, -1.0, 0.0]), "position": jnp.array([0.0, SIZE[1], 0.0])}
    return (
        ElasticSupport(triangles=side("z_min"), normal=2e4, tangential=1e3),
        on_plane(mesh, np.asarray(mesh.node_sets["y_min"])),
        Membrane(triangles=side("z_min"), thickness=1e-5, law=LAYER),
        ligament.between(mesh, LINE, stiffness=5.0, pre_tension=1e-3),
        vessel.along(mesh, LINE, 5e-4, LAYER),
        Obstacle(triangles=side("z_min"), stiffness=1e5),
        RoughObstacle(triangles=side("y_max"), stiffness=1e6, friction=0.2, by=jnp.array([4e-4, -2e-4, 0.0]), **plate),
        PressedObstacle(**ball, position=ABOVE, stiffness=1e6, force=jnp.array([0.0, 0.0, -2e-3])),
    )


#: Parameters that a sweep varies and that derivatives refer to.
NUMBERS = (
    "support.0.normal",
    "membrane.0.thickness",
    "ligament.0.stiffness",
    "vessel.0.law.mu",
    "obstacle.0.stiffness",
    "obstacle.1.friction",
    "obstacle.1.by",
    "obstacle.2.force",
    "traction.0.history",
    "region.0.law.bulk",
)
#: In a porous body its bulk modulus replaces that of the law, so a change of the law's own value has no effect.
FLUID = ("porosity.inlet.0.flux", "porosity.inlet.1.pressure", "region.1.viscosity.ratios", "region.1.porosity.bulk")


#: For each form: the order of the elements, and their volumetric option.
FORMS = {
    "linear": (1, "element"),
    "linear nodal": (1, "nodal"),
    "linear mixed": (1, "mixed"),
    "quadratic": (2, "element"),
    "quadratic mixed": (2, "mixed"),
}


def at_rest(form: str, **solve) -> lj.Scene:
    """Two steps of an elastic body without inertia."""
    order, volumetric = FORMS[form]
    mesh = lj.shapes.box(SIZE, (2, 1, 1))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    right = jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets["x_max"]))
    pull = lj.Traction(triangles=right, value=jnp.array([20.0, 0.0, -10.0]), times=TIMES, history=TIMES / 0.1)
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=800.0, bulk=4000.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        body=lj.Body(density=1000.0, gravity=(0.0, 0.0, -3.0)),
        traction=(pull,),
        region=(lj.Region(elements=jnp.arange(4), law=replace(lj.laws.typical("ogden"), bulk=jnp.asarray(5e3))),),
        physics=everything(mesh),
        solve=lj.Solve(**{"steps": 2, "dt": 0.05, "tolerance": 1e-11, "volumetric": volumetric} | solve),
    )


def in_motion(form: str) -> lj.Scene:
    """Three steps of a viscous body that falls. With the volume of each element separate, the body is also porous.

    Fluid enters below and at the end.
    """
    scene = at_rest(form, kind="dynamic", steps=3, dt=0.03)
    if FORMS[form][1] != "element":
        own = lj.Region(elements=jnp.arange(6, 9), viscosity={"ratios": jnp.array([0.2])})
        return replace(scene, viscosity=replace(PRONY, part="isochoric"), region=(*scene.region, own))
    below = jnp.asarray(lj.boundary.boundary_triangles(scene.mesh, scene.mesh.node_sets["z_min"]))
    end = np.asarray(scene.mesh.node_sets["x_max"])
    given = Inlet(nodes=jnp.asarray(end[end < scene.mesh.number_of_vertices]), pressure=jnp.asarray(5.0))
    sponge = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-6)
    own = lj.Region(
        elements=jnp.arange(6, 9),
        viscosity={"ratios": jnp.array([0.2])},
        porosity={"bulk": jnp.asarray(500.0)},
    )
    return replace(
        scene,
        viscosity=PRONY,
        porosity=replace(sponge, inlet=(Inlet(triangles=below, flux=jnp.asarray(1e-4)), given)),
        region=(*scene.region, own),
    )


def check_sweep_and_gradient(scene: lj.Scene, numbers: tuple[str, ...]) -> None:
    """Check that the runs of a batch converge and are equal to single runs, and that gradients agree with
    differences.
    """
    lj.check_scene(scene)
    first = {name: jnp.asarray(numbers_at(scene, name)) for name in numbers}

    @jax.jit
    def moved(factors):
        changed = {name: factor * first[name] for name, factor in zip(numbers, factors, strict=True)}
        result = lj.simulate(lj.with_parameters(scene, changed))
        return 1e6 * jnp.mean((result.positions[-1] - scene.mesh.points) ** 2), result.status

    one = jnp.ones(len(numbers))
    (value, status), slopes = jax.jit(jax.value_and_grad(moved, has_aux=True))(one)
    h = np.array([3e-2, 1e-3, 1e-4, 1e-7])
    rows = np.concatenate([sign * h[:, None, None] * np.eye(len(numbers))[None] for sign in (1, -1)])
    lanes, codes = jax.jit(jax.vmap(moved))(
        1 + jnp.asarray(np.concatenate([0 * rows[0, :1], rows.reshape(-1, len(numbers))]))
    )
    assert status.max() == 0 and codes.max() == 0
    assert np.isclose(lanes[0], value, rtol=1e-8)
    plus, minus = np.asarray(lanes[1:]).reshape(2, len(h), len(numbers))
    for k, name in enumerate(numbers):
        errors = np.abs((plus[:, k] - minus[:, k]) / (2 * h) - slopes[k])
        # A residual of 1e-11 changes the value by at least 1e-11 of itself; divided by h, this is 1e-7.
        small = 1e-4 * abs(slopes[k]) + 1e-7 * value
        assert slopes[k] != 0 and errors[1:3].min() < small, (name, slopes[k], errors)
        assert errors[1:3].min() <= errors[0] + small and errors[1:3].min() <= errors[3] + small, (name, errors)


@pytest.fixture(autouse=True)
def without_programs():
    """Empty the caches. A program with all objects needs half a gigabyte, and no two tests share one."""
    yield
    jax.clear_caches()


EVERY_FORM = pytest.mark.parametrize("form", FORMS)


@pytest.mark.slow
@EVERY_FORM
def test_in_motion_with_viscosity_and_fluid_it_sweeps_and_has_gradients(form):
    sponge = FORMS[form][1] == "element"
    check_sweep_and_gradient(in_motion(form), NUMBERS[:-1] + FLUID if sponge else NUMBERS + FLUID[2:3])


@pytest.mark.slow
@EVERY_FORM
def test_at_rest_it_sweeps_and_has_gradients(form):
    check_sweep_and_gradient(at_rest(form), NUMBERS)


def inverted_start(mesh: lj.TetMesh) -> jax.Array:
    """Return positions (V, 3) in which some elements are inverted."""
    noise = {1: 0.6, 2: 0.3}[mesh.order] * SIZE[1] * np.random.default_rng(3).standard_normal(mesh.points.shape)
    start = mesh.points + jnp.asarray(noise).at[mesh.node_sets["x_min"]].set(0.0)
    assert volume_ratios(mesh, start).min() < 0
    return start


@pytest.mark.slow
@pytest.mark.parametrize("form", ["linear", "quadratic", "quadratic mixed"])
def test_robust_steps_find_the_same_from_an_inverted_start(form):
    """Friction and a pressed obstacle are among the objects. The runs begin at rest and from inverted elements."""
    plain, robust = at_rest(form), at_rest(form, robust="projected")
    lj.check_scene(robust)
    rest = lj.simulate(plain).check().positions
    run = jax.jit(lambda start: lj.simulate(robust, start=start))
    for begin in (plain.mesh.points, inverted_start(plain.mesh)):
        assert np.abs(run(begin).check().positions - rest).max() < 1e-7 * SIZE[0]


@pytest.mark.slow
@EVERY_FORM
def test_a_robust_step_minimises_the_energy_of_all(form):
    """In motion, the solver must use an inverted starting point. In one very long step, inertia has no effect.

    Friction depends on the positions at the beginning of the step, so it is left out.
    """
    long = at_rest(form, kind="dynamic", steps=1, dt=1e3, tolerance=1e-9)
    smooth = tuple(p for p in long.physics if not isinstance(p, RoughObstacle))
    plain = replace(long, physics=smooth)
    robust = replace(plain, solve=replace(plain.solve, robust="projected"))
    rest = lj.simulate(plain).check().positions
    result = lj.simulate(robust, start=inverted_start(plain.mesh)).check()
    assert np.abs(result.positions - rest).max() < 1e-6 * SIZE[0]


@pytest.mark.slow
@EVERY_FORM
def test_a_factorisation_finds_the_same(form):
    """The stiffness is non-symmetric because of friction, and has a rank-one part from the pressed obstacle."""
    rest = lj.simulate(at_rest(form)).check().positions
    direct = at_rest(form, linear_solver="direct")
    lj.check_scene(direct)
    assert np.abs(lj.simulate(direct).check().positions - rest).max() < 1e-8 * SIZE[0]


@pytest.mark.slow
@pytest.mark.parametrize("form", ["linear", "quadratic mixed"])
def test_what_holds_the_body_carries_its_loads(form):
    """At rest, the forces of all supports in the table of reactions balance weight and traction."""
    scene = at_rest(form)
    result = lj.simulate(scene).check()
    names, rows = reaction_table(scene, result)
    table = dict(zip(names, rows.T, strict=True))
    carried = np.stack([sum(v for n, v in table.items() if n.endswith(f".{axis}_N")) for axis in "xyz"], axis=1)
    weight = np.array([0.0, 0.0, -3.0]) * 1000.0 * np.prod(SIZE)
    pull = np.array([20.0, 0.0, -10.0]) * SIZE[1] * SIZE[2]
    for step, factor in enumerate((0.5, 1.0)):
        assert np.allclose(carried[step], -(weight + factor * pull), atol=1e-8 * np.abs(weight[2])), step
    assert np.isclose(table["obstacle.2.z_N"][-1], -2e-3, rtol=1e-9)
    assert table["obstacle.2.z_m"][-1] < 0 < table["obstacle.2.depth_m"][-1]
    assert {"fixed.0.x_N", "support.0.z_N", "support.1.y_N", "obstacle.1.x_N"} < set(names)


@pytest.mark.slow
@EVERY_FORM
def test_from_the_shape_before_the_load_it_comes_to_the_given_one(form):
    """The loads have no history and there is no obstacle. All other supports and covers are present."""
    scene = at_rest(form, dt=None)
    pull = replace(scene.traction[0], times=None, history=None)
    still = tuple(p for p in scene.physics if type(p) in (ElasticSupport, SlidingSupport, Membrane, Ligament, Vessel))
    scene = replace(scene, traction=(pull,), physics=still, points_are="loaded")
    lj.check_scene(scene)
    found = lj.unloaded(scene)
    vertices, given = slice(scene.mesh.number_of_vertices), scene.mesh.points
    assert np.abs(found.scene.mesh.points - given)[vertices].max() > 1e-3 * SIZE[0]
    assert np.abs(lj.simulate(scene).check().positions[-1] - given)[vertices].max() < 1e-8 * SIZE[0]
