"""Elements that connect nodes of the body: membranes, springs, bars. Their energy depends on their lengths and angles.

At every integration point an element has d tangent vectors f_k = sum_a p_ka y_a, with the positions y_a of its nodes
and constant factors p_ka. The energy of the element is a function W of the metric C_kl = f_k . f_l. The stress is
T_kl = dW/dC_kl + dW/dC_lk. C_v and C_w are components of the metric, and I is the identity. The forces g_a on nodes a,
and the stiffness blocks K_ab between nodes a and b, are

    g_a = sum p_ka T_kl f_l,    K_ab = sum p_ka p_lb (T_kl I + d2W/dC_v dC_w (dC_v/df_k) (dC_w/df_l)).
"""

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import NodalForce
from liverjax.solvers.attached import Attached


class Elements(NodalForce):
    """Force term, for one step, of elements that connect nodes of the body."""

    def nodes(self, mesh: TetMesh) -> jax.Array:
        """Return the node numbers (n, m) of m elements with n nodes each."""
        raise TypeError(f"{type(self).__name__} must define nodes(mesh)")

    def tangents(self, mesh: TetMesh) -> jax.Array:
        """Return the factors p_ka (d, n, Q, m) of d tangent vectors and n nodes, at Q points of m elements.

        Their unit is 1/m (ligaments: no unit).
        """
        raise TypeError(f"{type(self).__name__} must define tangents(mesh)")

    def energies(self, mesh: TetMesh, C: tuple[jax.Array, ...]) -> jax.Array:
        """Return the energies (Q, m) [J] at Q integration points of m elements.

        `C` are the components of the metric: C_11 (Q, m), or C_11, C_12 and C_22.
        """
        raise TypeError(f"{type(self).__name__} must define energies(mesh, C)")

    def away(self) -> jax.Array | None:
        """Return vectors (d, 3, Q, m) to subtract from the d tangent vectors, at Q points of m elements.

        These vectors are needed if one end of an element is not a node. Returns None if all ends are nodes.
        """
        return None

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the nodal forces (V, 3) [N]: the gradient of the energy with respect to the positions x (V, 3)."""
        p, nodes = self.tangents(mesh), self.nodes(mesh)
        f = self._vectors(p, x[nodes])
        T = _tension(jax.grad(lambda C: jnp.sum(self.energies(mesh, C)))(_metric(f)))
        pulls = jnp.stack([sum(t[None] * v for t, v in zip(row, f, strict=True)) for row in T])
        own = jnp.einsum("kaqm,kiqm->ami", p, pulls)
        return jnp.zeros_like(x).at[nodes].add(own)

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the energy [J] of all elements."""
        f = self._vectors(self.tangents(mesh), x[self.nodes(mesh)])
        return jnp.sum(self.energies(mesh, _metric(f)))

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Attached:
        """Return the stiffness: second derivatives of the energy with respect to the positions x (V, 3)."""
        p, nodes = self.tangents(mesh), self.nodes(mesh)
        f = self._vectors(p, x[nodes])
        C = _metric(f)
        slopes = jax.grad(lambda C: jnp.sum(self.energies(mesh, C)))
        units = [tuple(jnp.full_like(c, float(v == w)) for w, c in enumerate(C)) for v in range(len(C))]
        curved = [jax.jvp(slopes, (C,), (unit,))[1] for unit in units]
        T, G = _tension(slopes(C)), _changes(f)
        rows = []
        for k in range(len(f)):
            for i in range(3):
                bent = [sum(G[v][k][i] * row[w] for v, row in enumerate(curved)) for w in range(len(C))]
                entry = [[sum(bent[w] * G[w][l][j] for w in range(len(C))) for j in range(3)] for l in range(len(f))]
                for l in range(len(f)):
                    entry[l][i] = entry[l][i] + T[k][l]
                rows.append(jnp.stack([jnp.stack(e) for e in entry]))
        H = jnp.stack(rows).reshape(len(f), 3, len(f), 3, *C[0].shape)
        right = jnp.einsum("kiljqm,lbqm->kibjqm", H, p)
        return Attached(nodes, jnp.einsum("kaqm,kibjqm->aibjm", p, right))

    def _vectors(self, p: jax.Array, y: jax.Array) -> jax.Array:
        """Return d tangent vectors (d, 3, Q, m) at Q points of m elements, from positions y (n, m, 3) of n nodes."""
        f, away = jnp.einsum("kaqm,ami->kiqm", p, y), self.away()
        return f if away is None else f - away


def _metric(f: jax.Array) -> tuple[jax.Array, ...]:
    """Return the components C_kl = f_k . f_l, for k <= l, of the metric of the tangent vectors f_k (d, 3, Q, m)."""
    return tuple(jnp.sum(f[k] * f[l], axis=0) for k in range(len(f)) for l in range(k, len(f)))


def _tension(slopes: tuple[jax.Array, ...]) -> list[list[jax.Array]]:
    """Return the stress T_kl as nested lists, from the derivatives of the energy with respect to the metric.

    These are the derivatives with respect to C_11 (one tangent vector), or to C_11, C_12 and C_22 (two tangent
    vectors).
    """
    if len(slopes) == 1:
        return [[2 * slopes[0]]]
    return [[2 * slopes[0], slopes[1]], [slopes[1], 2 * slopes[2]]]


def _changes(f: jax.Array) -> list[list[jax.Array]]:
    """Return the derivatives dC_v/df_k of the components C_v of the metric, as nested lists [v][k] of arrays (3, Q, m).

    f: one or two tangent vectors f_k, at Q points of m elements.
    """
    if len(f) == 1:
        return [[2 * f[0]]]
    zero = jnp.zeros_like(f[0])
    return [[2 * f[0], zero], [f[1], f[0]], [zero, 2 * f[1]]]
