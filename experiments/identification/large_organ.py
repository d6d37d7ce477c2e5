"""Waves in an organ of 32,000 voxels (synthetic): undivided it would need too much memory.

The organ is an ellipsoid with one complex modulus. The data are the exact sum of twelve plane shear waves of 60 Hz with
random directions and phases, and 3 % of noise. One wavelength has 9 voxels. The program divides such an organ into
parts. The alternative are means over blocks of 2 x 2 x 2 voxels (``--stride 2``), which need less memory but have only
4.5 voxels in a wavelength.

``python -m experiments large_organ`` (5 minutes, 7 GB) writes results/large_organ.json.
"""

import resource
import time

import numpy as np

from experiments.common import either, save
from fitting.waves import elastography, stiffness_map, wave_field
from fitting.waves.voxels import VoxelBody
from fitting.waves.wave_field import WaveField, noise_of

SHAPE, VOXEL, HERTZ, DENSITY = either((64, 48, 20), (30, 24, 16)), 3e-3, 60.0, 1000.0
MODULUS, NOISE, WAVES = 2500 + 800j, 0.03, 12
#: Largest factor [GB]; with --quick a smaller one, so that the small organ is divided too.
MOST_MEMORY = either(4.0, 0.3)


def measured() -> WaveField:
    """Return the noisy voxels of the ellipsoid."""
    rng = np.random.default_rng(0)
    x = np.stack(np.meshgrid(*[VOXEL * np.arange(n) for n in SHAPE], indexing="ij"), axis=-1)
    middle = VOXEL * (np.array(SHAPE) - 1) / 2
    k = 2 * np.pi * HERTZ * np.sqrt(DENSITY / MODULUS)
    U = np.zeros((1, *SHAPE, 3), complex)
    for _ in range(WAVES):
        direction, other = rng.normal(size=(2, 3))
        direction /= np.linalg.norm(direction)
        polarisation = np.cross(direction, other)
        amplitude = 1e-5 * rng.normal() * np.exp(2j * np.pi * rng.uniform()) / np.linalg.norm(polarisation)
        U[0] += amplitude * np.exp(-1j * k * ((x - middle) @ direction))[..., None] * polarisation
    sd = NOISE * np.sqrt(np.mean(np.abs(U) ** 2) / 2)
    U += sd * (rng.normal(size=U.shape) + 1j * rng.normal(size=U.shape))
    mask = np.sum(((x - middle) / (middle + VOXEL / 2)) ** 2, axis=-1) < 1
    field = WaveField(np.array([HERTZ]), U, np.full(3, VOXEL), np.zeros(3), mask, None, np.zeros(1), "synthetic")
    return field._replace(noise=noise_of(field))


def found_in(field: WaveField, body: VoxelBody) -> dict:
    """Return the modulus of the whole organ and a map, with their errors and the run time."""
    begin = time.perf_counter()
    organ = elastography.organ_of(field, body, DENSITY)
    found = elastography.regions_of(organ)
    whole, bias = found.whole, found.mesh_bias[0]
    drawn = stiffness_map.map_of(elastography.problem_of_map(organ, found, float(4 * np.mean(field.spacing))))
    off = np.log(drawn.modulus[0] / MODULUS)
    z = np.concatenate([off.real / drawn.sd[0].real, off.imag / drawn.sd[0].imag])
    G, error = whole.modulus[0, 0], whole.standard_errors[0, 0]
    return {
        "parts": int(body.part.max()) + 1,
        "unknowns": 3 * body.mesh.number_of_nodes,
        "modulus_Pa": [G.real, G.imag],
        "standard_errors_Pa": [error.real, error.imag],
        "mesh_bias": float(np.abs(bias)),
        "chi2": float(whole.chi2[0] / whole.components),
        "map_chi2": float(drawn.chi2 / drawn.components),
        "map_off": float(np.sqrt(np.mean(np.abs(off) ** 2))),
        "map_covered_90": float(np.mean(np.abs(z) < 1.645)),
        "noise_factor": drawn.noise_factor.tolist(),
        "seconds": time.perf_counter() - begin,
        "peak_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }


def main() -> None:
    """Fit the means over blocks first, then the divided organ: the peak of the memory can only grow."""
    field = measured()
    body = elastography.body_of(field)
    means = wave_field.coarsened(field, 2)
    means = means._replace(noise=noise_of(means))
    averaged = found_in(means, elastography.body_of(means))
    divided = elastography.body_that_fits(field, MOST_MEMORY)
    assert divided is not None
    data = {
        "frequency_Hz": HERTZ,
        "noise": NOISE,
        "voxels": int(field.mask.sum()),
        "voxels_in_a_wavelength": float(np.sqrt(np.abs(MODULUS) / DENSITY) / HERTZ / VOXEL),
        "true_Pa": [MODULUS.real, MODULUS.imag],
        "undivided_GB": elastography.gigabytes(body),
        "averaged": averaged,
        "divided": found_in(field, divided),
    }
    save("large_organ", data)


if __name__ == "__main__":
    main()
