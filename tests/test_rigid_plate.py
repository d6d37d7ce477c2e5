"""A rigid plate as a physics object of scenes: its circular motion, the rheometer as a scene, derivatives, invalid
input.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liverjax as lj
from fitting.rigs import torsion
from fitting.rigs.torsion import Drive
from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.core.struct import in_precision, replace
from liverjax.mesh.cylinders import graded_cylinder
from liverjax.mesh.nodal import nodal_volumes
from liverjax.physics.base import Step
from liverjax.physics.rigid_plate import RigidPlate
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.checks.rigid_motion import check_held

pytestmark = pytest.mark.quick_to_compile


@pytest.fixture(scope="module")
def rig():
    return torsion.make_rig(cell_size=0.008)


def _plate(rig, **given):
    n = rig.mesh.number_of_nodes
    return RigidPlate(**({"nodes": jnp.arange(n - rig.top, n), "turn": 0.5} | given))


def _step(rig, x):
    return Step(rig.mesh, x, 1, 1, None, False, 1e-8, None)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
def test_unknowns_stand_for_positions_on_the_circle(rig, axis):
    """Rodrigues' formula turns the nodes by 2.5 rad about an arbitrary axis. The unknowns are recovered from the
    positions.
    """
    e, c, a = np.array(axis), np.array([1e-3, -2e-3, 5e-3]), 2.5
    plate = _plate(rig, axis=axis, centre=tuple(c), by="torque", lifts=True)
    X = np.asarray(rig.mesh.points)
    W = np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])
    Q = np.eye(3) + np.sin(a) * W + (1 - np.cos(a)) * W @ W
    turned = jnp.asarray((X - c) @ Q.T + c + 3e-4 * e)
    tied = plate.tied(_step(rig, rig.mesh.points))
    x = tied.placed(tied.unknown(jnp.asarray(X), turned), 1.0)
    nodes = np.asarray(plate.nodes)
    assert np.allclose(x[nodes], turned[nodes], rtol=0, atol=1e-16 / 1e-2)
    assert np.array_equal(x[: nodes[0]], X[: nodes[0]])
    assert np.isclose(tied.angle(turned), a, rtol=1e-13) and np.isclose(tied.lift(turned), 3e-4, rtol=1e-10)
    # Forces at x do work on the motions at x: the difference quotient of f . x along the field.
    rng = np.random.default_rng(0)
    f, direction = jnp.asarray(rng.normal(size=X.shape)), jnp.asarray(rng.normal(size=X.shape))
    q, h = tied.unknown(jnp.asarray(X), turned), 1e-6
    up, down = (jnp.sum(f * tied.placed(q + s * h * direction, 1.0)) for s in (1, -1))
    assert np.isclose(jnp.sum(tied.gathered(f, turned) * direction), (up - down) / (2 * h), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("lifts", [False, True])
def test_a_given_turn_with_newmark_does_not_oscillate(lifts):
    """The plate once had the average acceleration of free nodes. Its torque changed sign at every step, and grew."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
    low, top = mesh.node_sets["z_min"], mesh.node_sets["z_max"]
    arm = np.asarray(mesh.points)[top] - [0.05, 0.05, 0.1]
    times, T, turn = jnp.array([0.0, 0.2]), 0.2, 0.02

    def torques(steps: int, **moved) -> np.ndarray:
        scene = lj.Scene(
            mesh=mesh,
            law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0),
            body=lj.Body(density=1060.0),
            fixed=(lj.Fixed(nodes=low),),
            solve=lj.Solve(kind="dynamic", integrator="newmark", dt=T / steps, steps=steps, tolerance=1e-9),
            **moved,
        )
        f = np.asarray(lj.simulate(scene).check().reactions)[:, top]
        return np.cross(arm, f)[..., 2].sum(axis=1)

    plate = RigidPlate(
        nodes=jnp.asarray(top),
        turn=turn * jnp.arange(2.0),
        times=times,
        centre=(0.05, 0.05, 0.1),
        axis=(0.0, 0.0, 1.0),
        lifts=lifts,
    )
    found = torques(10, physics=(plate,))
    by = turn * np.stack([-arm[:, 1], arm[:, 0], 0 * arm[:, 0]], axis=1)
    drawn = lj.Displaced(nodes=jnp.asarray(top), by=jnp.asarray(by), times=times, history=jnp.arange(2.0))
    exact = torques(10, displaced=(drawn,))
    # Straight paths, undeformed arms, and a lift that `drawn` lacks change torques in the second order of the angle.
    assert np.abs(found - exact).max() < 5 * turn**2 * exact.max()


PRONY = lj.Prony(ratios=jnp.array([0.5]), relaxation_times=jnp.array([0.1]))
CASES = [
    pytest.param("angle", None, None, marks=pytest.mark.slow, id="elastic"),
    pytest.param("angle", PRONY, None, marks=pytest.mark.slow, id="viscous"),
    pytest.param("torque", PRONY, None, marks=pytest.mark.slow, id="torque"),
    pytest.param("angle", PRONY, 1000.0, marks=pytest.mark.slow, id="inertia"),
]


@pytest.mark.parametrize(("by", "prony", "density"), CASES)
def test_the_rheometer_is_a_scene_too(rig, by, prony, density):
    """Both give the same numbers: angle, torque and lift, at a strain of a tenth."""
    law = lj.laws.typical("neo_hookean")
    rig = replace(rig, density=density, free_height=True)
    omega, strain = 2 * np.pi, 0.1
    amplitude = strain * 0.4 if by == "angle" else torsion.torque_for_strain(rig, 500.0, strain)
    drive = Drive(steps=8, by=by, start="rest", cycles=1)
    run = torsion.oscillate(rig, law, prony, omega, amplitude, drive)
    scene = torsion.scene_of(rig, law, prony, omega, amplitude, drive)
    result = lj.simulate(scene)
    assert result.status.max() == 0 and run.statistics.status.max() == 0
    at_rest = scene.physics[0].at_rest(rig.mesh)
    angle, lift = (np.array([getattr(at_rest, name)(x) for x in result.positions]) for name in ("angle", "lift"))
    size = np.abs(run.angle).max()
    assert np.allclose(angle[-8:], run.angle[1:], rtol=0, atol=1e-8 * size)
    assert np.allclose(lift[-8:], run.lift[1:], rtol=0, atol=1e-7 * np.abs(run.lift).max())
    if by == "angle":
        pairs = zip(result.positions[-8:], result.reactions[-8:], strict=True)
        torque = np.array([at_rest.torque(x, f) for x, f in pairs])
        assert np.allclose(torque, run.torque[1:], rtol=0, atol=1e-7 * np.abs(run.torque).max())


@pytest.mark.slow
def test_the_derivative_of_a_turned_body(rig):
    """The angle under a torque, 0.5 rad, is differentiated with respect to mu and compared with central differences."""
    plate = _plate(rig, turn=jnp.array([0.0, 3e-3]), times=jnp.array([0.0, 1.0]), by="torque")
    law = lj.laws.NeoHookean(mu=770.0, bulk=7700.0)
    scene = lj.Scene(
        mesh=rig.mesh,
        law=law,
        fixed=(lj.boundary.Fixed(nodes=jnp.arange(rig.bottom)),),
        physics=(plate,),
        solve=lj.Solve(dt=1.0, steps=1, tolerance=1e-11),
    )

    @jax.jit
    def angle(mu):
        return plate.at_rest(rig.mesh).angle(lj.simulate(lj.with_parameters(scene, {"law.mu": mu})).positions[-1])

    found = jax.jit(jax.grad(angle))(770.0)
    errors = [abs((angle(770 + h) - angle(770 - h)) / (2 * h) / found - 1) for h in (30.0, 1.0, 1e-9)]
    assert angle(770.0) > 0.3 and errors[1] < 1e-5 and errors[1] < min(errors[0], errors[2])


@pytest.mark.slow
def test_the_derivative_of_a_turned_body_with_pressures():
    """The derivative's linear solves took conjugate gradients for a matrix that is not positive definite: NaN."""
    mesh = lj.shapes.box((0.1, 0.1, 0.15), (2, 2, 2))
    nodes = {name: jnp.asarray(mesh.node_sets[name]) for name in ("z_min", "z_max")}
    plate = RigidPlate(nodes=nodes["z_max"], turn=0.02, by="torque", lifts=True, centre=(0.05, 0.05, 0.0))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1000.0, bulk=2e4),
        fixed=(lj.Fixed(nodes=nodes["z_min"]),),
        physics=(plate,),
        solve=lj.Solve(volumetric="mixed"),
    )

    @jax.jit
    def angle(mu):
        return plate.at_rest(mesh).angle(lj.simulate(lj.with_parameters(scene, {"law.mu": mu})).positions[-1])

    found = jax.grad(angle)(1000.0)
    assert np.isclose(found, (angle(1001.0) - angle(999.0)) / 2, rtol=1e-5)


REFUSED = {
    "by = 'force' is not known: use angle or torque": {"by": "force"},
    "must be of length 1": {"axis": (0.0, 0.0, 2.0)},
    "needs ascending times": {"turn": (0.0, 1.0), "times": (1.0, 1.0)},
    "fewer than two nodes": {"nodes": jnp.array([3])},
}


@pytest.mark.parametrize("sentence", REFUSED)
def test_what_no_plate_can_use_is_refused(rig, sentence):
    with pytest.raises(lj.InputError, match=sentence):
        plate = _plate(rig, **REFUSED[sentence])
        bounds.check_fields(plate, "plate.0")
        plate.check(rig.mesh, "plate.0")


def test_what_else_holds_or_moves_the_nodes_of_a_plate_is_refused(rig):
    """These settings had no effect, without a message."""
    law, plate = lj.laws.typical("neo_hookean"), _plate(rig)
    low = lj.Fixed(nodes=jnp.arange(rig.bottom))
    also = (
        ("displaced", (lj.Displaced(nodes=plate.nodes[:3], by=jnp.array([0.0, 0.0, 1e-3]), axes="z"),), "displaced.0"),
        ("fixed", (low, lj.Fixed(nodes=plate.nodes[-1:])), "fixed.1"),
        ("physics", (plate, _plate(rig, turn=0.1)), "plate.0"),
        ("physics", (plate, SlidingSupport(nodes=plate.nodes, axis="z")), "support.0"),
    )
    for key, parts, name in also:
        scene = lj.Scene(**{"mesh": rig.mesh, "law": law, "physics": (plate,), "fixed": (low,), key: parts})
        for refuses in (lj.check_scene, lj.simulate):
            with pytest.raises(lj.InputError, match=rf"plate.[01] and {name} share node .* select different nodes"):
                refuses(scene)


def test_a_torque_without_times_grows_with_the_load_steps(rig):
    plate = _plate(rig, turn=3e-3, by="torque")
    for k, (before, after) in ((1, (0.0, 1e-3)), (3, (2e-3, 3e-3))):
        tied = plate.tied(_step(rig, rig.mesh.points)._replace(k=k, steps=3))
        assert np.allclose((tied.before, tied.after), (before, after), rtol=1e-14)
    tied = plate.tied(_step(rig, rig.mesh.points)._replace(dt=0.1))
    assert tied.before == tied.after == 3e-3


@pytest.mark.ci
def test_a_torque_turns_far_in_one_step():
    """Within a step the tangent had the directions of its beginning. A turn of 0.33 rad took 151 iterations and three
    cuts, and a turn of 0.25 rad of quadratic elements failed."""
    mesh = graded_cylinder(np.array([0.0, 0.005, 0.01]), np.array([0.0, 0.005, 0.01]))
    height = np.asarray(mesh.points)[:, 2]
    top, low = (jnp.asarray(np.flatnonzero(np.isclose(height, z))) for z in (0.01, 0.0))
    plate = RigidPlate(nodes=top, turn=1.8e-3, by="torque", lifts=True)
    law = lj.laws.NeoHookean(mu=1000.0, bulk=4000.0)
    scene = lj.Scene(mesh=mesh, law=law, fixed=(lj.Fixed(nodes=low),), physics=(plate,), solve=lj.Solve(steps=2))
    runs = [lj.simulate(replace(scene, solve=lj.Solve(steps=steps))).check() for steps in (2, 8)]
    assert int(runs[0].statistics.cuts.sum()) == 0 and np.all(np.asarray(runs[0].statistics.iterations) < 10)
    few, many = (np.asarray(run.positions)[-1] for run in runs)
    assert np.abs(few - many).max() < 1e-7 * np.abs(many - np.asarray(mesh.points)).max()


def test_a_factorisation_is_refused(rig):
    scene = lj.Scene(
        mesh=rig.mesh,
        law=lj.laws.typical("neo_hookean"),
        physics=(_plate(rig),),
        solve=lj.Solve(linear_solver="direct"),
    )
    with pytest.raises(lj.InputError, match="cannot be used with a rigid plate: use linear_solver = 'cg'"):
        lj.simulate(scene)


@pytest.mark.ci
def test_a_plate_swings_as_a_pendulum_with_second_order():
    """The amplitude is above 2 rad. When Newmark's method was applied to each node alone, the acceleration towards the
    axis was missing: the error grew, and steps failed.
    """
    mesh, ends = lj.shapes.box((0.02, 0.03, 0.08), (1, 1, 2)), 1.4
    centre, tilted = np.array([0.01, 0.0, 0.08]), 9.81 * np.array([np.sin(1.0), 0.0, -np.cos(1.0)])
    mass, arm = 1000 * np.asarray(nodal_volumes(mesh)), np.asarray(mesh.points) - centre
    inertia, first = np.sum(mass * (arm[:, 0] ** 2 + arm[:, 2] ** 2)), mass @ arm

    def motion(_, y):
        c, s = np.cos(y[0]), np.sin(y[0])
        turned = np.array([c * first[0] + s * first[2], 0.0, c * first[2] - s * first[0]])
        return [y[1], np.cross(turned, tilted)[1] / inertia]

    exact = solve_ivp(motion, (0, ends), [0.0, 0.0], rtol=1e-10, atol=1e-12).y[0, -1]
    axis = jnp.array([0.0, 1.0, 0.0])
    plate = RigidPlate(nodes=jnp.arange(len(mass)), turn=0.0, axis=axis, centre=jnp.asarray(centre), by="torque")
    errors = []
    for steps in (140, 280):
        scene = lj.Scene(
            mesh=mesh,
            law=lj.laws.NeoHookean(mu=1e3, bulk=2e3),
            body=lj.Body(density=1000.0, gravity=jnp.asarray(tilted)),
            physics=(plate,),
            solve=lj.Solve(kind="dynamic", integrator="newmark", dt=ends / steps, steps=steps),
        )
        x = lj.simulate(scene).check().positions[-1]
        errors.append(abs(float(plate.at_rest(mesh).angle(x)) - exact))
    assert abs(exact) > 0.9 and errors[1] < 0.01 and 3.5 < errors[0] / errors[1] < 4.5


#: Angle [rad] and torque [N m] of `_turned` with 5 x 5 x 5 cells and quadratic elements.
FINE = {"torque": 0.035425748, "angle": 0.0033873518}


def _turned(by: str) -> tuple[lj.Scene, RigidPlate]:
    mesh = lj.quadratic(lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)))
    turn, centre = 0.004 if by == "torque" else 0.03, jnp.array([0.05, 0.05, 0.1])
    plate = RigidPlate(nodes=mesh.node_sets["z_max"], turn=turn, centre=centre, by=by, lifts=True)
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        physics=(plate,),
        solve=lj.Solve(tolerance=1e-9),
    )
    return scene, plate


@pytest.mark.ci
@pytest.mark.parametrize("by", ["torque", pytest.param("angle", marks=pytest.mark.slow)])
def test_the_mesh_error_of_a_plate_on_quadratic_elements(by):
    """The cubic functions of the estimate turned with the plate, as if they were nodes at the origin. The estimate was
    26 times the error.
    """
    scene, plate = _turned(by)

    def result_of(x, R):
        q = plate.at_rest(scene.mesh)
        return q.angle(x[-1]) if by == "torque" else jnp.sum(q.arms(x[-1]) * R[-1][plate.nodes])

    result = lj.simulate(scene, mesh_error=True).check()
    value, change = result.mesh_error.change(result_of, result)
    assert bool(result.mesh_error.found.all())
    assert 0.5 < change / (FINE[by] - value) < 2


@pytest.mark.parametrize("size", [(6, 6, 1), (40, 40, 1)])
def test_a_loose_plate_of_many_nodes_is_refused_in_float32(size):
    """The roundoff of many rows counted as a support."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), size)
    plate = RigidPlate(nodes=mesh.node_sets["z_max"], turn=0.0, by="torque", centre=(0.05, 0.05, 0.0))
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1.0, bulk=3.0), physics=(plate,))
    with pytest.raises(InputError, match="do not prevent every rigid motion"):
        check_held(jax.tree.map(lambda leaf: in_precision(leaf, jnp.float32), scene))


@pytest.mark.parametrize(("by", "lifts"), [("angle", False), ("angle", True), ("torque", False), ("torque", True)])
def test_a_plate_prevents_every_rigid_motion_that_it_cannot_do_itself(by, lifts):
    """A body that was held completely by a plate was refused, because the tilts of the plate counted as free."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
    top = mesh.node_sets["z_max"]
    plate = RigidPlate(nodes=top, turn=0.0, by=by, lifts=lifts, centre=(0.05, 0.05, 0.0))
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1.0, bulk=3.0), physics=(plate,))
    below = mesh.node_sets["z_min"][:1]
    for axes in ("", "x", "z", "xz"):
        own = replace(scene, fixed=(lj.Fixed(nodes=below, axes=axes),) if axes else ())
        if (by == "angle" or "x" in axes) and (not lifts or "z" in axes):
            check_held(own)
        else:
            with pytest.raises(InputError, match="do not prevent every rigid motion"):
                check_held(own)
