"""A stiff lesion in the liver phantom, reconstructed from the waves of an external driver (synthetic).

The phantom is scaled to two fifths of its size, so that its elements are a sixth of a shear wave at 60 Hz. A patch of
its surface is driven; the rest is free. The data are computed with displacements on quadratic tetrahedra, with a bulk
modulus of 300 times the storage modulus. The fit uses voxels of 4 mm with 5 % of noise, and separate elements on these
voxels. It does not use the bulk modulus. The regions are assumed to be known from other images; the map does not use
them.

``python -m experiments liver_waves`` (4 minutes) writes results/liver_waves.json and liver_waves.png.
"""

import time

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import ROOT, either, save
from fitting.reports.waves import maps
from fitting.waves import direct_inversion, elastography, stiffness_map
from fitting.waves.wave_field import WaveField, noise_of
from liverjax.mesh import locate
from liverjax.mesh.tetrahedra import with_points

DENSITY, HERTZ, NOISE, VOXEL, SIZE = 1000.0, 60.0, 0.05, 4e-3, 0.4
LIVER, LESION = 3000.0 + 900.0j, 7500.0 + 2250.0j
RADIUS = 0.015


def truth() -> tuple[lj.TetMesh, np.ndarray, np.ndarray]:
    """Return the mesh of the data, the centre of the lesion [m], and the motion (V, 3) [m]."""
    mesh = lj.read_mesh(ROOT / "data" / "liver_phantom.vtu")
    mesh = with_points(mesh, SIZE * mesh.points)
    points = np.asarray(mesh.points)
    corners = points[np.asarray(mesh.tetrahedra)]
    volumes = np.asarray(mesh.volumes)
    centre = (volumes[:, None] * corners.mean(axis=1)).sum(axis=0) / volumes.sum()
    inside = np.random.default_rng(1).dirichlet(np.ones(4), 64)
    at = np.einsum("qk,ekd->eqd", inside, corners)
    part = (np.linalg.norm(at - centre, axis=2) < RADIUS).mean(axis=1)
    G = LIVER + (LESION - LIVER) * part
    surface = np.unique(lj.boundary.boundary_triangles(mesh))
    low = points[surface][:, 1].min()
    driven = surface[points[surface][:, 1] < low + 0.2 * np.ptp(points[:, 1])]
    mesh2 = lj.quadratic(mesh)
    triangles = lj.boundary.boundary_triangles(mesh2, None)
    whole = triangles[np.isin(triangles, driven).all(axis=1)]
    nodes = np.unique(np.concatenate([driven, _middles(mesh2, whole)]))
    scene = lj.Scene(
        mesh=mesh2,
        law=lj.laws.NeoHookean(mu=LIVER.real, bulk=300 * LIVER.real),
        viscosity=lj.Prony(ratios=jnp.array([0.5]), relaxation_times=jnp.array([1.0]), part="isochoric"),
        body=lj.Body(density=DENSITY),
        displaced=(lj.Displaced(nodes=jnp.asarray(nodes), by=jnp.array([1e-5, 1e-5, 1e-5])),),
        solve=lj.Solve(volumetric="element"),
    )
    factors = jnp.asarray(G / LIVER.real)[None]
    moved = lj.harmonic(scene, jnp.array([HERTZ]), factors=factors).check().displacement[0]
    return mesh2, centre, np.asarray(moved)


def _middles(mesh: lj.TetMesh, triangles: np.ndarray) -> np.ndarray:
    """Return the nodes in the middle of the edges of `triangles`, which are given by their vertices."""
    low, high = np.asarray(mesh.pattern.edges)
    pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    V = mesh.number_of_vertices
    key = np.minimum(low, high) * V + np.maximum(low, high)
    return V + np.flatnonzero(np.isin(key, pairs @ [V, 1]))


def sampled(mesh: lj.TetMesh, moved: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion (n, 3) at points (n, 3), and whether each point is in the body."""
    motion, within = np.zeros(points.shape, complex), np.zeros(len(points), bool)
    for begin in range(0, len(points), 500):
        some = slice(begin, begin + 500)
        L = np.asarray(locate.barycentric(mesh, points[some]))  # (4, n, E)
        least = L.min(axis=0)
        own = least.argmax(axis=1)
        row = np.arange(len(own))
        within[some] = least[row, own] > -1e-9
        nodes, shares = locate.weights(mesh, own, L[:, row, own])
        motion[some] = np.einsum("kn,knd->nd", shares, moved[nodes])
    return motion, within


def measured() -> tuple[WaveField, np.ndarray]:
    """Return the noisy voxels, and the fraction of each voxel (nx, ny, nz) that is in the lesion."""
    mesh, centre, moved = truth()
    corner, far = np.asarray(mesh.points).min(axis=0), np.asarray(mesh.points).max(axis=0)
    step = either(VOXEL, 2 * VOXEL)
    count = ((far - corner) / step).astype(int)
    origin = corner + 0.5 * (far - corner - step * (count - 1))
    points = origin + step * np.stack(np.meshgrid(*[np.arange(n) for n in count], indexing="ij"), axis=-1)
    motion, within = sampled(mesh, moved, points.reshape(-1, 3))
    within = within.reshape(count)
    U = motion.reshape(1, *count, 3)
    sd = NOISE * np.sqrt(np.mean(np.sum(np.abs(U[0][within]) ** 2, axis=-1)) / 6)
    rng = np.random.default_rng(3)
    U = U + sd * (rng.normal(size=U.shape) + 1j * rng.normal(size=U.shape))
    labels = 1 + (np.linalg.norm(points - centre, axis=-1) < RADIUS)
    spacing = np.full(3, step)
    field = WaveField(
        np.array([HERTZ]),
        np.where(within[None, ..., None], U, 0),
        spacing,
        origin,
        within,
        labels,
        np.zeros(1),
        "synthetic",
    )
    inner = step * (np.stack(np.meshgrid(*[np.linspace(-0.45, 0.45, 6)] * 3), -1)).reshape(-1, 3)
    part = (np.linalg.norm(points[..., None, :] + inner - centre, axis=-1) < RADIUS).mean(axis=-1)
    return field._replace(noise=noise_of(field)), part


def _median(values: np.ndarray) -> float | None:
    """Return the median, or None if no voxel has a value."""
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None


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
    G, known = maps.at_voxels(organ, drawn.modulus[0]), np.isfinite(maps.at_voxels(organ, drawn.sd[0]))
    core, liver = known & (part == 1), known & (part == 0) & organ.field.mask
    data = {
        "hertz": HERTZ,
        "noise": NOISE,
        "voxels": int(field.mask.sum()),
        "unknowns": 3 * organ.body.mesh.number_of_nodes,
        "radius_m": RADIUS,
        "data_s": made,
        "regions_s": by_regions,
        "map_s": drawn.seconds,
        "chi2": (found.parts.chi2 / found.parts.components).tolist(),
        "rows": [
            {
                "name": name,
                "true_Pa": [true.real, true.imag],
                "regions_Pa": [float(v) for v in (found.parts.modulus[0, k].real, found.parts.modulus[0, k].imag)],
                "standard_error_Pa": [
                    float(v) for v in (found.parts.standard_errors[0, k].real, found.parts.standard_errors[0, k].imag)
                ],
                "edges_farther_out_voxels": float(found.parts.farther[0, k]),
                "map_median_Pa": [float(np.median(G[place].real)), float(np.median(G[place].imag))],
                "direct_median_Pa": _median(usual[0].real[place]),
            }
            for k, (name, true, place) in enumerate((("liver", LIVER, liver), ("lesion", LESION, core)))
        ],
    }
    print(data, flush=True)
    figure = maps.maps_picture(organ, drawn, usual)
    save("liver_waves", data, figure)


if __name__ == "__main__":
    main()
