"""Check whether chains of samples agree, by the rank-normalised split R-hat.

Vehtari, Gelman, Simpson, Carpenter and Buerkner (2021), Bayesian Analysis 16, 667.
"""

import numpy as np


def r_hat(draws: np.ndarray) -> float:
    """Return the larger value of bulk R-hat and tail R-hat of one parameter. `draws` (chains, N): N values of the
    parameter in each chain. R-hat is near 1 if the chains agree."""
    half = draws.shape[1] // 2
    split = np.concatenate([draws[:, :half], draws[:, -half:]])
    folded = np.abs(split - np.median(split))
    return max(_basic(_normal_scores(split)), _basic(_normal_scores(folded)))


def _normal_scores(draws: np.ndarray) -> np.ndarray:
    import scipy.special
    import scipy.stats  # imported here: it takes half a second, and only fits with samples need it

    ranks = scipy.stats.rankdata(draws, method="average").reshape(draws.shape)
    return scipy.special.ndtri((ranks - 0.375) / (draws.size + 0.25))


def _basic(draws: np.ndarray) -> float:
    n = draws.shape[1]
    within = draws.var(axis=1, ddof=1).mean()
    between = n * draws.mean(axis=1).var(ddof=1)
    if not within > 0:
        return float("inf") if between > 0 else 1.0
    return float(np.sqrt(((n - 1) / n * within + between / n) / within))
