"""Write the results of a fit to displacements: field.json, and for a map field.vtu, field.h5 and field.png."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import jax.numpy as jnp
import numpy as np

from fitting.fits.field import Field, distance_sentence, level_sentence, map_bias_sentences
from fitting.methods.estimate import Estimate, bias_sentences
from fitting.readers.displacements import locate
from fitting.reports.sweep_report import numbers
from liverjax.core.files import whole, write_whole
from liverjax.core.plotting import pyplot, save
from liverjax.core.status import NAMES
from liverjax.core.struct import Content
from liverjax.core.versions import versions
from liverjax.mesh.files import write_mesh
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.tetrahedra import TetMesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: If chi^2 per component is above TOO_FAR, the program warns that the model does not explain the data. If it is below
#: TOO_NEAR for FEW components or more, the stated noise counts as too large. With FEW components, a value below
#: TOO_NEAR occurs by chance once in a million fits.
TOO_FAR, TOO_NEAR, FEW = 1.5, 0.4, 50
#: If chi^2 is too large, a mesh error above this many times the noise of the data is reported too.
MESH = 1.0


def misfit_sentence(found: Estimate, with_mesh: bool = False) -> str | None:
    """Return a warning if the residuals are much larger or much smaller than the noise of the displacements, or else
    None.

    If the noise contains an estimated error of the mesh or of the time step (`with_mesh`), a small misfit does not mean
    that the noise is wrong.
    """
    ratio = found.chi2 / found.components
    if ratio < TOO_NEAR and found.components >= FEW and not with_mesh:
        return (
            f"chi2 is {ratio:.3g} per component, so the displacements scatter {np.sqrt(ratio):.2g} times as much as "
            "the stated noise, and the errors are too large. Give the noise in metres (--noise), or in the unit of "
            "the file (column sd)"
        )
    if not ratio > TOO_FAR:
        return None
    if not np.any(np.isfinite(found.standard_errors)):
        return (
            f"no values of {', '.join(found.names)} explain the displacements (chi2 is {ratio:.3g} per component). The "
            "fit diverged, and the printed values have no meaning: check the unit (--unit), the sign and the origin "
            "of the coordinates, node numbers (from 0), loads and supports"
        )
    said = (
        f"chi2 stays at {ratio:.3g} per component, so the fit misses the displacements by {np.sqrt(ratio):.2g} times "
        "their noise: the parameters may be wrong by much more than their errors"
    )
    if found.mesh_over_noise is not None and found.mesh_over_noise > MESH:
        said += (
            f"; the mesh's error in the data is {found.mesh_over_noise:.2g} times the noise: refine the mesh, or use "
            "order = 2 if order is 1 (the mesh bias does not contain the error of a region border inside elements)"
        )
    return (
        f"{said}; check the unit (--unit), the origin of the coordinates, node numbers (from 0), rows of zeros, "
        "loads and supports, or give a larger noise (--noise in metres, or the column sd in the unit of the file)"
    )


def noise_sentence(found: Field) -> str | None:
    """Return a warning if the residuals of a map exceed the stated noise by more than expected by chance, or else
    None."""
    chance = 3 * np.sqrt(2 * found.components)
    if found.reached or found.chi2 <= found.components + chance:
        return None
    return (
        f"chi2 stays at {found.chi2 / found.components:.3g} per component: the stated noise is too small, or the scene "
        "is not correct (mesh, supports, loads)"
    )


def map_sentences(mesh: TetMesh, found: Field) -> list[str]:
    """Return all warnings about a map."""
    known = _where_mapped(mesh, found)
    first = (noise_sentence(found), distance_sentence(found), level_sentence(known))
    return [*(sentence for sentence in first if sentence is not None), *map_bias_sentences(known)]


def of_numbers(found: Estimate, with_mesh: bool = False) -> Content:
    """Return the content of field.json for a few parameters. `with_mesh`: see `misfit_sentence`."""
    sentences = (misfit_sentence(found, with_mesh), *found.warnings, *bias_sentences(found))
    return {
        "values": dict(zip(found.names, found.values.tolist(), strict=True)),
        "standard_errors": dict(zip(found.names, found.standard_errors.tolist(), strict=True)),
        **{
            key: None if bias is None else dict(zip(found.names, bias.tolist(), strict=True))
            for key, bias in (("mesh_bias", found.mesh_bias), ("time_step_bias", found.time_step_bias))
        },
        "correlation": found.correlation.tolist(),
        "chi2_per_component": found.chi2 / found.components,
        "noise_factor": found.noise,
        "components": found.components,
        "iterations": found.iterations,
        "converged": found.converged,
        "status": [NAMES[c] for c in found.codes],
        "warnings": [sentence for sentence in sentences if sentence],
        "run_time_s": found.seconds,
    }


def _mapped(mesh: TetMesh, found: Field) -> np.ndarray:
    """Return the indices of the nodes at which the map has a value: the nodes of all elements whose parameter is not
    given by a [[region]]."""
    return np.unique(mesh.element_nodes_on_host[:, ~found.given])


def _where_mapped(mesh: TetMesh, found: Field) -> Field:
    """Return a copy of `found` in which the standard deviations and the biases contain only the mapped vertices (see
    `_mapped`)."""
    mapped = _mapped(mesh, found)
    mapped = mapped[mapped < len(found.sd)]
    of_mesh, of_steps = (None if b is None else b[mapped] for b in (found.mesh_bias, found.time_step_bias))
    return found._replace(sd=found.sd[mapped], mesh_bias=of_mesh, time_step_bias=of_steps)


def of_field(mesh: TetMesh, found: Field) -> Content:
    """Return the content of field.json for a map."""
    known = _where_mapped(mesh, found)
    return {
        "name": found.name,
        "smallest": float(found.modulus[~found.given].min()),
        "largest": float(found.modulus[~found.given].max()),
        "elements_given_by_regions": int(found.given.sum()),
        "smallest_standard_deviation_of_ln": float(np.min(known.sd)),
        "largest_standard_deviation_of_ln": float(np.max(known.sd)),
        "prior_deviation": found.deviation,
        "correlation_length_m": found.length,
        **{
            f"largest_{key}_of_ln": None if bias is None else float(np.abs(bias).max())
            for key, bias in (("mesh_bias", known.mesh_bias), ("time_step_bias", known.time_step_bias))
        },
        "chi2_per_component": found.chi2 / found.components,
        "discrepancy_reached": found.reached,
        "distance_to_minimum_in_standard_deviations": found.distance,
        "components": found.components,
        "directions_known": int(np.sum(found.eigenvalues > 1)),
        "standard_deviation_of_level_of_ln": found.level_sd,
        "history": found.history,
        "status": [NAMES[c] for c in found.codes],
        "warnings": map_sentences(mesh, found),
        "run_time_s": found.seconds,
    }


def write(out: Path, mesh: TetMesh, content: Content, found: Field | None) -> None:
    """Write field.json into the folder `out`. For a map, also write field.vtu, field.h5 and field.png."""
    write_whole(out / "field.json", json.dumps(numbers(content | {"versions": versions()}), indent=1) + "\n")
    if found is None:
        return
    at_nodes = {"factor": found.log_factor, "sd_of_ln": found.sd, "prior_sd_of_ln": found.prior_sd}
    for key, bias in (("mesh_bias", found.mesh_bias), ("time_step_bias", found.time_step_bias)):
        if bias is not None:
            at_nodes[f"{key}_of_ln"] = bias
    at_nodes = {name: np.array(on_middles(mesh, jnp.asarray(values))) for name, values in at_nodes.items()}
    at_nodes["factor"] = np.exp(at_nodes["factor"])
    unknown = np.setdiff1d(np.arange(mesh.number_of_nodes), _mapped(mesh, found))
    for values in at_nodes.values():
        values[unknown] = np.nan
    write_mesh(out / "field.vtu", mesh, at_nodes)
    with whole(out / "field.h5") as new, h5py.File(new, "w") as f:
        f["modulus"], f["reference"], f["tetrahedra"] = found.modulus, mesh.points, mesh.tetrahedra
        for name, values in at_nodes.items():
            f[name] = values
        f["eigenvalues"], f["given"] = found.eigenvalues, found.given
        f.attrs["name"] = found.name
    save(map_figure(mesh, found), out / "field.png")


def section(mesh: TetMesh, values: np.ndarray, middle: np.ndarray, axis: int, n: int = 200) -> tuple[np.ndarray, tuple]:
    """Interpolate values at the vertices (V,) on a plane through `middle` normal to `axis`. Return the values on the
    plane (NaN outside of the body), and the extent of the plane [cm]."""
    X = np.asarray(mesh.points)
    low, high = X.min(axis=0), X.max(axis=0)
    a, b = (k for k in range(3) if k != axis)
    grid = np.empty((n, n, 3))
    grid[..., axis] = middle[axis]
    grid[..., a], grid[..., b] = np.meshgrid(np.linspace(low[a], high[a], n), np.linspace(low[b], high[b], n))
    nodes, weights, outside = locate(mesh, grid.reshape(-1, 3))
    values = np.asarray(on_middles(mesh, jnp.asarray(values)))
    shown = np.where(outside > 0.01, np.nan, np.sum(weights * values[nodes], axis=1))
    return shown.reshape(n, n), tuple(100 * v for v in (low[a], high[a], low[b], high[b]))


def map_figure(mesh: TetMesh, found: Field) -> "Figure":
    """Plot three sections of the factor that multiplies the parameter of the scene, and three of the standard deviation
    of its logarithm. The sections pass through the node at which the logarithm is farthest from its median."""
    shown = np.isin(np.arange(len(found.sd)), _mapped(mesh, found))
    factor, sd = (np.where(shown, values, np.nan) for values in (np.exp(found.log_factor), found.sd))
    middle = np.asarray(mesh.points)[np.nanargmax(np.abs(np.log(factor) - np.nanmedian(np.log(factor))))]
    figure, axes = pyplot().subplots(2, 3, figsize=(11, 5.5), layout="constrained")
    # With this number of decimals, the size of the body [cm] has three or more significant digits.
    digits = max(1, 2 - int(np.floor(np.log10(100 * np.ptp(mesh.points, axis=0).max()))))
    rows = (
        (factor, f"{found.name} over the scene's [1]", "viridis"),
        (sd, "standard deviation of its logarithm", "magma"),
    )
    for row, (values, label, colours) in zip(axes, rows, strict=True):
        for axis in range(3):
            plane, extent = section(mesh, values, middle, axis)
            drawn = row[axis].imshow(
                plane, origin="lower", extent=extent, cmap=colours, vmin=np.nanmin(values), vmax=np.nanmax(values)
            )
            a, b = (name for k, name in enumerate("xyz") if k != axis)
            place = f"{'xyz'[axis]} = {100 * middle[axis]:.{digits}f} cm"
            row[axis].set(xlabel=f"{a} [cm]", ylabel=f"{b} [cm]", title=place)
        figure.colorbar(drawn, ax=row, label=label)
    return figure


def table_of_numbers(found: Estimate) -> str:
    """Return a table of names, values, standard errors and biases of the parameters, for the terminal. The bias of the
    time step is given only if the scenes have time steps."""
    width = max(map(len, found.names))
    biases = {"mesh bias": found.mesh_bias}
    if found.time_step_bias is not None:
        biases["step bias"] = found.time_step_bias
    rows = [f"{'parameter':{width}}  {'value':>11}  {'standard error':>14}" + "".join(f"  {own:>11}" for own in biases)]
    for k, (name, value, error) in enumerate(zip(found.names, found.values, found.standard_errors, strict=True)):
        each = ("not known" if bias is None else f"{bias[k]:.3g}" for bias in biases.values())
        rows.append(f"{name:{width}}  {value:11.5g}  {error:14.3g}" + "".join(f"  {own:>11}" for own in each))
    rows.append(f"chi2 per component {found.chi2 / found.components:.3f} of {found.components}, {found.seconds:.1f} s")
    return "\n".join(rows)


def table_of_field(mesh: TetMesh, found: Field) -> str:
    """Return a table for the terminal: one line for each prior that was tried, and a line with the result."""
    rows = ["prior sd  chi2/component  iterations  evaluations  seconds"]
    for h in found.history:
        rows.append(
            f"{h['deviation']:8g}  {h['chi2_per_component']:14.4f}  {h['iterations']:10.0f}  {h['evaluations']:11.0f}  "
            f"{h['seconds']:7.1f}"
        )
    own, sd = found.modulus[~found.given], _where_mapped(mesh, found).sd
    known, factors = int(np.sum(found.eigenvalues > 1)), np.exp([np.min(sd), np.max(sd)])
    rows.append(
        f"{found.name} from {own.min():.4g} to {own.max():.4g}, known to a factor of "
        f"{factors[0]:.3g} to {factors[1]:.3g} (one standard deviation); the data determine "
        f"{'at least ' if known == len(found.eigenvalues) else ''}{known} combinations of values; {found.seconds:.1f} s"
    )
    return "\n".join(rows)
