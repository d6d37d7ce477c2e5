"""Make data/liver_phantom.vtu: a liver-shaped PHANTOM, not an anatomy, from an implicit surface.

``pip install '.[mesher]' && python -m experiments.sources.make_liver``. The phantom has two lobes, about 28 x 16 x 8 cm
and 1.5 l. Its node sets are `vena_cava` (a patch of the back, where the vessel would support it) and
`suspensory_ligament` (a strip of the top between the lobes). The axes are x from left to right lobe, y from front to
back, z upwards, in metres. A patient's own mesh can be used in the same scene file.
"""

from pathlib import Path

import numpy as np
import tetgen
from skimage.measure import marching_cubes

import liverjax as lj
from liverjax.physics.boundary import boundary_triangles

FILE = Path(__file__).parents[2] / "data" / "liver_phantom.vtu"
#: Lobes as ellipsoids: centre and semi-axes [m]. The left one is flatter and becomes thin towards its end.
LOBES = (((0.055, 0.0, 0.0), (0.090, 0.080, 0.041)), ((-0.060, -0.012, 0.008), (0.085, 0.055, 0.027)))
VOLUME = 1.5e-3
SPACING = 0.0113  # grid spacing for the surface [m]


def level(points: np.ndarray) -> np.ndarray:
    """Return a smooth union of the lobes: about the distance from the surface in units of a lobe's size, negative
    inside.
    """
    f = np.stack([np.linalg.norm((points - c) / np.asarray(r), axis=-1) - 1 for c, r in map(np.array, LOBES)])
    sharpness = 6.0
    blend = -np.log(np.sum(np.exp(-sharpness * f), axis=0)) / sharpness
    # A shallow dent on the lower side, where the vessels enter.
    dent = np.exp(-np.sum(((points - np.array([0.01, 0.0, -0.045])) / 0.035) ** 2, axis=-1))
    return blend + 0.35 * dent


def surface(offset: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of level = offset, smoothed and projected back onto the surface."""
    low, high = np.array([-0.17, -0.11, -0.07]), np.array([0.17, 0.11, 0.07])
    shape = np.ceil((high - low) / spacing).astype(int) + 1
    grid = low + spacing * np.moveaxis(np.indices(shape), 0, -1)
    vertices, triangles, _, _ = marching_cubes(level(grid), offset, spacing=(spacing,) * 3, allow_degenerate=False)
    vertices = vertices + low
    neighbours = [[] for _ in vertices]
    for a, b, c in triangles:
        neighbours[a] += (b, c)
        neighbours[b] += (c, a)
        neighbours[c] += (a, b)
    for _ in range(30):
        mean = np.array([vertices[n].mean(axis=0) for n in neighbours])
        vertices = 0.5 * vertices + 0.5 * mean
        for _ in range(3):  # Newton iterations along the gradient
            h = 1e-5
            slope = np.stack([(level(vertices + h * e) - level(vertices - h * e)) / (2 * h) for e in np.eye(3)], axis=1)
            step = (level(vertices) - offset) / np.sum(slope**2, axis=1)
            vertices = vertices - step[:, None] * slope
    return vertices, triangles


def enclosed(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Return the volume of a closed surface [m^3], by the divergence theorem."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return abs(float(np.sum(a * np.cross(b, c)))) / 6


def filled(spacing: float, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points and tetrahedra of the phantom.

    The volume of a tetrahedron is at most `largest` [m^3]; `spacing` [m] is that of the grid for the surface.
    """
    low, high = -0.3, 0.3
    for _ in range(18):
        offset = (low + high) / 2
        enough = enclosed(*surface(offset, spacing)) >= VOLUME
        low, high = (low, offset) if enough else (offset, high)
    mesher = tetgen.TetGen(*surface(offset, spacing))
    mesher.tetrahedralize(order=1, mindihedral=14, minratio=1.4, maxvolume=largest, nobisect=True)
    points, tets = np.asarray(mesher.node), np.asarray(mesher.elem)
    tets = tets[:, [0, 1, 2, 3]]
    flipped = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) < 0
    tets[flipped] = tets[flipped][:, [0, 2, 1, 3]]
    used = np.unique(tets)
    return points[used], np.searchsorted(used, tets)


def main() -> None:
    """Find the level for the wanted volume, fill it with tetrahedra, name the node sets, and write the file."""
    points, tets = filled(SPACING, 3.2e-7)
    outer = np.unique(boundary_triangles(lj.tet_mesh(points, tets)))
    x, y, z = points[outer].T
    middle = (x > -0.045) & (x < 0.005)
    sets = {
        "vena_cava": outer[(x > -0.01) & (x < 0.05) & (y > 0.045)],
        "suspensory_ligament": outer[middle & (z > 0.02) & (y < 0.03)],
    }
    mesh = lj.tet_mesh(points, tets, sets)
    lj.check_mesh(mesh, "liver phantom")
    lj.write_mesh(FILE, mesh)
    size = 100 * np.ptp(points, axis=0)
    counts = {name: len(nodes) for name, nodes in sets.items()}
    print(f"{mesh.number_of_nodes} nodes, {mesh.number_of_elements} tetrahedra, {counts}")
    print(f"{1000 * float(mesh.volumes.sum()):.2f} l, {size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} cm")


if __name__ == "__main__":
    main()
