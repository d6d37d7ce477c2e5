"""Draw pictures of the surface of a body, coloured by a field."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from liverjax.core.did_you_mean import hint
from liverjax.core.errors import InputError
from liverjax.core.plotting import BLUE, GREY, pyplot, save
from liverjax.mesh.selection import boundary_triangles
from liverjax.mesh.tetrahedra import tet_mesh


class Surface(NamedTuple):
    """The surface to draw, with the labels of the picture."""

    before: np.ndarray  # (V, 3) [m] positions before the run
    after: np.ndarray  # (V, 3) [m] positions after the run
    triangles: np.ndarray  # (m, 3) node numbers of m triangles
    values: np.ndarray  # (V,) values that the colours show
    label: str
    title: str


#: Name of each field -> quantity that is drawn.
DRAWN = {
    "cauchy_stress": "von Mises stress [Pa]",
    "green_strain": "largest principal strain [1]",
    "principal_stretches": "largest stretch [1]",
    "volume_ratio": "volume ratio J [1]",
    "energy": "energy density [Pa]",
    "fluid_velocity": "speed of the fluid [m/s]",
}


def draw_surface(file: Path, surface: Surface) -> None:
    """Draw the surface before the run (grey) and after the run (coloured) to a PNG file."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    before, after, triangles = surface.before, surface.after, surface.triangles
    figure = pyplot().figure(figsize=(6.5, 5.5), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    edges = Poly3DCollection(before[triangles], facecolor="none", edgecolor=GREY, lw=0.15)
    filled = Poly3DCollection(after[triangles], lw=0.1, edgecolor="black")
    filled.set_array(surface.values[triangles].mean(axis=1))
    filled.set_cmap("viridis")
    for collection in (edges, filled):
        axes.add_collection3d(collection)
    both = np.concatenate([before, after])
    middle, half = (both.min(axis=0) + both.max(axis=0)) / 2, np.ptp(both, axis=0).max() / 2
    for k, name in enumerate("xyz"):
        getattr(axes, f"set_{name}lim")(middle[k] - half, middle[k] + half)
        getattr(axes, f"set_{name}label")(f"{name} [m]")
    axes.set_box_aspect((1, 1, 1))
    figure.colorbar(filled, ax=axes, shrink=0.6, label=surface.label)
    axes.set_title(surface.title, color=BLUE, fontsize=9)
    save(figure, file)


def of_result(file: Path, name: str, step: int | None = None) -> Surface:
    """Read the surface from result.h5. The colours of the surface show a field, the displacement or the pressure.

    Args:
        file: result.h5 of `liverjax simulate`.
        name: name of a field in the file.
        step: number of the step, from 1. None means the last step.

    Raises:
        InputError: the file is not the result of one run, or the field or the step does not exist.
    """
    import h5py

    if not file.is_file():
        raise InputError(f"{file} does not exist: give the result.h5 of liverjax simulate")
    try:
        with h5py.File(file) as data:
            if "sweep" in data.attrs:
                raise InputError(
                    f"{file} contains the runs of a sweep, which cannot be drawn: give the result.h5 of one run"
                )
            if "modes" in data:
                raise InputError(f"{file} contains a reduced model: run this model, and give the result.h5 of the run")
            if "frequencies_Hz" in data:
                raise InputError(
                    f"{file} contains harmonic motion: use simulate --vtu to write the motion for ParaView"
                )
            tets, before, after = data["tetrahedra"][()][:, :4], data["reference"][()], data["positions"]
            steps, fields = len(after), list(data.get("fields/vertices", ()))
            known = ["displacement", *(["pressure"] if "pressure" in data else []), *fields]
            if name not in known:
                raise InputError(
                    f"{file} has no field {name!r}: {hint(name, known)}. The file has {', '.join(known)}; liverjax "
                    "simulate --fields writes more fields"
                )
            step = steps if step is None else step
            if not 1 <= step <= steps:
                raise InputError(f"--step {step} is not in {file}: give 1 to {steps}")
            after = after[step - 1]
            values = data[f"fields/vertices/{name}"][step - 1] if name in fields else None
            if name == "pressure":
                values = data["pressure"][step - 1]
    except (OSError, KeyError) as error:
        raise InputError(
            f"{file} is not a result of liverjax simulate ({error}): give the result.h5 of a run"
        ) from None
    V = int(tets.max()) + 1
    if name == "displacement":
        values, label = np.linalg.norm(after - before, axis=1), "displacement [m]"
    else:
        values, label = _drawn_number(name, np.asarray(values)), DRAWN.get(name, "pressure [Pa]")
    triangles = np.asarray(boundary_triangles(tet_mesh(before[:V], tets)))
    return Surface(before[:V], after[:V], triangles, values[:V], label, f"step {step} of {steps}")


def _drawn_number(name: str, values: np.ndarray) -> np.ndarray:
    """Return one number per vertex (V,) from a field (V, …)."""
    if name == "cauchy_stress":
        deviator = values - np.trace(values, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        return np.sqrt(1.5 * np.sum(deviator**2, axis=(1, 2)))
    if name == "green_strain":
        return np.linalg.eigvalsh(values)[:, -1]
    if name == "principal_stretches":
        return values[:, 0]
    return np.linalg.norm(values, axis=1) if name == "fluid_velocity" else values
