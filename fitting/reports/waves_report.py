"""Files of a fit to waves: waves.json, waves.h5, waves.vtu and waves.png."""

import itertools
import json
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import meshio
import numpy as np

from fitting.reports.sweep_report import numbers
from fitting.waves import voxels
from fitting.waves.elastography import Found, Organ
from fitting.waves.files import components
from fitting.waves.regions import Regions
from fitting.waves.shear_waves import velocity_and_attenuation
from fitting.waves.stiffness_map import FAR, WaveMap, sd_of_modulus
from fitting.waves.wave_field import WaveField
from liverjax.core.errors import InputError
from liverjax.core.plotting import pyplot, save
from liverjax.core.struct import Content
from liverjax.core.versions import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: chi^2 per equation above which there is a warning that the model misses something.
TOO_FAR = 1.5
#: Standard deviations of the chi^2 of a map above which it is told, and the part of it that the noise's estimate costs.
BY_CHANCE, ROUGH = 5.0, 0.03
#: The same, above which the moduli themselves may be wrong.
WRONG = 10.0
#: Fewest frequencies of a sweep.
FEWEST = 3
#: A node of the map counts as different from the organ's mean beyond this many standard deviations.
TOLD = 3.0


def write(out: Path, organ: Organ, found: Found, drawn: WaveMap | None, usual: np.ndarray) -> Content:
    """Write all files into the folder `out`; returns the content of waves.json.

    Args:
        out: folder.
        organ, found, drawn: the organ, its fitted regions, and its map (None: no map).
        usual: direct inversion (F, nx, ny, nz) [Pa].
    """
    content = {
        "data": organ.field.source,
        "notes": list(organ.field.notes),
        "frequencies_Hz": organ.field.frequencies.tolist(),
        "noise_m": organ.field.noise.tolist(),
        "density_kg_m3": organ.density,
        "spacing_m": organ.field.spacing.tolist(),
        "voxels": int(organ.body.mesh.number_of_nodes),
        "elements": int(organ.body.mesh.number_of_elements),
        "whole": _of_regions(organ, found.whole, found.mesh_bias[:, None], found.bias_left[:, None])[0],
        "regions": _by_label(organ, found),
        "direct_inversion": _direct(organ, found, usual),
        "map": None if drawn is None else _of_map(drawn),
        "warnings": _cautions(organ, found, drawn),
        "versions": versions(),
    }
    content = numbers(content)
    content["springpots"], told = _springpots(_sweeps(out, organ, content))
    content["warnings"] += told
    (out / "waves.json").write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    _write_voxels(out / "waves.h5", organ, drawn, usual)
    if drawn is not None:
        _for_paraview(out / "waves.vtu", organ, drawn)
        save(maps_picture(organ, drawn, usual), out / "waves.png")
    return content


def _of_regions(organ: Organ, own: Regions, bias: np.ndarray, left: np.ndarray) -> list[Content]:
    """One dictionary per region, with lists over the frequencies. Errors contain noise, the uncertainty of the edges'
    places, and the error of the elements: its mean `bias` (F, R) over the directions of waves, and what is `left` of
    it (F, R, D) for each direction.
    """
    omega, rows = organ.waves.omega, []
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


def _springpots(sweeps: dict[str, Path]) -> tuple[Content | None, list[str]]:
    """The springpot model that `models.best_of_models` chooses per sweep, with its numbers, None without sweeps; then
    warnings.
    """
    if not sweeps:
        return None, []
    from fitting.fits.families import models
    from fitting.readers import rheometer

    found, told = {}, []
    for name, file in sweeps.items():
        try:
            sweep = rheometer.read_sweep(file)
        except InputError as error:
            told.append(f"{name}: no springpot is fitted over the frequencies: {error}")
            continue
        told += [f"{name}: the springpot is fitted without some frequencies: {note}" for note in sweep.notes]
        fit, _ = models.best_of_models(models.fractional(sweep), sweep)
        u, off = fit.parameters, float(np.mean(fit.relative_errors(sweep)))
        assert u is not None
        if off > MISSED:
            told.append(
                f"{name}: the {fit.kind.name} misses the moduli over the frequencies by {100 * off:.2g} % on average: "
                "use the moduli of each frequency"
            )
        found[name] = {
            "model": fit.kind.name,
            "numbers": {k: float(v) for k, v in zip(u.names, u.values, strict=True)},
            "standard_errors": numbers({k: float(v) for k, v in zip(u.names, u.standard_errors, strict=True)}),
            "mean_relative_error": off,
            "frequencies": len(sweep.angular_frequency),
        }
    return found, told


def _sweeps(out: Path, organ: Organ, content: Content) -> dict[str, Path]:
    """A frequency sweep of the whole and of every region, for ``python -m fitting``, if frequencies are enough."""
    if len(organ.field.frequencies) < FEWEST:
        return {}
    files = {}
    for name, own in {"whole": content["whole"], **(content["regions"] or {})}.items():
        columns = [
            content["frequencies_Hz"],
            own["storage_Pa"],
            own["loss_Pa"],
            own["error_storage_Pa"],
            own["error_loss_Pa"],
        ]
        if any(v is None for column in columns for v in column):  # a region that the data do not determine
            continue
        rows = ["frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,storage_modulus_sd_Pa,loss_modulus_sd_Pa"]
        rows += [",".join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True)]
        files[name] = out / f"sweep_{name}.csv"
        files[name].write_text("\n".join(rows) + "\n")
    return files


def _by_label(organ: Organ, found: Found) -> Content | None:
    if found.parts is None or found.labels is None or found.parts_bias is None or found.parts_bias_left is None:
        return None
    rows = _of_regions(organ, found.parts, found.parts_bias, found.parts_bias_left)
    return {str(label): row for label, row in zip(found.labels, rows, strict=True)}


def _direct(organ: Organ, found: Found, usual: np.ndarray) -> Content:
    """Medians of the direct inversion over the whole and over the regions; None if no voxel has a value."""
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
        "discrepancy_reached": drawn.reached,
        "distance_to_minimum_in_standard_deviations": drawn.distance,
        "part_of_variance_left": float(np.mean((drawn.posterior_sd / drawn.prior_sd) ** 2)),
        "told_from_the_mean": float(np.mean(np.abs(drawn.exponent.real) > TOLD * drawn.sd.real)),
        "history": drawn.history,
        "run_time_s": drawn.seconds,
    }


def _cautions(organ: Organ, found: Found, drawn: WaveMap | None) -> list[str]:
    told, each = _sign(organ, found), found.whole if found.parts is None else found.parts
    told += _of_scales(organ, found)
    any_coarse = False
    order = components.order_sentence(organ.field)
    if order is not None:
        told.insert(0, order)
    for f, hertz in enumerate(organ.field.frequencies):
        if not np.isfinite(organ.field.noise[f]):
            continue
        still = _of_no_motion(organ.field, f)
        if still:
            told += still
            continue
        coarse = _of_voxel_size(hertz, found, f)
        told += coarse + _of_residuals(hertz, each, f, "regions" if found.parts else "moduli", bool(coarse))
        any_coarse |= bool(coarse)
        told += _of_long_waves(hertz, found, f)
    if found.parts is not None and found.labels is not None:
        few = ~(found.parts.standard_errors.real < np.abs(found.parts.modulus)).all(axis=0)
        for label in found.labels[few]:
            told.append(f"region {label}: its standard error is larger than its modulus: it has too few voxels")
        far = np.abs(found.parts.farther).max(axis=0) > 1
        if far.any():
            names = ", ".join(str(label) for label, beyond in zip(found.labels, far, strict=True) if beyond)
            told.append(
                f"regions {names}: the waves place their edges more than a voxel away from the edges of the labels "
                "(edges_farther_out_voxels): look at the labels"
            )
    if drawn is not None and not drawn.distance <= FAR:
        told.append(
            f"the map stopped {drawn.distance:.2g} standard deviations away from its minimum: compare it with regions"
        )
    # The mean of n squares scatters by the root of 2/n; the noise that divides them is an estimate.
    if drawn is not None and drawn.chi2 / drawn.components > 1 + ROUGH + BY_CHANCE * np.sqrt(2 / drawn.components):
        told.append(
            f"chi2 of the map is {drawn.chi2 / drawn.components:.3g} per equation: "
            f"{'coarse voxels (mesh_bias), ' if any_coarse else ''}edges sharper than the map, "
            "noise that is larger in a part of the organ, a ratio of the moduli at several frequencies that is not the "
            "same everywhere, or a body that does not move like a "
            "viscous solid; its deviations are too small then, so compare it with regions and with one frequency alone"
        )
    return told


#: Mean relative distance of the springpot from the moduli of the frequencies that is told.
MISSED = 0.03
#: Root mean square of the motion over the noise, below which nothing but noise is seen: the two add up as squares, so
#: that the motion itself is smaller than two thirds of the noise.
NO_MOTION = 1.2


def _of_no_motion(field: WaveField, f: int) -> list[str]:
    """A sentence if the displacements at this frequency are hardly larger than their noise."""
    u = field.displacement[f][field.mask]
    size = float(np.sqrt(np.nanmean(np.abs(u) ** 2) / 2))
    if not size < NO_MOTION * field.noise[f]:
        return []
    return [
        f"{field.frequencies[f]:g} Hz: the displacements ({size:.2g} m) are hardly larger than their noise "
        f"({field.noise[f]:.2g} m): nothing is known of the waves there; leave this frequency out"
    ]


#: Relative standard error of a modulus above which its interval is not symmetric.
SKEW = 0.15


def _of_long_waves(hertz: float, found: Found, f: int) -> list[str]:
    """The interval of each modulus that is known so badly that its error is not the same on both sides.

    Waves that are long beside the organ determine the compliance 1/G, whose error is symmetric.
    """
    each, told = found.whole if found.parts is None else found.parts, []
    for r, (G, e) in enumerate(zip(np.abs(each.modulus[f]), each.standard_errors[f].real, strict=True)):
        told_already = found.parts is not None and e >= G  # a region has a sentence of its own
        if told_already or not (np.isfinite(e) and e > SKEW * G):
            continue
        half = 2 * e / G**2
        top = f"{1 / (1 / G - half):.3g} Pa" if half < 1 / G else "any value above"
        told.append(
            f"{hertz:g} Hz: {_modulus_named(found, r)} has an error of {100 * e / G:.2g} %. Where waves are long "
            f"beside the organ the data determine 1/G, so its size may be {1 / (1 / G + half):.3g} Pa to {top} "
            "(95 %): measure at a higher frequency"
        )
    return told


def _of_voxel_size(hertz: float, found: Found, f: int) -> list[str]:
    """A sentence if the size of the voxels changes a modulus by more than its standard error."""
    each, biases = found.whole, found.mesh_bias[:, None]
    if found.parts is not None and found.parts_bias is not None:
        each, biases = found.parts, found.parts_bias
    bias, error = np.abs(biases[f]), each.standard_errors[f].real / np.abs(each.modulus[f])
    r = int(np.argmax(bias / np.maximum(error, 1e-12)))
    if not bias[r] > error[r]:
        return []
    return [
        f"{hertz:g} Hz: the size of the voxels changes {_modulus_named(found, r)} by {100 * bias[r]:.2g} % (standard "
        f"error {100 * error[r]:.2g} %): subtract mesh_bias, or measure smaller voxels"
    ]


def _modulus_named(found: Found, r: int) -> str:
    if found.parts is None or found.labels is None:
        return "the modulus"
    return f"the modulus of region {found.labels[r]}"


def _of_residuals(hertz: float, each: Regions, f: int, uniform: str, coarse: bool) -> list[str]:
    """Sentences on residuals that are too large, or alike in neighbouring voxels.

    `coarse`: the size of the voxels changes a modulus by more than its error. Then it comes first among the causes.
    """
    told, ratio = [], each.chi2[f] / each.components
    alike = f < len(each.correlations) and each.correlations[f].seen
    if alike:
        told.append(
            f"{hertz:g} Hz: neighbouring voxels share their residuals (correlation {each.correlations[f].beyond:.2g} "
            f"above that of independent noise): {'the voxels are coarse (mesh_bias), ' if coarse else ''}the data are "
            "smoothed, or the organ is less uniform than its "
            f"{uniform}; standard errors are enlarged {each.noise_factor[f].max():.3g} times, those of a map are not"
        )
    if ratio > WRONG:
        told.append(
            f"{hertz:g} Hz: chi2 = {ratio:.3g} per equation with uniform {uniform}: unless the data are smoothed"
            f"{' or the voxels coarse' if coarse else ''}, the "
            "moduli may be wrong by more than their errors; look for voxels that were not measured or are noisier, and "
            "at the labels"
        )
    elif ratio > TOO_FAR and not alike:
        told.append(
            f"{hertz:g} Hz: chi2 = {ratio:.3g} per equation with uniform {uniform}: the organ is less uniform, or the "
            "noise larger; the standard errors are enlarged by its root"
        )
    return told


#: Speeds [m/s] of shear waves in soft tissue.
SLOW, FAST = 0.4, 15.0


def _in_radians(hertz: np.ndarray) -> bool:
    """Whether no frequency is a whole number, and all are whole numbers times 2 pi, to the digits of a table."""

    def whole(x: np.ndarray) -> np.ndarray:
        return np.abs(x - np.round(x)) < 5e-4

    return bool(np.all(whole(hertz / (2 * np.pi)) & ~whole(hertz)))


def _of_scales(organ: Organ, found: Found) -> list[str]:
    """Sentences on speeds that no soft tissue has, and on moduli that change with frequency as no material's do.

    The balance of forces has no scale of its own, so that a wrong unit leaves its chi^2 as it is.
    """
    told, omega = [], organ.waves.omega
    G, errors = found.whole.modulus[:, 0], np.abs(found.whole.standard_errors[:, 0])
    speeds = velocity_and_attenuation(G.real, G.imag, omega, organ.density)[0]
    odd = np.flatnonzero(~((speeds > SLOW) & (speeds < FAST)))
    if odd.size:
        told.append(
            f"waves of {omega[odd[0]] / (2 * np.pi):g} Hz run at {speeds[odd[0]]:.2g} m/s, and in soft tissue at "
            f"{SLOW:g} to {FAST:g} m/s: check the spacing (metres) and the frequencies (Hz, not rad/s)"
        )
    elif _in_radians(omega / (2 * np.pi)):
        told.append(
            f"the frequencies {', '.join(f'{f:.6g}' for f in omega / (2 * np.pi))} are whole numbers times 2 pi: if "
            "they are in rad/s, moduli are 39 times too large; give them in Hz"
        )
    for a, b in itertools.pairwise(range(len(omega))):
        span = np.log(omega[b] / omega[a])
        slope = np.log(np.abs(G[b]) / np.abs(G[a])) / span
        error = 3 * float(np.hypot(errors[a] / np.abs(G[a]), errors[b] / np.abs(G[b]))) / span
        if slope + error < -0.1 or slope - error > 1.1:
            told.append(
                f"from {omega[a] / (2 * np.pi):g} to {omega[b] / (2 * np.pi):g} Hz |G*| changes as the frequency to "
                f"the power of {slope:.2g}, which is 0 to 1 in all materials: check that the frequencies are in the "
                "order of the fields"
            )
    return told


def _sign(organ: Organ, found: Found) -> list[str]:
    """A sentence if every loss modulus that the data determine is negative, which no passive material has.

    Where regions are given, theirs count: one modulus for several materials may have any loss.
    """
    wrong, each = [], found.whole if found.parts is None else found.parts
    for hertz, G, error in zip(organ.field.frequencies, each.modulus, each.standard_errors, strict=True):
        known = np.abs(G.imag) > 3 * error.imag
        if known.any() and np.all(G.imag[known] < 0):
            wrong.append(f"{hertz:g} Hz")
    if not wrong:
        return []
    return [
        f"the loss modulus is negative at {', '.join(wrong)}, which no tissue has: here the motion is the real part of "
        "U exp(+i omega t), so take the complex conjugate of waves of the other sign"
    ]


def _short(chi2: float) -> str:
    """chi^2 as text with two decimals; in scientific form from 1e4 on."""
    return f"{chi2:.2f}" if chi2 < 1e4 else f"{chi2:.1e}"


def _error_cell(x: float | None) -> str:
    return "unknown" if x is None else f"{x:.2g}"


def table(content: Content) -> str:
    """Moduli of the whole and of the regions at every frequency, and the direct inversion for comparison."""
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
                f"{_short(own['chi2_per_component'][f]):>9s}   {pair}"
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


def at_voxels(organ: Organ, corners: np.ndarray) -> np.ndarray:
    """Values at the voxels (nx, ny, nz), NaN outside, from values at the corners (P,)."""
    nothing = complex(np.nan, np.nan) if np.iscomplexobj(corners) else np.nan
    out = np.full(organ.field.mask.shape, nothing, corners.dtype)
    out[tuple(organ.body.voxel.T)] = voxels.on_all_nodes(organ.body, corners)
    return out


def _write_voxels(path: Path, organ: Organ, drawn: WaveMap | None, usual: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        for name in ("frequencies", "spacing", "origin", "mask"):
            file[name] = getattr(organ.field, name)
        file["direct_inversion"] = usual
        if drawn is None:
            return
        whole = np.stack([at_voxels(organ, G) for G in drawn.modulus])
        sd = np.stack([at_voxels(organ, own) for own in drawn.sd])
        file["modulus"], file["sd_of_logarithm"], file["sd_of_loss_angle"] = whole, sd.real, sd.imag
        file["sd"] = sd_of_modulus(whole, sd)
        file["draws_of_exponent"] = (
            np.stack([[at_voxels(organ, c) for c in own] for own in drawn.draws]) if len(drawn.draws) else []
        )
        file["modulus"].attrs["unit"] = file["sd"].attrs["unit"] = "Pa"


def _for_paraview(path: Path, organ: Organ, drawn: WaveMap) -> None:
    data: dict[str, np.ndarray] = {}
    for hertz, G, sd in zip(organ.field.frequencies, drawn.modulus, drawn.sd, strict=True):
        data |= {f"storage_{hertz:g}_Hz": G.real, f"loss_{hertz:g}_Hz": G.imag}
        data |= {f"sd_of_logarithm_{hertz:g}_Hz": sd.real, f"sd_of_loss_angle_{hertz:g}_Hz": sd.imag}
    mesh = organ.body.linear
    meshio.write_points_cells(path, np.asarray(mesh.points), {"tetra": np.asarray(mesh.tetrahedra)}, data)


def maps_picture(organ: Organ, drawn: WaveMap, usual: np.ndarray) -> "Figure":
    """Middle slice across the shortest side at the highest frequency: map, its deviation, the direct inversion."""
    f, axis = len(drawn.modulus) - 1, int(np.argmin(organ.field.mask.shape))
    k = int(np.median(organ.body.voxel[organ.body.inner][:, axis]))
    G, sd = at_voxels(organ, drawn.modulus[f]), at_voxels(organ, drawn.sd[f].real)
    panels = (
        ("storage modulus [kPa]", G.real / 1e3, "viridis"),
        ("loss modulus [kPa]", G.imag / 1e3, "viridis"),
        ("sd of ln|G|", sd, "magma"),
        ("direct inversion, storage [kPa]", usual[f].real / 1e3, "viridis"),
    )
    size = 1e3 * organ.field.spacing * np.array(organ.field.mask.shape)
    across = [a for a in range(3) if a != axis]
    fig, axes = pyplot().subplots(1, 4, figsize=(13, 4.2), layout="constrained")
    top = np.nanquantile(panels[0][1], 0.995)  # one voxel shall not set the scale
    for ax, (title, values, colours) in zip(axes, panels, strict=True):
        limits = {"vmin": 0.0, "vmax": top} if "storage" in title else {"vmin": 0.0}
        shown = np.take(values, k, axis).T
        picture = ax.imshow(
            shown, origin="lower", cmap=colours, extent=(0, size[across[0]], 0, size[across[1]]), **limits
        )
        ax.set(title=title, xlabel=f"{'xyz'[across[0]]} [mm]", ylabel=f"{'xyz'[across[1]]} [mm]")
        ax.title.set_fontsize(9)
        if not np.isfinite(shown).any():  # the organ is thinner than the differences of the direct inversion are wide
            ax.text(0.5, 0.5, "no voxel is far enough\nfrom an edge", ha="center", transform=ax.transAxes, fontsize=8)
        fig.colorbar(picture, ax=ax, shrink=0.8)
    return fig
