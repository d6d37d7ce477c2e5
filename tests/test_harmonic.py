"""Harmonic motion: against waves in closed form, against transient runs, and its derivatives."""

import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.laws.base import Law
from liverjax.scenes.scene_file import scene_from
from liverjax.waves.cautions import cautions_of_waves
from liverjax.waves.rest import under_its_weight

pytestmark = pytest.mark.quick_to_compile

LENGTH, MU, DENSITY = 0.03, 3000.0, 1000.0
PRONY = lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([0.003]))
FREQUENCIES = np.array([60.0, 100.0])

FILE = """
[mesh]
shape = "box"
size = [0.03, 0.01, 0.01]
cells = [3, 1, 1]
[law]
name = "neo_hookean"
mu = 3000.0
bulk = 30000.0
[body]
density = 1000.0
[[displaced]]
where = {x_max = 0.0}
by = [0.0, 1e-5, 0.0]
[solve]
kind = "harmonic"
"""


def slab(n: int, order: int, **changes) -> lj.Scene:
    """A slab of n cells along z that moves along x only. Its lower face is driven, its upper face is free."""
    mesh = lj.shapes.box((LENGTH / n, LENGTH / n, LENGTH), (1, 1, n))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=10 * MU),
        viscosity=PRONY,
        body=lj.Body(density=DENSITY),
        fixed=(lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes), axes="yz"),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_min"], by=jnp.array([1e-4, 0.0, 0.0]), axes="x"),),
        **changes,
    )


def standing(z: np.ndarray, G: np.ndarray, length: float = LENGTH) -> np.ndarray:
    """Return amplitudes (F, V) [m] between a driven and a free face, for complex moduli G (F,) [Pa]."""
    k = (2 * np.pi * FREQUENCIES * np.sqrt(DENSITY / G))[:, None]
    return 1e-4 * np.cos(k * (length - z[None])) / np.cos(k * length)


def modulus(prony: lj.Prony = PRONY) -> np.ndarray:
    """Return G* (F,) [Pa] by the textbook formula."""
    g, tau = np.asarray(prony.ratios), np.asarray(prony.relaxation_times)
    w = 2 * np.pi * FREQUENCIES[:, None]
    return MU * (1 - np.sum(g / (1 + 1j * w * tau), axis=1))


def off(n: int, order: int, mass: str = "consistent") -> float:
    """Return the largest error of the slab's motion, divided by the largest motion."""
    scene = slab(n, order)
    found = np.asarray(lj.harmonic(scene, FREQUENCIES, mass=mass).check().displacement[:, :, 0])
    exact = standing(np.asarray(scene.mesh.points)[:, 2], modulus())
    return np.abs(found - exact).max() / np.abs(exact).max()


@pytest.mark.core
def test_a_plane_shear_wave_and_its_order(verified):
    """The wavelengths are 17 and 27 mm. The error of the motion is of order h^2 and h^3, that of the phase of quadratic
    elements of order h^4.
    """
    linear = [off(n, 1) for n in (40, 80)]
    quadratic = [off(n, 2) for n in (20, 40)]
    orders = [float(np.log2(e[0] / e[1])) for e in (linear, quadratic)]
    assert 1.9 < orders[0] < 2.1 and 2.8 < orders[1] < 4.2
    # Eleven elements per wavelength, and twice as many.
    assert quadratic[0] < 2e-3 and quadratic[1] < 2e-4
    verified(
        "plane shear wave, viscoelastic, 23 quadratic elements a wave", "closed form", quadratic[1], 2e-4, orders[1]
    )


@pytest.mark.slow
def test_lumped_masses_cost_quadratic_elements_their_order():
    assert 1.8 < np.log2(off(20, 2, "lumped") / off(40, 2, "lumped")) < 2.2


def test_a_torsional_wave(verified):
    """The lower face of a cylinder turns. Every section turns as a whole, by the formula of the slab."""
    mesh = lj.quadratic(lj.shapes.cylinder(0.004, 0.01, 0.002))
    low, points = np.asarray(mesh.node_sets["bottom"]), np.asarray(mesh.points)
    turn = 1e-4 / 0.004 * np.stack([-points[:, 1], points[:, 0], 0 * points[:, 0]], axis=1)
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=10 * MU),
        viscosity=PRONY,
        body=lj.Body(density=DENSITY),
        displaced=(lj.Displaced(nodes=jnp.asarray(low), by=jnp.asarray(turn[low])),),
    )
    found = np.asarray(lj.harmonic(scene, FREQUENCIES).check().displacement)
    exact = turn[None] * (standing(points[:, 2], modulus(), 0.01) / 1e-4)[:, :, None]
    error = np.abs(found - exact).max() / np.abs(exact).max()
    assert error < 0.02  # eight elements per wavelength
    verified("torsional wave, viscoelastic, 2 mm quadratic elements", "closed form", error, 0.02)


def around_a_sphere(X: np.ndarray, G: complex, K: complex, omega: float, radius: float) -> np.ndarray:
    """Motion (V, 3) around a rigid sphere that oscillates along z with amplitude 1 (Oestreicher 1951, JASA 23, 707).

    u = grad(A p(r) cos t) + curl curl(B g(r) e_z), with spherical Hankel functions p and g of order 1 and 0.
    """
    r = np.linalg.norm(X, axis=1)
    cosine = X[:, 2] / r

    def waves(r):
        kp, ks = omega * np.sqrt(DENSITY / (K + 4 * G / 3)), omega * np.sqrt(DENSITY / G)
        e, g = np.exp(-1j * kp * r) / (kp * r), np.exp(-1j * ks * r) / (ks * r)
        p, dp = -(1j * kp + 1 / r) * e, ((1j * kp + 1 / r) ** 2 + 1 / r**2) * e
        dg, ddg = -(1j * ks + 1 / r) * g, ((1j * ks + 1 / r) ** 2 + 1 / r**2) * g
        return p / r, dp, dg / r + ks**2 * g, ddg + ks**2 * g  # perpendicular to r and along r, for A and for B

    pa, pr, ga, gr = waves(radius)
    A, B = np.linalg.solve(np.array([[pr, gr], [pa, ga]]), np.ones(2))
    pa, pr, ga, gr = waves(r)
    along, across = A * pr + B * gr, A * pa + B * ga
    return ((along - across) * cosine / r)[:, None] * X + across[:, None] * np.array([0.0, 0.0, 1.0])


@pytest.mark.slow
def test_waves_about_a_sphere_that_swings(verified):
    """A box beside the sphere is driven at its surface by the closed form. Inside, the motion agrees with it; K is 10
    G.
    """
    radius, side, errors = 0.003, 0.009, []
    for n in (3, 6):
        box = lj.quadratic(lj.shapes.box((side,) * 3, (n,) * 3))
        X = np.asarray(box.points) + np.array([0.002, -0.004, 0.005])
        m = modulus()[1] / MU
        exact = around_a_sphere(X, m * MU, m * 10 * MU, 2 * np.pi * FREQUENCIES[1], radius)
        outer = np.flatnonzero(np.any((np.asarray(box.points) < 1e-9) | (np.asarray(box.points) > side - 1e-9), axis=1))
        scene = lj.Scene(
            mesh=box,
            law=lj.laws.NeoHookean(mu=MU, bulk=10 * MU),
            viscosity=PRONY,
            body=lj.Body(density=DENSITY),
            displaced=(lj.Displaced(nodes=jnp.asarray(outer), by=jnp.zeros(3)),),
        )
        found = lj.harmonic(scene, FREQUENCIES[1:], motion=jnp.asarray(exact)).check()
        errors.append(float(np.abs(found.displacement[0] - exact).max() / np.abs(exact).max()))
    order = float(np.log2(errors[0] / errors[1]))

    assert 2.7 < order < 4.2 and errors[1] < 3e-3
    verified(
        "waves about a swinging sphere (Oestreicher), 11 quadratic elements a wave",
        "closed form",
        errors[1],
        3e-3,
        order,
    )


def stretched(scene: lj.Scene, stretch: float) -> jax.Array:
    """Return the positions of the slab stretched along z."""
    return scene.mesh.points * jnp.array([[1.0, 1.0, stretch]])


@pytest.mark.ci
@pytest.mark.parametrize("part", [pytest.param("all", marks=pytest.mark.slow), "isochoric"])
def test_about_a_stretched_state(part):
    """The stress that has not relaxed stiffens the slab. Its modulus in this state is computed from the energy
    alone.
    """
    prony = replace(PRONY, part=part)
    scene = replace(slab(30, 2), viscosity=prony)
    F0, law = jnp.diag(jnp.array([1.0, 1.0, 1.2])), scene.law

    def of(law: Law) -> tuple[float, float]:
        """Return d2W/dF_xz^2 and the second Piola-Kirchhoff stress S_zz."""
        P = jax.grad(law.energy)
        return float(jax.jacfwd(P)(F0)[0, 2, 0, 2]), float(P(F0)[2, 2] / 1.2)

    kept = lj.laws.NeoHookean(mu=MU, bulk=1e-9) if part == "isochoric" else law
    (A, S), (whole, _) = of(kept), of(law)
    m = modulus() / MU
    C = m * (A - S) + 0.7 * S + (whole - A if part == "isochoric" else 0.0)
    found = np.asarray(lj.harmonic(scene, FREQUENCIES, about=stretched(scene, 1.2)).check().displacement[:, :, 0])
    exact = standing(np.asarray(scene.mesh.points)[:, 2], C)
    assert np.abs(found - exact).max() < 2e-3 * np.abs(exact).max()
    # Without the state, the result would be different.
    assert np.abs(standing(np.asarray(scene.mesh.points)[:, 2], modulus()) - exact).max() > 0.1 * np.abs(exact).max()


@pytest.mark.slow
def test_a_run_in_time_comes_to_it():
    """A compressed slab, at rest for a long time, is driven until the motion is steady. The error falls with dt^2."""
    n, f, errors = 6, 100.0, []
    for per_cycle in (32, 64):
        dt, cycles = 1 / f / per_cycle, 40
        at_rest = 10 * per_cycle  # equally many steps, in total 33 times the relaxation time
        times = np.arange(at_rest + cycles * per_cycle + 1) * dt
        after = np.maximum(times - at_rest * dt, 0.0)
        wave = 1e-5 * np.sin(2 * np.pi * f * after) * np.minimum(after * f / 2, 1.0) ** 2
        pull = np.minimum(times / (at_rest * dt / 4), 1.0)
        scene = slab(n, 1)
        z = np.asarray(scene.mesh.points)[:, 2]
        ends = (
            lj.Displaced(
                nodes=scene.mesh.node_sets["z_min"], times=times, history=wave[:, None] * [1.0, 0, 0], axes="x"
            ),
            lj.Displaced(
                nodes=jnp.arange(len(z)),
                by=np.asarray(-0.1 * z[:, None] * [0, 0, 1.0]),
                times=times,
                history=pull,
                axes="z",
            ),
        )
        held = (lj.Fixed(nodes=jnp.arange(len(z)), axes="y"),)
        solve = lj.Solve(kind="dynamic", integrator="newmark", dt=dt, steps=len(times) - 1, tolerance=1e-9)
        run = lj.simulate(replace(scene, displaced=ends, fixed=held, solve=solve)).check()
        last = np.asarray(run.positions[-per_cycle:, :, 0] - scene.mesh.points[None, :, 0])
        phase = np.exp(-2j * np.pi * f * (times[-per_cycle:] - at_rest * dt))
        amplitude = 2 / per_cycle * np.einsum("t,tv->v", phase, last) * 1j * 10
        steady = replace(scene, displaced=(replace(scene.displaced[0], by=jnp.array([1e-4, 0, 0])),))
        exact = np.asarray(
            lj.harmonic(steady, [f], about=run.positions[at_rest - 1], mass="lumped").displacement[0, :, 0]
        )
        errors.append(np.abs(amplitude - exact).max() / np.abs(exact).max())
    assert errors[1] < 0.02 and 1.7 < np.log2(errors[0] / errors[1]) < 2.3, errors


@pytest.mark.parametrize(("order", "n"), [pytest.param(1, 20, marks=pytest.mark.slow), (2, 10)])
def test_the_error_of_the_mesh(order, n):
    """The estimated error agrees with the closed form within a tenth: 18 % and 1.2 % of the motion."""
    scene = slab(n, order)
    found = lj.harmonic(scene, FREQUENCIES)
    estimate = np.asarray(lj.harmonic_mesh_error(scene, found))[:, :, 0]
    exact = standing(np.asarray(scene.mesh.points)[:, 2], modulus())
    missing = exact - np.asarray(found.displacement)[:, :, 0]
    assert np.all(np.linalg.norm(estimate - missing, axis=1) < 0.1 * np.linalg.norm(missing, axis=1))
    # The force on the driven face in closed form follows from the derivative of the motion there.
    low = np.asarray(scene.mesh.node_sets["z_min"])
    area = np.ptp(np.asarray(scene.mesh.points)[:, :2], axis=0).prod()
    k = 2 * np.pi * FREQUENCIES * np.sqrt(DENSITY / modulus())
    force = -area * modulus() * 1e-4 * k * np.tan(k * LENGTH)
    more, given = (
        np.asarray(own.reactions)[:, low, 0].sum(axis=1) for own in (lj.harmonic_errors(scene, found), found)
    )
    assert np.all(np.abs(given + more - force) < 0.15 * np.abs(given - force))
    with pytest.raises(lj.InputError, match="nodes"):
        lj.harmonic_mesh_error(slab(2, 1), found)


@pytest.mark.ci
def test_derivatives_in_both_modes_and_by_differences():
    """Derivatives with respect to element moduli, the relaxation time and the density. The error of differences has its
    minimum at eps^(2/3).
    """
    scene = slab(4, 2)
    E = scene.mesh.number_of_elements
    rng = np.random.default_rng(3)
    way = {"law.mu": MU * jnp.asarray(rng.uniform(0.5, 1, E)), "viscosity.relaxation_times": jnp.array([0.002])}
    way["body.density"] = jnp.asarray(300.0)
    at = {"law.mu": jnp.full(E, MU), "viscosity.relaxation_times": jnp.array([0.003]), "body.density": jnp.asarray(1e3)}
    weights = jnp.asarray(rng.normal(size=(2, scene.mesh.number_of_nodes, 3)))

    def loss(values):
        u = lj.harmonic(lj.with_parameters(scene, values), FREQUENCIES).displacement
        return jnp.sum(weights * u.real + weights[::-1] * u.imag) * 1e4

    both = jax.jit(jax.value_and_grad(loss))
    gradient = both(at)[1]
    slope = sum(float(jnp.vdot(gradient[name], way[name])) for name in at)
    _, forward = jax.jit(lambda v: jax.jvp(loss, (v,), (way,)))(at)
    assert np.isclose(slope, forward, rtol=1e-10)

    def moved(h):
        return float(both({name: at[name] + h * way[name] for name in at})[0])

    errors = [abs((moved(h) - moved(-h)) / (2 * h) / slope - 1) for h in (1e-3, 1e-4, 1e-5)]
    assert errors[0] / errors[1] > 50 and min(errors) < 1e-7


def test_supports_and_regions_take_part():
    """A stiff slab on springs is a mass on a spring: u = p A / (k A - omega^2 m) for a traction p."""
    from liverjax.physics.elastic_support import ElasticSupport

    mesh = lj.shapes.box((0.02, 0.02, 0.01), (2, 2, 1))
    low, top = (jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets[s])) for s in ("z_min", "z_max"))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1e9, bulk=1e10),
        body=lj.Body(density=1000.0),
        fixed=(lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes), axes="xy"),),
        traction=(lj.Traction(triangles=top, value=jnp.array([0.0, 0.0, 2.0])),),
        physics=(ElasticSupport(triangles=low, normal=1e6),),
    )
    u = np.asarray(lj.harmonic(scene, FREQUENCIES).check().displacement[:, :, 2])
    exact = 2.0 / (1e6 - (2 * np.pi * FREQUENCIES) ** 2 * 1000.0 * 0.01)
    # The strain of the slab itself is p h/(K + 4/3 mu), 2e-6 of u.
    assert np.allclose(u, exact[:, None], rtol=1e-5)


@pytest.mark.slow
def test_an_undamped_resonance_is_told():
    scene = replace(slab(2, 1), viscosity=None)
    broken = replace(scene, law=lj.laws.NeoHookean(mu=jnp.nan, bulk=jnp.nan))
    result = jax.jit(lambda s: lj.harmonic(s, [50.0]))(broken)
    with pytest.raises(RuntimeError, match="50 Hz"):
        result.check()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frequencies_Hz": [-1.0]}, "frequencies_Hz = .* above 0"),
        ({"frequencies_Hz": [60.0, 1e200]}, "frequencies_Hz = .* at most 1e"),
        ({"frequencies_Hz": []}, "frequencies_Hz"),
        ({"factors": np.ones(5)}, "'factors' has shape"),
        ({"motion": np.ones(3)}, "'motion' has shape"),
        ({"about": np.ones(3)}, "'about' has shape"),
        ({"mass": "none"}, "mass = 'none'"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with pytest.raises(lj.InputError, match=words):
        lj.harmonic(**{"scene": slab(2, 1), "frequencies_Hz": FREQUENCIES} | changes)


@pytest.mark.parametrize(
    "region",
    [
        pytest.param({"law": {"mu": 9000.0}}, marks=pytest.mark.slow),
        pytest.param(
            {"law": {"name": "yeoh", "c1": 4500.0, "c2": 100.0, "c3": 10.0, "bulk": 90000.0}}, marks=pytest.mark.slow
        ),
        pytest.param({"viscosity": {"ratios": [0.1]}}, marks=pytest.mark.slow),
    ],
    ids=["numbers", "law", "viscosity"],
)
def test_the_state_of_rest_of_regions_has_relaxed(region):
    """Compare with a static run of very long steps, in which all modes relax. Regions once kept their instantaneous
    moduli, with an error of 12 %.
    """
    content = tomllib.loads(FILE) | {"viscosity": {"ratios": [0.5], "relaxation_times": [0.1]}}
    content["region"] = [{"where": {"x_min": 0.0149}} | region]
    content["mesh"] = content["mesh"] | {"cells": [4, 1, 1]}
    content["body"] = {"density": 1000.0, "gravity": [-3.0, 0.0, 0.0]}
    content["fixed"] = [{"where": {"x_max": 0.0}}]
    del content["displaced"]
    content["solve"] = {"kind": "static", "dt": 1e6, "steps": 4}
    long = lj.simulate(scene_from(content)).check().positions[-1]
    content["solve"] = {"kind": "harmonic", "frequencies": [40.0]}
    rest = under_its_weight(scene_from(content))
    moved = np.abs(long - scene_from(content).mesh.points).max()
    # Newton's tolerance is 1e-8, and the modes have relaxed to exp(-1e7)
    assert np.abs(rest - long).max() < 1e-6 * moved


def test_histories_are_refused():
    """Without this check, histories were ignored silently, or ended in a traceback."""
    scene = slab(2, 1)
    moved = replace(scene.displaced[0], times=jnp.array([0.0, 1.0]), history=jnp.array([1.0, 2.0]))
    solve = replace(scene.solve, kind="harmonic", frequencies=jnp.array([10.0]))
    with pytest.raises(lj.InputError, match=r"displaced\.0\.history cannot be used with kind = 'harmonic'"):
        lj.check_scene(replace(scene, displaced=(moved, *scene.displaced[1:]), solve=solve))


def test_what_acts_in_one_direction_is_told_and_a_motion_without_a_drive():
    scene = slab(2, 1)
    side = lj.boundary.boundary_triangles(
        scene.mesh, np.flatnonzero(scene.mesh.points[:, 0] > 0.999 * scene.mesh.points[:, 0].max())
    )
    wall = lj.Obstacle(
        triangles=jnp.asarray(side), position=(scene.mesh.points[:, 0].max(), 0.0, 0.0), axis=(-1.0, 0.0, 0.0)
    )
    (said,) = cautions_of_waves(replace(scene, physics=(wall,)))
    assert said.startswith("obstacle.0 touches the body without pressure")
    assert cautions_of_waves(replace(scene, physics=(wall,)), 0.99 * scene.mesh.points) == []
    assert cautions_of_waves(replace(scene, physics=(wall,)), 1.01 * scene.mesh.points) == []
    (said,) = cautions_of_waves(replace(scene, displaced=()))
    assert said.startswith("the scene has no excitation")


@pytest.mark.slow
def test_an_obstacle_stands_where_it_begins():
    """Scenes made in Python may have histories for transient runs. Harmonic motion uses the position at their
    beginning.
    """
    scene = slab(2, 1)
    side = lj.boundary.boundary_triangles(
        scene.mesh, np.flatnonzero(scene.mesh.points[:, 0] > 0.999 * scene.mesh.points[:, 0].max())
    )
    length = float(scene.mesh.points[:, 0].max())
    far = lj.Obstacle(triangles=jnp.asarray(side), position=(2 * length, 0.0, 0.0), axis=(-1.0, 0.0, 0.0))
    way, times = jnp.array([-1.2 * length, 0.0, 0.0]), jnp.array([0.0, 1.0])

    def moved(obstacle: lj.Obstacle) -> np.ndarray:
        return np.asarray(lj.harmonic(replace(scene, physics=(obstacle,)), FREQUENCIES).displacement)

    alone, touching = moved(far), moved(replace(far, position=(0.8 * length, 0.0, 0.0)))
    assert np.abs(alone - touching).max() > 1e-3 * np.abs(alone).max()
    assert np.array_equal(moved(replace(far, by=way)), alone)
    assert np.array_equal(moved(replace(far, by=way, times=times, history=jnp.array([0.0, 1.0]))), alone)
    begins_inside = replace(far, times=times, history=jnp.stack([way, 0 * way]))
    assert np.allclose(moved(begins_inside), touching, rtol=1e-12, atol=1e-12 * np.abs(alone).max())


def test_physics_without_harmonic_motion_is_refused():
    scene = slab(2, 1)
    top = jnp.asarray(lj.boundary.boundary_triangles(scene.mesh, scene.mesh.node_sets["z_max"]))
    for change, words in (
        ({"traction": (lj.Traction(triangles=top, pressure=1.0),)}, "follows the body"),
        ({"solve": lj.Solve(volumetric="nodal")}, "isochoric"),
    ):
        with pytest.raises(lj.InputError, match=words):
            lj.harmonic(replace(scene, **change), FREQUENCIES)
