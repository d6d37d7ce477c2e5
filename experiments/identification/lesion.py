"""A stiff lesion of 5 cm in the liver phantom, reconstructed from noisy displacements of its surface (synthetic data).

The liver is fixed at its lower surface. Gravity of 3 m/s^2 acts in three directions. The load is below full gravity,
because neighbouring organs carry the rest of the weight (the chapter uses 2 m/s^2). With more, the quadratic elements
at the edge of the fixed surface invert. The true displacements are computed with 42,808 quadratic tetrahedra (each
tetrahedron of the phantom cut into eight). From them, two things are estimated. The first is a smooth map of the shear
modulus with its uncertainty (`fitting.fits.field`), on the phantom's 5,351 linear tetrahedra. The second is a sphere
(`fitting.fits.inclusion`), with the map as starting point, on the 5,351 tetrahedra made quadratic. The noise is 0, 1 %
and 5 % of the largest displacement. The mesh error counts as noise. It is the difference of a uniform body from the
finest mesh.

    python -m experiments lesion [--quick]
"""

import sys
import tempfile
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import ROOT, plt, save
from fitting.fits import field, inclusion, scene_numbers
from fitting.readers.displacements import read_displacements
from fitting.reports.field_report import section
from liverjax.core.plotting import ORANGE
from liverjax.mesh.shape_functions import basis
from liverjax.physics.boundary import boundary_triangles

MESH = ROOT / "data" / "liver_phantom.vtu"
CENTRE, RADIUS, MU, STIFFER = np.array([0.06, 0.005, 0.008]), 0.025, 770.0, 3.0
GRAVITY = ([0.0, 3.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, -3.0])
_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def refined(points: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mesh with every tetrahedron cut into eight (Bey 1995), and the edges (n, 2) that hold the new
    nodes.
    """
    ends = np.sort(np.stack([tets[:, p] for p in _EDGES], axis=1), axis=-1)
    edges, number = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    a, b, c, d = tets.T
    ab, ac, ad, bc, bd, cd = (len(points) + number.reshape(-1, 6)).T
    children = [
        *([a, ab, ac, ad], [ab, b, bc, bd], [ac, bc, c, cd], [ad, bd, cd, d]),
        *([ab, ac, ad, bd], [ab, bc, ac, bd], [ac, ad, bd, cd], [ac, bc, cd, bd]),
    ]
    return np.vstack([points, points[edges].mean(axis=1)]), np.stack(children).transpose(2, 0, 1).reshape(-1, 4), edges


def bodies(levels: int) -> tuple[list[lj.TetMesh], np.ndarray]:
    """Return the phantom and finer meshes with the node set `held`, and the nodes whose displacement is measured."""
    phantom = lj.read_mesh(MESH)
    X = np.asarray(phantom.points)
    surface = np.unique(boundary_triangles(phantom))
    held = surface[X[surface, 2] < 0]
    meshes, seen = [lj.tet_mesh(X, phantom.tetrahedra, {"held": held})], np.setdiff1d(surface, held)
    for _ in range(levels):
        n = meshes[-1].number_of_nodes
        points, tets, edges = refined(np.asarray(meshes[-1].points), np.asarray(meshes[-1].tetrahedra))
        between = n + np.flatnonzero(np.isin(edges, held).all(axis=1))
        held = np.intersect1d(np.unique(boundary_triangles(lj.tet_mesh(points, tets))), np.r_[held, between])
        meshes.append(lj.tet_mesh(points, tets, {"held": held}))
    return meshes, seen


def hung(mesh: lj.TetMesh, gravity: list, mu: np.ndarray | float) -> lj.Scene:
    """The liver under gravity in one direction; linear elements with volume changes averaged at the nodes."""
    volumetric = "nodal" if mesh.order == 1 else "element"
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=jnp.asarray(mu), bulk=jnp.asarray(2200.0)),
        body=lj.Body(density=1060.0, gravity=jnp.array(gravity)),
        fixed=(lj.Fixed(nodes=mesh.node_sets["held"]),),
        solve=lj.Solve(volumetric=volumetric),
    )


def truth(mesh: lj.TetMesh) -> np.ndarray:
    """Return the true shear modulus of every element (E,), or at every integration point (4, E) of quadratic
    elements.
    """
    corners = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)]
    points = corners.mean(axis=1) if mesh.order == 1 else np.einsum("kq,eki->qei", basis(mesh.order).L, corners)
    return np.where(np.linalg.norm(points - CENTRE, axis=-1) < RADIUS, STIFFER * MU, MU)


def displaced(scene: lj.Scene, nodes: np.ndarray) -> np.ndarray:
    """Return the displacements (n, 3) [m] of some nodes."""
    return np.asarray(lj.simulate(scene).check().positions[-1] - scene.mesh.points)[nodes]


def problem_of(mesh: lj.TetMesh, seen: np.ndarray, u: list, sd: list, noise: float, seed: int) -> scene_numbers.Problem:
    """Return what a user has: scenes and CSV files. Fits begin at 1.3 times the true background."""
    rng, X = np.random.default_rng(seed), np.asarray(mesh.points)
    made, data = [], []
    for gravity, one, model in zip(GRAVITY, u, sd, strict=True):
        size = noise * np.linalg.norm(one, axis=1).max()
        rows = np.c_[X[seen], one + size * rng.normal(size=one.shape)]
        scene = hung(mesh, gravity, 1.3 * MU)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "displacements.csv"
            np.savetxt(file, rows, delimiter=",", header="x,y,z,ux,uy,uz", comments="")
            data.append(read_displacements(file, scene, noise=float(np.hypot(size, model))))
        made.append(scene)
    return scene_numbers.Problem(tuple(made), tuple(data))


def mapped(problem: scene_numbers.Problem, noise: float, length: float, iterations: int) -> tuple[dict, field.Field]:
    """Estimate the map and return its results."""
    mesh = problem.scenes[0].mesh
    found = field.estimate(problem, "law.mu", length=length, max_iterations=iterations)
    volumes, log_truth = np.asarray(mesh.volumes), np.log(truth(mesh))

    def off(modulus):
        return float(np.sqrt(np.sum(volumes * (np.log(modulus) - log_truth) ** 2) / volumes.sum()))

    centre = inclusion.start_from(problem, found)[:3]
    return {
        "noise_of_largest": noise,
        "length_m": length,
        "prior_deviation": found.deviation,
        "chi2_per_component": found.chi2 / found.components,
        "history": found.history,
        "seconds": found.seconds,
        "rms_error_of_log_modulus": off(found.modulus),
        "rms_error_of_a_uniform_body": off(MU),
        "centre_off_mm": 1e3 * float(np.linalg.norm(centre - CENTRE)),
        "largest_modulus_over_truth": float(found.modulus.max() / (STIFFER * MU)),
        "directions_known": int(np.sum(found.eigenvalues > 1)),
    }, found


def sphere_in(problem: scene_numbers.Problem, start: np.ndarray) -> dict:
    """Estimate the sphere and return its results."""
    found = inclusion.estimate(problem, "law.mu", start)
    values = dict(zip(found.names, found.values.tolist(), strict=True))
    return {
        "values": values,
        "standard_errors": dict(zip(found.names, found.standard_errors.tolist(), strict=True)),
        "centre_off_mm": 1e3 * float(np.linalg.norm(found.values[:3] - CENTRE)),
        "radius_off": values["radius"] / RADIUS - 1,
        "modulus_off": values["inclusion"] / (STIFFER * MU) - 1,
        "background_off": values["background"] / MU - 1,
        "mesh_bias": None if found.mesh_bias is None else dict(zip(found.names, found.mesh_bias.tolist(), strict=True)),
        "chi2_per_component": found.chi2 / found.components,
        "iterations": found.iterations,
        "converged": found.converged,
        "seconds": found.seconds,
    }


def missed(mesh: lj.TetMesh, seen: np.ndarray, uniform: list) -> list[float]:
    """Return the root mean square difference [m] of a mesh from the finest one, for the uniform body under each
    load.
    """
    apart = [displaced(hung(mesh, g, MU), seen) - u for g, u in zip(GRAVITY, uniform, strict=True)]
    return [float(np.sqrt(np.mean(a**2))) for a in apart]


def main(quick: bool) -> None:
    """Run all cases, and write table and pictures."""
    begin = time.perf_counter()
    (coarse, fine), seen = bodies(1)
    truest, quadratic = lj.quadratic(fine), lj.quadratic(coarse)
    u = [displaced(hung(truest, g, truth(truest)), seen) for g in GRAVITY]
    uniform = [displaced(hung(truest, g, MU), seen) for g in GRAVITY]
    off = {"linear": missed(coarse, seen, uniform), "quadratic": missed(quadratic, seen, uniform)}
    print(f"data in {time.perf_counter() - begin:.0f} s; the meshes miss [m]: {off}", flush=True)
    cases = [(0.01, 0.03)] if quick else [(0.0, 0.03), (0.01, 0.03), (0.05, 0.03), (0.01, 0.015), (0.01, 0.06)]
    rows, found = [], {}
    for k, (noise, length) in enumerate(cases):
        problem = problem_of(coarse, seen, u, off["linear"], noise, seed=k)
        row, found[noise, length] = mapped(problem, noise, length, 5 if quick else 60)
        print({key: value for key, value in row.items() if key != "history"}, *row["history"], sep="\n  ", flush=True)
        if length == 0.03 and not quick:
            start = inclusion.start_from(problem, found[noise, length])
            row["sphere"] = sphere_in(problem_of(quadratic, seen, u, off["quadratic"], noise, seed=k), start)
            print("   sphere", row["sphere"], flush=True)
        rows.append(row)
        meshes = {"map": coarse, "sphere": quadratic, "truth": truest}
        content = {
            "missed_m": off,
            "tetrahedra": {n: m.number_of_elements for n, m in meshes.items()},
            "rows": rows,
        }
        maps = {n: f for (n, length), f in found.items() if length == 0.03}
        spheres = {r["noise_of_largest"]: r["sphere"] for r in rows if "sphere" in r}
        save("lesion", content, figure(coarse, maps, spheres))


def circle(axis: plt.Axes, centre: np.ndarray, radius: float, style: str, colour: str) -> None:
    """Plot the outline of a sphere on the section through the middle of the lesion, if the sphere meets the section."""
    squared = radius**2 - (centre[2] - CENTRE[2]) ** 2
    turn = np.linspace(0, 2 * np.pi, 100)
    outline = centre[:2, None] + np.sqrt(max(squared, 0.0)) * np.array([np.cos(turn), np.sin(turn)])
    axis.plot(*(100 * outline), style, color=colour, lw=1)


def figure(mesh: lj.TetMesh, found: dict[float, field.Field], spheres: dict[float, dict]) -> plt.Figure:
    """Plot sections through the middle of the lesion: truth, maps and their uncertainty, outlines of the spheres."""
    fig, axes = plt.subplots(2, 4, figsize=(11, 3.8), layout="constrained", sharex=True, sharey=True)
    body, extent = section(mesh, np.full(mesh.number_of_nodes, MU), CENTRE, 2)
    x, y = np.meshgrid(*(np.linspace(extent[2 * k], extent[2 * k + 1], body.shape[1 - k]) / 100 for k in (0, 1)))
    inside = np.hypot(x - CENTRE[0], y - CENTRE[1]) < RADIUS
    shown = dict(origin="lower", extent=extent, vmin=0.4, vmax=STIFFER * MU / 1e3, cmap="viridis")
    picture = axes[0, 0].imshow(np.where(inside, STIFFER, 1.0) * body / 1e3, **shown)
    axes[0, 0].set(title="truth", ylabel="y [cm]", xlabel="x [cm]")
    axes[0, 0].xaxis.set_tick_params(labelbottom=True)
    axes[1, 0].axis("off")
    lines = [plt.Line2D([], [], color=c, ls=s) for c, s in (("grey", "--"), (ORANGE, "-"))]
    axes[1, 0].legend(lines, ["true outline", "outline of the fitted sphere"], loc="center", frameon=False)
    widest = max(float(f.sd.max()) for f in found.values())
    for k, (noise, f) in enumerate(found.items(), start=1):
        modulus, _ = section(mesh, 1.3 * MU * np.exp(f.log_factor), CENTRE, 2)
        axes[0, k].imshow(modulus / 1e3, **shown)
        axes[0, k].set_title(f"map, noise {100 * noise:g} %")
        sd, _ = section(mesh, f.sd, CENTRE, 2)
        spread = axes[1, k].imshow(sd, origin="lower", extent=extent, vmin=0, vmax=widest, cmap="magma")
        axes[1, k].set_xlabel("x [cm]")
        for axis in axes[:, k]:
            circle(axis, CENTRE, RADIUS, "--", "white")
        if noise in spheres:
            v = spheres[noise]["values"]
            at = np.array([v["centre.x"], v["centre.y"], v["centre.z"]])
            circle(axes[0, k], at, v["radius"], "-", ORANGE)
    for axis in axes.flat:
        axis.grid(False)
    axes[1, 1].set_ylabel("y [cm]")
    fig.colorbar(picture, ax=axes[0, :], label="shear modulus [kPa]", pad=0.01)
    fig.colorbar(spread, ax=axes[1, :], label="standard deviation\nof ln(modulus) [1]", pad=0.01)
    return fig


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
