"""Locking and its remedy: error and iterations against K/mu, with volume changes per element or averaged at the nodes.

Two bodies are compared with quadratic elements with pressure unknowns, on a finer mesh: Cook's membrane (plane strain,
mean rise of the right edge in two load steps) and a column twisted by an eighth of a turn in five steps (torque). The
equations are solved by a factorisation and by conjugate gradients; the finest meshes also run in float32.
``python -m experiments stability_bulk`` (5 minutes) writes results/stability_bulk.json.
"""

import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liverjax as lj
from experiments.common import either, plain_ticks, save
from liverjax.core import status
from liverjax.core.plotting import COLOURS
from liverjax.mesh import shapes
from liverjax.physics import boundary
from liverjax.tensors.matrices import deformation_gradient, determinant

MU = 770.0
RATIOS = either((1.0, 10.0, 100.0, 1e3, 1e4, 1e5), (1e3,))
SINGLE = {"precision": "float32", "tolerance": 1e-4}
#: Of the reference. The error of its mesh is below 1 % (`experiments.benchmarks.elements`).
REFERENCE = {"order": 2, "volumetric": "mixed"}
COOK, FINEST, COLUMN, TURN = either((4, 8, 16), (2, 4, 8)), either(24, 8), (2, 3), np.pi / 4


def membrane(n: int, ratio: float, order: int = 1, **solve) -> tuple[lj.Scene, np.ndarray]:
    """Return Cook's membrane of n x n cells, 48 mm wide, and the nodes of its right edge."""
    flat = shapes.box((1.0, 1.0, 1.0), (n, n, 1))
    s, t, w = np.asarray(flat.points).T
    points = np.stack([48 * s, 44 * s + t * (44 - 28 * s), w], axis=1) * 1e-3
    mesh = lj.tet_mesh(points, flat.tetrahedra, flat.node_sets)
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    right = boundary.boundary_triangles(mesh, mesh.node_sets["x_max"])
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=MU * ratio, volumetric="simo"),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]), lj.Fixed(nodes=np.arange(mesh.number_of_nodes), axes="z")),
        traction=(lj.Traction(triangles=jnp.asarray(right), value=jnp.array([0.0, 0.01 * MU, 0.0])),),
        solve=lj.Solve(steps=2, **solve),
    )
    return scene, np.asarray(mesh.node_sets["x_max"])


def rise(scene: lj.Scene, nodes: np.ndarray, result: lj.Result) -> float:
    """Return the mean rise of the right edge [m]."""
    return float(np.mean(np.asarray(result.positions[-1] - scene.mesh.points)[nodes, 1]))


def column(n: int, ratio: float, order: int = 1, **solve) -> tuple[lj.Scene, np.ndarray]:
    """Return a column of n x n x 3 n cells whose top is turned in five steps, and the nodes of its top."""
    mesh = shapes.box((0.02, 0.02, 0.06), (n, n, 3 * n))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    points = np.asarray(mesh.points)
    bottom, top = (np.flatnonzero(np.isclose(points[:, 2], z)) for z in (0.0, 0.06))
    r = points[top, :2] - 0.01
    turned = np.stack([r @ (np.cos(TURN), -np.sin(TURN)), r @ (np.sin(TURN), np.cos(TURN)), 0 * r[:, 0]], axis=1)
    by = turned - np.pad(r, ((0, 0), (0, 1)))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=MU * ratio, volumetric="simo"),
        fixed=(lj.Fixed(nodes=bottom),),
        displaced=(lj.Displaced(nodes=top, by=jnp.asarray(by)),),
        solve=lj.Solve(steps=5, **solve),
    )
    return scene, top


def torque(scene: lj.Scene, nodes: np.ndarray, result: lj.Result) -> float:
    """Return the torque [N m] at the top."""
    arm = np.asarray(result.positions[-1])[nodes] - [0.01, 0.01, 0.06]
    force = np.asarray(result.reactions[-1])[nodes]
    return float(np.sum(arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]))


def ran(made: tuple[lj.Scene, np.ndarray], measure) -> dict:
    """Run one case. Return its result and cost."""
    scene, nodes = made
    begin = time.perf_counter()
    program = jax.jit(lj.simulate).lower(scene).compile()
    compiled = time.perf_counter()
    result = jax.block_until_ready(program(scene))
    seconds, s = time.perf_counter() - compiled, result.statistics
    J = np.asarray(determinant(deformation_gradient(scene.mesh, jnp.asarray(result.positions[-1], float))))
    codes = np.asarray(result.status)
    return {
        "elements": scene.mesh.number_of_elements,
        "value": measure(scene, nodes, result),
        "code": status.NAMES[int(codes.max())],
        "newton": int(s.iterations.sum()),
        "linear": int(s.linear_iterations.sum()),
        "residual": float(s.residual.max()) if np.isfinite(s.residual).all() else None,
        "J": [float(J.min()), float(J.max())],
        "run_s": seconds,
        "compile_s": compiled - begin,
    }


def cases(sizes: tuple[int, ...], both: bool) -> list[tuple[int, dict]]:
    """Return cells and settings for the runs of a body. With `both`, the second mesh is also solved by conjugate
    gradients.
    """
    chosen = []
    for n in sizes:
        for volumetric in ("element", "nodal"):
            direct = {"volumetric": volumetric, "linear_solver": "direct"}
            chosen.append((n, direct))
            if both and n == sizes[1]:
                chosen.append((n, direct | {"linear_solver": "cg"}))
            if n == sizes[-1]:
                chosen.append((n, direct | SINGLE))
    return chosen


def main() -> None:
    """Run both bodies with both volume options and every ratio."""
    rows = []
    bodies = (("Cook's membrane", membrane, rise, COOK, FINEST), ("twisted column", column, torque, COLUMN, 4))
    for ratio in RATIOS:
        for body, make, measure, sizes, finest in bodies:
            fine = ran(make(finest, ratio, **REFERENCE), measure)["value"]
            for n, chosen in cases(sizes, both=body == bodies[0][0]):
                row = ran(make(n, ratio, **chosen), measure)
                keys = {"body": body, "cells": n, "ratio": ratio, "precision": "float64"} | chosen
                rows.append(keys | {"error": row["value"] / fine - 1} | row)
                print(rows[-1], flush=True)
        save("stability_bulk", {"rows": rows})
    save("stability_bulk", {"rows": rows}, _figure(rows))


def _pick(rows: list[dict], **of) -> list[dict]:
    """Return the converged rows in float64 for a body, mesh, volume option and solver."""
    of |= {"precision": "float64", "code": "converged"}
    return [r for r in rows if all(r[k] == v for k, v in of.items())]


def _figure(rows: list[dict]) -> plt.Figure:
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.1), layout="constrained")
    bodies = (("Cook's membrane", COOK), ("twisted column", COLUMN))
    for axis, (body, sizes) in zip(axes, bodies, strict=False):
        for n, colour in zip(sizes, COLOURS, strict=False):
            for volumetric, style in (("element", "--"), ("nodal", "-")):
                mine = _pick(rows, body=body, cells=n, volumetric=volumetric, linear_solver="direct")
                label = f"{n} cells, {volumetric}"
                y = [100 * abs(r["error"]) for r in mine]
                axis.loglog([r["ratio"] for r in mine], y, style, marker="o", ms=3, color=colour, label=label)
        axis.set(xlabel="K / mu", ylabel="error [%]", title=body)
        plain_ticks(axis.yaxis)
        axis.set_ylim(bottom=0.25 * axis.get_ylim()[0])  # space for the legend
        axis.legend(fontsize=6, ncols=2, loc="lower center")
    for volumetric, style in (("element", "--"), ("nodal", "-")):
        for linear, colour in (("direct", COLOURS[0]), ("cg", COLOURS[1])):
            mine = _pick(rows, body=bodies[0][0], cells=COOK[1], volumetric=volumetric, linear_solver=linear)
            y = [r["run_s"] for r in mine]
            axes[2].loglog(
                [r["ratio"] for r in mine], y, style, marker="o", ms=3, color=colour, label=f"{volumetric}, {linear}"
            )
    axes[2].set(xlabel="K / mu", ylabel="run time [s]", title=f"Cook's membrane, {COOK[1]} cells")
    axes[2].legend(fontsize=6)
    return figure


if __name__ == "__main__":
    main()
