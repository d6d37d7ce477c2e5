"""Four stiff cylinders in a soft plate, reconstructed from waves (synthetic; the plate of a published benchmark).

The plate of 80 x 100 x 10 mm has 3 kPa, and cylinders of 10 kPa with radii 10, 5, 3 and 2 mm along the short side. The
viscosity is 1 Pa s, the frequencies are 50 to 100 Hz. Shear waves of the same amplitude enter at two neighbouring
sides; the motion stays in the plane. The data are the exact series of an unbounded medium
(`experiments.sources.cylinders_in_waves`), so the other sides do not reflect waves. The voxels have 2 mm (the published
ones 1 mm), with noise of 2 % of the root mean square of the motion.

``python -m experiments elastography`` (5 minutes) writes results/elastography.json and elastography.png.
"""

import itertools
import time

import numpy as np

from experiments.common import either, plt, save
from experiments.sources import cylinders_in_waves
from fitting.reports.waves import maps
from fitting.waves import direct_inversion, elastography, stiffness_map
from fitting.waves.wave_field import WaveField, noise_of

SIZE, DENSITY, VISCOSITY = np.array([0.08, 0.1, 0.01]), 1000.0, 1.0
SOFT, STIFF = 3000.0, 10000.0
CYLINDERS = (((0.025, 0.07), 0.010), ((0.055, 0.07), 0.005), ((0.025, 0.03), 0.003), ((0.055, 0.03), 0.002))
HERTZ = np.array(either([50.0, 75.0, 100.0], [100.0]))
VOXEL, NOISE = 2e-3, 0.02
VOXELS = either((39, 49, 5), (19, 25, 5))
#: Limits [m] of the classes of distance from the nearest edge, for the coverage; negative inside a cylinder.
ENDS = (-np.inf, -4e-3, -2e-3, 0.0, 2e-3, 4e-3, 8e-3, np.inf)


def stiff_part(xy: np.ndarray) -> np.ndarray:
    """Return 1 in the cylinders and 0 outside, for points (..., 2) [m]."""
    return np.sum([np.hypot(*np.moveaxis(xy - np.array(c), -1, 0)) < r for c, r in CYLINDERS], axis=0).astype(float)


def motion(points: np.ndarray) -> np.ndarray:
    """Return the motion (F, n, 3) at points (n, 2) [m]."""
    out = np.zeros((len(HERTZ), len(points), 3), complex)
    for f, omega in enumerate(2 * np.pi * HERTZ):
        loss = 1j * omega * VISCOSITY
        medium = cylinders_in_waves.Medium(SOFT + loss, STIFF + loss, omega, DENSITY)
        # One wave starts at y = 0, the other at the largest x in the direction -x.
        waves = [(np.pi / 2, 1e-5), (np.pi, 1e-5 * np.exp(-1j * medium.number(True) * SIZE[0]))]
        out[f, :, :2] = cylinders_in_waves.motion(points, list(CYLINDERS), medium, waves)
    return out


def measured() -> tuple[WaveField, np.ndarray]:
    """Return the noisy voxels, and the stiff fraction of each voxel (nx, ny, nz)."""
    x, y = (VOXEL / 2 + 2e-4 + VOXEL * np.arange(n) for n in VOXELS[:2])
    points = np.stack(np.meshgrid(x, y, [SIZE[2] / 2], indexing="ij"), axis=-1)
    flat = motion(points[..., :2].reshape(-1, 2)).reshape(len(HERTZ), *VOXELS[:2], 1, 3)
    U = np.repeat(flat, VOXELS[2], axis=3)
    # two components, each with real and imaginary part
    sd = NOISE * np.sqrt(np.mean(np.sum(np.abs(U) ** 2, axis=-1), axis=(1, 2, 3)) / 4)
    rng = np.random.default_rng(3)
    noise = rng.normal(size=U.shape) + 1j * rng.normal(size=U.shape)
    number = np.ones(VOXELS, int)
    for k, (c, r) in enumerate(CYLINDERS):
        number[np.hypot(*np.moveaxis(points[..., 0, :2] - np.array(c), -1, 0)) < r] = k + 2
    shape = (len(HERTZ), *VOXELS)
    field = WaveField(
        HERTZ,
        U + sd[:, None, None, None, None] * noise.reshape(*shape, 3),
        np.full(3, VOXEL),
        np.array([x[0], y[0], SIZE[2] / 2 - VOXEL * (VOXELS[2] - 1) / 2]),
        np.ones(VOXELS, bool),
        number,
        np.zeros(len(HERTZ)),
        "synthetic",
    )
    grid = points[:, :, 0, None, None, :2] + VOXEL * (np.stack(np.meshgrid(*[np.linspace(-0.45, 0.45, 10)] * 2), -1))
    part = np.repeat(stiff_part(grid).mean(axis=(2, 3))[..., None], VOXELS[2], axis=2)
    return field._replace(noise=noise_of(field)), part


def held(organ: elastography.Organ, drawn: stiffness_map.WaveMap, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Test whether the true storage and loss modulus are in the 90 % interval.

    Returns the results (2, F, n) of the n voxels with a modulus, and the positions (n, 2) [m] of these voxels.
    """
    sds, out = [maps.at_voxels(organ, own) for own in drawn.sd], []
    known = np.isfinite(sds[0])
    for f, hertz in enumerate(HERTZ):
        G = maps.at_voxels(organ, drawn.modulus[f])
        exact = SOFT + (STIFF - SOFT) * part + 2j * np.pi * hertz * VISCOSITY
        off, allowed = (G - exact)[known], 1.645 * stiffness_map.sd_of_modulus(G, sds[f])[known]
        out.append((np.abs(off.real) < allowed.real, np.abs(off.imag) < allowed.imag))
    places = organ.field.origin[:2] + VOXEL * np.argwhere(known)[:, :2]
    return np.moveaxis(np.array(out), 1, 0), places


def covered(organ: elastography.Organ, drawn: stiffness_map.WaveMap, part: np.ndarray) -> dict:
    """Return the fraction of voxels whose true modulus is in the 90 % interval.

    It is given for all voxels at every frequency, and for classes of distance from the nearest edge over all
    frequencies.
    """
    inside, places = held(organ, drawn, part)
    distance = np.min([np.hypot(*(places - np.array(c)).T) - r for c, r in CYLINDERS], axis=0)
    rows = []
    for low, high in itertools.pairwise(ENDS):
        near = (distance >= low) & (distance < high)
        ends = {"from_m": None if np.isinf(low) else low, "to_m": None if np.isinf(high) else high}
        if near.any():
            rows.append(ends | {"voxels": int(near.sum()), "storage": float(inside[0][:, near].mean())})
    return {"storage": inside[0].mean(axis=1).tolist(), "loss": inside[1].mean(axis=1).tolist(), "by_distance": rows}


def rows_of(organ, found, drawn, usual) -> list[dict]:
    """Return one row for each cylinder and one for the plate: results of regions, map and direct inversion."""
    rows, every = [], [maps.at_voxels(organ, own) for own in drawn.sd]
    for k, label in enumerate(found.labels):
        place = organ.field.labels == label
        place[:, :, [0, -1]] = False
        core = place & np.isfinite(every[0])
        moduli = [maps.at_voxels(organ, G)[core] for G in drawn.modulus]
        sds = [stiffness_map.sd_of_modulus(G, sd[core]).real for G, sd in zip(moduli, every, strict=True)]
        rows.append(
            {
                "radius_m": None if label == 1 else CYLINDERS[label - 2][1],
                "true_storage_Pa": SOFT if label == 1 else STIFF,
                "storage_Pa": found.parts.modulus[:, k].real.tolist(),
                "loss_Pa": found.parts.modulus[:, k].imag.tolist(),
                "standard_error_Pa": found.parts.standard_errors[:, k].real.tolist(),
                "edges_farther_out_voxels": found.parts.farther[:, k].tolist(),
                "map_median_Pa": [float(np.median(G.real)) for G in moduli],
                "map_sd_Pa": [float(np.median(sd)) for sd in sds],
                "direct_median_Pa": [float(np.nanmedian(G.real[place])) for G in usual],
            }
        )
    return rows


def main() -> None:
    """Compute the data, fit them, and write the results."""
    begin = time.perf_counter()
    field, part = measured()
    made = time.perf_counter() - begin
    organ = elastography.organ_of(field, elastography.body_of(field), DENSITY)
    begin = time.perf_counter()
    found = elastography.regions_of(organ)
    by_regions = time.perf_counter() - begin
    drawn = stiffness_map.map_of(elastography.problem_of_map(organ, found, 4 * VOXEL))
    usual = direct_inversion.invert(organ.field, DENSITY)
    rows = rows_of(organ, found, drawn, usual)
    data = {
        "frequencies_Hz": HERTZ.tolist(),
        "noise": NOISE,
        "elements": organ.body.mesh.number_of_elements,
        "unknowns": 3 * organ.body.mesh.number_of_nodes,
        "data_s": made,
        "regions_s": by_regions,
        "map_s": drawn.seconds,
        "mesh_bias": np.abs(found.mesh_bias).tolist(),
        "regions_chi2": (found.parts.chi2 / found.parts.components).tolist(),
        "map_chi2": drawn.chi2 / drawn.components,
        "deviation": drawn.deviation,
        "covered_90": covered(organ, drawn, part),
        "rows": rows,
    }
    figure = maps.maps_picture(organ, drawn, usual)
    for axes in figure.axes[:4]:
        for c, r in CYLINDERS:
            place = 1e3 * (np.array(c) - field.origin[:2] + VOXEL / 2)
            axes.add_patch(plt.Circle(place, 1e3 * r, fill=False, color="white", lw=0.8))
    save("elastography", data, figure)


if __name__ == "__main__":
    main()
