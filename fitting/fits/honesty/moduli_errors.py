"""Errors of the fitted moduli. These errors contain the error due to the choice of the model.

Models that explain the data about equally well differ in their moduli. Each model gets its Akaike weight, and the
weighted differences between the models become part of the error. Sources: Buckland, Burnham and Augustin 1997,
Biometrics 53, 603. For few data: Hurvich and Tsai 1989, Biometrika 76, 297.
"""

import numpy as np

from fitting.fits.honesty import alike_points
from fitting.fits.viscoelastic import Fit, mean_square, number_of_parameters, of_noise_shown
from fitting.methods import generalised_maxwell, host
from fitting.methods.estimate import Estimate, errors_and_correlation, estimated, wider
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.host import Array, arrays_of

#: Models with a weight below this value are ignored.
NEGLIGIBLE = 1e-4


def fitted_moduli(fit: Fit, omega: np.ndarray, noise_given: bool) -> Estimate:
    """Return n values of G' and then n values of G'' (2n,) [Pa] of a fit in closed form. The errors are computed with
    the delta method (linear propagation of errors).

    Noise and the choice of the model cause these errors. They also contain the errors of the gap and of the instrument
    if the fit contains these errors.

    Args:
        fit: the fit; its field `rivals` contains the fits of the other models if several models were fitted.
        omega: angular frequencies (n,) [rad/s].
        noise_given: whether the data have standard deviations.
    """
    found = _of_one_model(fit, omega, noise_given)
    others = [(w, _of_one_model(other, omega, noise_given)) for w, other in _weighed(fit)]
    if others:
        own = 1 - sum(weight for weight, _ in others)
        columns = [np.sqrt(own) * found.root]
        for weight, other in others:
            columns += [np.sqrt(weight) * other.root, np.sqrt(weight) * (other.values - found.values)[:, None]]
        root = np.concatenate(columns, axis=1)
        errors, correlation = errors_and_correlation(root)
        found = found._replace(root=root, standard_errors=errors, correlation=correlation)
    for direction in _shared_errors(fit, omega):
        found = wider(found, direction)
    return found


def model_weights(fit: Fit) -> dict[str, float]:
    """Return the weight [1] of each model in the errors of the moduli, by name, with the chosen model first. The result
    is empty if there is no other model."""
    others = {other.kind.name: weight for weight, other in _weighed(fit)}
    return {fit.kind.name: 1 - sum(others.values())} | others if others else {}


def _weighed(fit: Fit) -> list[tuple[float, Fit]]:
    """Return the other models whose weight is above `NEGLIGIBLE`, with their weights."""
    evidence = np.array([_akaike(own) for own in (fit, *fit.rivals)])
    shares = np.exp(-0.5 * (evidence - evidence.min()))
    shares /= shares.sum()
    return [(float(w), own) for w, own in zip(shares[1:], fit.rivals, strict=True) if w > NEGLIGIBLE]


def _akaike(fit: Fit) -> float:
    """Return Akaike's information criterion with the correction for few data. The size of the noise counts as a
    parameter, because the criterion estimates this size from the residuals. If the data have standard deviations, the
    parameter is a common factor of all standard deviations."""
    m, k = 2 * len(fit.storage), number_of_parameters(fit) + 1
    return float(m * np.log(mean_square(fit)) + 2 * k * m / max(1.0, m - k - 1))


def _shared_errors(fit: Fit, omega: np.ndarray) -> np.ndarray:
    """Return the changes (s, 2n) [Pa] of G' and G'' at n frequencies due to s systematic errors (gap, instrument), one
    row for each error. A systematic error is common to all points. Each row is the change if the error is one standard
    deviation."""
    shared, n = fit.uncertainty.shared, fit.modes
    if shared is None:
        return np.zeros((0, 2 * len(omega)))

    def of(p: np.ndarray) -> np.ndarray:
        model = Maxwell(p[..., 0], p[..., 1 : n + 1], p[..., n + 1 :])
        return np.concatenate(generalised_maxwell.moduli(model, omega), axis=-1)

    _, slope = host.with_jacobian(of, np.asarray(fit.uncertainty.values, float))
    return (slope @ shared).T


def moduli_of_model(fit: Fit, u: Array, omega: np.ndarray) -> tuple[Array, Array]:
    """Return G' and G'' (n,) [Pa] of the fitted material for the unknowns u of the fit. For a compressed sample, these
    are the moduli at rest."""
    own = fit.kind.moduli
    return generalised_maxwell.moduli(fit.kind.maxwell(u), omega) if own is None else own(u, omega)


def _of_one_model(fit: Fit, omega: np.ndarray, noise_given: bool) -> Estimate:
    def of(u: Array) -> Array:
        return arrays_of(u).concatenate(moduli_of_model(fit, u, omega), axis=-1)

    names = [f"{part} at {at:.3g} rad/s" for part in ("storage", "loss") for at in omega]
    found = estimated(names, of, fit.solution, 2 * len(fit.storage), noise_given, fit.kind.effective)
    found = of_noise_shown(found, of, fit.solution.u, fit.noise_root)
    if alike_points.INDEPENDENT not in fit.details:
        return found
    alike = alike_points.alike_of(fit)
    return found if alike is None else alike_points.not_below(found, of, np.asarray(fit.solution.u), alike)
