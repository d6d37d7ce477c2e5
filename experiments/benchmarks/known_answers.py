"""Three static problems with known solutions, on finer and finer meshes: error against run time.

* Cook's membrane (Miehe 1994): plane strain, dead load of 1 N; the middle of its right edge rises by 14.74 mm.
* The beam of Land et al. 2015 (problem 1): Guccione's law, and a pressure of 4 Pa that follows the lower face. The
  codes compared there find the end at a height of 4.0-4.2 mm for an incompressible beam. Here the bulk modulus is 50
  kPa.
* The silicone cantilever of Mazier et al. 2021 under its own weight: position of the tip, compared with their MJED
  program on meshes of similar size. (Both use linear tetrahedra, which are too stiff on coarse meshes.) Needs the
  optional mesher: pip install '.[mesher]'. Quadratic mixed elements with an estimate of the mesh error show the
  converged value of the model; the measured value is 116 mm.

    python -m experiments known_answers [--quick]

``python -m experiments.benchmarks.known_answers cantilever`` runs the quadratic cantilever again.
"""

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import RESULTS, plain_ticks, plt, save
from liverjax.core import status
from liverjax.core.plotting import BLUE, COLOURS, GREEN, GREY, ORANGE
from liverjax.physics import boundary

MM = 1e-3


def cook(n: int) -> lj.Scene:
    """Cook's membrane of n x n x 1 cells, 48 mm long, 44 mm high at its left edge and 16 mm high at its right edge."""
    flat = lj.shapes.box((1.0, 1.0, 1.0), (n, n, 1))
    s, t, w = np.asarray(flat.points).T
    points = np.stack([48 * s, 44 * s + t * (44 - 28 * s), w], axis=1) * MM
    mesh = lj.tet_mesh(points, flat.tetrahedra, flat.node_sets)
    mu, nu = 422.5e3, 0.3
    everywhere = jnp.arange(mesh.number_of_nodes)
    right = boundary.boundary_triangles(mesh, mesh.node_sets["x_max"])
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=mu, bulk=2 * mu * (1 + nu) / (3 * (1 - 2 * nu)), volumetric="simo"),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]), lj.Fixed(nodes=everywhere, axes="z")),
        traction=(lj.Traction(triangles=jnp.asarray(right), value=jnp.array([0.0, 1 / (16 * MM * MM), 0.0])),),
    )


def cook_rise(scene: lj.Scene, x: np.ndarray) -> float:
    """Return the vertical displacement [mm] of the middle of the right edge."""
    X = np.asarray(scene.mesh.points)
    k = np.argmin(np.linalg.norm(X - np.array([48, 52, 0]) * MM, axis=1))
    return float((x - X)[k, 1] / MM)


def land(n: int) -> lj.Scene:
    """Land's beam of 10 x 1 x 1 mm with 10 n x n x n cells, fixed at x = 0."""
    mesh = lj.shapes.box((10 * MM, MM, MM), (10 * n, n, n))
    below = boundary.boundary_triangles(mesh, mesh.node_sets["z_min"])
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.Costa(c=2e3, b_ff=8.0, b_ss=2.0, b_nn=2.0, b_fs=4.0, b_fn=4.0, b_sn=2.0, bulk=5e4),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        traction=(lj.Traction(triangles=jnp.asarray(below), pressure=4.0),),
    )


def land_end(scene: lj.Scene, x: np.ndarray) -> float:
    """Return the height [mm] of the beam's end, at the middle of the upper face: the point (10, 0.5, 1) mm at rest."""
    X = np.asarray(scene.mesh.points)
    k = np.argmin(np.linalg.norm(X - np.array([10, 0.5, 1]) * MM, axis=1))
    return float(x[k, 2] / MM)


def rod(cell: float, radius: float = 4.25, length: float = 182.0) -> lj.TetMesh:
    """Return a mesh of Delaunay tetrahedra of about `cell` mm in a polygonal rod [mm], made by the optional mesher."""
    import tetgen

    n, layers = max(8, round(2 * np.pi * radius / cell)), round(length / cell)
    angle = 2 * np.pi * np.arange(n) / n
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [np.c_[ring, np.full(n, z)] for z in np.linspace(0, length, layers + 1)]
    points = np.vstack([*rings, [[0, 0, 0]], [[0, 0, length]]])
    low, high, i, j = len(points) - 2, len(points) - 1, np.arange(n), (np.arange(n) + 1) % n
    sides = [np.c_[k * n + i, k * n + j, (k + 1) * n + j] for k in range(layers)]
    sides += [np.c_[k * n + i, (k + 1) * n + j, (k + 1) * n + i] for k in range(layers)]
    ends = [np.c_[np.full(n, low), j, i], np.c_[np.full(n, high), layers * n + i, layers * n + j]]
    mesher = tetgen.TetGen(points, np.vstack(sides + ends))
    mesher.tetrahedralize(order=1, minratio=1.4, mindihedral=15, maxvolume=0.25 * cell**3, nobisect=True)
    points, tets = np.asarray(mesher.node), np.asarray(mesher.elem)[:, :4]
    flipped = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) < 0
    tets[flipped] = tets[flipped][:, [0, 2, 1, 3]]
    z = points[:, 2]
    sets = {"bottom": np.flatnonzero(z < 1e-6), "top": np.flatnonzero(z > length - 1e-6)}
    return lj.tet_mesh(points * MM, tets, sets)


def cantilever(cell: float, volumetric: str = "element", order: int = 1) -> lj.Scene:
    """A rod of 4.25 mm radius and 182 mm length along z, clamped at z = 0, with its weight along -y.

    Quadratic elements are arranged in rings and layers. The cross-section is a polygon with the area of the circle.
    """
    rings = lj.shapes.cylinder(4.25 * MM, 182 * MM, cell * MM, match_area=True) if order == 2 else None
    mesh = rod(cell) if rings is None else lj.quadratic(rings)
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.MooneyRivlin(c10=151065.46, c01=101709.668, bulk=1e7, volumetric="log"),
        body=lj.Body(density=963.0, gravity=jnp.array([0.0, -9.81, 0.0])),
        fixed=(lj.Fixed(nodes=mesh.node_sets["bottom"]),),
        solve=lj.Solve(steps=4, volumetric=volumetric),
    )


def tip(scene: lj.Scene, x: np.ndarray) -> list[float]:
    """Return the mean position (y, z) [m] of the free end."""
    return np.asarray(x)[np.asarray(scene.mesh.node_sets["top"])].mean(axis=0)[1:].tolist()


def solved(scene: lj.Scene) -> tuple[np.ndarray, dict]:
    """Return the last positions, and run time, iterations and residual of the run."""
    begin = time.perf_counter()
    program = jax.jit(lj.simulate).lower(scene).compile()
    compiled = time.perf_counter()
    result = jax.block_until_ready(program(scene))
    s = result.statistics
    row = {
        "nodes": scene.mesh.number_of_nodes,
        "tetrahedra": scene.mesh.number_of_elements,
        "run_s": time.perf_counter() - compiled,
        "compile_s": compiled - begin,
        "newton": int(s.iterations.sum()),
        "linear": int(s.linear_iterations.sum()),
        "cuts": int(s.cuts.sum()),
        "residual": float(np.asarray(s.residual).max()),
        "converged": bool((np.asarray(result.status) == status.CONVERGED).all()),
    }
    return np.asarray(result.positions[-1]), row


def corrected_cantilevers(cells: tuple[float, ...]) -> list[dict]:
    """Return the tip of the cantilever with quadratic mixed elements, and the correction of its height by the error
    estimate.
    """
    rows = []
    for cell in cells:
        scene = cantilever(cell, "mixed", order=2)
        x, row = solved(scene)
        top = np.asarray(scene.mesh.node_sets["top"])
        begin = time.perf_counter()
        result = lj.simulate(scene, mesh_error=True)
        _, change = result.mesh_error.change(lambda x, R, top=top: x[-1, top, 1].mean(), result)
        row |= {"cell_mm": cell, "tip_m": tip(scene, x), "change_m": float(change)}
        row |= {"estimate_first_s": time.perf_counter() - begin, "found": bool(result.mesh_error.found.all())}
        rows.append(row)
        print("cantilever, quadratic", row, flush=True)
    return rows


#: Number of tetrahedra: tip (y, z) [m] of Mazier et al. 2021 (the source named in `mathematics.md`).
MAZIER = {7675: (-0.1039, 0.1438), 12724: (-0.1067, 0.1415), 23665: (-0.1116, 0.1369), 52979: (-0.1141, 0.1344)}


def main(quick: bool, wanted: list[str]) -> None:
    """Compute three tables and a figure."""
    quadratic = (6.0,) if quick else (4.25, 2.125)
    if wanted == ["cantilever"]:
        kept = json.loads((RESULTS / "known_answers.json").read_text())
        out = kept | {"cantilever, quadratic": corrected_cantilevers(quadratic)}
        save("known_answers", out, figure(out))
        return
    out: dict[str, list] = {"cook": [], "land": [], "cantilever": []}
    for n in (4, 8) if quick else (4, 8, 16, 32, 64):
        scene = cook(n)
        x, row = solved(scene)
        out["cook"].append(row | {"cells": n, "rise_mm": cook_rise(scene, x)})
        print("cook", out["cook"][-1], flush=True)
    for n in (1,) if quick else (2, 4, 6, 8, 10):
        scene = land(n)
        x, row = solved(scene)
        out["land"].append(row | {"cells": n, "end_mm": land_end(scene, x)})
        print("land", out["land"][-1], flush=True)
    rods = [(cell, "element") for cell in (2.19, 1.86, 1.52, 1.165)] + [(cell, "nodal") for cell in (2.19, 1.86)]
    for cell, volumetric in [(3.5, "element")] if quick else rods:
        scene = cantilever(cell, volumetric)
        x, row = solved(scene)
        y = theirs(row["tetrahedra"])
        row |= {"cell_mm": cell, "volumetric": volumetric, "tip_m": tip(scene, x), "mazier_y_m": y}
        out["cantilever"].append(row)
        print("cantilever", out["cantilever"][-1], flush=True)
    out["cantilever, quadratic"] = corrected_cantilevers(quadratic)
    save("known_answers", out | {"mazier": {str(k): v for k, v in MAZIER.items()}}, figure(out))


def theirs(tetrahedra: int) -> float | None:
    """Return the height [m] of the end that Mazier et al. find with this number of tetrahedra, by interpolation.

    Returns None outside the range of their meshes.
    """
    y = np.interp(np.log(tetrahedra), np.log(list(MAZIER)), [y for y, _ in MAZIER.values()], left=np.nan, right=np.nan)
    return float(y) if np.isfinite(y) else None


def figure(out: dict) -> plt.Figure:
    """Plot the results against the size of the mesh, and the error of Cook's rise against run time."""
    fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
    cook_rows = out["cook"]
    error = [abs(r["rise_mm"] / 14.74 - 1) * 100 for r in cook_rows]
    axes[0].loglog([r["run_s"] for r in cook_rows], error, "o-", color=BLUE)
    for r, e in zip(cook_rows, error, strict=True):
        axes[0].annotate(f"{r['tetrahedra']:,}", (r["run_s"], e), fontsize=7, xytext=(3, 3), textcoords="offset points")
    axes[0].set(title="Cook's membrane (tetrahedra beside)", xlabel="run time [s]", ylabel="error of the rise [%]")
    plain_ticks(axes[0].yaxis)
    axes[1].axhspan(4.0, 4.2, color=GREEN, alpha=0.25, label="codes of Land et al.")
    axes[1].plot([r["run_s"] for r in out["land"]], [r["end_mm"] for r in out["land"]], "o-", color=BLUE)
    for r in out["land"]:
        axes[1].annotate(f"{r['tetrahedra']:,}", (r["run_s"], r["end_mm"]), fontsize=7)
    axes[1].set(title="Land's beam", xlabel="run time [s]", ylabel="end height [mm]", xscale="log")
    axes[1].legend()
    axes[2].plot(list(MAZIER), [-y * 1e3 for y, _ in MAZIER.values()], "s--", color=ORANGE, label="Mazier et al. 2021")
    for volumetric, label, colour in (("element", "here", BLUE), ("nodal", "here, volumes at the nodes", GREEN)):
        rows = [r for r in out["cantilever"] if r["volumetric"] == volumetric]
        heights = [-r["tip_m"][0] * 1e3 for r in rows]
        axes[2].plot([r["tetrahedra"] for r in rows], heights, "o-", color=colour, label=label)
    for part, style, label in ((0.0, "^-", "quadratic, mixed"), (1.0, "^:", "the same, corrected")):
        rows = out["cantilever, quadratic"]
        heights = [-(r["tip_m"][0] + part * r["change_m"]) * 1e3 for r in rows]
        axes[2].plot([r["tetrahedra"] for r in rows], heights, style, color=COLOURS[3], label=label)
    axes[2].axhline(116, color=GREY, ls=":", lw=1, label="measured")
    for r in out["cantilever"]:
        axes[2].annotate(f"{r['run_s']:.0f} s", (r["tetrahedra"], -r["tip_m"][0] * 1e3), fontsize=7)
    axes[2].set(
        title="Silicone cantilever", xlabel="tetrahedra", ylabel="tip below clamp [mm]", xscale="log", ylim=(65, 122)
    )
    axes[2].set_xticks([2e3, 5e3, 1e4, 2e4, 5e4], ["2,000", "5,000", "10,000", "20,000", "50,000"])
    axes[2].minorticks_off()
    axes[2].legend(fontsize=7, loc="lower right")
    return fig


if __name__ == "__main__":
    main("--quick" in sys.argv[1:], [a for a in sys.argv[1:] if not a.startswith("-")])
