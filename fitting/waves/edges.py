"""Equations for regions with edges inside the elements. At an edge the displacement has a kink and the pressure has a
jump.

At an edge between two materials, displacement and traction are continuous, but strain and pressure are not. The
displacement within a quadratic element cannot have a kink. So a standard element at an edge is too stiff, and the
fitted modulus of a region of few voxels is too low. Therefore an element that is cut by an edge has one additional
shape function L_i psi for each of its corners i. L_i is the linear shape function of the corner, and

    psi = sum_a N_a max_k s_k(x_a) - max_k sum_a N_a s_k(x_a).

N_a is the quadratic shape function of node a, and x_a is the position of this node. s_k is the indicator function of
region k after smoothing: about 1 inside the region and about 0 outside. Psi is continuous, has a kink at the edges and
is zero at all nodes (extended finite elements: Moes et al. 2003, Comput. Methods Appl. Mech. Eng. 192, 3163). So the
displacements of the nodes are still the displacements of their voxels. The amplitudes of the kinks are unknowns without
a measured value. Every point has the modulus and the pressure of the region in which it lies.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse

from fitting.waves import balance, edge_places
from fitting.waves.balance import Matrices
from fitting.waves.edge_places import NO_PATCHES, MovedEdges, Patches, patches_of
from fitting.waves.voxels import VoxelBody
from liverjax.mesh.adjacency import PAIRS

#: HALVINGS: number of times that the sides of cut elements are halved. In each of the resulting small tetrahedra, the
#: edges of regions are planes. CHUNK: number of elements that are computed together.
HALVINGS, CHUNK = 3, 60


class RegionMatrices(NamedTuple):
    """Matrices for the balance of forces with R regions.

    There are U unknowns: the 3 V displacements of the nodes, then the amplitudes of the kinks. C (I, U) is the matrix
    of the force balance with I equations (see `fitting.waves.balance`). N is the number of entries of C, and P is the
    number of pressures.
    """

    stiffness: np.ndarray  # (R, N) entries of C for a shear modulus of 1 Pa in each region
    mass: np.ndarray  # (N,) entries of C that are multiplied by -omega^2
    pattern: scipy.sparse.csr_array  # (I, U): positions of these entries
    forces: scipy.sparse.csr_array  # (I, P) nodal forces of P pressures with the same large prior variance
    pressure: np.ndarray  # covariance of these forces, in the form of `Matrices.pressure`
    kinks: int  # number of unknowns of the kinks, which are not measured
    patches: Patches
    patch: np.ndarray  # (I,) index of the nearest patch for each row of C, -1 for rows away from cut elements
    farther: "RegionMatrices | None" = None  # the same matrices, with edges moved outwards by `edge_places.FARTHER`

    @property
    def balances(self) -> int:
        """Number of real equations in chi^2."""
        return 2 * (self.forces.shape[0] - int(np.sum(np.diff(self.forces.tocsc().indptr) > 0)) - self.kinks)

    def rows(self, G: np.ndarray, omega: float) -> scipy.sparse.csr_array:
        """Return the matrix C (I, U) of the force balance, with I equations and U unknowns, for the moduli G (R,) [Pa]
        of R regions at one angular frequency [rad/s]."""
        return self._filled(G @ self.stiffness - omega**2 * self.mass)

    def by_moduli(self, u: np.ndarray) -> np.ndarray:
        """Return the derivatives (I, R) of the nodal forces C u with respect to the moduli of the R regions."""
        return np.stack([self._filled(own) @ u for own in self.stiffness], axis=1)

    def by_edges(self, here: balance.Balanced, G: np.ndarray, omega: float) -> np.ndarray:
        """Return the derivatives (I, P) of the unbalanced forces with respect to the outward shift [voxels] of each of
        the P patches into which the edges of the regions are divided."""
        out = np.zeros((len(self.patch), len(self.patches.region)), complex)
        if self.farther is not None:
            p = self.forces.T @ here.multipliers
            changed = (self.farther.rows(G, omega) - self.rows(G, omega)) @ here.motion
            changed = changed - (self.farther.forces - self.forces) @ p
            known = np.flatnonzero(self.patch >= 0)
            out[known, self.patch[known]] = changed[known] / edge_places.FARTHER
        return out

    def _filled(self, entries: np.ndarray) -> scipy.sparse.csr_array:
        return scipy.sparse.csr_array((entries, self.pattern.indices, self.pattern.indptr), shape=self.pattern.shape)


class _CutElements(NamedTuple):
    """K elements with n shape functions each, or the parts of these elements that lie in one region."""

    region: np.ndarray  # (K,) index of the region
    functions: np.ndarray  # (K, n) indices of the shape functions
    shear: np.ndarray  # (K, n, 3, n, 3) for a shear modulus of 1 Pa
    mass: np.ndarray  # (K, n, n) for a density of 1
    corners: np.ndarray  # (K, 4) node numbers of the corners
    divergence: np.ndarray  # (K, n, 3, 4) integrals of the divergence times linear shape functions of the corners


def region_matrices(
    m: Matrices, body: VoxelBody, density: float, s: np.ndarray, farther: MovedEdges | None = None
) -> RegionMatrices:
    """Return the matrices for the balance of forces in a body with R regions.

    Args:
        m, body: the result of `balance.matrices`, and the body for which this result was computed.
        density: [kg/m^3].
        s: smoothed indicator functions (R, V) from `edge_places.places`.
        farther: the same regions with edges moved outwards, from `edge_places.moved_edges`. If it is None, the edges
            have the fixed positions that `s` gives, and the result has no patches.
    """
    nodes, tets = _nodes_of_elements(body), np.asarray(body.linear.tetrahedra)
    both = [s] if farther is None else [s, farther.s]
    own = np.concatenate([each.argmax(axis=0)[nodes] for each in both])
    cut = np.flatnonzero(np.any(own != own[0], axis=0))
    kinked = np.unique(tets[cut])
    parts = [_cut_parts(body, each, cut, kinked) if len(cut) else [] for each in both]
    alive = _with_forces(parts[0], len(kinked), body.mesh.number_of_nodes)
    kinked = kinked[alive]
    rows = _numbers_of_rows(body, kinked)
    whole = _whole_parts(m, body, own[0], np.setdiff1d(np.arange(nodes.shape[1]), cut), density)
    patches, of_node = NO_PATCHES, np.full(body.mesh.number_of_nodes, -1)
    if farther is not None:
        patches, of_node = patches_of(s, farther.rank, body, np.unique(nodes[:, cut]))
    at = np.concatenate([np.arange(body.mesh.number_of_nodes), kinked])
    patch, known = np.full(int(rows.max()) + 1, -1), rows >= 0
    patch[rows[known]] = np.repeat(of_node[at], 3)[known]
    found = []
    for own_parts in parts:
        each = [_renumbered(p, alive, body.mesh.number_of_nodes) for p in own_parts]
        own_matrices = _all_together([whole, *each], rows, len(s), density, m.typical)
        found.append(own_matrices._replace(kinks=3 * len(kinked), patches=patches, patch=patch))
    return found[0] if farther is None else found[0]._replace(farther=found[1])


def _nodes_of_elements(body: VoxelBody) -> np.ndarray:
    """Return the indices (10, E) of the nodes of the elements."""
    return body.mesh.element_nodes_on_host


def _numbers_of_rows(body: VoxelBody, kinked: np.ndarray) -> np.ndarray:
    """Return the number of the row of C for each unknown, or -1 for unknowns without a row. The order of the rows is
    that of `balance.by_part_and_slice`."""
    inner, hidden = np.flatnonzero(body.inner), np.flatnonzero(body.inner[kinked])
    at = np.concatenate([inner, kinked[hidden]])
    functions = np.concatenate([inner, len(body.inner) + hidden])
    order = functions[balance.by_part_and_slice(body.voxel[at], body.part[at])]
    rows = np.full(3 * (len(body.inner) + len(kinked)), -1)
    rows[(3 * order[:, None] + np.arange(3)).ravel()] = np.arange(3 * len(order))
    return rows


def _whole_parts(m: Matrices, body: VoxelBody, region: np.ndarray, chosen: np.ndarray, density: float) -> _CutElements:
    nodes = _nodes_of_elements(body)[:, chosen].T
    grad, volume = _corner_gradients(body)[chosen], np.asarray(body.linear.volumes)[chosen]
    lam, weight = _rule_of_four(), volume / 4
    slopes = np.einsum("qal,elj->eqaj", _quadratic_functions(lam)[1], grad)
    return _CutElements(
        region[chosen],
        nodes,
        np.moveaxis(m.shear[..., chosen], -1, 0),
        np.moveaxis(m.mass[..., chosen], -1, 0) / density,
        np.asarray(body.linear.tetrahedra)[chosen],
        np.einsum("e,qv,eqaj->eajv", weight, lam, slopes),
    )


def _cut_parts(body: VoxelBody, s: np.ndarray, cut: np.ndarray, kinked: np.ndarray) -> list[_CutElements]:
    """Divide the cut elements into parts that each lie in one region, and return these parts. The list has one entry
    for each region and chunk of elements."""
    corners = _equal_parts(HALVINGS)  # (Q, 4, 4)
    lam = corners.mean(axis=1)
    N, dN = _quadratic_functions(lam)
    at_corners = _quadratic_functions(corners.reshape(-1, 4))[0]
    nodes, tets, gradients = _nodes_of_elements(body), np.asarray(body.linear.tetrahedra), _corner_gradients(body)
    hidden = np.full(body.linear.number_of_nodes, -1)
    hidden[kinked] = body.mesh.number_of_nodes + np.arange(len(kinked))
    out: list[_CutElements] = []
    for chunk in np.array_split(cut, -(-len(cut) // CHUNK)):
        own, grad = s[:, nodes[:, chunk]], gradients[chunk]  # (R, 10, K)
        there, highest = np.unique(own.argmax(axis=0)), own.max(axis=0)
        at = np.einsum("rak,qa->rkq", own[there], at_corners).reshape(len(there), len(chunk), -1, 4)
        plain = np.einsum("qal,klj->kqaj", dN, grad)
        values = np.broadcast_to(N, (len(chunk), *N.shape))
        functions = np.concatenate([nodes[:, chunk].T, hidden[tets[chunk]]], axis=1)
        weights = _parts_by_region(at) * np.asarray(body.linear.volumes)[chunk, None] / len(lam)
        for region, weight in zip(there, weights, strict=True):
            # In this region, psi is the interpolated maximum of all s_k minus the function s_k of this region.
            above = highest - own[region]  # (10, K)
            psi = np.einsum("ak,qa->kq", above, N)
            slope = np.einsum("ak,kqaj->kqj", above, plain)
            more = lam[:, :, None] * slope[:, :, None] + grad[:, None] * psi[:, :, None, None]
            both = np.concatenate([values, lam * psi[..., None]], axis=2)
            integrals = _integrals(both, np.concatenate([plain, more], axis=2), lam, weight)
            out.append(_CutElements(np.full(len(chunk), region), functions, *integrals[:2], tets[chunk], integrals[2]))
    return out


def _parts_by_region(at: np.ndarray) -> np.ndarray:
    """Return volume fractions (R, ...) of tetrahedra: the fraction of each tetrahedron in which each of R linear
    functions is the largest. `at` (R, ..., 4): values of the functions at the corners."""
    if len(at) == 1:
        return np.ones(at.shape[:-1])
    out = []
    for k in range(len(at)):
        g = at[k] - np.delete(at, k, axis=0).max(axis=0)
        # The formula divides by the differences between the corner values. Equal values are avoided by changes of about
        # 1e-3 of the largest value.
        g = g + 1e-3 * np.abs(g).max(axis=-1, keepdims=True) * np.array([0.0, 1.0, -1.5, 2.5]) + 1e-30
        apart = g[..., :, None] - g[..., None, :] + np.where(np.eye(4, dtype=bool), 1.0, 0.0)
        out.append(np.sum(np.maximum(g, 0) ** 3 / np.prod(apart, axis=-1), axis=-1))
    shares = np.clip(np.array(out), 0.0, 1.0)
    return np.asarray(shares / np.maximum(shares.sum(axis=0), 1e-300))


def _integrals(
    values: np.ndarray, gradients: np.ndarray, lam: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the arrays `shear`, `mass` and `divergence` of `_CutElements`.

    Args:
        values: values (K, Q, n) of the n shape functions at Q points of K elements.
        gradients: gradients (K, Q, n, 3) of the shape functions.
        lam: linear shape functions of the corners (Q, 4).
        weights: integration weights (K, Q).
    """
    K, Q, n = values.shape
    flat = gradients.reshape(K, Q, 3 * n)
    D = np.matmul(np.swapaxes(flat * weights[..., None], 1, 2), flat).reshape(K, n, 3, n, 3)
    # Twice the deviatoric strain of one shape function, contracted with the strain of another.
    shear = np.einsum("ik,eajbj->eaibk", np.eye(3), D) + np.einsum("eakbi->eaibk", D) - 2 / 3 * D
    mass = np.matmul(np.swapaxes(values * weights[..., None], 1, 2), values)
    return shear, mass, np.einsum("kq,qv,kqaj->kajv", weights, lam, gradients, optimize=True)


def _with_forces(parts: list[_CutElements], kinks: int, nodes: int) -> np.ndarray:
    """Return for each kink function whether it differs from zero (kinks,). A kink function is zero if the edge meets an
    element only at a node."""
    size = np.zeros(kinks)
    for p in parts:
        np.add.at(size, p.functions[:, 10:] - nodes, np.einsum("eaibi->eab", p.shear)[:, range(10, 14), range(10, 14)])
    return size > 1e-9 * size.max(initial=0.0)


def _renumbered(p: _CutElements, alive: np.ndarray, nodes: int) -> _CutElements:
    number = np.where(alive, np.cumsum(alive) - 1 + nodes, -1)
    functions = p.functions.copy()
    functions[:, 10:] = number[p.functions[:, 10:] - nodes]
    return p._replace(functions=functions)


def _all_together(
    parts: list[_CutElements], rows: np.ndarray, R: int, density: float, typical: float
) -> RegionMatrices:
    """Return the assembled matrices of all parts. `rows` (U,): row of C for each unknown. `typical` [Pa]: see
    `Matrices.typical`."""
    I, U = int(rows.max()) + 1, len(rows)
    known, ends, at = _pattern(parts, rows)
    stiffness, mass = np.zeros((R, len(known))), np.zeros(len(known))
    for p, (inside, place) in zip(parts, at, strict=True):
        region = np.broadcast_to(p.region[:, None, None, None, None], inside.shape)[inside]
        values = p.shear[inside]
        for r in np.unique(p.region):
            stiffness[r] += np.bincount(place[region == r], values[region == r], len(known))
        inertia = density * p.mass[:, :, None, :, None] * np.eye(3)[:, None, :]
        mass += np.bincount(place, inertia[inside], len(known))
    pattern = scipy.sparse.csr_array((np.zeros(len(known)), known % U, ends), shape=(I, U))
    corners = 1 + max((int(p.corners.max()) for p in parts if p.corners.size), default=0)
    B = _pressure_columns(parts, rows, (I, corners * R), corners)
    forces = balance.freely(B, typical * stiffness.sum(axis=0))
    return RegionMatrices(
        stiffness, mass, pattern, forces, balance.by_diagonals(forces @ forces.T), 0, NO_PATCHES, np.zeros(0)
    )


def _pattern(
    parts: list[_CutElements], rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the sparsity pattern of C: the sorted keys of the matrix entries (row times U plus column, for U columns),
    and the ends of the rows in this list. Also return, for each entry of `parts`, which values of this entry belong to
    C, and the positions of these values in the list of keys."""
    keys, insides, U = [], [], len(rows)
    for p in parts:
        unknowns, lines = _unknowns_and_rows(p, rows)
        line, column = np.broadcast_arrays(lines[:, :, :, None, None], unknowns[:, None, None])
        insides.append((line >= 0) & (column >= 0))
        keys.append(line[insides[-1]] * U + column[insides[-1]])
    known, at = np.unique(np.concatenate(keys), return_inverse=True)
    counts = np.bincount(known // U, minlength=int(rows.max()) + 1)
    places = np.split(at, np.cumsum([len(k) for k in keys])[:-1])
    return known, np.concatenate([[0], np.cumsum(counts)]), list(zip(insides, places, strict=True))


def _unknowns_and_rows(p: _CutElements, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (K, n, 3) of the unknowns of the shape functions, and the rows (K, n, 3) of C for these
    unknowns. An index is -1 if this unknown or row does not exist."""
    unknowns = np.where(p.functions[..., None] < 0, -1, 3 * p.functions[..., None] + np.arange(3))
    return unknowns, np.where(unknowns < 0, -1, rows[unknowns])


def _pressure_columns(
    parts: list[_CutElements], rows: np.ndarray, shape: tuple[int, int], corners: int
) -> scipy.sparse.csr_array:
    """Return the nodal forces (I, P R) of unit pressures at P = `corners` corners in R regions. Each region has
    separate pressures."""
    lines, columns, values = [], [], []
    for p in parts:
        own = p.corners + corners * p.region[:, None]
        line, column = np.broadcast_arrays(_unknowns_and_rows(p, rows)[1][..., None], own[:, None, None])
        lines.append(line[line >= 0])
        columns.append(column[line >= 0])
        values.append(p.divergence[line >= 0])
    at = np.concatenate(lines), np.concatenate(columns)
    return scipy.sparse.coo_array((np.concatenate(values), at), shape=shape).tocsr()


def _corner_gradients(body: VoxelBody) -> np.ndarray:
    """Return the gradients (E, 4, 3) of the linear shape functions of the corners."""
    D = np.moveaxis(np.asarray(body.linear.shape_vectors), -1, 0)
    return np.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)


def _quadratic_functions(lam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values (Q, 10) of the quadratic shape functions, and their derivatives (Q, 10, 4) with respect to the
    barycentric coordinates (Q, 4)."""
    values, slopes = [lam[:, i] * (2 * lam[:, i] - 1) for i in range(4)], np.zeros((len(lam), 10, 4))
    slopes[:, range(4), range(4)] = 4 * lam - 1
    for k, (i, j) in enumerate(PAIRS):
        values.append(4 * lam[:, i] * lam[:, j])
        slopes[:, 4 + k, i], slopes[:, 4 + k, j] = 4 * lam[:, j], 4 * lam[:, i]
    return np.stack(values, axis=1), slopes


def _rule_of_four() -> np.ndarray:
    """Return the barycentric coordinates (4, 4) of the points of an integration rule that is exact for quadratic
    functions."""
    low = (5 - np.sqrt(5)) / 20
    return low + (1 - 4 * low) * np.eye(4)


def _equal_parts(halvings: int) -> np.ndarray:
    """Divide a tetrahedron into equal parts. Return the barycentric coordinates (8^halvings, 4, 4) of their corners."""
    parts = [np.eye(4)]
    for _ in range(halvings):
        parts = [part for t in parts for part in _split_in_eight(t)]
    return np.array(parts)


def _split_in_eight(t: np.ndarray) -> list[np.ndarray]:
    """Divide a tetrahedron with corners (4, 4) into eight parts. Return the corners (4, 4) of each part."""
    middle = {pair: 0.5 * (t[pair[0]] + t[pair[1]]) for pair in PAIRS}
    ab, ac, ad, bc, bd, cd = (middle[pair] for pair in PAIRS)
    a, b, c, d = t
    corners = ((a, ab, ac, ad), (ab, b, bc, bd), (ac, bc, c, cd), (ad, bd, cd, d))
    inside = ((ab, ac, ad, bd), (ab, ac, bc, bd), (ac, ad, bd, cd), (ac, bc, bd, cd))
    return [np.array(one) for one in (*corners, *inside)]
