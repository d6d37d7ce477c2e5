"""Extreme numbers: sizes, moduli, time steps and materials of very different scale, without hidden absolute
tolerances.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax import laws
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.mesh import shapes
from liverjax.physics import boundary, viscosity
from liverjax.physics.prescribed import strained_by_motion
from liverjax.physics.volumes.averaged import averaged_pressure
from liverjax.simulation.equations import equations, force_sizes, initial_state, residual, unknowns
from liverjax.simulation.run import prepared
from liverjax.tensors.matrices import deformation_gradient, determinant

pytestmark = pytest.mark.quick_to_compile

EPS = np.finfo(float).eps
UNIT = shapes.box((1.0, 1.0, 1.0), (2, 2, 2))


def pulled(size: float, modulus: float, **solve) -> lj.Scene:
    """A block of a size [m] and modulus [Pa], stretched and sheared by a fifth of its size."""
    mesh = lj.tet_mesh(size * UNIT.points, UNIT.tetrahedra, UNIT.node_sets)
    by = size * jnp.array([0.1, 0.0, 0.2])
    return lj.Scene(
        mesh=mesh,
        law=laws.MooneyRivlin(c10=0.4 * modulus, c01=0.1 * modulus, bulk=4 * modulus),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=by),),
        solve=lj.Solve(**({"tolerance": 1e-10} | solve)),
    )


@pytest.mark.ci
def test_lengths_and_moduli_are_units_only():
    reference = lj.simulate(pulled(1.0, 1.0)).check()
    for size, modulus in ((1e-6, 1e3), (1e3, 1e3), (1.0, 1e6), (1e-3, 1e9), (1.0, 1.0e-3)):
        result = lj.simulate(pulled(size, modulus)).check()
        assert int(result.statistics.iterations.sum()) == int(reference.statistics.iterations.sum())
        # Newton's last correction has the size of the tolerance.
        assert np.abs(result.positions / size - reference.positions).max() < 1e-9
        scale = modulus * size**2
        assert np.abs(result.reactions / scale - reference.reactions).max() < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("scheme", ["exponential", "backward_euler"])
def test_steps_far_from_the_relaxation_time(ratio, scheme):
    """A stretch is applied in one step. The remaining fraction of the stress is compared with the formula of the
    scheme.
    """
    g, dt = 0.9, 0.5
    prony = lj.Prony(ratios=jnp.array([g]), relaxation_times=jnp.array([dt / ratio]), scheme=scheme)
    elastic = pulled(1.0, 1e3, dt=dt, steps=1)
    result = lj.simulate(replace(elastic, viscosity=prony)).check()
    whole = lj.simulate(elastic).check()
    left = 1 - float(np.sum(viscosity.coefficients(prony, dt)[0]))
    limit = 1 - g * (ratio / (1 + ratio) if scheme == "backward_euler" else 1 - -np.expm1(-ratio) / ratio)
    assert np.isclose(left, limit, rtol=1e-9)
    # The positions are equal, and the forces are a fraction. The tolerance is relative to the acting forces.
    assert np.abs(result.positions - whole.positions).max() < 1e-8
    assert np.abs(result.reactions - left * whole.reactions).max() < 1e-8 * np.abs(whole.reactions).max()


@pytest.mark.parametrize("times", [[0.0], [np.inf], [-1.0], [np.nan]])
def test_relaxation_times_of_nothing_and_forever_are_refused(times):
    with pytest.raises(lj.InputError, match="relaxation_times"):
        viscosity.check_viscosity(
            lj.Prony(ratios=jnp.array([0.2]), relaxation_times=jnp.array(times)), laws.typical("yeoh")
        )


@pytest.mark.slow
def test_ratios_that_leave_almost_nothing():
    prony = lj.Prony(ratios=jnp.array([0.5, 0.4999999]), relaxation_times=jnp.array([1e-6, 1e-5]))
    scene = replace(pulled(1.0, 1e3, dt=1.0, steps=3), viscosity=prony)
    result = lj.simulate(scene).check()
    elastic = lj.simulate(replace(scene, viscosity=None)).reactions[-1]
    # All stress relaxes, except 1e-7 and what remains because the ramp is finite relative to the relaxation times.
    assert np.abs(result.reactions[-1]).max() < 2e-5 * np.abs(elastic).max()


@pytest.mark.ci
@pytest.mark.parametrize("solver", ["cg", pytest.param("direct", marks=pytest.mark.slow)])
def test_a_layer_ten_thousand_times_stiffer(solver):
    """The top quarter of a block is stiff. In series, only the soft part stretches."""
    mesh = shapes.box((1.0, 1.0, 1.0), (2, 2, 4))
    height = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)].mean(axis=1)[:, 2]
    mu = jnp.asarray(np.where(height > 0.75, 1e7, 1e3))
    scene = lj.Scene(
        mesh=mesh,
        law=laws.NeoHookean(mu=mu, bulk=4 * mu),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([0.0, 0.0, 0.1]), axes="z"),),
        solve=lj.Solve(linear_solver=solver),
    )
    scene = replace(scene, fixed=(*scene.fixed, lj.Fixed(nodes=mesh.node_sets["z_max"], axes="xy")))
    result = lj.simulate(scene).check()
    layer = np.flatnonzero(np.isclose(np.asarray(mesh.points)[:, 2], 0.75))
    moved = np.asarray(result.positions[-1] - mesh.points)[layer, 2]
    assert np.abs(moved - 0.1).max() < 1e-3 * 0.1
    total = np.asarray(result.reactions[-1]).sum(axis=0)
    # The forces balance up to the solver's tolerance: 1e-8 of the acting forces, which include those of the stiff part.
    assert np.abs(total).max() < 1e-7 * np.linalg.norm(np.asarray(result.reactions[-1]))


@pytest.mark.slow
def test_slivers():
    """Elements are 1e4 times longer than high. With both solvers, the solution is that of a solid block."""
    mesh = shapes.box((1.0, 1.0, 1e-4), (2, 2, 1))
    stretch = jnp.array([0.1, 0.0, 0.0])
    scene = lj.Scene(
        mesh=mesh,
        law=laws.NeoHookean(mu=1e3, bulk=4e3),
        fixed=tuple(lj.Fixed(nodes=mesh.node_sets[f"{a}_min"], axes=a) for a in "xyz"),
        displaced=(lj.Displaced(nodes=mesh.node_sets["x_max"], by=stretch, axes="x"),),
        solve=lj.Solve(tolerance=1e-10),
    )
    cube = replace(scene, mesh=lj.tet_mesh(mesh.points * jnp.array([[1, 1, 1e4]]), mesh.tetrahedra, mesh.node_sets))
    for solver in ("cg", "direct"):
        solve = replace(scene.solve, linear_solver=solver)
        thin, thick = (lj.simulate(replace(s, solve=solve)).check().positions[-1] for s in (scene, cube))
        assert np.abs(thin * jnp.array([[1, 1, 1e4]]) - thick).max() < 1e-6


@pytest.mark.slow
def test_tight_and_open_sponges():
    """With permeability 0 nothing flows. With a very large one, no pressure remains if the surface is drained."""
    by = jnp.array([0.0, 0.0, -0.1])
    scene = replace(
        pulled(1.0, 1e3, dt=1.0, steps=2, tolerance=1e-9),
        displaced=(lj.Displaced(nodes=UNIT.node_sets["z_max"], by=by),),
        porosity=lj.Porosity(
            bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=0.0, drained=UNIT.node_sets["z_max"]
        ),
    )
    tight = lj.simulate(scene).check()
    assert np.abs(tight.pressure).max() > 10
    wide = lj.simulate(replace(scene, porosity=replace(scene.porosity, permeability=1e3))).check()
    assert np.abs(wide.pressure).max() < 1e-3


# -- near-incompressible ----------------------------------------------------------------------------------------------


def membrane(n: int, ratio: float, volumetric: str) -> lj.Scene:
    """Cook's membrane, 48 mm wide, in plane strain."""
    flat = shapes.box((1.0, 1.0, 1.0), (n, n, 1))
    s, t, w = np.asarray(flat.points).T
    points = np.stack([48 * s, 44 * s + t * (44 - 28 * s), w], axis=1) * 1e-3
    mesh = lj.tet_mesh(points, flat.tetrahedra, flat.node_sets)
    right = jnp.asarray(boundary.boundary_triangles(mesh, mesh.node_sets["x_max"]))
    return lj.Scene(
        mesh=mesh,
        law=laws.NeoHookean(mu=770.0, bulk=770.0 * ratio, volumetric="simo"),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]), lj.Fixed(nodes=np.arange(len(points)), axes="z")),
        traction=(lj.Traction(triangles=right, value=jnp.array([0.0, 0.38, 0.0])),),
        solve=lj.Solve(volumetric=volumetric, linear_solver="direct"),
    )


def rise(scene: lj.Scene) -> float:
    """Mean rise of the right edge [m]."""
    moved = lj.simulate(scene).check().positions[-1] - scene.mesh.points
    return float(np.mean(np.asarray(moved)[np.asarray(scene.mesh.node_sets["x_max"]), 1]))


@pytest.mark.slow
def test_averaged_volumes_do_not_lock():
    # With averaged volumes, refinement increases the rise of the edge. With volumes per element the edge hardly moves
    # (3.6e-5 m/Pa on every mesh).
    coarse, fine = (rise(membrane(n, 1e5, "nodal")) for n in (8, 16))
    assert fine > 1.4 * coarse and fine > 2.5 * rise(membrane(16, 1e5, "element"))
    # Without locking, both agree up to the mesh error.
    soft = [rise(membrane(16, 2.0, kind)) for kind in ("nodal", "element")]
    assert abs(soft[0] / soft[1] - 1) < 0.06


@pytest.mark.slow
def test_averaged_volumes_pass_the_patch_test():
    """In a homogeneous stretch, averaging changes nothing."""
    scene = pulled(1.0, 1e3)
    nodal = replace(scene, solve=replace(scene.solve, volumetric="nodal"))
    F = np.eye(3) + 0.1 * np.random.default_rng(0).standard_normal((3, 3))
    outer = np.unique(boundary.boundary_triangles(UNIT))
    moves = lj.Displaced(nodes=outer, by=UNIT.points[outer] @ (F - np.eye(3)).T)
    result = lj.simulate(replace(nodal, fixed=(), displaced=(moves,))).check()
    assert np.abs(result.positions[-1] - np.asarray(UNIT.points) @ F.T).max() < 1e-9
    J = determinant(deformation_gradient(UNIT, result.positions[-1]))
    p = averaged_pressure(UNIT, scene.law, J)
    assert np.allclose(p, 4e3 * (np.linalg.det(F) - 1), rtol=1e-8)


@pytest.mark.slow
def test_averaged_volumes_have_a_gradient():
    def top(bulk):
        scene = membrane(4, 100.0, "nodal")
        scene = replace(scene, law=replace(scene.law, bulk=bulk), solve=replace(scene.solve, tolerance=1e-11))
        return lj.simulate(scene).positions[-1, -1, 1]

    import jax

    h = 10.0
    difference = (top(77e3 + h) - top(77e3 - h)) / (2 * h)
    assert np.isclose(jax.grad(top)(77e3), difference, rtol=1e-5)


@pytest.mark.parametrize(
    "change, sentence",
    [
        (dict(law=laws.typical("saint_venant_kirchhoff")), "needs a law with separate isochoric and volumetric"),
        (dict(porosity=lj.Porosity(bulk=1.0, limit_bulk=2.0, fluid_fraction=0.5, permeability=1.0)), "porosity"),
        (dict(viscosity=lj.Prony(ratios=jnp.array([0.2]), relaxation_times=jnp.array([1.0]))), "part = 'isochoric'"),
    ],
)
def test_averaged_volumes_that_mean_nothing_are_refused(change, sentence):
    scene = replace(membrane(2, 10.0, "nodal"), **change)
    with pytest.raises(lj.InputError, match=sentence):
        lj.simulate(scene)


def test_a_hopeless_step_is_told():
    scene = pulled(1.0, 1e3)
    crushed = lj.Displaced(nodes=UNIT.node_sets["z_max"], by=jnp.array([0.0, 0.0, -1.5]))
    code = int(lj.simulate(replace(scene, displaced=(crushed,))).status[-1])
    assert code in (status.STEP_CUT, status.INDEFINITE, status.NOT_FINITE)


@pytest.mark.parametrize(("precision", "by", "traction"), [("float32", 0, 0), ("float64", 10, 0), ("float32", 0, 0.1)])
def test_a_body_without_loads_is_in_equilibrium(precision, by, traction):
    """The body is at rest in single precision, or has moved by ten times its size. Roundoff is no residual there.

    A small traction that is missing in the balance is one, also in single precision.
    """
    moved = 0.1 * by * jnp.array([1.0, 0.3, 0.0])
    mesh = shapes.box((0.1, 0.1, 0.1), (3, 3, 3))
    top = jnp.asarray(boundary.boundary_triangles(mesh, mesh.node_sets["z_max"]))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1e3, bulk=1e4),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_min"], by=moved),),
        traction=(lj.Traction(triangles=top, value=jnp.array([traction, 0.0, 0.0])),),
        solve=lj.Solve(precision=precision, tolerance=1e-6 if precision == "float32" else 1e-9),
    )
    scene = prepared(scene)
    e = equations(scene, initial_state(scene), 1.0, force_sizes(scene))
    r, force, _ = residual(e, unknowns(e, jnp.asarray(mesh.points + moved[None], scene.mesh.points.dtype)), 1.0)
    assert bool(jnp.linalg.norm(r) <= scene.solve.tolerance * force) == (traction == 0)


@pytest.mark.parametrize(("pulled", "strained"), [(2e-6, True), (0.0, False)])
def test_a_small_prescribed_strain_is_no_roundoff(pulled, strained):
    """In float32, forces of a top that moves by 2 um were called roundoff: a start 8.5 % away had converged."""
    place = jnp.full((1, 3), 0.3)
    mesh = shapes.box((0.02, 0.02, 0.02), (2, 2, 2))
    mesh = lj.tet_mesh(mesh.points + place, mesh.tetrahedra, node_sets=mesh.node_sets)
    turn = jnp.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])  # a rotation does not strain the body
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1e3, bulk=1e4),
        fixed=tuple(lj.Fixed(nodes=mesh.node_sets[name]) for name in ("z_min", "z_max")),
        solve=lj.Solve(precision="float32", tolerance=1e-4),
    )
    scene = prepared(scene)
    e = equations(scene, initial_state(scene), 1.0, force_sizes(scene))
    x = jnp.asarray((mesh.points - place) @ turn.T + place, scene.mesh.points.dtype)
    x = x.at[:, 2].add(jnp.where(jnp.arange(len(x)) == int(mesh.node_sets["z_max"][4]), pulled, 0.0))
    assert bool(strained_by_motion(e.free, scene.mesh.points, x)) == strained
    r, force, _ = residual(e, unknowns(e, scene.mesh.points), 1.0)
    assert jnp.linalg.norm(r) <= scene.solve.tolerance * force


@pytest.mark.slow
def test_more_than_float32_can_give_is_told_with_the_best_it_has():
    """The tolerance is below the digits of small displacements. The run has stalled, as close to float64 as rounding
    allows.
    """
    mesh = lj.shapes.box((0.06, 0.01, 0.01), (6, 2, 2))
    right = boundary.boundary_triangles(mesh, mesh.node_sets["x_max"])
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=770.0, bulk=2000.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        traction=(lj.Traction(triangles=jnp.asarray(right), value=jnp.array([0.0, 0.01, 0.0])),),
        solve=lj.Solve(tolerance=1e-6),
    )
    exact = np.asarray(lj.simulate(scene).check().positions[-1])
    single = lj.simulate(replace(scene, solve=replace(scene.solve, precision="float32")))
    moved = np.abs(exact - np.asarray(mesh.points)).max()
    assert status.NAMES[int(single.status[-1])] == "stalled"
    assert moved < 1e-4  # of 0.06 m: float32 resolves 4e-9 m
    # The beam is six times as long as high. Positions rounded to 4e-9 m bend it by up to 36 times this.
    assert np.abs(np.asarray(single.positions[-1], float) - exact).max() < 1e-2 * moved
