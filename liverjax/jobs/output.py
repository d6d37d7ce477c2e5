"""Write results to disk: an HDF5 file, a series of files for ParaView, a picture."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liverjax.core import status
from liverjax.core.files import whole
from liverjax.jobs.fields import FIELDS, at_vertices
from liverjax.jobs.pictures import Surface, draw_surface
from liverjax.jobs.reactions import reaction_table
from liverjax.mesh.files import meshio_cells
from liverjax.physics.boundary import boundary_triangles
from liverjax.scenes.scene import Scene
from liverjax.simulation.run import Result

if TYPE_CHECKING:
    import h5py

#: Fields of a `Result` with one number per step.
BY_STEP = ("status", "iterations", "linear_iterations", "cuts", "residual")
#: Maximum size of an attribute [bytes]. HDF5 allows 64 kB, including name and shape of the attribute.
_MOST_IN_ATTRIBUTE = 65_000


def write_hdf5(
    file: Path,
    scene: Scene,
    result: Result,
    attributes: Mapping[str, object],
    fields: dict[str, np.ndarray] | None = None,
    beside: Mapping[str, tuple[np.ndarray, str]] | None = None,
) -> None:
    """Write a run to an HDF5 file. Arrays become datasets; status, iterations and `attributes` become attributes.

    The datasets are the results of the T steps, the mesh, `fields` (T, E, …) and `beside` (values and unit). An array
    with one number per step becomes a dataset if it is too long for an attribute; `read_by_step` reads both forms. The
    nodes of quadratic tetrahedra (E, 10) are in the order of VTK.
    """
    import h5py

    with whole(file) as new, h5py.File(new, "w") as out:
        for name, unit in (("times", "s"), ("positions", "m"), ("reactions", "N")):
            out[name] = np.asarray(getattr(result, name))
            out[name].attrs["unit"] = unit
        if result.pressure is not None:
            out["pressure"] = np.asarray(result.pressure)
            out["pressure"].attrs["unit"] = "Pa"
        if result.mesh_error is not None:
            units = {"positions": "m", "reactions": "N", "found": "1", "pressure": "Pa"}
            for name, unit in units.items():
                if getattr(result.mesh_error, name) is None:
                    continue
                out[f"mesh_error/{name}"] = np.asarray(getattr(result.mesh_error, name))
                out[f"mesh_error/{name}"].attrs["unit"] = unit
        for name, values in (fields or {}).items():
            for place, numbers in (("elements", values), ("vertices", at_vertices(scene.mesh, values))):
                out[f"fields/{place}/{name}"] = numbers
                out[f"fields/{place}/{name}"].attrs["unit"] = FIELDS[name]
        for name, (values, unit) in (beside or {}).items():
            out[name] = values
            out[name].attrs["unit"] = unit
        out["times"].attrs["unit"] = "s" if scene.solve.dt is not None else "load step"
        out["reference"] = np.asarray(scene.mesh.points)
        out["reference"].attrs["unit"] = "m"
        out["tetrahedra"] = meshio_cells(scene.mesh)[1]
        codes = np.asarray(result.status)
        out.attrs["advice"] = [status.advice(c) for c in sorted(set(codes.tolist()))]
        taken = {name: np.asarray(getattr(result.statistics, name)) for name in BY_STEP if name != "status"}
        for name, numbers in {"status": codes, **taken}.items():
            (out.attrs if numbers.nbytes <= _MOST_IN_ATTRIBUTE else out)[name] = numbers
        for name, value in attributes.items():
            out.attrs[name] = value if isinstance(value, (str, int, float)) else json.dumps(value)


def read_by_step(file: "h5py.File", name: str) -> np.ndarray:
    """Read a field of `BY_STEP` (T,) from result.h5. The field is an attribute or, if it is too long, a dataset."""
    return np.asarray(file.attrs[name] if name in file.attrs else file[name][()])


def write_reactions(file: Path, scene: Scene, result: Result) -> None:
    """Write the support forces over time (`liverjax.jobs.reactions`) to a CSV file."""
    names, rows = reaction_table(scene, result)
    lines = [",".join(names), *(",".join(f"{number:.10g}" for number in row) for row in rows)]
    with whole(file) as new:
        Path(new).write_text("\n".join(lines) + "\n")


def write_vtu(folder: Path, scene: Scene, result: Result, fields: dict[str, np.ndarray] | None = None) -> Path:
    """Write one VTU file per step with displacements, reactions and fields, and the series file that ParaView opens."""
    import meshio

    folder.mkdir(parents=True, exist_ok=True)
    reference, cells = np.asarray(scene.mesh.points), [meshio_cells(scene.mesh)]
    entries = []
    for k, (time, x, f) in enumerate(
        zip(*map(np.asarray, (result.times, result.positions, result.reactions)), strict=True)
    ):
        name = f"step_{k + 1:05d}.vtu"
        data = {"displacement": x - reference, "reaction": f}
        if result.pressure is not None:
            data["pressure"] = np.asarray(result.pressure[k])
        own = {key: [values[k].reshape(len(values[k]), -1)] for key, values in (fields or {}).items()}
        meshio.Mesh(reference, cells, point_data=data, cell_data=own).write(folder / name)
        entries.append({"name": name, "time": float(time)})
    series = folder / "result.vtu.series"
    series.write_text(json.dumps({"file-series-version": "1.0", "files": entries}, indent=1) + "\n")
    return series


def picture(file: Path, scene: Scene, result: Result) -> None:
    """Draw the surface of the body before the run (grey) and after it (coloured by displacement)."""
    before, after = np.asarray(scene.mesh.points), np.asarray(result.positions[-1])
    worst = float(np.asarray(result.statistics.residual).max())
    title = f"step {len(result.times)}, largest residual {worst:.1e} of the forces"
    moved = np.linalg.norm(after - before, axis=1)
    draw_surface(file, Surface(before, after, boundary_triangles(scene.mesh), moved, "displacement [m]", title))
