"""The balance of forces in measured waves, and the computation of the modulus from this balance.

No external force acts at the inner nodes of a body, so C(G) u + B p = 0, with the moduli G and the nodal displacements
u. C consists of the rows of K(G) - omega^2 M that belong to these nodes. K is the stiffness matrix due to the shear
stress alone, and M is the mass matrix. B p are the nodal forces of a pressure p, which is continuous and linear in each
element. The pressure is an unknown, so no bulk modulus is needed. The measured motion at all nodes is d = u + noise,
and the noise has the standard deviation sd. The pressure has a large prior variance g sd^2. Then the most probable
motion u that fulfils this balance is

    u = d - C^H q,   S q = C d,   S = C C^H + g B B^H,   chi^2 = (C d)^H q / sd^2.

No boundary condition is needed at the surface of the body, because the motion there is measured, with noise, as at all
other nodes. Let C' be the derivative of C with respect to a modulus. With respect to this modulus, chi^2 / 2 has the
gradient Re(q^H C' u) / sd^2 and the Gauss-Newton Hessian (C' u)^H S^-1 C' u / sd^2 (variable projection: Golub and
Pereyra 1973, SIAM J. Numer. Anal. 10, 413). C' multiplies the fitted motion u and not the noisy d, so noise does not
make the modulus too small. In a direct inversion with second derivatives, noise makes the modulus too small.
"""

import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse

import liverjax as lj
from fitting.waves.voxels import VoxelBody
from liverjax.mesh.adjacency import PAIRS
from liverjax.solvers.blas import one_blas_thread
from liverjax.solvers.factors.multifrontal import cores
from liverjax.waves.harmonic import element_operator


class Matrices(NamedTuple):
    """Element matrices for elements with n nodes, and the positions of their entries in the matrix C.

    There are E elements, V nodes and I unknowns at inner nodes. I is also the number of rows of C.
    """

    shear: np.ndarray  # (n, 3, n, 3, E) stiffness for a shear modulus of 1 Pa [N/m/Pa]
    mass: np.ndarray  # (n, n, E) [kg] mass matrices, the same for x, y and z
    unknowns: np.ndarray  # (n, 3, E) index of each unknown in a vector (3 V,) with x, y, z of a node together
    rows: np.ndarray  # (n, 3, E) row of C for each unknown, -1 if the node is not an inner node
    pattern: scipy.sparse.csr_array  # positions of the entries of C
    places: np.ndarray  # positions in pattern.data of the element entries that belong to a row of C
    entries: np.ndarray  # indices of these entries among all element entries
    pressure: np.ndarray  # lower triangle of g B B^H, stored by diagonals (bandwidth + 1, I)
    balances: int  # number of real equations in chi^2
    parts: tuple[slice, ...]  # rows of C of each part of the body; rows of different parts share no unknowns
    typical: float  # storage modulus [Pa] from which the size of the pressure term is computed


#: FREE: size of the pressure term g B B^H of S, divided by the size of the term C C^H at a typical modulus
#: (`Matrices.typical`). Since this ratio is finite, the pressure is slightly restricted by its prior. For a modulus G,
#: the relative error due to this restriction is about (G / typical modulus)^2 / FREE. In a small stiff region, the
#: error is larger: 2 % for a cylinder with a radius of 2.5 voxels that is three times as stiff as its surroundings. The
#: pressure term is the same for all moduli of a fit, so that values of chi^2 for different moduli can be compared.
#: TYPICAL: typical modulus [Pa] before the waves are known; `with_typical` changes it.
FREE, TYPICAL = 1e4, 3000.0


def _columns_of(band: np.ndarray, a: int, b: int) -> np.ndarray:
    """Return columns a to b of a lower triangle stored by diagonals, from row a to the last nonzero row."""
    bands, size = len(band), b - a
    out = np.zeros((size, size + bands - 1), band.dtype)  # the result, transposed
    diagonals = np.lib.stride_tricks.as_strided(
        out, (size, bands), ((out.shape[1] + 1) * out.itemsize, out.itemsize), writeable=True
    )
    diagonals[...] = band[:, a:b].T
    return out.T


class Balanced(NamedTuple):
    """The most probable motion u for given moduli, with chi^2, the multipliers q and the Cholesky factor of S (symbols:
    module docstring)."""

    chi2: float
    motion: np.ndarray  # u (3 V,) complex [m]
    multipliers: np.ndarray  # q (I,)
    factor: np.ndarray  # (bandwidth + 1, I): L of S = L L^H, stored by diagonals

    def of(self, rows: slice) -> "Balanced":
        """Return the same result, but with the multipliers and the factor for only the given rows of C. These rows must
        share no unknowns with the other rows."""
        return self._replace(multipliers=self.multipliers[rows], factor=self.factor[:, rows])

    def whitened(self, columns: scipy.sparse.csc_array, kind: type = np.complex128) -> np.ndarray:
        """Return the k whitened columns L^-1 `columns` (I, k), computed with numbers of the type `kind`. For two
        columns a and b, the scalar product of the whitened columns is a^H S^-1 b."""
        left, (bands, n) = columns.astype(kind).toarray(), self.factor.shape
        for a in range(0, n, bands):
            b = min(a + bands, n)
            block: np.ndarray = _columns_of(self.factor, a, b).astype(kind)
            left[a:b] = scipy.linalg.solve_triangular(block[: b - a], left[a:b], lower=True, check_finite=False)
            rest = block[b - a : b - a + n - b]
            left[b : b + len(rest)] -= rest @ left[a:b]
        return left


def matrices(body: VoxelBody, density: float) -> Matrices:
    """Return the matrices of the force balance for a body with this density [kg/m^3], with the typical modulus
    `TYPICAL`."""
    scene = lj.Scene(
        mesh=body.mesh,
        law=lj.laws.NeoHookean(mu=1.0, bulk=1.0),
        viscosity=lj.Prony(ratios=jnp.array([0.5]), relaxation_times=jnp.array([1.0]), part="isochoric"),
        body=lj.Body(density=density),
    )
    A = jax.tree.map(np.asarray, element_operator(scene))
    unknowns = 3 * A.nodes[:, None] + np.arange(3)[None, :, None]
    inner = _in_order(body)
    number = np.full(3 * len(body.inner), -1)
    number[inner] = np.arange(len(inner))
    rows = number[unknowns]
    lines, columns = np.broadcast_arrays(rows[:, :, None, None], unknowns[None, None])
    entries = np.flatnonzero(lines.ravel() >= 0)
    key = lines.ravel()[entries] * len(number) + columns.ravel()[entries]
    known, places = np.unique(key, return_inverse=True)
    counts = np.bincount(known // len(number), minlength=len(inner))
    ends = np.concatenate([[0], np.cumsum(counts)])
    shape = (len(inner), len(number))
    pattern = scipy.sparse.csr_array((np.zeros(len(known), complex), known % len(number), ends), shape=shape)
    B = _forces_of_pressures(body, rows, len(inner))
    balances = 2 * (len(inner) - B.shape[1])
    starts = np.flatnonzero(np.diff(body.part[inner // 3], prepend=-1, append=-1))
    parts = tuple(slice(a, b) for a, b in itertools.pairwise(starts))
    none = np.zeros((1, 1))
    m = Matrices(A.relaxing, A.mass, unknowns, rows, pattern, places, entries, none, balances, parts, TYPICAL)
    shear = rows_of_balance(m, np.full(rows.shape[-1], TYPICAL + 0j), 0.0)
    B = freely(B, np.abs(shear.data))
    return m._replace(pressure=by_diagonals(B @ B.T))


def with_typical(m: Matrices, modulus: float) -> Matrices:
    """Return the same matrices, but with the pressure term for the typical modulus `modulus` [Pa]."""
    return m._replace(pressure=m.pressure * (modulus / m.typical) ** 2, typical=modulus)


def freely(B: scipy.sparse.csr_array, shear: np.ndarray) -> scipy.sparse.csr_array:
    """Return the matrix B of the pressure forces, scaled to the prior variance that `FREE` determines.

    Args:
        B: nodal forces of pressures of 1 Pa.
        shear: entries of C at the typical modulus, without the mass.
    """
    part = np.sum(shear**2) / B.shape[0]  # mean diagonal entry of C C^H
    return np.sqrt(FREE * part / B.power(2).sum(axis=1).mean()) * B


def _in_order(body: VoxelBody) -> np.ndarray:
    """Return the indices of the unknowns at inner nodes, in the order of `by_part_and_slice`."""
    nodes = np.flatnonzero(body.inner)
    order = by_part_and_slice(body.voxel[nodes], body.part[nodes])
    return (3 * nodes[order][:, None] + np.arange(3)).ravel()


def by_part_and_slice(voxel: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the indices (n,) that sort nodes with voxel indices (n, 3) by the parts of the body, and by slices along
    the longest side of each part. In this order, coupled nodes have close indices."""
    longest_last = voxel.copy()
    for k in np.unique(part):
        own = voxel[part == k]
        longest_last[part == k] = own[:, np.argsort(np.ptp(own, axis=0))]
    return np.lexsort((*longest_last.T, part))


def _forces_of_pressures(body: VoxelBody, rows: np.ndarray, inner: int) -> scipy.sparse.csr_array:
    """Return the matrix B (I, P): the forces on the I unknowns of inner nodes due to P corner pressures of 1 Pa. An
    entry is the integral of the linear shape function of a corner times the divergence of the quadratic shape function
    of an inner node."""
    D = np.moveaxis(np.asarray(body.linear.shape_vectors), -1, 0)
    gradients = np.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)  # (E, 4, 3) of linear shape functions
    second = (1 + np.eye(4)) / 20  # integrals of the products of two linear functions, divided by the volume
    parts = [np.einsum("v,ec->vce", 4 * second[i] - 0.25, gradients[:, i]) for i in range(4)]
    for i, j in PAIRS:
        both = np.einsum("v,ec->vce", second[i], gradients[:, j]) + np.einsum("v,ec->vce", second[j], gradients[:, i])
        parts.append(4 * both)
    values = np.stack(parts) * np.asarray(body.linear.volumes)  # (n, 4, 3, E)
    line = np.broadcast_to(rows[:, None], values.shape)
    corner = np.broadcast_to(np.asarray(body.linear.tetrahedra).T[None, :, None], values.shape)
    inside = line >= 0
    shape = (inner, body.linear.number_of_nodes)
    B = scipy.sparse.coo_array((values[inside], (line[inside], corner[inside])), shape=shape).tocsc()
    return B[:, np.flatnonzero(np.diff(B.indptr))].tocsr()


def rows_of_balance(m: Matrices, G: np.ndarray, omega: float) -> scipy.sparse.csr_array:
    """Return the matrix C of the force balance (I, 3 V; module docstring), for complex moduli G of the elements (E,)
    [Pa] and an angular frequency [rad/s]. It has one row for each of the I unknowns at inner nodes, and one column for
    each unknown of the body."""
    mass = m.mass[:, None, :, None] * np.eye(3)[None, :, None, :, None]
    real = G.real * m.shear - omega**2 * mass
    C = m.pattern.copy()
    for part, factor in ((real, 1.0), (G.imag * m.shear, 1j)):
        C.data += factor * np.bincount(m.places, part.reshape(-1)[m.entries], minlength=len(C.data))
    return C


def balanced(m: Matrices, G: np.ndarray, omega: float, d: np.ndarray, sd: float) -> Balanced:
    """Compute the most probable motion for given moduli.

    Args:
        m: result of `matrices`.
        G: complex moduli of the elements (E,) [Pa].
        omega: angular frequency [rad/s].
        d: measured motion (3 V,) complex [m], x, y, z of a node together.
        sd: standard deviation of real and imaginary part of one component [m].
    """
    return likeliest(rows_of_balance(m, G, omega), m.pressure, d, sd)


def likeliest(
    C: scipy.sparse.csr_array, B: np.ndarray, d: np.ndarray, sd: float, spread: np.ndarray | None = None
) -> Balanced:
    """Compute the most probable motion (U,) of U unknowns that fulfils the I equations of the force balance.

    Args:
        C: matrix (I, U) of the force balance.
        B: lower triangle of the covariance g B B^H of the pressure forces, stored by diagonals.
        d: measured motion (U,) [m]; 0 where it was not measured.
        sd: standard deviation of real and imaginary part of one component [m].
        spread: variance (U,) of the difference between each unknown and d, divided by sd^2; None: 1.
    """
    CH = C.conj().T.tocsr()
    WCH = CH if spread is None else scipy.sparse.diags_array(spread) @ CH
    # S is Hermitian and positive definite, so its factorisation needs no pivots. So the rows stay in an order that
    # keeps the factor small.
    S = by_diagonals((C @ WCH).tocsr())
    if len(S) < len(B):
        S = np.pad(S, ((0, len(B) - len(S)), (0, 0)))
    S[: len(B)] += B
    # A banded factorisation is faster here than a sparse factorisation, because the factor fills the band in both
    # cases.
    factor = _factor_of_blocks(S)
    r = C @ d
    q = scipy.linalg.cho_solve_banded((factor, True), r, check_finite=False)
    return Balanced(float(np.real(np.vdot(r, q))) / sd**2, d - WCH @ q, q, factor)


def _factor_of_blocks(S: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor L of S = L L^H, stored by diagonals. Uncoupled blocks, for example the parts of a
    body, are factorised in parallel."""
    gaps = np.flatnonzero(~S[1:2, :-1].any(axis=0))  # rows that are not coupled with the next row
    ends = [k + 1 for k in gaps.tolist() if not _coupled_across(S, k)]
    blocks = [slice(a, b) for a, b in itertools.pairwise([0, *ends, S.shape[1]])]
    if len(blocks) == 1:
        return scipy.linalg.cholesky_banded(S, overwrite_ab=True, lower=True, check_finite=False)

    def factorise(block: slice) -> None:
        L = scipy.linalg.cholesky_banded(S[:, block], overwrite_ab=True, lower=True, check_finite=False)
        if not np.may_share_memory(L, S):
            S[:, block] = L

    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        list(pool.map(factorise, blocks))
    return S


def _coupled_across(S: np.ndarray, k: int) -> bool:
    """Return whether a row up to k is coupled with a later row. S is stored by diagonals.

    In a body of one part, the first tested column already shows a coupling, so the search ends there.
    """
    return any(S[k - j + 1 :, j].any() for j in range(k, max(-1, k - len(S)), -1))


def by_diagonals(S: scipy.sparse.csr_array) -> np.ndarray:
    """Return the lower triangle of a Hermitian matrix in the band storage of LAPACK, (bandwidth + 1, n)."""
    at = S.tocoo()
    below = at.row >= at.col
    row, column = at.row[below], at.col[below]
    band = np.zeros((int((row - column).max()) + 1, S.shape[0]), at.data.dtype, order="F")
    band[row - column, column] = at.data[below]
    return band


def gigabytes(body: VoxelBody) -> float:
    """Return the memory [GB] of the factor of S for one frequency."""
    voxel, part = body.voxel[body.inner], body.part[body.inner]
    sides = [np.sort(np.ptp(voxel[part == k], axis=0) + 1) for k in np.unique(part)]
    return 16e-9 * 3 * len(voxel) * 3 * max(4 * a * b + 4 * a + 5 for a, b, _ in sides)


def by_modulus(m: Matrices, u: np.ndarray) -> scipy.sparse.csc_array:
    """Return the derivatives (I, E) of the nodal forces C u with respect to the modulus of every element."""
    forces = np.einsum("arbse,bse->are", m.shear, u[m.unknowns], optimize=True)
    inside = m.rows >= 0
    element = np.broadcast_to(np.arange(m.rows.shape[-1]), m.rows.shape)
    shape = (m.pattern.shape[0], m.rows.shape[-1])
    return scipy.sparse.coo_array((forces[inside], (m.rows[inside], element[inside])), shape=shape).tocsc()
