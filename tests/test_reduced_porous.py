"""Reduced models of porous scenes: the full equations in other coordinates, their tangent, errors and files."""

from typing import NamedTuple

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core.struct import replace
from liverjax.jobs import reduction
from liverjax.laws.base import Volumetric
from liverjax.mesh.nodal import integrals, nodal_volumes
from liverjax.physics.porosity import Inlet
from liverjax.reduced import step, training
from liverjax.reduced.model import as_matrix, solid_at_points, with_all_points
from liverjax.reduced.physics import fluid as reduced_fluid
from liverjax.reduced.physics.fluid import flowing, fluid_at_rest, reduced_sponge, storage_and_flow
from liverjax.reduced.sampling import _at
from liverjax.reduced.tangent import in_single_precision, tangent_matrix
from liverjax.tensors.matrices import determinant

pytestmark = pytest.mark.quick_to_compile

PRONY = lj.Prony(ratios=jnp.array([0.3, 0.2]), relaxation_times=jnp.array([0.3, 0.03]))
MOVING = lj.Solve(kind="dynamic", dt=0.05, steps=3)


def _sponge(cells: tuple, order: int = 1, solve: lj.Solve = MOVING, **numbers) -> lj.Scene:
    """A viscous porous body of 3 x 1 x 1 cm, fixed at x = 0 under its weight, drained at the other end."""
    mesh = lj.shapes.box([0.03, 0.01, 0.01], list(cells))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    held, drained = (jnp.asarray(lj.boundary.select(mesh, w, None, "ends")) for w in ({"x_max": 0.0}, {"x_min": 0.03}))
    numbers = {"bulk": 400.0, "limit_bulk": 2200.0, "fluid_fraction": 0.5, "permeability": 2e-7} | numbers
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=800.0, bulk=3000.0),
        fixed=(lj.Fixed(nodes=held),),
        body=lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -1.0])),
        viscosity=PRONY,
        porosity=lj.Porosity(drained=drained, **numbers),
        solve=solve,
    )


def _whole(scene: lj.Scene) -> lj.ReducedModel:
    """Return a model with one mode per free degree of freedom, one per unknown pressure, and all points."""
    mesh = scene.mesh
    free = lj.boundary.free_degrees(mesh, scene.fixed, ())
    modes = np.eye(free.size)[np.flatnonzero(free.ravel())].reshape(-1, *free.shape)
    modes = modes / np.sqrt(np.asarray(nodal_volumes(mesh)))[:, None]  # orthonormal with these volumes
    unknown = np.setdiff1d(np.arange(mesh.number_of_vertices), np.asarray(scene.porosity.drained))
    volumes = np.asarray(integrals(mesh, jnp.ones_like(mesh.weights)))
    pressures = np.eye(mesh.number_of_vertices)[unknown] / np.sqrt(volumes[unknown])[:, None]
    return with_all_points(scene, jnp.asarray(modes), jnp.asarray(pressures))


CASES = [
    pytest.param(1, "lagged", lj.Solve(dt=0.1, steps=3), id="lagged-at-rest", marks=pytest.mark.slow),
    pytest.param(2, "implicit", replace(MOVING, integrator="newmark"), id="quadratic", marks=pytest.mark.slow),
]


def _with_a_region(scene: lj.Scene) -> lj.Scene:
    """Return the scene with a region of other porous parameters, which belong to points of the region."""
    soft = lj.Region(elements=jnp.arange(2), porosity={"permeability": 2e-8, "bulk": 300.0})
    return replace(scene, region=(soft,))


def _assert_same(scene: lj.Scene, x: jax.Array, P: jax.Array) -> None:
    """Check that the model of all motions, pressures and points gives these positions and pressures of the full
    model.
    """
    model = _whole(scene)
    found = lj.simulate_reduced(model, scene)
    assert not np.any(found.status)
    moved, size = np.abs(x - scene.mesh.points[None]).max(), np.abs(P).max()
    assert size > 1.0
    # The bound is the solver's tolerance of 1e-8 times a condition number of some thousands.
    assert np.abs(lj.reduced_positions(model, scene, found) - x).max() < 1e-5 * moved
    assert np.abs(lj.reduced_pressure(model, scene, found) - P).max() < 1e-5 * size


@pytest.mark.slow
@pytest.mark.parametrize(("order", "scheme", "solve"), CASES)
def test_all_motions_pressures_and_points_are_the_full_model(order, scheme, solve):
    scene = _with_a_region(_sponge((1, 1, 1), order, solve, scheme=scheme, initial_pressure=5.0))
    full = lj.simulate(scene).check()
    _assert_same(scene, full.positions, full.pressure)


@pytest.mark.ci
@pytest.mark.parametrize("order", [1, 2])
def test_storage_at_vertices_is_that_of_the_points(order):
    """The sampled points belong to several elements that share vertices, with uneven volumes."""
    scene = _sponge((2, 1, 1))
    scene = replace(scene, mesh=lj.quadratic(scene.mesh)) if order == 2 else scene
    rng, V = np.random.default_rng(4), scene.mesh.number_of_vertices
    modes = jnp.asarray(rng.normal(size=(2, scene.mesh.number_of_nodes, 3)))
    model = with_all_points(scene, modes, jnp.asarray(rng.normal(size=(3, V))))
    model = _at(model, np.arange(0, len(model.points), 2), 2 * model.weights[::2])
    F = fluid_at_rest(model, scene).F + 0.02 * rng.normal(size=(9, len(model.points)))
    sponge = reduced_sponge(model, scene)
    own = reduced_fluid._stored_at_vertices(model, sponge, determinant(as_matrix(F)))
    stores = storage_and_flow(model, sponge.porosity, F)[0]
    exact = np.einsum("kas,las->kl", stores, stores)
    np.testing.assert_allclose(own, exact, rtol=1e-13, atol=1e-13 * np.abs(exact).max())
    one = _at(model, np.arange(1), model.weights[:1])
    assert reduced_sponge(one, scene).lumped is None  # fewer points than vertices


def test_derivatives_without_flow_are_finite():
    """They were NaN, because a square root contained the permeability."""
    scene = _sponge((1, 1, 1), permeability=0.0)
    model = _whole(scene)
    sponge, rest = reduced_sponge(model, scene), fluid_at_rest(model, scene)

    @jax.jit
    def inverse(kappa, size):
        own = sponge._replace(porosity=replace(sponge.porosity, permeability=kappa))
        return jnp.sum(flowing(model, own, rest._replace(F=size * rest.F), 0.05).inverse)

    slopes = jax.jit(jax.grad(inverse, (0, 1)))(0.0, 0.9)
    assert np.isclose(slopes[0], (inverse(1e-9, 0.9) - inverse(0.0, 0.9)) / 1e-9, rtol=1e-2) and slopes[0] < 0
    assert np.isclose(slopes[1], (inverse(0.0, 0.901) - inverse(0.0, 0.899)) / 2e-3, rtol=1e-3)


@pytest.mark.ci
@pytest.mark.parametrize("scheme", ["implicit", "lagged"])
def test_the_tangent_is_the_derivative_of_the_forces(scheme):
    scene = _sponge((1, 1, 1), scheme=scheme)
    model = _whole(scene)
    rng, n = np.random.default_rng(2), model.number_of_modes
    memory = fluid_at_rest(model, scene)
    memory = memory._replace(pressure=jnp.asarray(rng.normal(size=len(memory.pressure))), F=memory.F + 0.01)
    fluid = flowing(model, reduced_sponge(model, scene), memory, 0.05)
    elastic = replace(scene, viscosity=None, porosity=None)
    acting = solid_at_points(model, elastic).freeze(None, None)
    rest, none = jnp.tile(jnp.eye(3).reshape(9, 1), len(model.points)), jnp.zeros(n)
    light = in_single_precision(model.slopes)
    known, dt = (model, acting, none, rest), jnp.asarray(0.05)
    e = step.ReducedEquations(*known, None, none, None, dt, None, None, 0.0, fluid, light, dt)
    q = jnp.asarray(1e-4 / np.abs(model.modes).max() * rng.normal(size=n))  # 0.1 mm
    # One program, because the single operations take ten times as long to compile.
    exact = jax.jit(jax.jacfwd(lambda q: step._residual(e, q, step.gradients_at(e, q))[0]))(q)
    found = jax.jit(lambda q: tangent_matrix(step._reduced_tangent(e, q)))(q)
    assert np.allclose(found, exact, rtol=0, atol=1e-12 * np.abs(exact).max())
    assert np.allclose(found, found.T, rtol=0, atol=1e-12 * np.abs(exact).max())


class Trained(NamedTuple):
    """A porous body in motion, its reduced model of few runs, and two full runs with other values."""

    scene: lj.Scene
    model: lj.ReducedModel
    unseen: list[lj.Scene]
    full: list[lj.Result]


@pytest.fixture(scope="module")
def trained() -> Trained:
    """All full runs, including those of the training, are in one batch, so they share a program."""
    scene = _with_a_region(_sponge((4, 1, 1), initial_pressure=5.0))
    rng = np.random.default_rng(1)
    gravity = 0.2 * np.stack([rng.uniform(-2, 2, 8), rng.uniform(-2, 2, 8), rng.uniform(-5.0, -2.0, 8)], axis=1)
    more = [[0.1, -0.2, -0.8], [0.0, 0.6, 0.4]]
    rows = {"porosity.permeability": np.concatenate([rng.uniform(1e-7, 3e-7, 8), [2e-7, 6e-7]])}
    rows["body.gravity"] = np.concatenate([gravity, more])
    batch = lj.simulate_batch(scene, rows)
    with pytest.MonkeyPatch.context() as patch:
        first = replace(batch, result=jax.tree.map(lambda a: a[:8], batch.result))
        patch.setattr(training, "simulate_batch", lambda *_: first)
        model = lj.reduce_scene(scene, {n: v[:8] for n, v in rows.items()}, most_modes=6, point_tolerance=1e-3)
    unseen = [lj.with_parameters(scene, {name: value[k] for name, value in rows.items()}) for k in (8, 9)]
    return Trained(scene, model, unseen, [jax.tree.map(lambda a, k=k: a[k], batch.result).check() for k in (8, 9)])


@pytest.mark.slow
def test_all_motions_pressures_and_points_are_the_full_model_in_motion(trained):
    _assert_same(trained.unseen[0], trained.full[0].positions, trained.full[0].pressure)


@pytest.mark.slow
def test_points_serve_motion_and_pressure_and_the_errors_are_stated(trained):
    scene, model = trained.scene, trained.model
    assert len(model.points) < scene.mesh.weights.size and model.pressures.modes.shape[0] == 3
    assert not np.any(np.asarray(model.pressures.modes)[:, np.asarray(scene.porosity.drained)])
    for own, full in zip(trained.unseen, trained.full, strict=True):
        for m in (replace(model, correction=None), model):
            found = lj.simulate_reduced(m, own)
            found = lj.reduced_error(m, own, found)
            true = np.linalg.norm(lj.reduced_positions(m, own, found) - full.positions, axis=-1).max(axis=1)
            off = np.abs(lj.reduced_pressure(m, own, found) - full.pressure).max(axis=1)
            # Few modes are not exact, so there is an error.
            assert true.max() > 1e-6 and off.max() > 0.02
            assert np.all((true < 2 * found.error) & (found.error < 2 * true + 1e-7))
            assert np.all((off < 2 * found.pressure_error) & (found.pressure_error < 2 * off + 2e-3))


@pytest.mark.slow
def test_a_scene_that_names_a_porous_model_is_run_by_it(trained, tmp_path):
    lj.save_reduced(trained.model, tmp_path / "model.h5")
    own, full = trained.unseen[0], trained.full[0]
    solve = replace(own.solve, reduced=str(tmp_path / "model.h5"), reduced_tolerance=0.1)
    ran, said = reduction.tried(replace(own, solve=solve))
    assert "estimated error" in said and "Pa of pressure" in said and "the full model runs" not in said
    assert 0 < np.abs(ran.result.pressure - full.pressure).max() < 0.1 * np.abs(full.pressure).max()


@pytest.mark.slow
def test_derivatives_by_numbers_of_the_fluid(trained):
    scene, model, *_ = trained

    def tip(k):
        own = lj.with_parameters(scene, {"porosity.permeability": 1e-7 * k, "porosity.bulk": 200.0 * k})
        found = lj.simulate_reduced(model, own)
        p = lj.reduced_pressure(model, own, found)[-1, 0]
        return 1e3 * lj.reduced_positions(model, own, found)[-1, -1, 2] + p

    found = jax.grad(tip)(2.0)
    assert found == pytest.approx(float(jax.jacfwd(tip)(2.0)), rel=1e-10)
    steps = 10.0 ** -np.arange(1, 8)
    lanes = jax.jit(jax.vmap(tip))(jnp.concatenate([2.0 + steps, 2.0 - steps]))
    errors = np.abs((lanes[:7] - lanes[7:]) / (2 * steps) / found - 1)
    # Second order, then the run's tolerance: the curve falls and rises.
    assert errors.min() < 1e-6 and errors[0] > 1e3 * errors.min() and errors[-1] > errors.min()
    slope = jax.jit(jax.grad(tip))
    second = (slope(2.001) - slope(1.999)) / 0.002
    assert jax.jit(jax.hessian(tip))(2.0) == pytest.approx(float(second), rel=1e-4)


@pytest.mark.ci
def test_files_keep_the_pressure_and_other_fluids_are_refused(trained, tmp_path):
    scene, model, *_ = trained
    lj.save_reduced(model, tmp_path / "model.h5")
    again = lj.load_reduced(tmp_path / "model.h5")
    for name in ("modes", "values", "parts", "slopes"):
        assert np.array_equal(getattr(again.pressures, name), getattr(model.pressures, name))
    inlet = Inlet(nodes=jnp.arange(2), pressure=10.0)
    with pytest.raises(lj.InputError, match=r"cannot have \[\[porosity.inlet\]\]"):
        lj.simulate_reduced(again, replace(scene, porosity=replace(scene.porosity, inlet=(inlet,))))
    for other in (None, replace(scene.porosity, drained=None), replace(scene.porosity, scheme="lagged")):
        with pytest.raises(lj.InputError, match="was made for scene"):
            lj.simulate_reduced(again, replace(scene, porosity=other))
    dry = replace(scene, porosity=None, region=())
    solid = with_all_points(dry, model.modes)
    with pytest.raises(lj.InputError, match="no pressures"):
        lj.reduced_pressure(solid, dry, lj.simulate_reduced(solid, dry))


SCENE = """
[mesh]
shape = "box"
size = [0.03, 0.01, 0.01]
cells = [3, 1, 1]

[law]
name = "neo_hookean"
mu = 800.0
bulk = 3000.0

[viscosity]
ratios = [0.3]
relaxation_times = [0.1]

[porosity]
bulk = 400.0
limit_bulk = 2200.0
fluid_fraction = 0.5
permeability = 2e-7
drained = {x_min = 0.03}

[body]
density = 1000.0
gravity = [0.0, 0.0, -1.0]

[[fixed]]
where = {x_max = 0.0}

[solve]
kind = "dynamic"
dt = 0.05
steps = 3
"""


@pytest.mark.slow
def test_the_commands_make_and_use_a_porous_model(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    rows = "porosity.permeability,body.gravity.2\n1e-7,-1.2\n3e-7,-0.8\n2e-7,-0.4\n2e-7,-1.0\n"
    (tmp_path / "rows.csv").write_text(rows)
    model = ["--out", str(tmp_path / "model.h5")]
    assert main(["reduce", str(tmp_path / "scene.toml"), str(tmp_path / "rows.csv"), *model]) == 0
    found = {}
    for name, line in (("full", ""), ("used", 'reduced = "model.h5"')):
        (tmp_path / f"{name}.toml").write_text(SCENE + line)
        assert main(["simulate", str(tmp_path / f"{name}.toml"), "--out", str(tmp_path / name)]) == 0
        said = capsys.readouterr().out
        assert ("estimated error" in said) == (name == "used") and "the full model runs" not in said
        assert ("Pa of pressure" in said) == (name == "used")
        with h5py.File(tmp_path / name / "result.h5") as file:
            found[name] = file["positions"][()], file["pressure"][()]
            assert ("reduced_error" in file) == (name == "used")
            if name == "used":
                stated = file["reduced_error"][()].max(), file["reduced_pressure_error"][()].max()
                assert file["reduced_pressure_error"].attrs["unit"] == "Pa"
                largest = np.linalg.norm(file["positions"][()] - file["reference"][()], axis=-1).max()
    moved = np.abs(found["full"][0] - found["full"][0][0, :1]).max()
    assert 0 < np.abs(found["used"][0] - found["full"][0]).max() < 0.01 * moved
    assert 0 < np.abs(found["used"][1] - found["full"][1]).max() < 0.02 * np.abs(found["full"][1]).max()
    # With a limit between both errors, only the pressure error is too large, and the full model runs.
    part = stated[0] / largest, stated[1] / np.abs(found["used"][1]).max()
    assert part[0] < part[1]
    between = f"reduced_tolerance = {np.sqrt(part[0] * part[1]):.3g}\n"
    (tmp_path / "used.toml").write_text(SCENE + 'reduced = "model.h5"\n' + between)
    assert main(["simulate", str(tmp_path / "used.toml"), "--out", str(tmp_path / "used")]) == 0
    assert "the full model runs" in capsys.readouterr().out


@pytest.mark.parametrize("several", [False, True])
def test_regions_change_the_law_before_its_volumetric_energy_is_removed(several):
    """The law without U(J) had no `bulk`, and the second term of a sum was changed instead of the first."""
    scene, mu = _sponge((2, 1, 1)), np.where(np.arange(12) < 4, 1600.0, 800.0)
    changes = {"mu": 1600.0, "bulk": 6000.0}
    if several:
        law = Volumetric(bulk=3000.0) + lj.laws.NeoHookean(mu=800.0, bulk=1.0) + lj.laws.typical("arruda_boyce")
        scene, changes = replace(scene, law=law), {"1.mu": 1600.0}
    scene = replace(scene, region=(lj.Region(elements=jnp.arange(4), law=changes),))
    model = with_all_points(scene, jnp.zeros((1, len(scene.mesh.points), 3)))
    first, *others = solid_at_points(model, scene).law.summands()
    assert first.mu.tolist() == mu.tolist() and first.bulk is None
    assert all(jnp.ndim(own.mu) == 0 for own in others) and len(others) == several
