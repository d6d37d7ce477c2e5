"""One steady cycle of large shear: the complex modulus of the first harmonic and the amplitude of the third harmonic.

The sample is incompressible and isotropic, with a strain energy function W. The instantaneous second Piola-Kirchhoff
stress S is computed from W. The relaxation of S does not depend on the strain (book chapter, section 4.2). The sample
is in simple shear. The amount of shear is g(t) = a sin(wt), with the amplitude a and the angular frequency w. The shear
stress is S12 + g S22, which does not depend on the pressure. S is a sum of harmonics of w. Relaxation multiplies
harmonic n by the modulus ratio m(nw) = G*(nw)/G0, with the complex modulus G* and the instantaneous modulus G0. In
torsion between plates, every ring of the sample is in simple shear (a universal deformation: Rivlin 1949). The amount
of shear depends on the radius, so the torque is a sum over rings. A rheometer converts this torque into moduli as if
the sample were linear.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.laws.base import Law
from liverjax.laws.terms.stretch_terms import stress_at_constant
from liverjax.tensors.matrices import pack, unpack

#: INSTANTS: number of instants in a cycle. The stress is computed at these instants. Harmonics of the stress above the
#: 15th are neglected. RINGS: number of rings between the plates (Gauss points).
INSTANTS, RINGS = 32, 8
#: The law is evaluated at this number of amounts of shear g. S12/g and S22 are even functions of g, so they are
#: interpolated by polynomials in g^2.
ASKED = 24


class Reading(NamedTuple):
    """Matrices that convert stresses at K = `ASKED` amounts of shear to the moduli that a rheometer reports. The
    matrices are the same for every law."""

    shears: np.ndarray  # (K,) amounts of shear, above 0
    F: jax.Array  # (K, 3, 3) deformation gradients
    #: Complex matrices (M, 2, A, 2, K) for M sets of modulus ratios, 2 harmonics (1 and 3), A strain amplitudes, 2
    #: components (S12/g and S22) and K amounts of shear.
    harmonics: jax.Array


def reading(strains: np.ndarray, memories: np.ndarray, plates: str = "parallel") -> Reading:
    """Compute the matrices of `Reading` for cycles with given strain amplitudes at the rim.

    Args:
        strains: A strain amplitudes (A,) at the rim.
        memories: M sets of complex modulus ratios m = G*(n omega) / G0, shape (M, `INSTANTS` / 2 + 1). The harmonics n
            of the angular frequency omega go from 0 to `INSTANTS` / 2. The reported moduli are linear in m.
        plates: "parallel", or "cone" (cone and plate, where the strain is the same everywhere).

    Raises:
        InputError: `plates` has another value.
    """
    if plates not in ("parallel", "cone"):
        raise InputError(f"plates = {plates!r} is not known: use parallel or cone")
    rho, weights = _radii_and_weights(plates)
    own = np.asarray(strains)[:, None] * rho
    shear = own[..., None] * np.sin(2 * np.pi * np.arange(INSTANTS) / INSTANTS)
    squares = 0.5 * np.max(own) ** 2 * (1 + np.cos(np.pi * (np.arange(ASKED) + 0.5) / ASKED))
    lines = _lagrange(squares, shear**2)  # (A, R, T, K) for R rings and T instants
    out = np.empty((len(memories), 2, len(own), 2, ASKED), complex)
    for c, S in enumerate((shear[..., None] * lines, lines)):
        spectrum = np.fft.rfft(S, axis=-2)
        for k, memory in enumerate(memories):
            relaxed = np.fft.irfft(spectrum * memory[:, None], INSTANTS, axis=-2)
            stress = relaxed if c == 0 else shear[..., None] * relaxed
            found = 2j * np.fft.rfft(stress, axis=-2) / INSTANTS / own[..., None, None]
            out[k, :, :, c] = np.einsum("r,arhk->hak", weights, found[..., [1, 3], :])
    F = np.tile(np.eye(3), (ASKED, 1, 1))
    F[:, 0, 1] = np.sqrt(squares)
    return Reading(np.sqrt(squares), jnp.asarray(F), jnp.asarray(out))


def _radii_and_weights(plates: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the radius of each ring, divided by the radius of the rim, and the weight of each ring. The modulus that a
    rheometer reports is the weighted sum of the moduli of the rings."""
    if plates == "cone":
        return np.ones(1), np.ones(1)
    x, w = np.polynomial.legendre.leggauss(RINGS)
    rho = 0.5 * (1 + x)
    return rho, 0.5 * w * 4 * rho**3  # modulus = 2 torque / (pi radius^3) / (strain at the rim)


def _lagrange(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the values (..., K) of the K Lagrange polynomials at the points `at` (...). `nodes` (K,) are Chebyshev
    nodes. The formula is the barycentric form (Berrut, Trefethen 2004)."""
    k = np.arange(len(nodes))
    w = (-1.0) ** k * np.sin(np.pi * (k + 0.5) / len(nodes))
    off = at[..., None] - nodes
    exact = off == 0
    terms = w / np.where(exact, 1.0, off)
    values = terms / terms.sum(axis=-1, keepdims=True)
    return np.where(exact.any(axis=-1, keepdims=True), exact, values)


def first_and_third(law: Law, r: Reading, shares: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return two results for A strain amplitudes. The first is the complex modulus (A,) [Pa] of the first harmonic. The
    second is the ratio (A,) of two amplitudes of the torque: third harmonic / first harmonic.

    Args:
        law: law of the instantaneous stress. Its volumetric energy is not used.
        r: the result of `reading`.
        shares: factors (M,) of the M sets of modulus ratios in `reading`. The modulus ratios m of the material are the
            sum of the sets, each multiplied by its factor.
    """
    S = _instantaneous_stress(law, r.F)
    asked = jnp.stack([S[:, 0, 1] / r.shears, S[:, 1, 1]])
    first, third = jnp.einsum("m,mhack,ck->ha", shares, r.harmonics, asked)
    return first, jnp.abs(third) / jnp.abs(first)


def _instantaneous_stress(law: Law, F: jax.Array) -> jax.Array:
    """Return the second Piola-Kirchhoff stress (K, 3, 3) [Pa] for K simple shears F (K, 3, 3). It is computed from the
    isochoric energy, or from the whole law if the law has no separate isochoric energy. F must be constant, because the
    result may have no derivatives with respect to F."""
    split = law.isochoric_part()
    if split is not None and split.stretch_energy is not None:
        return pack(stress_at_constant(split, unpack(F)))
    inverse = F.at[:, 0, 1].multiply(-1.0)  # inverse of a simple shear
    return inverse @ (law if split is None else split).first_piola(F)
