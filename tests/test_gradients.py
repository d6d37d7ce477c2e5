"""Derivatives of runs: central differences, forward and reverse mode, stored states, and status codes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.simulation import gradient_checkpoints, gradients

pytestmark = pytest.mark.quick_to_compile

RNG = np.random.default_rng(5)


def _scene(kind: str, cells: tuple[int, int, int] = (3, 3, 2), steps: int = 3) -> lj.Scene:
    """A block of 108 tetrahedra that hangs and is stretched, pushed and moved, with the physics objects that `kind`
    names.
    """
    names = set(kind.split())
    mesh = lj.shapes.box((0.05, 0.04, 0.03), cells)
    top = mesh.node_sets["x_max"]
    side = jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets["y_max"]))
    load = {"pressure": 30.0} if "follower" in names else {"value": jnp.array([5.0, -30.0, 10.0])}
    dynamic = bool(names & {"dynamic", "newmark", "complete"})
    viscous = bool(names & {"viscous", "isochoric", "complete"})
    porous = bool(names & {"porous", "chapter", "complete"})
    sponge = lj.Porosity(
        bulk=400.0,
        limit_bulk=2200.0,
        fluid_fraction=0.5,
        permeability=2e-6,
        drained=mesh.node_sets["z_max"] if "porous" in names else None,
        scheme="chapter" if "chapter" in names else "implicit",
    )
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=jnp.asarray(770.0), bulk=jnp.asarray(2200.0)),
        viscosity=lj.Prony(
            ratios=jnp.array([0.235, 0.333]),
            relaxation_times=jnp.array([0.27, 0.03]),
            part="isochoric" if "isochoric" in names else "all",
        )
        if viscous
        else None,
        porosity=sponge if porous else None,
        body=lj.Body(density=1060.0, gravity=jnp.array([1.0, 0.5, -4.0])),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        displaced=(lj.Displaced(nodes=top, by=jnp.array([0.004, 0.002, 0.001]), axes="xz"),),
        traction=(lj.Traction(triangles=side, **load),),
        solve=lj.Solve(
            kind="dynamic" if dynamic else "static",
            integrator="newmark" if "newmark" in names else "euler",
            steps=steps,
            dt=0.02 if dynamic or viscous or porous else None,
            tolerance=1e-12,
        ),
    )


def _leaves(scene: lj.Scene) -> dict:
    """Return every parameter of the scene by its name."""
    names = ["law.mu", "law.bulk", "body.density", "body.gravity", "displaced.0.by", "mesh.points", "start"]
    names += ["viscosity.ratios", "viscosity.relaxation_times"] if scene.viscosity is not None else []
    if scene.porosity is not None:
        names.remove("law.bulk")
        names += [f"porosity.{n}" for n in ("bulk", "limit_bulk", "fluid_fraction", "permeability")]
    names += ["solve.dt"] if scene.solve.dt is not None else []
    names += ["traction.0.pressure" if lj.boundary.follows(scene.traction) else "traction.0.value"]
    if scene.solve.kind == "static":
        names.remove("start")  # the equilibrium does not depend on its starting point
    return {name: _value(scene, name) for name in names} | {"law.mu": jnp.full(scene.mesh.number_of_elements, 770.0)}


def _value(scene: lj.Scene, name: str):
    thing = scene
    if name == "start":
        return scene.mesh.points
    for key in name.split("."):
        thing = thing[int(key)] if key.isdigit() else getattr(thing, key)
    return jnp.asarray(thing, float)


KINDS = ("static", "follower", "dynamic", "newmark", "viscous", "isochoric", "porous", "chapter", "complete")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_leaf_of_a_scene(kind):
    """Compare reverse mode with central differences (best of several steps) and with forward mode."""
    scene, rng = _scene(kind), np.random.default_rng(5)
    at = _leaves(scene)
    names = list(at)
    shape = (scene.solve.steps, *scene.mesh.points.shape)
    weight, sideways = jnp.asarray(rng.normal(size=shape)), jnp.asarray(1e-3 * rng.normal(size=shape))
    along = {}
    for name, value in at.items():
        size = 0.01 if name in ("mesh.points", "start") else 1.0
        spread = 0.003 if name in ("mesh.points", "start") else jnp.abs(value)
        along[name] = (
            size * spread * jnp.asarray(rng.choice([-1.0, 1.0], value.shape) * rng.uniform(0.5, 1, value.shape))
        )

    def loss(result):
        return jnp.sum(weight * result.positions) + jnp.sum(sideways * result.reactions)

    @jax.jit
    def moved(eps):
        values = {name: at[name] + e * along[name] for name, e in zip(names, eps, strict=True)}
        start = values.pop("start", None)
        result = lj.simulate(lj.with_parameters(scene, values), start=start)
        return loss(result), result.status

    found = lj.value_and_gradient(loss, scene, at)
    assert int(found.status) == status.CONVERGED
    slopes = np.array([float(jnp.vdot(found.gradient[name], along[name])) for name in names])
    zero = jnp.zeros(len(names))
    direction = jnp.asarray(rng.normal(size=len(names)))
    forward = jax.jit(lambda eps: jax.jvp(lambda eps: moved(eps)[0], (eps,), (direction,))[1])(zero)
    # Both modes have the same products in another order. The adjoint solves have a relative residual of 1e-13.
    assert abs(forward - slopes @ direction) < 1e-10 * (abs(slopes) @ abs(direction))

    # Errors are relative to the sum of the sizes of all contributions, because the contributions of a derivative may
    # cancel.
    sizes = [float(jnp.vdot(abs(found.gradient[name]), abs(along[name]))) for name in names]
    steps = (4e-4, 1e-4)
    errors = np.full((len(steps), len(names)), np.inf)
    for i, h in enumerate(steps):
        for j in range(len(names)):
            ends = [moved(zero.at[j].set(s)) for s in (h, -h)]
            assert not any(np.any(codes) for _, codes in ends)
            errors[i, j] = abs(float(ends[0][0] - ends[1][0]) / (2 * h) - slopes[j]) / sizes[j]
    best = dict(zip(names, errors.min(axis=0), strict=True))
    assert max(best.values()) < 1e-7, best


def _sum(result):
    return jnp.sum(result.positions[-1] ** 2)


#: Several physics objects in one program, and some parameters of each. The slow test uses all of them.
TOGETHER = {
    "static": ("law.mu", "displaced.0.by", "traction.0.value"),
    "follower": ("law.mu", "displaced.0.by", "traction.0.pressure", "mesh.points"),
    "dynamic viscous chapter": ("body.density", "start", "viscosity.ratios", "porosity.bulk", "traction.0.value"),
    "newmark isochoric porous": ("body.gravity", "viscosity.relaxation_times", "porosity.permeability", "solve.dt"),
}


#: The case with the fewest equations is in the core tests, which run with other versions of jax.
MARKS = {
    "static": (pytest.mark.core, pytest.mark.slow),
    "newmark isochoric porous": pytest.mark.slow,
    "dynamic viscous chapter": pytest.mark.slow,
    "follower": pytest.mark.slow,
}


@pytest.mark.parametrize("kind", [pytest.param(k, marks=MARKS[k]) if k in MARKS else k for k in TOGETHER])
def test_some_leaves_of_a_scene(kind):
    """Six tetrahedra and two steps. Central differences use the value from the program of the gradient itself."""
    scene = _scene(kind, cells=(1, 1, 1), steps=2)
    at = {name: value for name, value in _leaves(scene).items() if name in TOGETHER[kind]}
    assert len(at) == len(TOGETHER[kind])
    rng = np.random.default_rng(5)
    size = {name: 0.002 if name in ("mesh.points", "start") else jnp.abs(value) for name, value in at.items()}
    along = {name: size[name] * rng.uniform(0.5, 1, value.shape) for name, value in at.items()}
    found = lj.value_and_gradient(_weighted, scene, at)
    assert int(found.status) == status.CONVERGED
    for name in at:
        slope = float(jnp.vdot(found.gradient[name], along[name]))
        entries = float(jnp.vdot(abs(found.gradient[name]), abs(along[name])))
        errors = []
        for h in (1e-2, 1e-3, 1e-4):
            ends = [lj.value_and_gradient(_weighted, scene, at | {name: at[name] + s * along[name]}) for s in (h, -h)]
            errors.append(abs(float(ends[0].value - ends[1].value) / (2 * h) - slope) / entries)
        # The truncation error is h^2, at last 1e-8. Rounding is the tolerance of the value, 1e-12, divided by h.
        assert min(errors) < 1e-7, (name, errors)


def _weighted(result):
    """Return the sum of positions and reactions, every entry with a separate weight."""
    n = result.positions.size
    weight = jnp.cos(jnp.arange(n, dtype=float)).reshape(result.positions.shape)
    return jnp.sum(weight * result.positions) + 1e-3 * jnp.sum(weight[::-1] * result.reactions)


@pytest.mark.slow
@pytest.mark.parametrize("store", ["sqrt", 1, 3])
def test_what_is_kept_changes_no_derivative(store):
    """Five steps in segments of three and two, in one segment, and in segments of two, two and one."""
    scene = _scene("viscous")
    scene = replace(scene, solve=replace(scene.solve, steps=5, tolerance=1e-8))
    at = {"law.mu": 770.0, "viscosity.ratios": scene.viscosity.ratios}
    whole = lj.value_and_gradient(_sum, scene, at)
    parts = lj.value_and_gradient(_sum, scene, at, store=store)
    for name in at:
        np.testing.assert_allclose(parts.gradient[name], whole.gradient[name], rtol=1e-9)
    forward = lj.value_and_gradient(_sum, scene, at, mode="forward")
    for name in at:
        np.testing.assert_allclose(forward.gradient[name], whole.gradient[name], rtol=1e-7)


@pytest.mark.slow
def test_a_step_keeps_no_more_than_its_state_and_root():
    """The program of the derivative stores no array over all steps that is larger than the state, by XLA's memory
    analysis.
    """
    scene = _scene("complete")
    sizes = []
    for steps in (20, 120):
        longer = replace(scene, solve=replace(scene.solve, steps=steps))
        program = (
            gradients._program_of_gradient(_sum, "all", "reverse")
            .lower(longer, {"law.mu": jnp.asarray(770.0)})
            .compile()
        )
        sizes.append(program.memory_analysis().temp_size_in_bytes)
        predicted = gradients.memory(longer)
    a_step = (sizes[1] - sizes[0]) / 100
    one = replace(scene, solve=replace(scene.solve, steps=1))
    two = replace(scene, solve=replace(scene.solve, steps=2))
    assert abs((gradients.memory(two) - gradients.memory(one)) / a_step - 1) < 0.2
    assert abs(predicted / sizes[1] - 1) < 0.2


def test_the_predicted_memory_is_that_of_the_prepared_scene():
    """In single precision, twice the memory was predicted. For quadratic elements, the pressures were missing. The
    arrays of the result were missing too."""
    mesh = lj.quadratic(lj.shapes.box((0.02, 0.02, 0.02), (1, 1, 1)))
    law = lj.laws.NeoHookean(mu=770.0, bulk=77000.0)

    def predicted(steps, **changes):
        solve = lj.Solve(steps=steps, volumetric="auto", **changes)
        return gradients.memory(lj.Scene(mesh=mesh, law=law, solve=solve))

    one, two = predicted(1), predicted(2)
    assert predicted(1, precision="float32") == pytest.approx(one / 2, rel=1e-2)
    # State and root contain positions and pressures of vertices. Each step has a derivative with respect to positions.
    assert two - one == 2 * 8 * (3 * mesh.number_of_nodes + mesh.number_of_vertices) + 8 * 3 * mesh.number_of_nodes


@pytest.mark.slow
@pytest.mark.parametrize("store", ["all", "sqrt"])
def test_the_predicted_memory_of_a_small_body_with_many_steps(store):
    """The arrays of the result are most of this memory, and were missing: only 0.4 of the memory was predicted."""
    mesh = lj.shapes.box((0.05, 0.04, 0.03), (1, 1, 1))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=jnp.asarray(770.0), bulk=jnp.asarray(2200.0)),
        body=lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -1.0])),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_max"]),),
        solve=lj.Solve(steps=2000, dt=0.01, linear_solver="cg"),
    )
    program = gradients._program_of_gradient(lambda result: jnp.sum(result.positions**2), store, "reverse")
    used = program.lower(scene, {"law.mu": jnp.asarray(770.0)}).compile().memory_analysis().temp_size_in_bytes
    assert abs(gradients.memory(scene, store) / used - 1) < 0.2


@pytest.mark.slow
def test_codes_of_derivatives():
    """The derivative is computed through a step that did not converge, and where the adjoint solve fails. Both use one
    program with two tolerances.
    """
    scene = _scene("static", cells=(1, 1, 1), steps=1)

    def spoiled(result):
        converged = result.status[-1] == status.CONVERGED
        return jnp.sum(jnp.where(converged, jnp.nan, 1.0) * result.positions)

    for tolerance, code in ((1e-14, status.GRADIENT_UNCONVERGED), (0.1, status.ADJOINT_FAILED)):
        hasty = replace(scene, solve=replace(scene.solve, newton_iterations=2, tolerance=tolerance))
        found = lj.value_and_gradient(spoiled, hasty, {"law.mu": 770.0})
        assert int(found.status) == code
        assert np.isfinite(float(found.gradient["law.mu"])) == (code == status.GRADIENT_UNCONVERGED)
    for code in (status.GRADIENT_UNCONVERGED, status.ADJOINT_FAILED):
        assert "derivative" in status.advice(code)


@pytest.mark.parametrize("store", [0, -1, 1.5, "some", True])
def test_unknown_stores_are_refused(store):
    with pytest.raises(lj.InputError, match="store"):
        lj.value_and_gradient(_sum, _scene("static"), {"law.mu": 770.0}, store=store)


def test_unknown_modes_and_names_are_refused():
    scene = _scene("static")
    with pytest.raises(lj.InputError, match="mode"):
        lj.value_and_gradient(_sum, scene, {"law.mu": 770.0}, mode="sideways")
    with pytest.raises(lj.InputError, match="no parameters"):
        lj.value_and_gradient(_sum, scene, {})
    with pytest.raises(lj.InputError, match=r"did you mean law\.mu"):
        lj.value_and_gradient(_sum, scene, {"law.nu": 770.0})
    with pytest.raises(lj.InputError, match="shape"):
        lj.value_and_gradient(_sum, scene, {"mesh.points": np.zeros((3, 3))})


def test_segments_cover_all_steps():
    for steps in range(1, 40):
        for kept in range(1, steps):
            count, length, rest = gradient_checkpoints.lengths(steps, kept)
            assert count * length + rest == steps and count + (rest > 0) <= kept


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["static", "dynamic viscous", "complete"])
def test_a_second_derivative_of_a_run(kind):
    """Forward over reverse mode is compared with central differences of the gradient. The other order is right,
    or NaN.
    """
    scene = _scene(kind, (1, 1, 1), 2)

    def size(mu):
        return jnp.sum(lj.simulate(lj.with_parameters(scene, {"law.mu": mu})).positions[-1] ** 2) * 1e4

    slope, h = jax.jit(jax.grad(size)), 0.8
    # Second order: half the step leaves a quarter of the error.
    wide, narrow = (float(slope(770.0 + d) - slope(770.0 - d)) / (2 * d) for d in (2 * h, h))
    expected = narrow + (narrow - wide) / 3
    found = float(jax.grad(jax.jacfwd(size))(770.0))
    assert found == pytest.approx(expected, rel=1e-5)
    other = float(jax.hessian(size)(770.0))
    assert np.isnan(other) or other == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("once", [{"newton": "one_step"}, {"newton_iterations": 1}])
def test_a_step_of_one_solve_has_no_gradient(once):
    """A derivative that was wrong by percents was returned without a warning."""
    scene = _scene("static")
    scene = replace(scene, solve=replace(scene.solve, tolerance=0.4, **once))
    with pytest.raises(lj.InputError, match="has no correct derivatives: use newton = 'converged'"):
        lj.value_and_gradient(_sum, scene, {"law.mu": 770.0})
