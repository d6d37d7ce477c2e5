"""The simulated rheometer: discrete and continuous formulas, orders, gradients, other programs, extreme cases."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from fitting.fits import sample_inertia, simulated_rheometer, viscoelastic
from fitting.methods import generalised_maxwell
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import with_friction
from fitting.readers.rheometer import Sweep, read_sweep
from fitting.rigs import torsion
from fitting.rigs.torsion import Drive
from liverjax.core.struct import replace
from liverjax.physics import viscosity

pytestmark = pytest.mark.quick_to_compile

OMEGA = 2 * np.pi * np.array([0.1, 1.0, 4.0])
STRAIN = 1e-4


@pytest.fixture(scope="module")
def rig():
    return torsion.make_rig(cell_size=0.004)


@pytest.fixture(scope="module")
def law():
    return lj.laws.typical("neo_hookean")


@pytest.fixture(scope="module")
def prony():
    return lj.Prony(ratios=jnp.array([0.235, 0.333]), relaxation_times=jnp.array([0.27, 0.03]))


def _complex(m: torsion.Moduli) -> np.ndarray:
    return np.asarray(m.storage) + 1j * np.asarray(m.loss)


def _of_the_mesh(m: torsion.Moduli) -> np.ndarray:
    """Return the moduli without their correction."""
    return _complex(m) * np.asarray(m.bias)


def _discrete(prony, omega, steps):
    omega = jnp.asarray(omega)
    return 770 * (1 - np.asarray(viscosity.complex_ratios(prony, omega, 2 * jnp.pi / omega / steps).sum(axis=0)))


def _amplitude(rig, by):
    return torsion.torque_for_strain(rig, 500.0, STRAIN) if by == "torque" else STRAIN * rig.height / rig.radius


CASES = [pytest.param(*c, marks=pytest.mark.slow) for c in (("chapter", "torque"), ("exponential", "angle"))]


@pytest.mark.ci
@pytest.mark.parametrize(("scheme", "by"), [("exponential", "torque"), *CASES])
def test_cycle_answers_the_discrete_formula(rig, law, prony, scheme, by, verified):
    prony = replace(prony, scheme=scheme)
    m = torsion.moduli(rig, law, prony, OMEGA, _amplitude(rig, by), Drive(by=by, cycles=3))
    off = np.abs(_complex(m) / _discrete(prony, OMEGA, 50) - 1).max()
    verified(f"torsion of a plate, {scheme} recursion, by {by}: G*", "discrete formula of linear theory", off, 1e-6)
    assert off < 1e-6
    assert m.statistics.status.max() == 0 and m.statistics.residual.max() < 1e-9
    assert m.defect.max() < 1e-6
    # One cycle is enough for a fit. It starts on the cycle, and the rest is of the order of the strain.
    one = torsion.moduli(rig, law, prony, OMEGA, _amplitude(rig, by), Drive(by=by))
    assert np.abs(_complex(one) / _discrete(prony, OMEGA, 50) - 1).max() < 0.1 * STRAIN


@pytest.mark.slow
def test_from_rest_the_transient_dies_to_the_same_answer(rig, law, prony):
    drive = Drive(by="angle", start="rest", cycles=12)
    m = torsion.moduli(rig, law, prony, OMEGA[1:2], _amplitude(rig, "angle"), drive)
    assert np.abs(_complex(m) / _discrete(prony, OMEGA[1:2], 50) - 1).max() < 1e-6


@pytest.mark.ci
@pytest.mark.parametrize(("scheme", "order"), [("exponential", 2), pytest.param("chapter", 1, marks=pytest.mark.slow)])
def test_observed_order_in_time(rig, law, prony, scheme, order, verified):
    prony = replace(prony, scheme=scheme)
    exact = 770 * (1 - viscosity.complex_ratios(prony, OMEGA[2:]).sum(axis=0))
    errors = []
    for steps in (25, 50):
        drive = Drive(by="angle", cycles=2, steps=steps)
        m = torsion.moduli(rig, law, prony, OMEGA[2:], _amplitude(rig, "angle"), drive)
        errors.append(abs(_complex(m) - exact)[0])
    rates = np.log2(np.asarray(errors[:-1]) / np.asarray(errors[1:]))
    off, exact = np.abs(rates - order).max(), "continuous Maxwell model"
    verified(f"torsion, {scheme} recursion: order {order} in time", exact, off, 0.15, rates[-1])
    assert off < 0.15, rates


@pytest.mark.ci
def test_geometry_factor_converges_at_second_order(law, verified):
    # These cell sizes divide the sample evenly, so that every mesh is twice as fine in each direction.
    excess = [float(torsion.geometry_factor(torsion.make_rig(cell_size=0.004 / n), law)) - 1 for n in (1, 2, 4)]
    rates = np.log2(np.asarray(excess[:-1]) / np.asarray(excess[1:]))
    verified("torsion of an elastic cylinder: stiffness, 1 mm cells", "pi r^4 G / (2 h)", excess[-1], 0.05, rates[-1])
    assert excess[-1] < 0.05 and rates[-1] > 1.7, (excess, rates)


@pytest.mark.slow
def test_correction_removes_the_mesh_bias(law, prony):
    meshes = [torsion.make_rig(cell_size=c) for c in (0.004, 0.0025)]
    found = [torsion.moduli(r, law, prony, OMEGA[1:2], _amplitude(r, "torque")) for r in meshes]
    raw, corrected = ([of(m)[0] for m in found] for of in (_of_the_mesh, _complex))
    assert abs(raw[0] / raw[1] - 1) > 0.1
    assert abs(corrected[0] / corrected[1] - 1) < 0.1 * STRAIN


@pytest.mark.slow
def test_relaxing_the_isochoric_part_alone(rig, law, prony):
    # Torsion does not change the volume, so relaxation of the isochoric part alone has the same formula. The bias of
    # the mesh is used at each frequency. With the elastic bias, the error would be 26 % on this coarse mesh.
    m = torsion.moduli(
        rig, law, replace(prony, part="isochoric"), OMEGA, _amplitude(rig, "angle"), Drive(by="angle", cycles=3)
    )
    difference = np.abs(_complex(m) / _discrete(prony, OMEGA, 50) - 1).max()
    assert difference < 1e-6


#: Radius and height [m]: of the README's data, of a small rig, of a tall and of a flat sample.
PLATES = [(0.004, 0.0092), (0.01, 0.004), (0.01, 0.041), (0.02, 0.001)]


@pytest.mark.slow
@pytest.mark.parametrize(("radius", "height"), PLATES)
def test_a_hundred_nodes_are_enough_at_small_strain(law, prony, radius, height):
    """After the correction, the remaining error is of the order of the strain, on every mesh."""
    rig, strain = torsion.make_rig(radius, height, torsion.linear_cell_for(radius, height)), 1e-3
    assert 70 <= rig.mesh.number_of_nodes <= 200
    angle = strain * height / radius
    m = torsion.moduli(rig, law, prony, OMEGA, angle, Drive(by="angle"))
    exact = np.asarray(torsion.linear_moduli(law, prony, jnp.asarray(OMEGA), 50))
    assert np.abs(_complex(m) / exact - 1).max() < 0.1 * strain
    assert np.allclose(m.bias, torsion.geometry_factor(rig, law), rtol=1e-9)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("part", "density"),
    [("all", 1060.0), *(pytest.param(part, None, marks=pytest.mark.slow) for part in ("all", "isochoric"))],
)
def test_the_linear_rig_has_the_derivatives_of_the_simulation(part, density):
    """The derivative along a random direction in all parameters is exact up to the order of the strain; a fit needs no
    more. With inertia, the mesh error of the inertial part, a sixth of the modulus, is added.
    """
    sweep = Sweep(OMEGA, np.array([320.0, 480.0, 580.0]), np.array([50.0, 110.0, 130.0]))
    simulation = simulated_rheometer.Simulation(cell_size=0.004, part=part, density=density, height=0.02)
    rig, law = simulated_rheometer.rig_of(simulation), lj.laws.typical("neo_hookean")
    torque = torsion.torque_for_strain(rig, np.hypot(sweep.storage, sweep.loss), simulation.strain)
    measured = np.concatenate([sweep.storage, sweep.loss])
    data = (rig, law, jnp.asarray(OMEGA), torque, measured, np.ones(6))
    run = jax.jit(partial(simulated_rheometer.with_jacobian, simulation=simulation))
    model = Maxwell(np.array(770.0), np.array([0.235, 0.333]), np.array([0.27, 0.03]))
    u, direction = generalised_maxwell.unconstrained(model), np.random.default_rng(0).normal(size=5)
    slope = np.asarray(run(u, data)[1]) @ direction
    h = 1e-4  # truncation h^2, rounding of the solved steps 1e-9 / h
    up, down = (np.asarray(run(u + s * h * direction, data)[0]) for s in (1, -1))
    allowed = simulation.strain if density is None else 0.02
    assert np.abs((up - down) / (2 * h) - slope).max() < allowed * np.abs(slope).max()


def test_inertia_and_large_strain_keep_the_derivative_and_the_mesh_of_the_simulation(monkeypatch):
    coarse = simulated_rheometer.rig_of(simulated_rheometer.Simulation()).mesh.number_of_nodes
    heavy, pressed = (simulated_rheometer.Simulation(density=1060.0, precompression=e) for e in (0.0, 0.05))
    for simulation in (heavy, simulated_rheometer.Simulation(strain=0.05)):
        assert simulated_rheometer.rig_of(simulation).mesh.number_of_nodes > 2 * coarse
    for simulation in (pressed, simulated_rheometer.Simulation(strain=0.05)):
        monkeypatch.setattr(simulated_rheometer, "simulated_residuals", lambda u, *_: (u**2, None))
        _, J, _ = simulated_rheometer.with_jacobian(jnp.arange(3.0), (), simulation)
        assert np.allclose(J, np.diag([0.0, 2.0, 4.0]))


def inertial(omega, G, height):
    """Return the measured modulus of a cylinder of 1060 kg/m^3: G k h cot(k h), written out."""
    x = omega * height * np.sqrt(1060.0 / G)
    return G * x * np.cos(x) / np.sin(x)


@pytest.mark.slow
@pytest.mark.parametrize("by", ["torque", "angle"])
def test_a_cycle_with_inertia_begins_without_a_transient(law, prony, by, verified):
    """One cycle agrees with the torsional wave. When the cycle started without inertia, G'' had an error of 16 % here.

    The rest is the error of mesh and steps in the inertial part. More cycles do not change it.
    """
    height, omega = 0.005, 2 * np.pi * np.array([5.0, 20.0, 30.0])
    rig = torsion.make_rig(0.010, height, cell_size=0.004, density=1060.0)
    G = 770 * (1 - np.asarray(viscosity.complex_ratios(prony, jnp.asarray(omega)).sum(axis=0)))
    exact = inertial(omega, G, height)
    assert np.abs(exact / G - 1)[-1] > 0.4
    drive = Drive(steps=50, by=by)
    size = torsion.torque_for_strain(rig, np.abs(exact), STRAIN) if by == "torque" else STRAIN * height / 0.010
    m = torsion.moduli(rig, law, prony, omega, size, drive)
    off = np.abs(_complex(m) - exact) / np.abs(G)
    assert np.all(off < 0.02) and float(m.defect.max()) < 1e-3
    six = torsion.moduli(rig, law, prony, omega, size, drive._replace(cycles=6))
    assert np.abs(_complex(six) - _complex(m)).max() < 1e-3 * np.abs(exact).min()
    assert int(m.statistics.linear_iterations.max()) < 10  # 43 with the inverse of the stiffness alone
    verified(f"inertia of a sample in torsion driven by {by}, one cycle", "torsional wave, k h cot(k h)", off[-1], 0.02)


@pytest.mark.slow
def test_from_rest_a_given_angle_with_inertia_does_not_oscillate(law, prony):
    """The torque had grown to 300 times that of the cycle, with a loss of the wrong sign."""
    rig, omega = torsion.make_rig(cell_size=0.008, density=1060.0), 2 * np.pi * 10.0
    found = []
    for drive in (Drive(steps=40, cycles=2, by="angle"), Drive(steps=40, cycles=2, by="angle", start="rest")):
        torque, angle = torsion.demodulate(torsion.oscillate(rig, law, prony, omega, 0.02, drive), omega, drive)
        found.append(complex(torque / angle))
    # The plate's own inertia is late by about one time step, here 0.16 rad. It is less than 0.3 of the torque.
    assert abs(found[1] - found[0]) < 0.16 * 0.3 * abs(found[0])


def test_inertia_is_taken_off_and_put_back():
    omega = np.geomspace(1.0, 200.0, 20)
    G = 300 + 900 * (1j * omega / 100) ** 0.4
    seen = inertial(omega, G, 0.008)
    assert np.abs(seen / G - 1).max() > 0.5
    np.testing.assert_allclose(sample_inertia.shown(G, omega, 1060.0, 0.008), seen, rtol=1e-13)
    np.testing.assert_allclose(sample_inertia.modulus_of(seen, omega, 1060.0, 0.008), G, rtol=1e-9)
    sweep = Sweep(omega, seen.real, seen.imag)
    own = sample_inertia.taken_off(sweep, 1060.0, 0.008)
    np.testing.assert_allclose(own.storage + 1j * own.loss, G, rtol=1e-9)
    assert "the inertia of the sample, 8 mm high, is subtracted" in own.notes[-1]
    back = sample_inertia.put_back(own, 1060.0, 0.008)
    np.testing.assert_allclose(back.storage + 1j * back.loss, seen, rtol=1e-9)
    # No modulus of a passive material has such a small loss if inertia dominates.
    with pytest.raises(lj.InputError, match="the inertia of the sample is too large to compute the modulus"):
        sample_inertia.taken_off(Sweep(omega, 0 * omega + 1.0, 0 * omega - 50.0), 1060.0, 0.008)


def test_the_inertia_of_a_sample_in_tension_is_that_of_young_s_modulus(tmp_path):
    """The formula of torsion was used for E / 3. So G' of 10 kPa became 21 kPa."""
    omega, young = 2 * np.pi * np.geomspace(1, 50, 12), 30e3 * (1 + 0.1j)
    x = omega * 0.02 * np.sqrt(1060 / young)
    seen = young * x / np.tan(x)
    rows = np.column_stack([omega / (2 * np.pi), seen.real, seen.imag])
    sweeps = {}
    for name in ("E", "bending E"):
        head = f"frequency_Hz,{name}' [Pa],{name}'' [Pa]"
        np.savetxt(tmp_path / "e.csv", rows, "%.17g", ",", header=head, comments="")
        sweeps[name] = read_sweep(tmp_path / "e.csv")
    own = sample_inertia.taken_off(sweeps["E"], 1060.0, 0.02)
    np.testing.assert_allclose(own.storage + 1j * own.loss, 10e3 * (1 + 0.1j) * np.ones(12), rtol=1e-9)
    assert own.tensile and sweeps["E"].load == "tension"
    back = sample_inertia.put_back(own, 1060.0, 0.02)
    np.testing.assert_allclose(back.storage, seen.real / 3, rtol=1e-9)
    # The simulation has the inertia of torsion, so it is run without inertia.
    assert simulated_rheometer.Simulation(density=1060.0, tensile=True).run.density is None
    simulated, run = simulated_rheometer._as_simulated(
        sweeps["E"], simulated_rheometer.Simulation(0.01, 0.02, density=1060.0)
    )
    assert run.density is None
    np.testing.assert_allclose(simulated.storage, own.storage, rtol=1e-9)
    for wrong, words in (
        (lambda s: sample_inertia.taken_off(s, 1060.0, 0.02), "of bending, where .* remove --density"),
        (lambda s: with_friction(s, 1e-7, 0.01, 0.02), "of bending, and --friction-error 1e-07 .* remove"),
    ):
        with pytest.raises(lj.InputError, match=words):
            wrong(sweeps["bending E"])


@pytest.mark.ci
def test_the_linear_derivative_passes_through_any_model_and_its_prior(monkeypatch, law):
    """If the simulation is replaced by the linear rig, both derivatives are equal; here for a fluid with a prior."""
    kind = viscoelastic.FLUID._replace(prior=lambda u: 3 * u[1:] ** 2)
    u, omega = jnp.array([6.0, 0.3, -1.0, 0.7]), jnp.asarray(OMEGA)
    data = (None, law, omega, None, jnp.linspace(300, 100, 6), jnp.full(6, 7.0))

    def moduli(rig, law, prony, omega, torque, drive):
        G = torsion.linear_moduli(law, prony, omega, drive.steps)
        return SimpleNamespace(storage=jnp.real(G), loss=jnp.imag(G))

    monkeypatch.setattr(torsion, "moduli", moduli)
    simulation = simulated_rheometer.Simulation()
    r, J, _ = simulated_rheometer.with_jacobian(u, data, simulation, kind)
    G = _discrete(simulated_rheometer.law_and_prony(kind.maxwell(u), law, simulation)[1], OMEGA, simulation.steps)
    expected = np.concatenate([G.real, G.imag]) * np.exp(6.0) / 770 - np.linspace(300, 100, 6)
    assert np.allclose(r[:6], expected / 7, rtol=1e-9) and np.allclose(r[6:], 3 * u[1:] ** 2)
    whole = jax.jacfwd(lambda u: simulated_rheometer.simulated_residuals(u, data, simulation, kind)[0])(u)
    assert J.shape == (9, 4) and np.allclose(J, whole, rtol=1e-12, atol=1e-12)


LAWS_OWN = {"neo_hookean": {"bulk": 1.0}, "mooney_rivlin": {"c10": 1.0, "c01": 1.0}}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["neo_hookean", "mooney_rivlin"])
def test_gradients_against_central_differences(rig, name):
    """The error curve is V-shaped: it falls with the step (truncation) and rises again (rounding). Its minimum is below
    1e-6.
    """
    base = lj.laws.typical(name)
    own = list(LAWS_OWN[name])
    drive = Drive(options=torsion.newton.NewtonOptions(tolerance=1e-12))
    amplitude = torsion.torque_for_strain(rig, 500.0, 1e-3)

    @jax.jit
    def moduli(p):
        law = lj.laws.scaled(base, p[0])
        law = replace(law, **{k: getattr(law, k) * p[5 + i] for i, k in enumerate(own)})
        prony = lj.Prony(ratios=p[1:3], relaxation_times=p[3:5])
        m = torsion.moduli(rig, law, prony, OMEGA[1:], amplitude, drive)
        G = (m.storage + 1j * m.loss) * m.bias
        return jnp.concatenate([jnp.real(G), jnp.imag(G)])

    p = jnp.array([1.0, 0.235, 0.333, 0.27, 0.03] + [1.0] * len(own))
    J = np.asarray(jax.jit(jax.jacfwd(moduli))(p))
    for k in range(len(p)):
        errors = []
        for h in (1e-2, 1e-3, 1e-4, 1e-5, 1e-7):
            up, down = (moduli(p.at[k].multiply(1 + s * h)) for s in (1, -1))
            difference = np.asarray(up - down) / (2 * h * float(p[k]))
            errors.append(np.abs(difference - J[:, k]).max() / np.abs(J[:, k]).max())
        assert min(errors) < 1e-6, (k, errors)
        best = int(np.argmin(errors))
        # The moduli are linear in the stiffnesses. There is no truncation error, and only rounding rises.
        assert errors[-1] > errors[best] and (errors[0] > errors[best] or errors[0] < 1e-9), (k, errors)


@pytest.mark.slow
def test_reverse_mode_agrees_with_forward_mode(rig, law, prony):
    def loss(tau):
        m = torsion.moduli(rig, law, replace(prony, relaxation_times=tau), OMEGA[1:2], _amplitude(rig, "torque"))
        return m.loss[0]

    tau = prony.relaxation_times
    assert np.allclose(jax.jit(jax.grad(loss))(tau), jax.jit(jax.jacfwd(loss))(tau), rtol=1e-8)


@pytest.mark.ci
def test_torque_history_against_febio(febio, prony, verified):
    points, rows = (
        np.loadtxt(febio / "cyl_nodes.csv", delimiter=","),
        np.loadtxt(febio / "c_torsion_f1Hz.csv", delimiter=","),
    )
    mesh = lj.tet_mesh(points, np.loadtxt(febio / "cyl_tets.csv", delimiter=",", dtype=int))
    rig = torsion.rig_from_mesh(mesh, 0.010, 0.004)
    law = lj.laws.NeoHookeanCompressible(mu=770.0, lame_lambda=3080.0)
    drive = Drive(steps=100, cycles=3, by="angle", start="rest")
    run = torsion.oscillate(rig, law, prony, 2 * np.pi, 4e-4, drive)
    assert np.allclose(run.time, rows[:, 0], atol=1e-12)
    # FEBio turns the plate by u = theta (-y, x, 0), without the cosine: a difference of theta^2/2 = 8e-8.
    off = np.abs(run.torque - rows[:, 2]).max() / np.abs(rows[:, 2]).max()
    verified("viscous torsion from rest, three cycles: torque", "FEBio, same mesh and steps", off, 1e-6)
    assert off < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("cell_size", [0.005, 0.0035])
def test_inertia_against_the_torsional_wave(law, prony, cell_size, verified):
    """A tall sample has M = pi r^4/2 G* k cot(k h) theta, k = omega sqrt(rho/G*). At 41 mm the inertia is large."""
    height, omega = 0.041, 2 * np.pi * 2.0
    rig = torsion.make_rig(0.010, height, cell_size=cell_size, density=1060.0)
    drive = Drive(steps=50, cycles=8, by="angle")
    m = torsion.moduli(rig, law, prony, omega, STRAIN * height / 0.010, drive)
    G = 770 * (1 - complex(viscosity.complex_ratios(prony, omega).sum()))
    k = omega * np.sqrt(1060.0 / G)
    exact = G * k * height / np.tan(k * height)
    assert abs(exact / G - 1) > 0.15
    # The stiff mesh biases only the elastic part. Lumped masses of a polygon have another polar moment.
    inertial = _of_the_mesh(m)[0] - float(torsion.geometry_factor(rig, law)) * G
    mass, points = 1060.0 * np.asarray(lj.boundary.nodal_volumes(rig.mesh)), np.asarray(rig.mesh.points)
    polar = (mass * (points[:, :2] ** 2).sum(axis=1)).sum() / (np.pi / 2 * 0.010**4 * height * 1060.0)
    # The next term of the wave, (k h)^2 / 15 = 3 % of the inertial part, also depends on the stiff mesh. Masses lumped
    # in N layers have the moment of the trapezoidal rule, 1 / (2 N^2) more than the integral of z^2.
    layers = len(np.unique(points[:, 2].round(9))) - 1
    off, allowed = abs(inertial / (exact - G) / polar - 1), abs(k * height) ** 2 / 15 + 1 / (2 * layers**2)
    verified(
        f"inertia of a tall sample in torsion, {1e3 * cell_size:g} mm cells",
        "torsional wave, k h cot(k h)",
        off,
        allowed,
    )
    assert off < allowed
    if cell_size < 0.005:
        still = replace(rig, density=None)
        m = torsion.moduli(still, law, prony, omega, STRAIN * height / 0.010, Drive(by="angle"))
        assert abs(_complex(m)[0] / G - 1) < 5e-3


@pytest.mark.ci
def test_state_holds_only_the_physics_there_is(rig, law, prony):
    def carried(rig, prony):
        drive = Drive()
        state = torsion._initial(torsion._Oscillation(rig, law, prony, 1.0, 1.0, drive), jnp.ones(n), jnp.array(1j))
        return [leaf.shape for leaf in jax.tree.leaves(state)]

    n, E = 3 * (rig.mesh.number_of_nodes - rig.bottom - rig.top) + 1, rig.mesh.number_of_elements
    assert carried(rig, None) == [(n,)]
    assert carried(rig, replace(prony, scheme="chapter")) == [(n,), (2, 6, E)]
    assert len(carried(replace(rig, density=1000.0), None)) == 1 + 2  # velocity and acceleration


@pytest.mark.ci
def test_strain_sweep_finds_where_linearity_ends(rig):
    strains = np.array([1e-4, 1e-3, 1e-2, 0.05, 0.1, 0.2])
    soft = lj.laws.NeoHookean(mu=770.0, bulk=7.7e4)
    m = torsion.strain_sweep(rig, soft, None, strains, drive=Drive(steps=20, by="angle"))
    # Rivlin: the torque of an incompressible neo-Hookean (or Mooney-Rivlin) cylinder is linear in the twist.
    assert m.statistics.status.max() == 0
    assert np.abs(np.asarray(m.storage) / 770 - 1).max() < 0.01
    assert torsion.linearity_limit(strains, m.storage) == np.inf
    assert np.allclose(m.strain, strains, rtol=1e-12)
    stiff = lj.laws.typical("saint_venant_kirchhoff")
    m = torsion.strain_sweep(rig, stiff, None, strains, drive=Drive(steps=20, by="angle"))
    limit = torsion.linearity_limit(strains, m.storage, deviation=0.02)
    assert 0.01 < limit < 0.2
    assert np.isclose(m.storage[0], 770, rtol=1e-6)


def test_the_end_of_linearity_needs_finite_moduli():
    """With a first modulus that is not finite, the largest strain was returned."""
    strains = np.array([1e-3, 1e-2, 0.1])
    assert torsion.linearity_limit(strains, [700.0, 700.0, np.nan]) == 1e-2
    assert np.isnan(torsion.linearity_limit(strains, [np.nan, 700.0, 700.0]))


@pytest.mark.ci
def test_free_plate_rises(law):
    rig = torsion.make_rig(cell_size=0.004, free_height=True)
    angle = 0.2 * 0.004 / 0.010
    run = torsion.oscillate(rig, law, None, 1.0, angle, Drive(steps=20, by="angle"))
    assert run.statistics.status.max() == 0
    half = torsion.oscillate(rig, law, None, 1.0, angle / 2, Drive(steps=20, by="angle"))
    # The Poynting effect is even in the twist, of second order. (This mesh is chiral and adds a small odd part.)
    even, even_half = ((r.lift[5] + r.lift[15]) / 2 for r in (run, half))
    assert even > 0 and np.isclose(even / even_half, 4, rtol=0.02)


def test_impossible_geometry_is_refused():
    with pytest.raises(lj.InputError, match=r"radius = -0\.01 must be positive"):
        torsion.make_rig(-0.01, 0.004)
