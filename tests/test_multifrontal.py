"""Factorisation by nested dissection: compared with dense solutions, in both precisions, and kept for derivatives."""

import os
import subprocess
import sys
import time
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

import liverjax as lj
from liverjax.solvers.factors import dissection, memory, multifrontal
from liverjax.solvers.factors.memory import free_memory
from liverjax.waves import harmonic, sparse

pytestmark = pytest.mark.quick_to_compile


def system(kind: type) -> tuple[scipy.sparse.csr_array, list[multifrontal.Front]]:
    """Return a symmetric matrix with two unknowns per node, neither definite nor well scaled, and its fronts."""
    rng = np.random.default_rng(1)
    box = lj.shapes.box((1.0, 1.0, 2.0), (5, 5, 10))
    # Sorted corners: the matrix does not depend on their order in the mesh.
    tets, points = np.sort(box.tetrahedra, axis=1).T, np.asarray(box.points)
    at = np.concatenate([2 * tets, 2 * tets + 1])
    blocks = rng.normal(size=(8, 8, tets.shape[1])) + (
        1j * rng.normal(size=(8, 8, tets.shape[1])) if kind is complex else 0
    )
    blocks = (blocks + np.swapaxes(blocks, 0, 1)) * 10.0 ** (6 * (np.arange(8) // 4))[:, None, None]
    blocks = blocks * 10.0 ** (6 * (np.arange(8) // 4))[None, :, None]
    lines, columns = np.broadcast_arrays(at[:, None], at[None])
    n = 2 * len(points)
    A = scipy.sparse.coo_array((blocks.ravel(), (lines.ravel(), columns.ravel())), shape=(n, n)).tocsr()
    return A, multifrontal.fronts(neighbours(tets), dissection.dissected(tets, points), np.arange(n) // 2)


def neighbours(tets: np.ndarray) -> scipy.sparse.csr_array:
    at = tuple(a.ravel() for a in np.broadcast_arrays(tets[:, None], tets[None]))
    return scipy.sparse.coo_array((np.ones(len(at[0])), at)).tocsr()


@pytest.mark.parametrize(
    ("kind", "single", "small"),
    [
        (float, False, False),
        (float, True, False),
        (complex, False, False),
        (complex, True, False),
        (complex, True, True),
    ],
)
@pytest.mark.parametrize("together", [512, 7])
def test_against_a_dense_solution(kind, single, small, together, monkeypatch):
    """Groups are eliminated at once, or by seven unknowns at a time."""
    monkeypatch.setattr(multifrontal, "PIVOTS", together)
    monkeypatch.setattr(multifrontal, "TILE", 2 * together)
    A, plan = system(kind)
    assert len(plan) > 8 and sorted(np.concatenate([front.own for front in plan])) == list(range(A.shape[0]))
    known = np.random.default_rng(2).normal(size=A.shape[0]).astype(kind)
    found, error = multifrontal.refined_solution(multifrontal.factorised(A, plan, single, small), A @ known)
    assert error < 1e-15
    dense = np.linalg.solve(A.toarray(), A @ known)
    # The error may be as large as that of a dense solution.
    assert np.linalg.norm(found - known) < 10 * np.linalg.norm(dense - known) + 1e-12 * np.linalg.norm(known)


@pytest.mark.parametrize("single", [False, True])
def test_groups_whose_nodes_are_all_held(single, monkeypatch):
    """These groups have no unknowns, and some have no border. LAPACK raises an error for a matrix without rows."""
    monkeypatch.setattr(dissection, "LEAF", 8)
    A, _ = system(complex)
    box = lj.shapes.box((1.0, 1.0, 2.0), (5, 5, 10))
    points = np.asarray(box.points)
    keep = np.flatnonzero(np.repeat(points[:, 2] > 0.7, 2))
    free = A[keep][:, keep].tocsr()
    tets = np.asarray(box.tetrahedra).T
    plan = multifrontal.fronts(neighbours(tets), dissection.dissected(tets, points), keep // 2)
    assert any(len(front.own) == 0 for front in plan)
    known = np.random.default_rng(2).normal(size=len(keep)) + 0j
    _, error = multifrontal.refined_solution(multifrontal.factorised(free, plan, single), free @ known)
    assert error < 1e-15


def test_whole_numbers_of_16_bits_are_half_as_large():
    A, plan = system(complex)
    plain, small = (multifrontal.factorised(A, plan, True, own) for own in (False, True))
    sizes = [sum(step.X.nbytes for step in own.steps) for own in (plain, small)]
    assert sizes[0] == 2 * sizes[1]
    assert plain.nbytes - plain.matrix.data.nbytes == multifrontal.single_bytes(plan, A.dtype)
    rounded = [step.times(np.eye(len(step.after), dtype=np.complex64)[0]) for step in small.steps if len(step.after)]
    exact = [step.X[:, 0] for step in plain.steps if len(step.after)]
    # Real and imaginary part are rounded to 1/32767 of the largest number in the row.
    most = [np.abs(step.X).max(axis=1) / 32767 for step in plain.steps if len(step.after)]
    for a, b, unit in zip(rounded, exact, most, strict=True):
        assert np.all(np.abs(a - b) < 0.75 * unit)  # sqrt(2) / 2, and the roundoff of single precision


def test_a_matrix_without_an_inverse_is_told():
    A, plan = system(complex)
    A.data[:] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        multifrontal.factorised(A, plan, False)
    A.data[:] = np.nan
    with pytest.raises(np.linalg.LinAlgError):
        multifrontal.factorised(A, plan, False)


def scene(cells: tuple[int, int, int] = (3, 2, 2)) -> lj.Scene:
    mesh = lj.shapes.box((0.03, 0.02, 0.02), cells)
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=3000.0, bulk=3e4),
        viscosity=lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([0.003])),
        body=lj.Body(density=1000.0),
        displaced=(lj.Displaced(nodes=mesh.node_sets["x_min"], by=jnp.array([0.0, 1e-5, 0.0])),),
    )


@pytest.mark.ci
def test_derivatives_take_the_factors_of_the_values(monkeypatch):
    made = []

    def counted(A, plan, single, small):
        made.append((single, small))
        return original(A, plan, single, small)

    original = multifrontal.factorised
    monkeypatch.setattr(multifrontal, "factorised", counted)
    body = scene()
    slope = jax.value_and_grad(
        lambda mu: jnp.sum(lj.harmonic(lj.with_parameters(body, {"law.mu": mu}), [40.0, 60.0]).displacement.imag)
    )
    slope(3100.0)
    assert made == [(False, False)] * 2
    # Two factors that fit only in 16 bits.
    monkeypatch.setattr(multifrontal, "SINGLE_FROM", 0)
    monkeypatch.setattr(dissection, "LEAF", 8)
    sparse._factors.clear()
    sparse._orders.clear()
    lj.harmonic(body, [40.0, 60.0])
    both = sum(own.nbytes for own in sparse._factors.values())
    made.clear()
    monkeypatch.setattr(sparse, "KEPT", 0.99 * both)
    slope(3200.0)
    assert made == [(True, True)] * 2
    monkeypatch.setattr(sparse, "KEPT", 0.0)
    sparse._factors.clear()
    lj.harmonic(body, [40.0])
    assert not sparse._factors


def test_other_ways_where_the_first_fails(monkeypatch):
    """Single precision, double precision and pivots in the whole matrix give the same result."""
    monkeypatch.setattr(sparse, "KEPT", 0.0)
    sparse._factors.clear()
    double = lj.harmonic(scene(), [40.0]).displacement
    monkeypatch.setattr(multifrontal, "SINGLE_FROM", 0)
    single = lj.harmonic(scene(), [40.0]).displacement
    monkeypatch.setattr(multifrontal, "WRONG", -1.0)
    pivoted = lj.harmonic(scene(), [40.0]).displacement
    for other in (single, pivoted):
        assert np.linalg.norm(other - double) < 1e-11 * np.linalg.norm(double)
        assert not np.array_equal(other, double)


def test_a_factor_that_does_not_fit_in_memory_is_told(monkeypatch):
    """Before, the system ended the process without a message."""
    for name, value in (("KEPT", 0.0), ("_factors", {}), ("_orders", {})):
        monkeypatch.setattr(sparse, name, value)
    body = scene((6, 4, 4))  # of more than one group
    whole = lj.harmonic(body, [40.0]).displacement
    monkeypatch.setattr(multifrontal, "SINGLE_FROM", 0)
    plan = next(iter(sparse._orders.values())).plan
    plain, small = (multifrontal.needed_bytes(plan, np.dtype(complex), True, own) for own in (False, True))
    assert small < plain
    monkeypatch.setattr(sparse, "free_memory", lambda: 0.5 * (small + plain))
    rounded = lj.harmonic(body, [40.0]).displacement
    assert 0 < np.linalg.norm(rounded - whole) < 1e-11 * np.linalg.norm(whole)
    monkeypatch.setattr(sparse, "free_memory", lambda: small)
    with pytest.warns(
        UserWarning, match="equations of harmonic motion need at least .* GB of memory, but only .* free: use"
    ):
        lost = lj.harmonic(body, [40.0])
    assert np.all(np.isnan(lost.residual))
    with pytest.raises(RuntimeError, match="40 Hz"):
        lost.check()


def test_element_matrices_that_do_not_fit_in_memory_are_refused(monkeypatch):
    """Before, the system ended the process without a message. 288 elements need 288 x 12 x 12 x 8 x 4 bytes."""
    body = scene((4, 4, 3))
    monkeypatch.setattr(harmonic, "free_memory", lambda: 1.2e6)
    with pytest.raises(
        lj.InputError, match=r"of 288 elements of order 1 need about 0\.00133 GB .* 0\.0012 GB are free"
    ):
        lj.harmonic(body, [40.0])


def test_memory_of_an_elimination_is_foretold(monkeypatch):
    monkeypatch.setattr(multifrontal, "cores", lambda: 1)
    A, plan = system(complex)
    tracemalloc.start()
    multifrontal.factorised(A, plan, False)
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # More memory is used: the matrix itself. Less is used: upper triangles are never touched.
    assert 0.5 * used < multifrontal.needed_bytes(plan, A.dtype, False, False) < used


def test_free_memory_is_below_that_of_the_machine():
    assert 1e8 < free_memory() <= 1.01 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def test_the_cache_of_files_of_a_container_is_free(monkeypatch, tmp_path):
    """A process with 10 GB of files in the cache had no memory left."""
    monkeypatch.setattr(memory, "_CONTAINER", tmp_path)
    for name, text in (("max", "2e8"), ("current", "1.9e8"), ("stat", "anon 100\ninactive_file 150000000\n")):
        (tmp_path / f"memory.{name}").write_text(text)
    assert free_memory() == pytest.approx(1.6e8)


@pytest.mark.slow
def test_a_hundred_thousand_unknowns(verified):
    """A cube with 16 quadratic cells per side at 60 Hz: one factor of 1 GB, in single precision with refinement."""
    mesh = lj.quadratic(lj.shapes.box((0.08, 0.08, 0.08), (16, 16, 16)))
    body = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=3000.0, bulk=3e4),
        viscosity=lj.Prony(ratios=jnp.array([0.3]), relaxation_times=jnp.array([0.003])),
        body=lj.Body(density=1000.0),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_min"], by=jnp.array([1e-4, 0.0, 0.0])),),
    )
    begin = time.process_time()
    residual = float(lj.harmonic(body, [60.0]).check().residual[0])
    seconds = time.process_time() - begin  # of all cores, with compilation
    assert sum(factor.nbytes for factor in sparse._factors.values()) < 1.2e9
    assert residual < 1e-12 and seconds < 120
    verified("104,544 unknowns of harmonic motion, residual", "balance of forces", residual, 1e-12, cpu_s=seconds)


ONE_CORE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import liverjax
import jax, jax.numpy as jnp, numpy as np
total = lambda a, b: np.asarray(a).sum() + np.asarray(b).sum()
solve = jax.jit(lambda a: jax.pure_callback(total, jax.ShapeDtypeStruct((), a.dtype), 2 * a, a + 1))
print([float(solve(jnp.ones(3_000_000) + k)) for k in range(40)][-1])
"""


@pytest.mark.ci
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no cores to choose")
def test_a_solve_on_the_host_does_not_wait_for_itself_on_one_core():
    """On one core JAX has one thread. It runs the solve, and would have to copy the data that the solve waits for."""
    env = {k: v for k, v in os.environ.items() if k != "NPROC"}
    done = subprocess.run([sys.executable, "-c", ONE_CORE], env=env, capture_output=True, text=True, timeout=60)
    assert float(done.stdout) == 3_000_000 * (2 * 40 + 41), done.stderr
