"""Cook's membrane by another program: plane strain, quadratic triangles with linear pressures (scikit-fem, SciPy).

Writes data for `experiments.benchmarks.elements`: the mean rise of the membrane's right edge. No code of this project
is imported. The energy, mu/2 (Ibar1 - 3) + K/2 (J - 1)^2, and its derivatives are implemented here independently, with
the pressure p = K (J - 1) as an unknown. The grid is graded to its corners. At the upper corner of the clamp the stress
is singular. At the two right corners the shear load does not fit the free edges.

    pip install '.[reference]' && python -m experiments.sources.cooks_membrane
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from skfem import (
    Basis,
    BilinearForm,
    ElementTriP1,
    ElementTriP2,
    ElementVector,
    FacetBasis,
    LinearForm,
    MeshTri,
)
from skfem.helpers import ddot, det, grad

FILE = Path(__file__).parents[1] / "results" / "cooks_membrane.json"
#: Shear modulus [Pa], shear traction over it, K/mu, and cells along each side. The last grid gives the result.
MU, LOAD, RATIOS, CELLS = 770.0, 0.01, (1.0, 3.0, 100.0, 1e4), (16, 32, 64)
#: The distance of line t (of n) from the nearer side is proportional to t to this power.
GRADING = 2.5


def grid(n: int) -> MeshTri:
    """Return n x n quadrilaterals, each cut into two triangles [m]."""
    t = np.linspace(0, 1, n + 1)
    half = 0.5 * (2 * np.minimum(t, 1 - t)) ** GRADING
    lines = np.where(t <= 0.5, half, 1 - half)
    flat = MeshTri.init_tensor(lines, lines)
    s, t = flat.p
    return MeshTri(1e-3 * np.stack([48 * s, 44 * s + t * (44 - 28 * s)]), flat.t)


def state(w: Any) -> tuple[Any, Any, Any]:
    """Return F, J and F^-T at the integration points."""
    F = grad(w["u"]) + np.eye(2)[:, :, None, None]
    J = det(F)
    return F, J, np.array([[F[1, 1], -F[1, 0]], [-F[0, 1], F[0, 0]]]) / J


@LinearForm
def forces(v, w):
    """Internal virtual work with the first Piola stress mu J^-2/3 (F - I1/3 F^-T) + p J F^-T.

    I1 contains the stretch of 1 perpendicular to the plane.
    """
    F, J, inverse = state(w)
    P = MU * J ** (-2 / 3) * (F - (ddot(F, F) + 1) / 3 * inverse) + w["p"] * J * inverse
    return ddot(P, grad(v))


@LinearForm
def volumes(q, w):
    """Weak form of J - 1 = p / K."""
    return (state(w)[1] - 1 - w["p"] / w["K"]) * q


@BilinearForm
def stiffness(du, v, w):
    """Derivative of `forces` with respect to the displacement."""
    F, J, inverse = state(w)
    H, I1, a = grad(du), ddot(F, F) + 1, MU * J ** (-2 / 3)
    trace, turned = ddot(inverse, H), -np.einsum("ij...,kj...,kl...->il...", inverse, H, inverse)
    dP = a * (H - 2 / 3 * trace * (F - I1 / 3 * inverse) - 2 / 3 * ddot(F, H) * inverse - I1 / 3 * turned)
    return ddot(dP + w["p"] * J * (trace * inverse + turned), grad(v))


@BilinearForm
def coupling(du, q, w):
    """Derivative of `volumes` with respect to the displacement: that of J."""
    _, J, inverse = state(w)
    return J * ddot(inverse, grad(du)) * q


@BilinearForm
def compliance(p, q, w):
    """Derivative of `volumes` with respect to the pressure."""
    return -p * q / w["K"]


def mean_rise(n: int, ratio: float) -> float:
    """Return the mean rise [m] of the right edge, by Newton's method in two load steps."""
    mesh = grid(n)
    u_basis = Basis(mesh, ElementVector(ElementTriP2()), intorder=6)
    p_basis = u_basis.with_element(ElementTriP1())
    right = FacetBasis(mesh, u_basis.elem, facets=mesh.facets_satisfying(lambda x: x[0] > 0.048 - 1e-9), intorder=6)
    load = LinearForm(lambda v, w: v[1]).assemble(right)
    held = u_basis.get_dofs(lambda x: x[0] < 1e-9).all()
    free = np.setdiff1d(np.arange(u_basis.N + p_basis.N), held)
    u, p = u_basis.zeros(), p_basis.zeros()
    for part in (0.5, 1.0):
        for _ in range(20):
            now = {"u": u_basis.interpolate(u), "p": p_basis.interpolate(p), "K": MU * ratio}
            r = np.concatenate(
                [forces.assemble(u_basis, **now) - part * LOAD * MU * load, volumes.assemble(p_basis, **now)]
            )
            B = coupling.assemble(u_basis, p_basis, **now)
            A, C = stiffness.assemble(u_basis, **now), compliance.assemble(p_basis, **now)
            change = np.zeros(len(r))
            change[free] = splu(sp.bmat([[A, B.T], [B, C]]).tocsc()[free][:, free]).solve(-r[free])
            u, p = u + change[: u_basis.N], p + change[u_basis.N :]
            if np.abs(change[: u_basis.N]).max() < 1e-12:
                break
        else:
            raise RuntimeError(f"no equilibrium of {n} cells at K/mu = {ratio:g}")
    return float(load @ u / 0.016)


def main() -> None:
    """Write the values for each K/mu on every grid."""
    found = {f"{ratio:g}": {str(n): mean_rise(n, ratio) for n in CELLS} for ratio in RATIOS}
    print(json.dumps(found, indent=1))
    FILE.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
