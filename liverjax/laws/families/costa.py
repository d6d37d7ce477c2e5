"""Costa's law of fibrous tissue. Guccione's law is its transversely isotropic case."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers, param, static, struct
from liverjax.laws.base import Law
from liverjax.laws.terms.green_terms import GreenModuli
from liverjax.tensors.material_axes import SIX, symmetric


@struct
class Costa(Law):
    """W = c/2 (exp Q - 1) + U(J), Q = sum of b_AB E_AB^2 over fibre, sheet and normal (shears twice).

    Q = b_ff E_ff^2 + b_ss E_ss^2 + b_nn E_nn^2 + 2 (b_fs E_fs^2 + b_fn E_fn^2 + b_sn E_sn^2). Costa, Holmes and
    McCulloch 2001. The book chapter names this law (section 4.1.2 i, for heart muscle) but prints no formula for it. E
    is Green's strain in the axes fibre, sheet (made orthogonal to the fibre) and normal. The exponential energy is not
    isochoric, so the bulk modulus of the law is larger than that of U(J).
    """

    c: Number = param("Pa", "scale", above=0.0, typical=200.0)
    b_ff: Number = param("1", "along the fibre", above=0.0, typical=8.0)
    b_ss: Number = param("1", "along the sheet", above=0.0, typical=4.0)
    b_nn: Number = param("1", "along the normal", above=0.0, typical=3.0)
    b_fs: Number = param("1", "shear fibre-sheet", above=0.0, typical=5.0)
    b_fn: Number = param("1", "shear fibre-normal", above=0.0, typical=4.0)
    b_sn: Number = param("1", "shear sheet-normal", above=0.0, typical=2.0)
    bulk: Number = param("Pa", "bulk modulus of U(J)", above=0.0, typical=7700.0)
    fibre: Numbers = param("1", "fibre direction, (3,) or (E, 3)", each=True, default=(1.0, 0.0, 0.0))
    sheet: Numbers = param("1", "sheet direction, (3,) or (E, 3)", each=True, default=(0.0, 1.0, 0.0))
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("E", "J")

    def _weights(self):
        return (self.b_ff, self.b_ss, self.b_nn, self.b_fs, self.b_fn, self.b_sn)

    def _exponent(self, E):
        terms = [b * E[i][j] ** 2 for b, (i, j) in zip(self._weights(), SIX, strict=True)]
        return sum(terms[:3]) + 2 * sum(terms[3:])

    def green_energy(self, E):
        """Return the energy, computed with expm1 so that there is no cancellation at rest."""
        return 0.5 * self.c * jnp.expm1(self._exponent(E))

    def green_derivatives(self, E):
        """Return the stress S_AB = s b_AB E_AB with s = c exp Q, and the moduli.

        The moduli are s b_AB (for shears s b_AB/2), plus (2/s) S (x) S.
        """
        s = self.c * jnp.exp(self._exponent(E))
        b = self._weights()
        S = symmetric(tuple(s * w * E[i][j] for w, (i, j) in zip(b, SIX, strict=True)))
        normal = symmetric((s * b[0], s * b[1], s * b[2], 0.0, 0.0, 0.0))
        return S, GreenModuli(normal, tuple(0.5 * s * w for w in b[3:]), 2 / s)

    def shear_modulus(self):
        """Return the Voigt mean of the shear modulus, c (b_ff + b_ss + b_nn)/15 + c (b_fs + b_fn + b_sn)/10 [Pa]."""
        b = self._weights()
        return self.c * (sum(b[:3]) / 15 + sum(b[3:]) / 10)

    def bulk_modulus(self):
        """Return the Voigt mean of the bulk modulus, bulk + c (b_ff + b_ss + b_nn)/9 [Pa]."""
        return (0.0 if self.bulk is None else self.bulk) + self.c * sum(self._weights()[:3]) / 9

    def check_directions(self):
        """Raise `InputError` if a direction has length 0, or the sheet is parallel to the fibre.

        Directions inside jit, grad or vmap are not checked.
        """
        if any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves((self.fibre, self.sheet))):
            return
        f, s = np.asarray(self.fibre, float), np.asarray(self.sheet, float)
        if f.shape[-1:] != (3,) or s.shape[-1:] != (3,):
            raise InputError(
                f"law costa: 'fibre' and 'sheet' have the shapes {f.shape} and {s.shape}; give (3,), or (E, 3) for E "
                "elements"
            )
        size = np.linalg.norm(f, axis=-1) * np.linalg.norm(s, axis=-1)
        if np.any(np.linalg.norm(np.cross(f, s), axis=-1) <= 1e-9 * size):
            raise InputError(
                "law costa: the directions 'fibre' and 'sheet' are parallel, or one of them is zero; give two "
                "directions that are not parallel"
            )

    @classmethod
    def guccione(cls, *, c: Number, b_f: Number, b_t: Number, b_fs: Number, bulk: Number, **directions: Any) -> "Costa":
        """Make the law of Guccione et al. 1991, with b_ff = b_f, b_ss = b_nn = b_sn = b_t and b_fn = b_fs."""
        return cls(c=c, b_ff=b_f, b_ss=b_t, b_nn=b_t, b_sn=b_t, b_fs=b_fs, b_fn=b_fs, bulk=bulk, **directions)
