"""The Matérn prior: a smooth random field on a mesh (Lindgren, Rue and Lindstroem 2011).

The field m solves (kappa^2 - Laplace) m = white noise, with kappa = 1 / length. In three dimensions, this gives the
covariance sd^2 exp(-distance / length), where sd is the standard deviation. With the lumped mass M and the stiffness L
of linear tetrahedra, the discrete solution is m = A^-1 M^(1/2) z. The entries of z are independent and standard normal,
and A = (kappa^2 M + L) / (sd sqrt(8 pi kappa)). The normal derivative of m is 0 at the boundary. Therefore the standard
deviation is larger there, and largest in corners.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from liverjax.mesh.tetrahedra import TetMesh


class Prior(NamedTuple):
    """The prior, stored as a factorised sparse matrix (SciPy). The functions below use this matrix."""

    solver: Any  # LU factorisation of kappa^2 M + L
    root_mass: np.ndarray  # (V,) square root of the lumped mass
    scale: float  # sqrt(8 pi kappa), for a field of standard deviation 1


def prior(mesh: TetMesh, length: float) -> Prior:
    """Return the prior of a field at the vertices with standard deviation 1 and correlation length `length` [m]."""
    kappa, n = 1 / length, mesh.number_of_vertices
    tets, volumes = np.asarray(mesh.tetrahedra), np.asarray(mesh.volumes)
    D = np.moveaxis(np.asarray(mesh.shape_vectors), -1, 0)
    grad = np.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)  # (E, 4, 3)
    local = volumes[:, None, None] * np.einsum("eac,ebc->eab", grad, grad)
    rows, columns = np.repeat(tets, 4, axis=1).ravel(), np.tile(tets, (1, 4)).ravel()
    L = scipy.sparse.coo_matrix((local.ravel(), (rows, columns)), shape=(n, n)).tocsc()
    mass = np.bincount(tets.ravel(), np.repeat(volumes / 4, 4), minlength=n)
    A = (kappa**2 * scipy.sparse.diags(mass) + L).tocsc()
    return Prior(scipy.sparse.linalg.splu(A), np.sqrt(mass), math.sqrt(8 * math.pi * kappa))


def field_at_nodes(p: Prior, z: np.ndarray) -> np.ndarray:
    """Return one field m (V,) or k fields (V, k) at the nodes, from independent standard normal numbers z of the same
    shape."""
    root = p.root_mass if z.ndim == 1 else p.root_mass[:, None]
    return p.scale * p.solver.solve(root * z)


def to_whitened(p: Prior, g: np.ndarray) -> np.ndarray:
    """Convert derivatives g with respect to the field m to derivatives with respect to the numbers z. This function is
    the transpose of `field_at_nodes`, which computes m from z."""
    root = p.root_mass if g.ndim == 1 else p.root_mass[:, None]
    return p.scale * root * p.solver.solve(g)


def variances(p: Prior, modes: np.ndarray, kept: np.ndarray, chunk: int = 512) -> tuple[np.ndarray, np.ndarray]:
    """Return the variances (V,) of the field without and with the data. Along the directions `modes`, the data reduce
    the variance to the fraction `kept`.

    Args:
        modes: k orthonormal directions (V, k) of the normal numbers z (see `field_at_nodes`).
        kept: fraction (k,) of the variance that remains in each direction.
    """
    n = len(p.root_mass)
    before = np.zeros(n)
    for first in range(0, n, chunk):
        unit = np.zeros((n, min(chunk, n - first)))
        unit[np.arange(first, first + unit.shape[1]), np.arange(unit.shape[1])] = 1
        # Column v of `to_whitened` is row v of T = scale A^-1 M^(1/2), because A is symmetric.
        before[first : first + unit.shape[1]] = np.sum(to_whitened(p, unit) ** 2, axis=0)
    after = before - field_at_nodes(p, modes) ** 2 @ (1 - kept)
    return before, np.maximum(after, 0.0)
