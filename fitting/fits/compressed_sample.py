"""Fit of a compressed sample: the parameters of the sample without compression, and the axial force."""

import numpy as np

from fitting.fits import simulated_rheometer, viscoelastic
from fitting.fits.families import models
from fitting.fits.honesty import total_error
from fitting.fits.honesty.long_times import INTERVAL, NORMAL
from fitting.fits.viscoelastic import Fit, Kind
from fitting.methods import as_prony_modes, uncertainty
from fitting.methods.generalised_maxwell import Maxwell, weighed
from fitting.readers.frequency_sweep import Sweep
from fitting.rigs import compression
from liverjax import laws
from liverjax.core.errors import InputError


def of_compressed_sample(fit: Fit, sweep: Sweep, factors: compression.Shares) -> Fit:
    """Return the closed-form fit of a compressed sample, with the parameters of the sample at rest (not compressed).

    The storage modulus, the loss modulus and the residuals of the fit still describe the compressed sample.

    Args:
        fit: fit of the measured moduli. All parameters of the model that are moduli are divided by the factors.
        sweep: the measured moduli.
        factors: factors of the relaxing and of the equilibrium moduli, caused by the compression.

    Raises:
        InputError: the moduli were measured in tension or bending. The factors are valid only for torsion.
    """
    if sweep.tensile:
        raise InputError(
            f"{sweep.source or 'sweep'}: the moduli are of {sweep.load}, but --precompression is for the torsion of a "
            "compressed sample: remove --precompression"
        )
    kind, details = _kind_at_rest(fit.kind, factors), fit.details
    if kind.moduli is not None:
        kind, details = _of_own_moduli(kind, fit, sweep)
    data = (2 * len(fit.storage), sweep.noise_given)
    spread, own = viscoelastic.estimates(fit.solution, kind, data, fit.noise_root)
    modes = len(spread.values) // 2
    model = Maxwell(spread.values[0], spread.values[1 : modes + 1], spread.values[modes + 1 :])
    rivals = tuple(of_compressed_sample(other, sweep, factors) for other in fit.rivals)
    found = fit._replace(model=model, kind=kind, uncertainty=spread, parameters=own, details=details, rivals=rivals)
    old, new = (_of_parameters(of, sweep) for of in (fit, found))
    return found._replace(warnings=(*(w for w in fit.warnings if w not in old), *new))


def _of_parameters(fit: Fit, sweep: Sweep) -> list[str]:
    """Return the warnings of a fit that contain values of its parameters or of the Prony modes that represent it."""
    if fit.parameters is None:
        return uncertainty.cautions(sweep, fit.uncertainty, fit.kind.name)
    return models.sentences_of_modes(fit)


def _kind_at_rest(kind: Kind, factors: compression.Shares) -> Kind:
    """Return the kind (`Kind`: the meaning of the variables u) for the sample at rest. The relaxing moduli and the
    equilibrium modulus are divided by their factors."""
    seen, shown, moduli = kind.maxwell, kind.values, kind.moduli
    if shown is None or moduli is None:
        return kind._replace(maxwell=lambda u: weighed(seen(u), 1 / factors.relaxing, 1 / factors.equilibrium))
    each = [1 / (factors.equilibrium if n == "equilibrium_modulus" else factors.relaxing) for n in kind.names]
    each = [f if unit.startswith("Pa") else 1.0 for f, unit in zip(each, kind.units, strict=True)]
    solid = kind.names[0] == "equilibrium_modulus"

    def at_rest(u, omega):
        stands = shown(u)[..., :1] if solid else 0.0
        storage, loss = moduli(u, omega)
        return (storage - stands) / factors.relaxing + stands / factors.equilibrium, loss / factors.relaxing

    return kind._replace(values=lambda u: np.asarray(each) * shown(u), moduli=at_rest)


def _of_own_moduli(kind: Kind, fit: Fit, sweep: Sweep) -> tuple[Kind, dict[str, object]]:
    """Return the kind and the details with new Prony modes, which represent the model of the sample at rest. The Prony
    modes of the measured moduli cannot be used, because each of these modes contains a relaxing and an equilibrium
    part."""
    own, omega = kind.moduli, sweep.angular_frequency
    assert own is not None
    solid = kind.names[0] == "equilibrium_modulus"
    made = as_prony_modes.convert(lambda w: own(fit.solution.u, w), omega[0], omega[-1], solid)
    told = {"modes": len(made.times), "largest_relative_error": made.error}
    kind = kind._replace(maxwell=lambda u: as_prony_modes.modes(made, own(u, made.omega)))
    return kind, fit.details | {"conversion": told}


def compression_numbers(fit: Fit, simulation: simulated_rheometer.Simulation) -> dict[str, object]:
    """Return the entry `precompression` of fit.json, for a fit in closed form or with the simulated rheometer. The
    forces are computed from the fitted model, not from its Prony modes. If the instantaneous modulus of the model is
    infinite, the instantaneous force (`axial_force_at_once_N`) is None."""
    law, strain = laws.typical(simulation.law), simulation.precompression
    G, glued = float(np.asarray(law.shear_modulus())), fit.method != "closed-form"
    factors, kept = compression.shares(law, strain), compression.incompressible(law, strain)
    force = fit.details["force_of_law_N"] if glued else compression.smooth_force(law, strain, simulation.radius)
    moduli, (noise, total) = models.limiting_moduli(fit), _equilibrium_errors(fit)
    rest, at_once = moduli["equilibrium_modulus"], moduli.get("shear_modulus")
    of_mesh = fit.details.get("force_of_law_mesh_bias_N", 0.0) * rest / G
    return {
        "strain": strain,
        "height_at_rest_m": simulation.height / (1 - strain),
        "plates": "glued" if glued else "smooth",
        "law": simulation.law,
        "bulk_over_shear_modulus": float(np.asarray(law.bulk_modulus())) / G,
        "modulus_if_incompressible": None if glued or kept is None else _changed(fit, factors, kept),
        "smooth_factor_of_relaxing_moduli": factors.relaxing,
        "smooth_factor_of_equilibrium_modulus": factors.equilibrium,
        "axial_force_N": force * rest / G,
        "axial_force_standard_error_N": None if noise is None else force * noise / G,
        "axial_force_mesh_bias_N": of_mesh,
        "axial_force_total_error_N": None if total is None else float(np.hypot(force * total / G, of_mesh)),
        "axial_force_at_once_N": None if at_once is None else force * at_once / G,
    }


def _equilibrium_errors(fit: Fit) -> tuple[float | None, float | None]:
    """Return the standard error and the total error [Pa] of the equilibrium modulus. An unknown error is None. The
    total error of a fluid is the upper end of the 95 % interval, converted to a standard deviation."""
    total, interval = total_error.total_errors(fit).get("equilibrium_modulus"), fit.details.get(INTERVAL)
    if total is None or (interval and not np.isfinite(total)):
        return None, interval["high"] / NORMAL if interval else None
    if fit.parameters is None:
        return uncertainty.equilibrium_error(fit.uncertainty), total
    return float(fit.parameters.standard_errors[fit.kind.names.index("equilibrium_modulus")]), total


def _changed(fit: Fit, before: compression.Shares, after: compression.Shares) -> float:
    """Return G0 computed with the factors `after`, divided by G0 computed with the factors `before`, for the same
    measured moduli. If the model has no finite G0, the result is valid for G0 of the Prony modes."""
    moduli = {"shear_modulus": float(fit.model.shear_modulus)} | models.limiting_moduli(fit)
    stands = moduli["equilibrium_modulus"] / moduli["shear_modulus"]
    return (1 - stands) * before.relaxing / after.relaxing + stands * before.equilibrium / after.equilibrium
