"""Write the map of a fit to waves: waves.h5 at the voxels, waves.vtu for ParaView, and the picture waves.png."""

from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import meshio
import numpy as np

from fitting.waves import voxels
from fitting.waves.elastography import Organ
from fitting.waves.stiffness_map import WaveMap, sd_of_modulus
from fitting.waves.wave_field import WaveField
from liverjax.core.files import whole
from liverjax.core.plotting import pyplot

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def at_voxels(organ: Organ, corners: np.ndarray) -> np.ndarray:
    """Interpolate values (P,) at the P corners of the mesh to the voxels (nx, ny, nz). Voxels outside of the organ are
    NaN."""
    nothing = complex(np.nan, np.nan) if np.iscomplexobj(corners) else np.nan
    out = np.full(organ.field.mask.shape, nothing, corners.dtype)
    out[tuple(organ.body.voxel.T)] = voxels.on_all_nodes(organ.body, corners)
    return out


def write_at_voxels(path: Path, organ: Organ, drawn: WaveMap | None, usual: np.ndarray) -> None:
    """Write waves.h5: the mask, the direct inversion `usual` (F, nx, ny, nz) [Pa] at F frequencies, and the map with
    its standard deviations."""
    with whole(path) as new, h5py.File(new, "w") as file:
        for name in ("frequencies", "spacing", "origin", "mask"):
            file[name] = getattr(organ.field, name)
        file["place"] = in_space(organ.field)
        file["place"].attrs["unit"] = "m"
        file["direct_inversion"] = usual
        if drawn is None:
            return
        moduli = np.stack([at_voxels(organ, G) for G in drawn.modulus])
        sd = np.stack([at_voxels(organ, own) for own in drawn.sd])
        file["modulus"], file["sd_of_logarithm"], file["sd_of_loss_angle"] = moduli, sd.real, sd.imag
        file["sd"] = sd_of_modulus(moduli, sd)
        file["draws_of_exponent"] = (
            np.stack([[at_voxels(organ, c) for c in own] for own in drawn.draws]) if len(drawn.draws) else []
        )
        file["modulus"].attrs["unit"] = file["sd"].attrs["unit"] = "Pa"


def write_for_paraview(path: Path, organ: Organ, drawn: WaveMap) -> None:
    """Write the map at the corners of the mesh for ParaView."""
    data: dict[str, np.ndarray] = {}
    for hertz, G, sd in zip(organ.field.frequencies, drawn.modulus, drawn.sd, strict=True):
        data |= {f"storage_{hertz:g}_Hz": G.real, f"loss_{hertz:g}_Hz": G.imag}
        data |= {f"sd_of_logarithm_{hertz:g}_Hz": sd.real, f"sd_of_loss_angle_{hertz:g}_Hz": sd.imag}
    mesh, field, place = organ.body.whole, organ.field, in_space(organ.field)
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    if field.place is not None:
        points = (points - field.origin) / field.spacing @ place[:, :3].T + place[:, 3]
    if np.linalg.det(place[:, :3]) < 0:  # the mesh is mirrored: exchange two corners, so that the volumes are positive
        tets = tets[:, [0, 2, 1, 3]]
    meshio.write_points_cells(path, points, {"tetra": tets}, data)


def in_space(field: WaveField) -> np.ndarray:
    """Return a matrix (3, 4) [m] with the position of the voxels in space. Its first three columns are the vectors from
    a voxel to the next voxel along each axis of the array. Its last column is the centre of the first voxel."""
    return np.column_stack([np.diag(field.spacing), field.origin]) if field.place is None else field.place


def maps_picture(organ: Organ, drawn: WaveMap, usual: np.ndarray) -> "Figure":
    """Plot the middle slice, normal to the shortest side, at the highest frequency: the map, its standard deviation and
    the direct inversion."""
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
    top = np.nanquantile(panels[0][1], 0.995)  # a quantile, so that a single voxel does not determine the colour scale
    for ax, (title, values, colours) in zip(axes, panels, strict=True):
        limits = {"vmin": 0.0, "vmax": top} if "storage" in title else {"vmin": 0.0}
        shown = np.take(values, k, axis).T
        picture = ax.imshow(
            shown, origin="lower", cmap=colours, extent=(0, size[across[0]], 0, size[across[1]]), **limits
        )
        ax.set(title=title, xlabel=f"{'xyz'[across[0]]} [mm]", ylabel=f"{'xyz'[across[1]]} [mm]")
        ax.title.set_fontsize(9)
        if not np.isfinite(shown).any():  # the organ is too thin for the differences of the direct inversion
            ax.text(0.5, 0.5, "no voxel is far enough\nfrom an edge", ha="center", transform=ax.transAxes, fontsize=8)
        fig.colorbar(picture, ax=ax, shrink=0.8)
    return fig
