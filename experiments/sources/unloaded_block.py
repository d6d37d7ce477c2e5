"""The shape of a block without its weight, by another program (scikit-fem, SciPy) and another method.

Writes data for `tests/test_unloaded.py`. The method is that of Govindjee and Mihalic (1996, Comput. Methods Appl. Mech.
Engrg. 136): equilibrium is written in the given loaded shape, and the inverse deformation from this shape is the
unknown. The block is that of Mazier et al. (2022, Engineering with Computers 38, DOI 10.1007/s00366-021-01597-z): 2 x 2
x 2 m, neo-Hookean, fixed at its bottom, under its weight. Here the cube is the given shape, with linear tetrahedra. No
code of this project is imported. The energy, mu/2 (I1 - 3) - mu ln J + lambda/2 ln^2 J, and its derivatives are
implemented here independently.

    pip install '.[reference]' && python -m experiments.sources.unloaded_block
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, LinearForm, MeshTet
from skfem.helpers import ddot, det, grad, inv

FILE = Path(__file__).parents[1] / "results" / "unloaded_block.json"
#: Side [m], cells along it, mu and lambda [Pa], reference density [kg/m^3], gravity [m/s^2].
SIDE, CELLS, MU, LAME, DENSITY, GRAVITY = 2.0, 2, 25e3, 8e5, 1000.0, 9.81
STEPS = 4


def strained(w: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return F = f^-1 of the inverse deformation f = 1 + grad u, and ln J."""
    f = np.eye(3)[:, :, None, None] + grad(w["u"])
    return inv(f), -np.log(det(f))


def turned(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the matrix product A B."""
    return np.einsum("ij...,jk...->ik...", A, B)


def stress(F: np.ndarray, ln_J: np.ndarray) -> np.ndarray:
    """Return the Cauchy stress (mu (F F^T - 1) + lambda ln J 1) / J."""
    one = np.eye(3)[:, :, None, None]
    return np.exp(-ln_J) * (MU * (turned(F, np.swapaxes(F, 0, 1)) - one) + LAME * ln_J * one)


@LinearForm
def forces(v, w):
    """Virtual work of stress and weight in the given shape, where the density is the reference density over J."""
    F, ln_J = strained(w)
    return ddot(stress(F, ln_J), grad(v)) + w["part"] * DENSITY * GRAVITY * np.exp(-ln_J) * v[2]


@BilinearForm
def slope(du, v, w):
    """Derivative of `forces` with respect to u: F changes by -F grad(du) F, and ln J by -tr(F grad(du))."""
    F, ln_J = strained(w)
    H = turned(F, grad(du))
    trace = np.einsum("ii...", H)
    dF = -turned(H, F)
    left = turned(dF, np.swapaxes(F, 0, 1))
    one = np.eye(3)[:, :, None, None]
    change = trace * stress(F, ln_J) + np.exp(-ln_J) * (MU * (left + np.swapaxes(left, 0, 1)) - LAME * trace * one)
    return ddot(change, grad(v)) + w["part"] * DENSITY * GRAVITY * np.exp(-ln_J) * trace * v[2]


def way_back(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return positions (V, 3) [m] of the shape without weight, by Newton's method in load steps."""
    basis = Basis(MeshTet(points.T, tetrahedra.T), ElementVector(ElementTetP1()), intorder=2)
    free = basis.complement_dofs(basis.get_dofs(lambda x: x[2] < 1e-9))
    u = basis.zeros()
    for part in np.arange(1, STEPS + 1) / STEPS:
        for _ in range(30):
            now = {"u": basis.interpolate(u), "part": part}
            r = forces.assemble(basis, **now)
            du = splu(slope.assemble(basis, **now).tocsc()[free][:, free]).solve(-r[free])
            u[free] += du
            if np.abs(du).max() < 1e-13 * SIDE:
                break
        else:
            raise RuntimeError(f"no shape at {part:g} of the weight")
    return points + u[basis.nodal_dofs].T


def cube() -> tuple[np.ndarray, np.ndarray]:
    """Return points (V, 3) [m] and tetrahedra (E, 4). Each cell is cut into six, always along the same diagonal."""
    lines = SIDE * np.linspace(0, 1, CELLS + 1)
    mesh = MeshTet.init_tensor(lines, lines, lines)
    return mesh.p.T, mesh.t.T


def main() -> None:
    """Write the mesh and the shape."""
    points, tetrahedra = cube()
    found = way_back(points, tetrahedra)
    top = found[np.abs(points[:, 2] - SIDE) < 1e-9, 2]
    print(f"the top was at {top.min():.6f} to {top.max():.6f} m")
    numbers = {"points": points.tolist(), "tetrahedra": tetrahedra.tolist(), "unloaded": found.tolist()}
    FILE.write_text(json.dumps(numbers) + "\n")


if __name__ == "__main__":
    main()
