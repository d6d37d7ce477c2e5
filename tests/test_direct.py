"""Factorisation on the host, parameters that change without compilation, and tangents that are reused in later
steps.
"""

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.physics import boundary
from liverjax.simulation import automatic, run, tangent
from liverjax.simulation.equations import equations, initial_state
from liverjax.solvers import direct

pytestmark = pytest.mark.quick_to_compile

LAW = lj.laws.NeoHookean(mu=770.0, bulk=2200.0)
MESH = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
HELD = (lj.Fixed(nodes=MESH.node_sets["z_min"]),)
BODY = lj.Body(density=1060.0, gravity=jnp.array([0.0, 0.0, -9.81]))
PULLED = lj.Scene(
    mesh=MESH,
    law=LAW,
    fixed=HELD,
    displaced=(lj.Displaced(nodes=MESH.node_sets["z_max"], by=jnp.array([0.01, 0.0, 0.02])),),
    solve=lj.Solve(tolerance=1e-10),
)
POROUS = lj.Scene(
    mesh=MESH,
    law=LAW,
    viscosity=lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([0.1])),
    porosity=lj.Porosity(
        bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-5, drained=MESH.node_sets["z_max"]
    ),
    body=BODY,
    fixed=HELD,
    solve=lj.Solve(kind="dynamic", dt=0.05, steps=3, tolerance=1e-10),
)


def directly(scene: lj.Scene) -> lj.Scene:
    """Return the scene with a factorisation as solver."""
    return replace(scene, solve=replace(scene.solve, linear_solver="direct"))


@pytest.mark.slow
def test_a_factorisation_finds_the_same():
    one, other = lj.simulate(POROUS).check(), lj.simulate(directly(POROUS)).check()
    assert np.abs(np.asarray(one.positions - other.positions)).max() < 1e-9 * 0.1
    assert int(one.statistics.linear_iterations.sum()) > 0 == int(other.statistics.linear_iterations.sum())


@pytest.mark.slow
def test_programs_of_several_runs_have_the_solver_that_one_of_them_needs():
    """Inside a compiled program the parameter values are unknown. Batches failed where a single run was solved."""
    pulled = replace(PULLED, law=replace(LAW, bulk=7.7e6), solve=lj.Solve())
    alone = lj.simulate(pulled).check()
    batch = lj.simulate_batch(pulled, {"law.bulk": [7.7e4, 7.7e6]}).result
    assert np.all(np.asarray(batch.status) == status.CONVERGED)
    assert np.allclose(batch.positions[1], alone.positions, rtol=0, atol=1e-12)
    assert automatic.with_solver(PULLED, [{"law.bulk": 2200.0}]) is PULLED
    flat = {"mesh.points": np.asarray(MESH.points) * np.array([1.0, 1.0, 1e-4])}
    assert automatic.with_solver(PULLED, [flat]).solve.linear_solver == "direct"


@pytest.mark.slow
def test_a_gradient_has_the_solver_that_its_run_needs():
    pulled = replace(PULLED, law=replace(LAW, bulk=7.7e6), solve=lj.Solve())
    alone, top = lj.simulate(pulled).check(), MESH.node_sets["z_max"]

    def pull(result):
        return result.reactions[-1, top, 2].sum()

    found = lj.value_and_gradient(pull, pulled, {"law.mu": 770.0})
    assert int(found.status) == 0 and np.isclose(found.value, pull(alone), rtol=1e-12) and found.gradient["law.mu"] > 0


@pytest.mark.slow
def test_its_gradient_against_differences():
    @jax.jit
    @jax.value_and_grad
    def force(mu):
        result = lj.simulate(lj.with_parameters(directly(PULLED), {"law.mu": mu}))
        return jnp.sum(result.reactions[-1, MESH.node_sets["z_max"], 2])

    h = 0.1
    difference = (force(770 + h)[0] - force(770 - h)[0]) / (2 * h)
    assert np.isclose(difference, force(770.0)[1], rtol=1e-7)


@pytest.mark.ci
def test_auto_decides_by_size_and_stiffness():
    static = lj.Scene(mesh=MESH, law=LAW, fixed=HELD)
    stiff = replace(static, law=replace(LAW, bulk=2000 * float(LAW.mu)))
    assert static.solve.linear_solver == "auto" and automatic.linear_solver(static) == "cg"
    assert automatic.linear_solver(stiff) == "direct"
    assert automatic.linear_solver(replace(static, law=replace(LAW, bulk=200 * float(LAW.mu)))) == "direct"
    large = lj.shapes.box((0.1, 0.1, 0.1), (7, 7, 7))
    assert automatic.linear_solver(replace(static, mesh=large, law=replace(LAW, bulk=200 * float(LAW.mu)))) == "cg"
    assert automatic.linear_solver(replace(stiff, solve=replace(stiff.solve, kind="dynamic", dt=0.1))) == "cg"
    load = lj.Traction(triangles=jnp.asarray(boundary.boundary_triangles(MESH, MESH.node_sets["z_max"])), pressure=4.0)
    assert automatic.linear_solver(replace(stiff, traction=(load,))) == "cg"
    points = np.asarray(MESH.points) * np.array([1.0, 1.0, 1e-4])
    assert automatic.linear_solver(replace(static, mesh=lj.tet_mesh(points, MESH.tetrahedra))) == "direct"
    assert abs(automatic.thinnest(np.eye(4)[:, 1:], np.array([[0, 1, 2, 3]]), np.array([1 / 6])) - 0.77) < 0.01
    seen = []
    jax.eval_shape(lambda s: seen.append(automatic.linear_solver(s)), stiff)
    assert seen == ["cg"]  # values of traced parameters are unknown

    @lj.struct
    class Bare(lj.Law):
        mu: float = lj.param("Pa")
        invariants = ("I1", "J")

        def strain_energy(self, I):
            return self.mu / 2 * (I.I1 - 3 - 2 * jnp.log(I.J)) + self.mu * (I.J - 1) ** 2

    # A law may leave out its moduli.
    assert automatic.linear_solver(replace(static, law=Bare(mu=770.0))) == "cg"
    lj.simulate(replace(PULLED, law=Bare(mu=770.0))).check()


@pytest.mark.ci
def test_the_columns_of_a_jacobian_have_one_factor(monkeypatch):
    """Each column factorised the same matrix again."""
    made, original = [], direct._factorised
    monkeypatch.setattr(direct, "_factorised", lambda *given: made.append(original(*given)) or made[-1])
    monkeypatch.setattr(direct, "_last", [])

    def top(values):
        numbers = {"law.mu": values[0], "law.bulk": values[1], "displaced.0.by": values[2:]}
        return lj.simulate(lj.with_parameters(directly(PULLED), numbers)).positions[-1].ravel()

    values = jnp.array([770.0, 2200.0, 0.01, 0.0, 0.02])
    top(values).block_until_ready()
    of_run = len(made)
    columns = np.asarray(jax.jit(jax.jacfwd(top))(values))
    assert of_run >= 2 and len(made) - of_run <= of_run + 1
    step = 1e-4 * np.array([770.0, 2200.0, 0.01, 0.01, 0.01])
    for k in range(5):
        ends = [np.asarray(top(values.at[k].add(sign * step[k]))) for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step[k])
        assert np.linalg.norm(columns[:, k] - difference) < 1e-6 * np.linalg.norm(difference)


@pytest.mark.slow
def test_a_matrix_without_an_inverse_is_told():
    loose = lj.Scene(mesh=MESH, law=LAW, body=BODY, solve=lj.Solve())  # the body is not supported
    e = equations(loose, initial_state(loose), 1.0)
    A = jax.jit(lambda: tangent.stiffness(e, None, MESH.points))()
    A = A._replace(rows=jax.tree.map(jnp.zeros_like, A.rows), diagonal=jax.tree.map(jnp.zeros_like, A.diagonal))
    free = jnp.ones((3, MESH.number_of_nodes))
    assert np.isnan(direct.solve(A, free, free)).all()
    result = lj.simulate(directly(loose))
    assert int(result.status[0]) != status.CONVERGED and np.isfinite(np.asarray(result.positions)).all()


def test_loads_that_follow_are_refused():
    load = lj.Traction(triangles=jnp.asarray(boundary.boundary_triangles(MESH, MESH.node_sets["z_max"])), pressure=4.0)
    with pytest.raises(
        lj.InputError, match=r"'direct' cannot be used with a follower pressure: use linear_solver = 'cg'"
    ):
        lj.simulate(directly(lj.Scene(mesh=MESH, law=LAW, fixed=HELD, traction=(load,))))


@pytest.mark.slow
def test_a_number_that_changes_costs_no_compilation():
    lj.simulate(POROUS)
    before = run._run._cache_size()
    for path, value in {
        "law.mu": 800.0,
        "law.bulk": 3000.0,
        "viscosity.ratios": (0.2,),
        "porosity.permeability": 1e-5,
        "body.density": 1000.0,
        "solve.dt": 0.03,
        "solve.tolerance": 1e-6,
    }.items():
        lj.simulate(lj.with_parameters(POROUS, {path: value})).check()
    assert run._run._cache_size() == before


@pytest.mark.ci
def test_a_tangent_goes_from_step_to_step():
    """Later steps use the old tangent as long as it converges fast."""
    made = []
    original = tangent.stiffness

    def counted(*arguments):
        A = original(*arguments)
        jax.debug.callback(lambda: made.append(1))
        return A

    scene = replace(POROUS, porosity=None, solve=replace(POROUS.solve, dt=0.002, steps=10, tolerance=1e-8))
    tangent.stiffness = counted
    try:
        result = run._run.__wrapped__(scene, None, None, scene.solve.steps)
    finally:
        tangent.stiffness = original
    result.check()
    jax.effects_barrier()
    assert 1 <= len(made) < 5 < int(result.statistics.iterations.sum())


@pytest.mark.ci
def test_the_command_chooses_by_the_numbers_of_the_scene(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(
        """
        mesh = {shape = "box", size = [0.01, 0.01, 0.01], cells = [2, 2, 2]}
        law = {name = "neo_hookean", mu = 770.0, bulk = 2e6}
        fixed = [{set = "z_min"}]
        displaced = [{set = "z_max", by = [0, 0, 1e-3]}]
        """
    )
    assert main(["simulate", str(scene), "--out", str(tmp_path)]) == 0
    with h5py.File(tmp_path / "result.h5") as result:
        assert result.attrs["iterations"].sum() > 0
        assert result.attrs["linear_iterations"].sum() == 0


def test_rank_one_changes_in_single_precision():
    """SuperLU refused the vectors of a pressed obstacle, which were in float64 beside a matrix in float32."""
    A = scipy.sparse.csr_array(np.array([[4.0, 1, 0], [1, 3, 1], [0, 1, 5]], np.float32))
    H, size, b = np.array([[1.0], [0.5], [0.0]]), np.array([2.0]), np.array([1.0, 2.0, 3.0], np.float32)
    x = direct._solution(direct._factorised(A, np.ones(3), (None, 1.0), (H, size)), b)
    assert x.dtype == np.float32 and np.allclose((A.toarray() - H @ H.T / size) @ x, b, rtol=1e-6)
