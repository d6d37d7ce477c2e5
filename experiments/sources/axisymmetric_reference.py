"""Stiffness of glued cylinders by another program: axisymmetric, linear elastic, quadratic triangles (NumPy, SciPy).

Writes tests/rig_values.json, which the rigs of `fitting.rigs` are compared with. No code of this project is imported.

Displacements (u_r, u_z) are quadratic, and the pressure p = K div u is linear in each triangle and continuous
(Taylor-Hood, which does not lock). The grid lines are graded to the rims of the plates and to the punch's edge, where
stresses are singular. Every number is computed on three grids, each with half the cells of the next. It is extrapolated
with the observed order. Elements with displacements alone, which are too stiff on any grid, serve as a check.

    python -m experiments.sources.axisymmetric_reference
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

FILE = Path(__file__).parents[2] / "tests" / "rig_values.json"
#: Height over radius, and bulk modulus over shear modulus.
ASPECTS, RATIOS = (0.2, 0.5, 1.0, 2.0, 5.0), (3.0, 20.0, 100.0, 1e4)
#: Radius of the punch over that of the sample: the first value in all cases, the others in some.
PUNCH, OTHERS = 0.4, (0.1, 0.8)
#: The distance of line t from a rim is proportional to t to this power. If the displacement near the rim has the
#: exponent 0.5, order 4 is kept.
GRADING = 4.0


class Grid(NamedTuple):
    """Quadratic triangles: nodes (n, 2) at (r, z), six node numbers per triangle with corners first, and number of
    corners.
    """

    nodes: np.ndarray
    triangles: np.ndarray
    corners: int


def lines(length: float, cells: int, rims: str) -> np.ndarray:
    """Return positions from 0 to `length`, graded to the end(s) named in `rims`: "0", "1" or "01"."""
    t = np.linspace(0.0, 1.0, cells + 1)
    if rims == "01":
        half = 0.5 * (2 * np.minimum(t, 1 - t)) ** GRADING
        return length * np.where(t <= 0.5, half, 1 - half)
    return length * (t**GRADING if rims == "0" else 1 - (1 - t) ** GRADING)


def grid(r: np.ndarray, z: np.ndarray) -> Grid:
    """Return rectangles between the lines, each cut into two triangles, with nodes in the middle of every edge."""

    def halves(x: np.ndarray) -> np.ndarray:
        return np.insert(x, np.arange(1, len(x)), (x[1:] + x[:-1]) / 2)

    n, m = 2 * len(r) - 1, 2 * len(z) - 1
    number = np.arange(n * m).reshape(n, m)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(0, n - 1, 2), np.arange(0, m - 1, 2), indexing="ij"))

    def at(*places: tuple[int, int]) -> np.ndarray:
        return np.column_stack([number[i + a, j + b] for a, b in places])

    triangles = np.vstack(
        [
            at((0, 0), (2, 0), (2, 2), (1, 0), (2, 1), (1, 1)),
            at((0, 0), (2, 2), (0, 2), (1, 1), (1, 2), (0, 1)),
        ]
    )
    corners = np.unique(triangles[:, :3])
    order = np.concatenate([corners, np.setdiff1d(number, corners)])
    new = np.argsort(order)
    nodes = np.column_stack([a.ravel() for a in np.meshgrid(halves(r), halves(z), indexing="ij")])[order]
    return Grid(nodes, new[triangles], len(corners))


def _rule() -> tuple[np.ndarray, np.ndarray]:
    """Return seven integration points of a triangle (7, 3), exact to degree 5, and their weights (Radon 1948)."""
    s = math.sqrt(15.0)
    a, b = (6 - s) / 21, (6 + s) / 21
    points = [[1 / 3, 1 / 3, 1 / 3]]
    for c in (a, b):
        points += [[1 - 2 * c, c, c], [c, 1 - 2 * c, c], [c, c, 1 - 2 * c]]
    return np.array(points), np.array([9 / 40] + 3 * [(155 - s) / 1200] + 3 * [(155 + s) / 1200])


def _shapes(L: np.ndarray, G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quadratic shape functions (6,) at one point and their gradients (e, 6, 2).

    L (3,) are the area coordinates, and G (e, 3, 2) are their gradients.
    """
    N = [L[a] * (2 * L[a] - 1) for a in range(3)]
    D = [(4 * L[a] - 1) * G[:, a] for a in range(3)]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        N.append(4 * L[a] * L[b])
        D.append(4 * (L[a] * G[:, b] + L[b] * G[:, a]))
    return np.array(N), np.stack(D, axis=1)


def system(mesh: Grid, ratio: float, mixed: bool = True) -> sp.csc_matrix:
    """Return the stiffness matrix divided by the shear modulus.

    With `mixed`, the unknowns are 2 n displacements followed by pressures over the shear modulus; otherwise
    displacements. The energy is that of small strain, |dev e|^2 + K/2 (div u)^2 with a shear modulus of 1, integrated 2
    pi r dr dz.
    """
    x, T = mesh.nodes[mesh.triangles[:, :3]], mesh.triangles
    edge = x[:, [2, 0, 1]] - x[:, [1, 2, 0]]
    twice = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
    G = np.stack([-edge[..., 1], edge[..., 0]], axis=-1) / twice[:, None, None]
    count, n = len(T), len(mesh.nodes)
    A, B, C = np.zeros((count, 12, 12)), np.zeros((count, 3, 12)), np.zeros((count, 3, 3))
    for L, weight in zip(*_rule(), strict=True):
        N, D = _shapes(L, G)
        r = x[..., 0] @ L
        w = weight * abs(twice) / 2 * 2 * math.pi * r
        e = np.zeros((count, 4, 12))  # rr, zz, tt and sqrt(2) rz
        e[:, 0, :6], e[:, 1, 6:], e[:, 2, :6] = D[..., 0], D[..., 1], N / r[:, None]
        e[:, 3, :6], e[:, 3, 6:] = D[..., 1] / math.sqrt(2), D[..., 0] / math.sqrt(2)
        div = e[:, :3].sum(axis=1)
        A += 2 * np.einsum("e,eki,ekj->eij", w, e, e)
        A += (0 if mixed else ratio) * w[:, None, None] * div[:, :, None] * div[:, None]
        A -= 2 / 3 * w[:, None, None] * div[:, :, None] * div[:, None]
        B += np.einsum("e,a,ei->eai", w, L, div)
        C += np.einsum("e,a,b->eab", w, L, L)
    u = np.hstack([T, T + n])
    stiffness = _assembled(A, u, u, (2 * n, 2 * n))
    if not mixed:
        return stiffness.tocsc()
    p = T[:, :3]
    across = _assembled(B, p, u, (mesh.corners, 2 * n))
    within = _assembled(C, p, p, (mesh.corners, mesh.corners)) / ratio
    return sp.bmat([[stiffness, across.T], [across, -within]], format="csc")


def _assembled(blocks: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> sp.csr_matrix:
    i, j = np.broadcast_arrays(rows[:, :, None], columns[:, None])
    return sp.coo_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape).tocsr()


def stiffness(K: sp.csc_matrix, held: np.ndarray, moved: np.ndarray) -> float:
    """Return the force on the unknowns `moved`, which are all 1, while the unknowns `held` are 0."""
    x = np.zeros(K.shape[0])
    x[moved] = 1.0
    free = np.setdiff1d(np.arange(len(x)), np.concatenate([held, moved]))
    x[free] = splu(K[free][:, free]).solve(-(K[free] @ x))
    return float(np.sum((K @ x)[moved]))


def compliance(K: sp.csc_matrix, held: np.ndarray, load: np.ndarray) -> float:
    """Return load . x, with the unknowns x that the load causes."""
    free = np.setdiff1d(np.arange(K.shape[0]), held)
    return float(load[free] @ splu(K[free][:, free]).solve(load[free]))


def tension(height: float, ratio: float, cells: int, mixed: bool = True) -> float:
    """Return the force over mu R d of a cylinder between glued plates that are pulled apart by d.

    The mesh is the upper half, fixed axially in the middle plane.
    """
    mesh = grid(lines(1.0, cells, "1"), lines(height / 2, cells, "1"))
    r, z = mesh.nodes.T
    n, top, axis, middle = len(r), np.flatnonzero(z == height / 2), np.flatnonzero(r == 0), np.flatnonzero(z == 0)
    held = np.unique(np.concatenate([top, axis, n + middle]))
    # The half cylinder is stretched by d / 2.
    return stiffness(system(mesh, ratio, mixed), held, n + top) / 2


def punch(height: float, ratio: float, cells: int, mixed: bool = True, radius: float = PUNCH) -> float:
    """Return the force over mu R d of a glued flat punch of `radius` R, pressed by d into a cylinder on a glued
    plate.
    """
    under, beside = lines(radius, cells, "1"), radius + lines(1 - radius, cells, "01")[1:]
    mesh = grid(np.concatenate([under, beside]), lines(height, 2 * cells, "01"))
    r, z = mesh.nodes.T
    n, bottom, axis = len(r), np.flatnonzero(z == 0), np.flatnonzero(r == 0)
    pressed = np.flatnonzero((z == height) & (r <= radius))
    held = np.unique(np.concatenate([bottom, n + bottom, axis, pressed]))
    return stiffness(system(mesh, ratio, mixed), held, n + pressed)


def creep(height: float, ratio: float, cells: int, mixed: bool = True) -> float:
    """Return the mean displacement of the top over R t / mu of a cylinder on a glued plate, under a uniform
    tension t.
    """
    mesh = grid(lines(1.0, cells, "1"), lines(height, cells, "0"))
    r, z = mesh.nodes.T
    n, bottom, axis = len(r), np.flatnonzero(z == 0), np.flatnonzero(r == 0)
    K = system(mesh, ratio, mixed)
    load = np.zeros(K.shape[0])
    top = np.flatnonzero(z == height)
    top = top[np.argsort(r[top])]
    # Integrals of N 2 pi r over an edge from a to b with middle node c. Simpson's rule is exact for this cubic.
    for a, c, b in zip(top[:-2:2], top[1:-1:2], top[2::2], strict=True):
        length = r[b] - r[a]
        load[n + np.array([a, c, b])] += 2 * math.pi * length / 6 * np.array([r[a], 4 * r[c], r[b]])
    return compliance(K, np.unique(np.concatenate([bottom, n + bottom, axis])), load) / math.pi


TESTS = {"tension": tension, "punch": punch, "creep": creep}


def converged(test: str, height: float, ratio: float, cells: int, **other: float) -> dict[str, Any]:
    """Return a number on three grids, the observed order, the extrapolation, and its difference from the finest grid
    [1].
    """
    coarse, middle, fine = (TESTS[test](height, ratio, n, **other) for n in (cells // 4, cells // 2, cells))
    order = math.log2(abs((middle - coarse) / (fine - middle)))
    value = fine + (fine - middle) / (2 ** max(order, 1.0) - 1)
    return {
        "test": test,
        "height_over_radius": height,
        "bulk_over_shear": ratio,
        **{f"punch_{name}": size for name, size in other.items()},
        "value": value,
        "grids": [coarse, middle, fine],
        "order": order,
        "left": abs(value / fine - 1),
        "displacements_alone": TESTS[test](height, ratio, cells // 2, mixed=False, **other),
    }


def main() -> None:
    """Write the table: every test at every height and ratio, and other punches at some of them."""
    own = {"tension": {}, "punch": {"radius": PUNCH}, "creep": {}}
    cases = [(test, h, k, own[test]) for test in TESTS for h in ASPECTS for k in RATIOS]
    cases += [("punch", h, k, {"radius": a}) for a in OTHERS for h in (ASPECTS[0], 1.0) for k in (3.0, 1e4)]
    rows = []
    for test, height, ratio, other in cases:
        rows.append(converged(test, height, ratio, 48 if test == "punch" else 32, **other))
        print({k: v for k, v in rows[-1].items() if k != "grids"}, flush=True)
    words = {
        "tension": "force / (mu R d), both plates glued, pulled apart by d",
        "punch": "force / (mu R d) on a glued flat punch of radius punch_radius R, pressed by d; the bottom glued",
        "creep": "mean displacement of the top / (R t / mu), pulled by t on its top; the bottom glued",
    }
    content = {"made_by": "experiments/sources/axisymmetric_reference.py", "what": words, "rows": rows}
    FILE.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
