"""Harmonic motion of porous and of nearly incompressible bodies: closed forms, transient runs, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_harmonic import DENSITY, FREQUENCIES, MU, PRONY, around_a_sphere, modulus, slab, standing
from test_porosity import DIFFUSION_TIME, HEIGHT, LOAD, MODULUS, column

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.laws.base import Law
from liverjax.mesh.promotion import cubic
from liverjax.physics.porosity import Inlet
from liverjax.scenes.enriched import enriched
from liverjax.waves.harmonic import element_operator
from liverjax.waves.operator import forces_of_motion

pytestmark = pytest.mark.quick_to_compile

#: One cycle takes twice the diffusion time, and a fifth of it.
SLOW, FAST = 0.5 / DIFFUSION_TIME, 5 / DIFFUSION_TIME


def oscillating(z: np.ndarray, hertz: float, permeability: float = 2e-5) -> tuple[np.ndarray, np.ndarray]:
    """Settlement and pressure of Terzaghi's column under an oscillating load (Biot 1941, J. Appl. Phys. 12, 155).

    M u' = load + p, and i omega (p/K + u') = kappa p'', with p = 0 at the top and no flow at the base.
    """
    omega, K = 2 * np.pi * hertz, 2200.0
    q = np.sqrt(1j * omega / permeability * (1 / K + 1 / MODULUS))
    trapped = -LOAD / (1 + MODULUS / K)
    p = trapped * (1 - np.cosh(q * z) / np.cosh(q * HEIGHT))
    u = ((LOAD + trapped) * z - trapped * np.sinh(q * z) / (q * np.cosh(q * HEIGHT))) / MODULUS
    return u, p


def off_terzaghi(scene: lj.Scene) -> list[float]:
    """Return the largest errors of settlement and pressure at the higher frequency, over the largest value."""
    found = lj.harmonic(scene, [SLOW, FAST]).check()
    exact = oscillating(np.asarray(scene.mesh.points)[:, 2], FAST)
    pairs = ((found.displacement[1, :, 2], exact[0]), (found.pressure[1], exact[1]))
    return [float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs]


@pytest.mark.ci
def test_terzaghis_column_under_an_oscillating_load(verified):
    """The error is of first order in the thickness of the layer at the drained top, as in transient runs."""
    errors = np.array([off_terzaghi(column(n, 1, 1.0)) for n in (12, 24)])
    orders = np.log2(errors[0] / errors[1])
    assert np.all(errors[1] < 0.013) and np.all(orders > 0.9)
    verified("oscillating column, 24 layers: settlement", "Biot 1941", errors[1, 0], 0.013, float(orders[0]))


@pytest.mark.slow
def test_quadratic_elements_and_fluid_that_is_pumped():
    """Eight quadratic layers settle as 24 linear ones do. Then a pressure or a flux at the base replaces the load."""
    assert off_terzaghi(enriched(column(8, 1, 1.0)))[0] < 0.013
    scene = column(24, 1, 1.0)
    base = np.flatnonzero(np.asarray(scene.mesh.points)[:, 2] < 1e-9)
    pump = Inlet(nodes=jnp.asarray(base), pressure=1.0, times=jnp.array([0.0, 1.0]), history=jnp.zeros(2))
    pumped = replace(scene, traction=(), porosity=replace(scene.porosity, inlet=(pump,)))
    p = np.asarray(lj.harmonic(pumped, [FAST]).check().pressure[0])
    z = np.asarray(scene.mesh.points)[:, 2]
    # Without a load u' = p/M, so that p'' = q^2 p.
    q = np.sqrt(2j * np.pi * FAST / 2e-5 * (1 / 2200.0 + 1 / MODULUS))
    assert np.abs(p - np.sinh(q * (HEIGHT - z)) / np.sinh(q * HEIGHT)).max() < 0.013
    # A flux through the base: -kappa p' is the 1e-6 m/s of fluid that enters.
    face = jnp.asarray(lj.boundary.boundary_triangles(scene.mesh, scene.mesh.node_sets["z_min"]))
    entering = Inlet(triangles=face, flux=1e-6)
    p = np.asarray(
        lj.harmonic(replace(pumped, porosity=replace(scene.porosity, inlet=(entering,))), [FAST]).pressure[0]
    )
    exact = 1e-6 / (2e-5 * q) * np.sinh(q * (HEIGHT - z)) / np.cosh(q * HEIGHT)
    # First order in the thickness of the layer at the inlet.
    assert np.abs(p - exact).max() < 0.04 * np.abs(exact).max()


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_a_porous_run_in_time_comes_to_it(order):
    """A viscous porous body is compressed until the flow has ended, and then oscillates. The error falls with dt, as
    expected for implicit Euler.
    """
    # A cycle takes one diffusion time. The transient part falls to 0.08 of itself in each cycle.
    hertz, errors = 2 * SLOW, []
    for per_cycle in (20, 40):
        dt, cycles, at_rest = 1 / hertz / per_cycle, 4, 8
        rest_steps = at_rest * per_cycle
        times = np.arange(rest_steps + cycles * per_cycle + 1) * dt
        pull = np.minimum(times * hertz, 1.0)
        wave = 1e-3 * np.sin(2 * np.pi * hertz * np.maximum(times - rest_steps * dt, 0.0))
        prony = lj.Prony(ratios=jnp.array([0.4]), relaxation_times=jnp.array([0.2 / hertz]))
        scene = replace(column(4, 1, 1.0), viscosity=prony)
        scene = enriched(scene) if order == 2 else scene
        load = replace(scene.traction[0], value=jnp.array([0.0, 0.0, -40.0]), times=times, history=pull + wave)
        solve = lj.Solve(dt=dt, steps=len(times) - 1, tolerance=1e-10)
        run = lj.simulate(replace(scene, traction=(load,), solve=solve)).check()
        phase = np.exp(-2j * np.pi * hertz * (times[-per_cycle:] - rest_steps * dt))
        before, last = run.positions[rest_steps - 1], np.asarray(run.positions[-per_cycle:])
        amplitude = 2j / per_cycle * np.einsum("t,tvi->vi", phase, last)
        pressure = 2j / per_cycle * np.einsum("t,tv->v", phase, np.asarray(run.pressure[-per_cycle:]))
        small = replace(scene, traction=(replace(scene.traction[0], value=jnp.array([0.0, 0.0, -0.04])),))
        exact = lj.harmonic(small, [hertz], about=before).check()
        pairs = ((amplitude, exact.displacement[0]), (pressure, exact.pressure[0]))
        errors.append([float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs])
    orders = np.log2(np.array(errors[0]) / np.array(errors[1]))
    assert np.all(np.array(errors[1]) < 0.1) and np.all(abs(orders - 1) < 0.15), (errors, orders)
    # The compressed body moves differently from the body at rest.
    bare = lj.harmonic(small, [hertz]).displacement[0]
    assert np.abs(bare - exact.displacement[0]).max() > 0.05 * np.abs(bare).max()


def sphere_box(n: int, bulk: float, volumetric: str) -> float:
    """Return the largest error of a box beside an oscillating sphere, over the largest motion.

    The law's bulk modulus is bulk mu.
    """
    side = 0.009
    box = lj.quadratic(lj.shapes.box((side,) * 3, (n,) * 3))
    X = np.asarray(box.points) + np.array([0.002, -0.004, 0.005])
    # With separate pressures, the volumetric part does not relax.
    exact = around_a_sphere(X, modulus()[1], bulk * MU, 2 * np.pi * FREQUENCIES[1], 0.003)
    outer = np.flatnonzero(np.any((np.asarray(box.points) < 1e-9) | (np.asarray(box.points) > side - 1e-9), axis=1))
    scene = lj.Scene(
        mesh=box,
        law=lj.laws.NeoHookean(mu=MU, bulk=bulk * MU),
        viscosity=replace(PRONY, part="isochoric"),
        body=lj.Body(density=DENSITY),
        displaced=(lj.Displaced(nodes=jnp.asarray(outer), by=jnp.zeros(3)),),
        solve=lj.Solve(volumetric=volumetric),
    )
    found = lj.harmonic(scene, FREQUENCIES[1:], motion=jnp.asarray(exact)).check()
    return float(np.abs(found.displacement[0] - exact).max() / np.abs(exact).max())


@pytest.mark.ci
def test_waves_that_keep_the_volume(verified):
    """Around an oscillating sphere with K = 100,000 G, mixed elements have their order. Others have large errors."""
    errors = [sphere_box(n, 1e5, "mixed") for n in (3, 6)]
    order = float(np.log2(errors[0] / errors[1]))
    assert 2.5 < order < 4.2 and errors[1] < 3e-3
    assert sphere_box(3, 1e5, "element") > 3 * errors[0]
    verified("swinging sphere, K = 100,000 G, mixed quadratic elements", "closed form", errors[1], 3e-3, order)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("volumetric", "order"), [*(pytest.param("mixed", k, marks=pytest.mark.slow) for k in (1, 2)), ("nodal", 1)]
)
def test_about_a_stretched_state_with_pressures(volumetric, order):
    """The pressure of the state also stiffens the slab. Its modulus in this state is computed from the energy alone."""
    n = 30 if order == 2 else 160
    scene = replace(slab(n, order), viscosity=replace(PRONY, part="isochoric"), solve=lj.Solve(volumetric=volumetric))
    F0 = jnp.diag(jnp.array([1.0, 1.0, 1.2]))

    def of(law: Law) -> tuple[float, float]:
        P = jax.grad(law.energy)
        return float(jax.jacfwd(P)(F0)[0, 2, 0, 2]), float(P(F0)[2, 2] / 1.2)

    (A, S), (whole, _) = of(lj.laws.NeoHookean(mu=MU, bulk=1e-9)), of(scene.law)
    C = modulus() / MU * (A - S) + 0.7 * S + whole - A
    about = scene.mesh.points * jnp.array([[1.0, 1.0, 1.2]])
    found = np.asarray(lj.harmonic(scene, FREQUENCIES, about=about).check().displacement[:, :, 0])
    exact = standing(np.asarray(scene.mesh.points)[:, 2], C)
    assert np.abs(found - exact).max() < 2e-3 * np.abs(exact).max()


@pytest.mark.ci
@pytest.mark.parametrize("other", [{"bulk": 40000.0}, lj.laws.Yeoh(c1=200.0, c2=10.0, c3=1.0, bulk=8000.0)])
def test_slow_waves_with_nodal_volumes_know_the_regions(other):
    """Moduli of elements were used as moduli of nodes: a traceback, or 6 % of error if there are as many elements as
    nodes."""
    mesh = lj.shapes.box((0.06, 0.04, 0.04), (2, 1, 1))
    assert mesh.number_of_elements == mesh.number_of_nodes
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=300.0, bulk=1000.0),
        region=(lj.Region(elements=np.arange(6, 12), law=other),),
        body=lj.Body(density=1e-3),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["x_max"], by=jnp.array([1e-7, 0.0, 0.0])),),
        solve=lj.Solve(volumetric="nodal", tolerance=1e-12),
    )
    still = np.asarray(lj.simulate(scene).check().positions[-1] - mesh.points)
    solve = replace(scene.solve, kind="harmonic", frequencies=jnp.array([1e-4]))
    moved = np.asarray(lj.harmonic(replace(scene, solve=solve)).check().displacement[0])
    assert np.abs(moved - still).max() < 1e-5 * np.abs(still).max()  # strain of the static run


@pytest.mark.slow
def test_the_mesh_s_error_of_mixed_elements():
    """The estimate uses cubic elements, and agrees with the closed form within a fifth."""
    scene = replace(slab(10, 2), viscosity=replace(PRONY, part="isochoric"), solve=lj.Solve(volumetric="mixed"))
    found = lj.harmonic(scene, FREQUENCIES)
    estimate = np.asarray(lj.harmonic_mesh_error(scene, found))[:, :, 0]
    missing = standing(np.asarray(scene.mesh.points)[:, 2], modulus()) - np.asarray(found.displacement)[:, :, 0]
    assert np.linalg.norm(estimate - missing) < 0.2 * np.linalg.norm(missing)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_operator_is_the_derivative_of_the_forces(order):
    """Compare with automatic differentiation of the forces. The elements of the body list their corners in any
    order.
    """
    rng = np.random.default_rng(2)
    box = lj.shapes.box((1.0, 1.0, 1.0), (2, 1, 1))
    even = np.array([[0, 1, 2, 3], [1, 2, 0, 3], [3, 2, 1, 0], [2, 3, 0, 1]])
    tets = np.asarray(box.tetrahedra)[:, None].repeat(4, axis=1)
    tets = np.stack([t[rng.integers(4)][even[rng.integers(4)]] for t in tets])
    mesh = lj.tet_mesh(np.asarray(box.points) + 0.05 * rng.normal(size=box.points.shape), tets)
    mesh = mesh if order == 1 else lj.quadratic(mesh)
    mesh = cubic(mesh) if order == 3 else mesh
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=1.0, bulk=3.0))
    u = jnp.asarray(rng.normal(size=mesh.points.shape))
    found = forces_of_motion(element_operator(scene), 1.0, 0.0, (u + 0j, None))[0]
    expected = jax.jvp(lambda x: mjed.internal_force(mesh, scene.law, x), (mesh.points,), (u,))[1]
    assert np.allclose(found, expected, rtol=1e-10, atol=1e-10)


def check_derivatives(scene: lj.Scene, at: dict, hertz: np.ndarray, about: jax.Array | None = None) -> None:
    """Check the gradient of a weighted sum of all results: reverse against forward mode, and against differences."""
    way = {name: (0.2 + 0.1 * k) * value for k, (name, value) in enumerate(at.items())}
    rng = np.random.default_rng(3)
    found = lj.harmonic(scene, hertz, about=about)
    results = [a for a in (found.displacement, found.pressure) if a is not None]
    weights = [jnp.asarray(rng.normal(size=a.shape)) / float(jnp.abs(a).max()) for a in results]

    def loss(values):
        r = lj.harmonic(lj.with_parameters(scene, values), hertz, about=about)
        kept = [a for a in (r.displacement, r.pressure) if a is not None]
        return sum(jnp.sum(w * a.real + w[::-1] * a.imag) for w, a in zip(weights, kept, strict=True))

    # One program for values and gradients: a third less to compile.
    both = jax.jit(jax.value_and_grad(loss))
    gradient = both(at)[1]
    slope = sum(float(jnp.vdot(gradient[name], way[name])) for name in at)
    forward = jax.jit(lambda v: jax.jvp(loss, (v,), (way,))[1])(at)

    def moved(h):
        return float(both({name: at[name] + h * way[name] for name in at})[0])

    errors = [abs((moved(h) - moved(-h)) / (2 * h) / slope - 1) for h in (1e-3, 1e-4, 1e-5)]
    assert np.isclose(slope, float(forward), rtol=1e-10)
    assert errors[0] / errors[1] > 50 and min(errors) < 1e-7, errors


@pytest.mark.slow
def test_derivatives_of_a_sponge():
    at = {"law.mu": 300.0, "porosity.bulk": 400.0, "porosity.limit_bulk": 2200.0, "porosity.permeability": 2e-5}
    at = {name: jnp.asarray(value) for name, value in at.items()}
    check_derivatives(column(4, 1, 1.0), at, np.array([SLOW, FAST]))


@pytest.mark.slow
def test_derivatives_of_mixed_elements_about_a_state():
    scene = replace(slab(3, 2), viscosity=replace(PRONY, part="isochoric"), solve=lj.Solve(volumetric="mixed"))
    about = scene.mesh.points * jnp.array([[1.0, 1.0, 1.1]])
    at = {"law.mu": jnp.full(scene.mesh.number_of_elements, MU), "law.bulk": jnp.asarray(10 * MU)}
    check_derivatives(scene, at | {"body.density": jnp.asarray(1e3)}, FREQUENCIES, about)


@pytest.mark.ci
def test_the_mesh_s_error_of_a_sponge_takes_factors_of_elements():
    """The refined mesh has eight times as many elements, and the factors of the scene were refused for it."""
    scene = replace(column(1, 1, 1.0), body=lj.Body(density=1000.0))
    factors = jnp.full((1, scene.mesh.number_of_elements), 0.8 + 0.1j)
    found = lj.harmonic(scene, [5.0], factors)
    own, same = (lj.harmonic_errors(scene, found, f).displacement for f in (factors, factors[:, 0]))
    assert np.abs(own - same).max() < 1e-9 * np.abs(same).max()
