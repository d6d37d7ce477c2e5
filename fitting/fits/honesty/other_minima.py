"""Other numbers of a law that follow the tests as well: does the law then say the same of tension?

In simple shear and pure shear one principal stretch is 1 and the other two are l and 1/l. There one term (mu, alpha) of
Ogden's law is the same as (-mu, -alpha), but in tension and compression they differ several times.
"""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.laws import homogeneous

if TYPE_CHECKING:
    from fitting.fits.stress_stretch import Candidate

#: Stretches at which stresses in tension and compression are compared, at most; ratio of stresses that is told.
_STRETCHES, _RATIO = (0.7, 1.4), 1.1
#: Relative difference of numbers that are the same; the most sets of numbers that are compared.
_SAME, _MOST = 0.02, 12


def of_other_minima(candidate: "Candidate", u: np.ndarray, us: np.ndarray, scale: float, F: np.ndarray) -> list[str]:
    """A sentence if starts with the cost of the best one have another stress in tension or compression.

    Args:
        candidate: the law.
        u: unknowns (p,) of the fit.
        us: those of all starts that reached its cost (S, p).
        scale: of the candidate's moduli [Pa].
        F: deformation gradients (n, 3, 3) of the tests; the stretches compared are not beyond theirs.
    """
    far = float(np.clip(np.max(np.linalg.norm(F, 2, axis=(1, 2))), 1.01, _STRETCHES[1]))
    stretches = np.array([max(1 / far, _STRETCHES[0]), far])
    uniaxial = jnp.asarray(np.stack([np.diag([l, l**-0.5, l**-0.5]) for l in stretches]))

    def stresses(values: np.ndarray) -> np.ndarray:
        return np.asarray(homogeneous.nominal_stress(candidate.law(jnp.asarray(values)), uniaxial)[:, 0, 0])

    values = np.asarray(candidate.values(jnp.asarray(u), scale))
    every = np.asarray(jax.vmap(lambda own: candidate.values(own, scale))(jnp.asarray(us)))
    _, places = np.unique(np.round(every / values, 2), axis=0, return_index=True)
    others = [k for k in places if not np.allclose(every[k], values, rtol=_SAME)]
    own = stresses(values) if others else None
    for other in every[others[:_MOST]]:
        ratios = stresses(other) / own
        k = int(np.argmax(np.abs(np.log(np.abs(ratios)))))
        if not 1 / _RATIO < ratios[k] < _RATIO:
            numbers = ", ".join(f"{n} {v:.4g}" for n, v in zip(candidate.names, other, strict=True))
            return [
                f"other numbers follow these tests as well ({numbers}), but their stress at a stretch of "
                f"{stretches[k]:.2g} is {ratios[k]:.2g} times that of the numbers given: add a test of tension or "
                "compression"
            ]
    return []
