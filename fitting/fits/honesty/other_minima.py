"""Other parameter values of a law may fit the test data equally well. This module checks whether such values predict
the same stress in tension and compression as the fitted values.

In simple shear and pure shear one principal stretch is 1 and the other two are l and 1/l. In these tests, one term (mu,
alpha) of Ogden's law equals the term (-mu, -alpha). In tension and compression, the stresses of the two terms differ by
a large factor.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from liverjax.laws import Law, homogeneous

#: _STRETCHES: smallest and largest stretch at which stresses are compared. _RATIO: a warning is given if stresses
#: differ by more than this factor.
_STRETCHES, _RATIO = (0.7, 1.4), 1.1
#: _SAME: two parameter sets are equal if all relative differences are at most this value. _MOST: maximum number of
#: compared parameter sets.
_SAME, _MOST = 0.02, 12


def of_other_minima(
    names: Sequence[str], law_of: Callable[..., Law], values: np.ndarray, every: np.ndarray, F: np.ndarray
) -> list[str]:
    """Return a warning if another minimum has the same cost as the fit, but predicts another stress in tension or
    compression.

    Args:
        names: names of the parameters of the law (P,).
        law_of: function from parameters (P,) to the law with these parameters.
        values: fitted parameters (P,).
        every: parameters (S, P) from S searches, which all reached the cost of the fit.
        F: deformation gradients (n, 3, 3) at the n points of the tests. Stresses are compared at the largest stretch of
            the tests (limited to 1.01 to 1.4), and at the inverse of this stretch (at least 0.7).
    """
    far = float(np.clip(np.max(np.linalg.norm(F, 2, axis=(1, 2))), 1.01, _STRETCHES[1]))
    stretches = np.array([max(1 / far, _STRETCHES[0]), far])
    uniaxial = jnp.asarray(np.stack([np.diag([l, l**-0.5, l**-0.5]) for l in stretches]))

    def stresses(values: np.ndarray) -> np.ndarray:
        return np.asarray(homogeneous.nominal_stress(law_of(jnp.asarray(values)), uniaxial)[:, 0, 0])

    _, places = np.unique(np.round(every / np.where(values == 0, 1.0, values), 2), axis=0, return_index=True)
    others = [k for k in places if not np.allclose(every[k], values, rtol=_SAME)]
    own = stresses(values) if others else None
    for other in every[others[:_MOST]]:
        ratios = stresses(other) / own
        k = int(np.argmax(np.abs(np.log(np.maximum(np.abs(ratios), 1e-300)))))
        if not 1 / _RATIO < ratios[k] < _RATIO:
            numbers = ", ".join(f"{n} {v:.4g}" for n, v in zip(names, other, strict=True))
            return [
                f"other parameter values fit these tests equally well ({numbers}). At a stretch of {stretches[k]:.2g}, "
                f"these values give {ratios[k]:.2g} times the stress of the fitted values: add a test in tension or "
                "compression"
            ]
    return []
