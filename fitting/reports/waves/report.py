"""Write the results of a fit to waves: waves.json, the sweeps of the regions, and the printed table."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.reports.sweep_report import numbers
from fitting.reports.waves.cautions import cautions_of_elastography, chi2_text, frequencies_with_motion
from fitting.reports.waves.maps import maps_picture, write_at_voxels, write_for_paraview
from fitting.waves.elastography import Found, Organ
from fitting.waves.regions import Regions
from fitting.waves.shear_waves import velocity_and_attenuation
from fitting.waves.stiffness_map import WaveMap
from liverjax.core.errors import InputError
from liverjax.core.files import write_whole
from liverjax.core.plotting import save
from liverjax.core.struct import Content
from liverjax.core.versions import versions

if TYPE_CHECKING:
    from fitting.fits.viscoelastic import Fit
    from fitting.readers.rheometer import Sweep

#: Minimum number of frequencies for which sweeps are written.
FEWEST = 3
#: A node of the map counts as different from the uniform organ if the logarithms of the two moduli differ by more than
#: this many standard deviations.
TOLD = 3.0
#: A warning is given if the relative error of the springpot model, averaged over the frequencies, exceeds this value.
MISSED = 0.03
#: This warning also requires that chi^2 per degree of freedom exceeds this value.
EXPLAINED = 1.5


def write(out: Path, organ: Organ, found: Found, drawn: WaveMap | None, usual: np.ndarray) -> Content:
    """Write all files into the folder `out` and return the content of waves.json.

    Args:
        out: folder.
        organ, found, drawn: the organ, its fitted regions, and its map (None: no map).
        usual: modulus from the direct inversion (F, nx, ny, nz) [Pa], complex, at F frequencies.
    """
    content = {
        "data": organ.field.source,
        "notes": list(organ.field.notes),
        "frequencies_Hz": organ.field.frequencies.tolist(),
        "noise_m": organ.field.noise.tolist(),
        "density_kg_m3": organ.density,
        "spacing_m": organ.field.spacing.tolist(),
        "voxels": len(np.unique(organ.body.voxel, axis=0)),
        "parts": int(organ.body.part.max()) + 1,
        "elements": int(organ.body.mesh.number_of_elements),
        "whole": _of_regions(organ, found.whole, found.mesh_bias[:, None], found.bias_left[:, None])[0],
        "regions": _by_label(organ, found),
        "direct_inversion": _direct(organ, found, usual),
        "map": None if drawn is None else _of_map(drawn),
        "warnings": cautions_of_elastography(organ, found, drawn),
        "versions": versions(),
    }
    content = numbers(content)
    moves = frequencies_with_motion(organ.field, found)
    content["springpots"], told = _springpots(_sweeps(out, organ, content, moves), content)
    content["warnings"] += _of_frequencies_left_out(organ, moves) + told
    write_whole(out / "waves.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    write_at_voxels(out / "waves.h5", organ, drawn, usual)
    if drawn is not None:
        write_for_paraview(out / "waves.vtu", organ, drawn)
        save(maps_picture(organ, drawn, usual), out / "waves.png")
    return content


def _of_regions(organ: Organ, own: Regions, bias: np.ndarray, left: np.ndarray) -> list[Content]:
    """Return one dictionary for each of R regions, with lists over the F frequencies.

    The entries `error_...` contain the noise, the uncertain position of the edges, and the discretisation error of the
    elements. The entries `standard_error_...` do not contain the discretisation error. The entries `edge_error_...` are
    the part due to the edges alone. The relative discretisation
    error was computed for plane waves in D directions with two polarisations, so for 2 D waves. It has two parts: its
    mean `bias` (F, R) over these waves, and the contribution `left` (F, R, 2 D) of each wave to the uncertainty of this
    mean.
    """
    omega, rows, edges = organ.waves.omega, [], np.broadcast_to(own.edge_errors, own.modulus.shape)
    for r in range(own.modulus.shape[1]):
        G, e = own.modulus[:, r], own.standard_errors[:, r]
        c, alpha = velocity_and_attenuation(G.real, G.imag, omega, organ.density)
        missed, along = G * bias[:, r], G[:, None] * left[:, r]
        rows.append(
            {
                "storage_Pa": G.real.tolist(),
                "loss_Pa": G.imag.tolist(),
                "error_storage_Pa": np.sqrt(e.real**2 + missed.real**2 + np.sum(along.real**2, axis=1)).tolist(),
                "error_loss_Pa": np.sqrt(e.imag**2 + missed.imag**2 + np.sum(along.imag**2, axis=1)).tolist(),
                "standard_error_storage_Pa": e.real.tolist(),
                "standard_error_loss_Pa": e.imag.tolist(),
                "edge_error_storage_Pa": edges[:, r].real.tolist(),
                "edge_error_loss_Pa": edges[:, r].imag.tolist(),
                "edges_farther_out_voxels": own.farther[:, r].tolist(),
                "mesh_bias_storage_Pa": missed.real.tolist(),
                "mesh_bias_loss_Pa": missed.imag.tolist(),
                "phase_velocity_m_s": c.tolist(),
                "attenuation_1_m": alpha.tolist(),
                "voxels_a_wave": (2 * np.pi * c / omega / organ.field.spacing.max()).tolist(),
                "chi2_per_component": (own.chi2 / own.components).tolist(),
                "noise_factor": own.noise_factor[:, r].tolist(),
                "iterations": own.iterations.tolist(),
                "converged": own.converged.tolist(),
            }
        )
    return rows


def _springpots(sweeps: dict[str, Path], content: Content | None = None) -> tuple[Content | None, list[str]]:
    """Fit the moduli of each sweep with the springpot model that `models.best_of_models` chooses. Return the results
    (None if there are no sweeps) and warnings.

    `content`: content of waves.json, from which `_noise_and_shared` takes the parts of the errors. If it is None, all
    standard deviations in the files are noise.
    """
    if not sweeps:
        return None, []
    from fitting.fits import viscoelastic
    from fitting.fits.families import models
    from fitting.readers import rheometer

    found, told = {}, []
    for name, file in sweeps.items():
        try:
            sweep = rheometer.read_sweep(file)
        except InputError as error:
            why = "a modulus is not above 0" if "is not positive" in str(error) else error
            told.append(f"{name}: no springpot is fitted over the frequencies: {why}")
            continue
        told += [f"{name}: the springpot is fitted without some frequencies: {note}" for note in sweep.notes]
        own, shared = _noise_and_shared(sweep, name, content)
        fit, _ = models.best_of_models(models.fractional(own), own)
        # The standard deviations are noise, even if the points scatter less than they state.
        size = 2 * len(sweep.angular_frequency), True
        u = viscoelastic.estimates(fit.solution, fit.kind, size, None)[1]
        off = float(np.mean(fit.relative_errors(sweep)))
        assert u is not None
        if off > MISSED and _beyond_errors(fit, own, shared):
            told.append(
                f"{name}: the {fit.kind.name} misses the moduli over the frequencies by {100 * off:.2g} % on average; "
                "use the moduli of each frequency"
            )
        errors = np.hypot(u.standard_errors, np.linalg.norm(_moved_numbers(fit, own, shared), axis=0))
        found[name] = {
            "model": fit.kind.name,
            "numbers": {k: float(v) for k, v in zip(u.names, u.values, strict=True)},
            "standard_errors": numbers({k: float(v) for k, v in zip(u.names, errors, strict=True)}),
            "mean_relative_error": off,
            "frequencies": len(sweep.angular_frequency),
        }
    return found, told


def _noise_and_shared(sweep: "Sweep", name: str, content: Content | None) -> tuple["Sweep", np.ndarray]:
    """Return the sweep with the noise alone as standard deviations, and changes (3, 2 n) [Pa] of G' and G'' at n
    frequencies due to errors that are similar at all frequencies.

    These changes are the mesh bias, and two more for G' and for G'': the uncertainty of the mesh bias together with
    the uncertainty of the edges. More frequencies do not make these errors smaller. Without `content`, the sweep is
    unchanged, and there are no such changes.
    """
    n = len(sweep.angular_frequency)
    if content is None:
        return sweep, np.zeros((0, 2 * n))
    row = content["whole"] if name == "whole" else content["regions"][name]
    hertz = np.array(content["frequencies_Hz"])
    at = [int(np.argmin(np.abs(hertz - f))) for f in sweep.angular_frequency / (2 * np.pi)]
    every, own, edges, bias = (
        [np.array(row[f"{kind}_{part}_Pa"], float)[at] for part in ("storage", "loss")]
        for kind in ("error", "standard_error", "edge_error", "mesh_bias")
    )
    noise = [np.sqrt(np.maximum(s**2 - e**2, 1e-12 * s**2)) for s, e in zip(own, edges, strict=True)]
    rest = [np.sqrt(np.maximum(e**2 - s**2 - b**2, 0.0)) for e, s, b in zip(every, noise, bias, strict=True)]
    blank = np.zeros(n)
    changes = np.array([np.concatenate(bias), np.concatenate([rest[0], blank]), np.concatenate([blank, rest[1]])])
    return sweep._replace(storage_sd=noise[0], loss_sd=noise[1]), changes


def _moved_numbers(fit: "Fit", sweep: "Sweep", moved: np.ndarray) -> np.ndarray:
    """Return the changes (k, P) of the P parameters of a springpot fit if the moduli change by `moved` (k, 2 n) [Pa],
    to first order."""
    from fitting.methods.estimate import with_slope

    assert fit.kind.values is not None
    right = (moved / np.concatenate(sweep.deviations)).T
    steps = np.linalg.lstsq(np.asarray(fit.solution.jacobian), right, rcond=None)[0]
    return (with_slope(fit.kind.values, fit.solution.u)[1] @ steps).T


def _beyond_errors(fit: "Fit", sweep: "Sweep", shared: np.ndarray) -> bool:
    """Return whether a fit misses the moduli at n frequencies by more than noise and the changes `shared` (k, 2 n) [Pa]
    explain. Each of these k changes may be present with a standard normal factor. The standard deviations of the sweep
    are noise alone."""
    if sweep.storage_sd is None or sweep.loss_sd is None:
        return True
    sd = np.concatenate([sweep.storage_sd, sweep.loss_sd])
    off, S = np.concatenate([fit.storage - sweep.storage, fit.loss - sweep.loss]) / sd, shared / sd
    chi2 = off @ off - off @ S.T @ np.linalg.solve(np.eye(len(S)) + S @ S.T, S @ off)
    return float(chi2) > EXPLAINED * max(1, len(off) - len(fit.solution.u))


def _of_frequencies_left_out(organ: Organ, moves: list[int]) -> list[str]:
    every = organ.field.frequencies
    if not FEWEST <= len(moves) < len(every):
        return []
    still = ", ".join(f"{hertz:g}" for hertz in np.delete(every, moves))
    return [f"the sweeps and the springpots are without {still} Hz, because the displacements there are only noise"]


def _sweeps(out: Path, organ: Organ, content: Content, moves: list[int] | None = None) -> dict[str, Path]:
    """Write files with a frequency sweep of the whole organ and of each region, for ``python -m fitting``. Return these
    files. With fewer than `FEWEST` frequencies, no file is written.

    `moves`: indices of the frequencies with motion. Other frequencies are left out, unless fewer than `FEWEST` remain.
    """
    kept = moves if moves is not None and len(moves) >= FEWEST else range(len(organ.field.frequencies))
    if len(organ.field.frequencies) < FEWEST:
        return {}
    files = {}
    for name, own in {"whole": content["whole"], **(content["regions"] or {})}.items():
        names = ("storage_Pa", "loss_Pa", "error_storage_Pa", "error_loss_Pa")
        columns = [[values[f] for f in kept] for values in (content["frequencies_Hz"], *(own[key] for key in names))]
        if any(v is None for column in columns for v in column):  # the data do not determine this region
            continue
        rows = ["frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,storage_modulus_sd_Pa,loss_modulus_sd_Pa"]
        rows += [",".join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True)]
        files[name] = out / f"sweep_{name}.csv"
        write_whole(files[name], "\n".join(rows) + "\n")
    return files


def _by_label(organ: Organ, found: Found) -> Content | None:
    if found.parts is None or found.labels is None or found.parts_bias is None or found.parts_bias_left is None:
        return None
    rows = _of_regions(organ, found.parts, found.parts_bias, found.parts_bias_left)
    return {str(label): row for label, row in zip(found.labels, rows, strict=True)}


def _direct(organ: Organ, found: Found, usual: np.ndarray) -> Content:
    """Return the median moduli of the direct inversion in the whole organ and in each region. A median is None if no
    voxel has a value."""
    labels = organ.field.labels
    places = {"whole": organ.field.mask}
    if found.labels is not None and labels is not None:
        places |= {str(k): organ.field.mask & (labels == k) for k in found.labels}
    out = {}
    for name, place in places.items():
        known = [G[place & np.isfinite(G)] for G in usual]
        out[name] = {
            "storage_Pa": [float(np.median(g.real)) if g.size else None for g in known],
            "loss_Pa": [float(np.median(g.imag)) if g.size else None for g in known],
        }
    return out


def _of_map(drawn: WaveMap) -> Content:
    return {
        "prior_deviation": drawn.deviation,
        "correlation_length_m": drawn.length,
        "chi2_per_component": drawn.chi2 / drawn.components,
        "noise_factor": drawn.noise_factor.tolist(),
        "discrepancy_reached": drawn.reached,
        "distance_to_minimum_in_standard_deviations": drawn.distance,
        "part_of_variance_left": float(np.mean((drawn.posterior_sd / drawn.prior_sd) ** 2)),
        "told_from_the_mean": float(np.mean(np.abs(drawn.exponent.real) > TOLD * drawn.sd.real)),
        "history": drawn.history,
        "run_time_s": drawn.seconds,
    }


def _error_cell(x: float | None) -> str:
    return "unknown" if x is None else f"{x:.2g}"


def table(content: Content) -> str:
    """Return a table of the moduli of the whole organ and the regions at every frequency, with the direct inversion."""
    rows = [f"{'':12s}{'Hz':>8s}{'G_storage [Pa]':>22s}{'G_loss [Pa]':>22s}{'c [m/s]':>9s}{'chi2':>9s}   direct [Pa]"]
    for name, own in {"whole": content["whole"], **(content["regions"] or {})}.items():
        direct = content["direct_inversion"][name]
        for f, hertz in enumerate(content["frequencies_Hz"]):
            usual = [direct[part][f] for part in ("storage_Pa", "loss_Pa")]
            pair = "none" if usual[0] is None else f"{usual[0]:.4g} + {usual[1]:.3g}i"
            cells = [
                f"{own[f'{part}_Pa'][f]:.5g} ± {_error_cell(own[f'error_{part}_Pa'][f])}"
                for part in ("storage", "loss")
            ]
            rows.append(
                f"{name:12s}{hertz:8g}{cells[0]:>22s}{cells[1]:>22s}{own['phase_velocity_m_s'][f]:9.3g}"
                f"{chi2_text(own['chi2_per_component'][f]):>9s}   {pair}"
            )
    if any(row.endswith("   none") for row in rows):
        rows.append(
            "direct: none where every voxel is near an edge or a hole of the data, or where a component is not "
            "measured. The derivatives and the smoothing of the direct inversion reach 5 voxels"
        )
    for name, own in (content["springpots"] or {}).items():
        said = ", ".join(
            f"{k} = {v:.4g} {f'± {error:.2g}' if (error := own['standard_errors'][k]) else '(at its bound)'}"
            for k, v in own["numbers"].items()
        )
        off = f"{100 * own['mean_relative_error']:.2g} % off on average"
        rows.append(f"{name:12s}{own['model']} over {own['frequencies']} frequencies, {off}: {said}")
    if content["map"]:
        m = content["map"]
        rows.append(
            f"map: chi2 {m['chi2_per_component']:.3g} per equation, "
            f"{100 * m['part_of_variance_left']:.2g} % of the prior's variance left, "
            f"{100 * m['told_from_the_mean']:.2g} % of the nodes differ from the mean, {m['run_time_s']:.3g} s"
        )
    return "\n".join(rows)
