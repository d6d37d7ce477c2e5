"""Linear, quadratic and mixed elements: error, estimated error and run time, on bodies with known solutions.

* Cook's membrane, plane strain, K/mu from 1 to 1e4: mean rise of its right edge, compared with another program
  (`experiments.sources.cooks_membrane`). In graded meshes the cells are small near the upper corner of the clamp.
* The beam of Land et al. 2015 (`known_answers`): height of its end, compared with 12,960 quadratic elements corrected
  by their own error estimate (published codes give 4.0 to 4.2 mm).
* A column of 2 x 2 x 6 cm twisted by an eighth of a turn, K/mu up to 1e5: its torque, compared with mixed elements on a
  finer mesh, corrected by their estimate. At K/mu = 1e5, elements that lock are left out.
* Linear iterations of a sheared cube on finer and finer meshes, of a porous body from no flow to fast flow, and of
  mixed elements in plates of flatter and flatter cells.
* The liver phantom at rest under 2 m/s^2: largest displacement. No mesh of the phantom is known to be converged. So the
  table shows the value of each mesh, and the correction by the error estimate.

The estimate is `simulate(…, mesh_error=True)`. Effectivity is the estimated error divided by the true error.
``python -m experiments elements`` (15 minutes) writes results/elements.json;
``python -m experiments.benchmarks.elements "Land's beam" sponge`` runs these two parts again.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.benchmarks.known_answers import land
from experiments.common import RESULTS, ROOT, either, plain_ticks, plt, save
from experiments.liver import models
from liverjax.core import status
from liverjax.core.plotting import COLOURS
from liverjax.core.struct import replace
from liverjax.physics.loads import nodal_tractions
from liverjax.scenes.enriched import enriched

RATIOS = either((1.0, 3.0, 100.0, 1e4), (100.0,))
MM = 1e-3
MU, TURN = 770.0, np.pi / 4
#: For each form: the order of the elements, and the settings of the solver.
FORMS: dict[str, tuple[int, dict]] = {
    "linear": (1, {"volumetric": "element"}),
    "linear, averaged": (1, {"volumetric": "nodal"}),
    "linear, mixed": (1, {"volumetric": "mixed"}),
    "quadratic": (2, {"volumetric": "element"}),
    "quadratic, mixed": (2, {"volumetric": "mixed"}),
    "quadratic, mixed, graded": (2, {"volumetric": "mixed"}),
}


def membrane(n: int, ratio: float, form: str) -> lj.Scene:
    """Cook's membrane of n x n cells in plane strain, with one layer of cells.

    The layer is as thick as a cell is wide, because flat cells make the linear equations ill-conditioned.
    """
    order, solve = FORMS[form]
    flat = lj.shapes.box((1.0, 1.0, 1.0), (n, n, 1))
    s, t, w = np.asarray(flat.points).T
    if form.endswith("graded"):
        s, t = s**2, 1 - (1 - t) ** 2
    points = np.stack([48 * s, 44 * s + t * (44 - 28 * s), 48 / n * w], axis=1) * MM
    mesh = lj.tet_mesh(points, flat.tetrahedra, flat.node_sets)
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    right = lj.boundary.boundary_triangles(mesh, mesh.node_sets["x_max"])
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=MU * ratio),
        fixed=(
            lj.Fixed(nodes=mesh.node_sets["x_min"]),
            lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes), axes="z"),
        ),
        traction=(lj.Traction(triangles=jnp.asarray(right), value=jnp.array([0.0, 0.01 * MU, 0.0])),),
        solve=lj.Solve(steps=2, **solve),
    )


def rise(scene: lj.Scene) -> Callable:
    """Return a function for the mean rise [m] of the right edge of the membrane, weighted by the nodal shares of the
    load.
    """
    share = nodal_tractions(scene.mesh, scene.traction)[:, 1]
    return lambda x, R: jnp.sum(share * (x[-1] - scene.mesh.points)[:, 1]) / jnp.sum(share)


def beam(n: int, form: str) -> lj.Scene:
    """Land's beam with 10 n x n x n cells."""
    scene = land(n)
    order, solve = FORMS[form]
    return replace(enriched(scene) if order == 2 else scene, solve=lj.Solve(steps=2, **solve))


def end(scene: lj.Scene) -> Callable:
    """Return a function for the height [m] of the end of the beam: of the node nearest to (10, 0.5, 1) mm at rest."""
    k = int(np.argmin(np.linalg.norm(np.asarray(scene.mesh.points) - np.array([10, 0.5, 1]) * MM, axis=1)))
    return lambda x, R: x[-1, k, 2]


def liver(form: str) -> lj.Scene:
    """The liver phantom at rest."""
    order, solve = FORMS[form]
    scene = replace(models()["hyperelastic"], solve=lj.Solve(linear_solver="cg", **solve))
    return enriched(scene) if order == 2 else scene


def largest(scene: lj.Scene) -> Callable:
    """Return a function for the largest displacement [m] of a vertex."""
    V = scene.mesh.number_of_vertices
    return lambda x, R: jnp.max(jnp.linalg.norm(x[-1, :V] - scene.mesh.points[:V], axis=1))


def column(n: int, ratio: float, form: str) -> lj.Scene:
    """A column of n x n x 3 n cells whose top is turned in five steps."""
    order, solve = FORMS[form]
    mesh = lj.shapes.box((0.02, 0.02, 0.06), (n, n, 3 * n))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    top = np.asarray(mesh.node_sets["z_max"])
    r = np.asarray(mesh.points)[top, :2] - 0.01
    turn = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
    by = np.pad(r @ turn.T - r, ((0, 0), (0, 1)))
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=MU * ratio),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(lj.Displaced(nodes=jnp.asarray(top), by=jnp.asarray(by)),),
        solve=lj.Solve(steps=5, **solve),
    )


def torque(scene: lj.Scene) -> Callable:
    """Return a function for the torque [N m] at the top."""
    top = np.asarray(scene.mesh.node_sets["z_max"])

    def of(x: jax.Array, R: jax.Array) -> jax.Array:
        arm = x[-1, top, :2] - 0.01
        return jnp.sum(arm[:, 0] * R[-1, top, 1] - arm[:, 1] * R[-1, top, 0])

    return of


def sheared(n: int, ratio: float, form: str) -> lj.Scene:
    """A cube of n^3 cells whose top is displaced sideways by a hundredth of its size, in one step."""
    order, solve = FORMS[form]
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (n, n, n))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=MU * ratio),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([1e-3, 0.0, 0.0])),),
        solve=lj.Solve(linear_solver="cg", **solve),
    )


def counted(scene: lj.Scene) -> dict[str, Any]:
    """Return the linear iterations per Newton iteration, and the run time."""
    jax.block_until_ready(lj.simulate(scene).positions)
    begin = time.perf_counter()
    result = jax.block_until_ready(lj.simulate(scene))
    s = result.statistics
    return {
        "elements": scene.mesh.number_of_elements,
        "unknowns": 3 * scene.mesh.number_of_nodes,
        "newton": int(s.iterations.sum()),
        "linear": int(s.linear_iterations.sum()),
        "run_s": time.perf_counter() - begin,
        "code": status.NAMES[int(result.status.max())],
    }


def ran(scene: lj.Scene, of: Callable) -> dict[str, Any]:
    """Return the value, its estimated mesh error, and run times. The times are those of a second run, without
    compilation.
    """
    begin = time.perf_counter()
    jax.block_until_ready(lj.simulate(scene).positions)
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    result = jax.block_until_ready(lj.simulate(scene))
    run = time.perf_counter() - begin
    jax.block_until_ready(lj.simulate(scene, mesh_error=True).positions)
    begin = time.perf_counter()
    result = jax.block_until_ready(lj.simulate(scene, mesh_error=True))
    value, change = result.mesh_error.change(of, result)
    both = time.perf_counter() - begin
    codes = np.asarray(result.status)
    print(scene.mesh.number_of_elements, float(value), float(change), run, flush=True)
    return {
        "elements": scene.mesh.number_of_elements,
        "nodes": scene.mesh.number_of_nodes,
        "value": float(value),
        "change": float(change),
        "found": bool(np.asarray(result.mesh_error.found).all()),
        "code": status.NAMES[int(codes.max())],
        "newton": int(result.statistics.iterations.sum()),
        "linear": int(result.statistics.linear_iterations.sum()),
        "run_s": run,
        "corrected_s": both,
        "first_s": first,
    }


def judged(rows: list[dict], truth: float) -> list[dict]:
    """Add the error, the error of the corrected value and the effectivity to the rows."""
    for row in rows:
        missing = truth - row["value"]
        row |= {
            "truth": truth,
            "error": -missing / truth,
            "corrected": (row["value"] + row["change"]) / truth - 1,
            "effectivity": row["change"] / missing,
        }
    return rows


def cook() -> list[dict]:
    """Cook's membrane for all K/mu."""
    rows, truths = [], json.loads((ROOT / "experiments/results/cooks_membrane.json").read_text())
    for ratio in RATIOS:
        case = []
        for form, sizes in either(
            {
                "linear": (8, 16, 32),
                "linear, averaged": (8, 16),
                "linear, mixed": (8, 16, 32),
                "quadratic": (4, 8, 16),
                "quadratic, mixed": (4, 8, 16),
                "quadratic, mixed, graded": (8, 16),
            },
            {"linear": (4,), "linear, mixed": (4,), "quadratic, mixed": (2,)},
        ).items():
            for n in sizes:
                scene = membrane(n, ratio, form)
                case.append({"form": form, "cells": n, "ratio": ratio} | ran(scene, rise(scene)))
        rows += judged(case, truths[f"{ratio:g}"]["64"])
    return rows


def land_beam() -> list[dict]:
    """Land's beam."""
    case = []
    for form, sizes in either({"linear": (2, 4, 8), "quadratic": (1, 2, 3, 4)}, {"linear": (1,)}).items():
        for n in sizes:
            scene = beam(n, form)
            case.append({"form": form, "cells": n, "ratio": None} | ran(scene, end(scene)))
    finest = beam(either(6, 1), "quadratic")
    fine = ran(finest, end(finest))
    return judged(case, fine["value"] + fine["change"])


def twisted() -> list[dict]:
    """The twisted column."""
    rows = []
    for ratio in either((1.0, 1e2, 1e5), ()):
        case = []
        plain = {"linear": (4,), "linear, averaged": (4,), "quadratic": (3,)} if ratio < 1e3 else {}
        for form, sizes in (plain | {"linear, mixed": (4, 8, 12), "quadratic, mixed": (2, 3, 4)}).items():
            for n in sizes:
                scene = column(n, ratio, form)
                case.append({"form": form, "cells": n, "ratio": ratio} | ran(scene, torque(scene)))
        finest = column(5, ratio, "quadratic, mixed")
        fine = ran(finest, torque(finest))
        rows += judged(case, fine["value"] + fine["change"])
    return rows


def phantom() -> list[dict]:
    """The liver phantom, whose exact solution is not known."""
    rows = []
    for form in either(("linear", "quadratic", "quadratic, mixed"), ()):
        scene = liver(form)
        rows.append({"form": form, "cells": None, "ratio": None} | ran(scene, largest(scene)))
    return rows


def iterations() -> list[dict]:
    """Linear iterations on finer and finer meshes."""
    counts = []
    for form, ratio in (("linear", 3.0), ("quadratic", 3.0), *(("quadratic, mixed", r) for r in (10.0, 1e4, 1e5))):
        for n in either((6, 12, 24) if form == "linear" else (6, 12, 25), (2, 3)):
            counts.append({"form": form, "ratio": ratio, "cells": n} | counted(sheared(n, ratio, form)))
            print(counts[-1], flush=True)
    return counts


def sponge() -> list[dict]:
    """Linear iterations of a saturated porous body, from no flow to fast flow."""
    rows = []
    for form in ("linear", "quadratic"):
        for n in either((8,) if form == "quadratic" else (16,), (2,)):
            for permeability in (0.0, 1e-9, 1e-7, 1e-5, 1e-3):
                scene = sheared(n, 3.0, form)
                wet = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=permeability)
                drained = replace(wet, drained=scene.mesh.node_sets["z_max"])
                solve = replace(scene.solve, dt=0.05, steps=2)
                row = counted(replace(scene, porosity=drained, solve=solve))
                rows.append({"form": form, "permeability": permeability, "cells": n} | row)
                print(rows[-1], flush=True)
    return rows


def thin_block(aspect: float, ratio: float, form: str) -> lj.Scene:
    """A plate of 6 x 6 x 6 cells, each `aspect` times as wide as thick. Its top moves by 0.2 of the thickness sideways
    and 0.1 down.
    """
    order, solve = FORMS[form]
    thick = 0.1 / aspect
    mesh = lj.shapes.box((0.1, 0.1, thick), either((6, 6, 6), (2, 2, 2)))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=MU * ratio),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=thick * jnp.array([0.2, 0.0, -0.1])),),
        solve=lj.Solve(linear_solver="cg", **solve),
    )


def thin_cells() -> list[dict]:
    """Linear iterations of mixed elements in plates of flat cells."""
    rows = []
    for form in ("linear, mixed", "quadratic, mixed"):
        for ratio in either((10.0, 1e4), (10.0,)):
            for aspect in either((1.0, 4.0, 12.0, 30.0), (4.0,)):
                rows.append({"form": form, "ratio": ratio, "aspect": aspect} | counted(thin_block(aspect, ratio, form)))
                print(rows[-1], flush=True)
    return rows


BODIES: dict[str, Callable[[], list[dict]]] = {
    "Cook's membrane": cook,
    "Land's beam": land_beam,
    "twisted column": twisted,
    "liver phantom": phantom,
}
COUNTS: dict[str, Callable[[], list[dict]]] = {"iterations": iterations, "sponge": sponge, "flat cells": thin_cells}


def main(wanted: list[str]) -> None:
    """Run all parts, or only the named ones. The stored results of the other parts stay."""
    file = RESULTS / "elements.json"
    kept = json.loads(file.read_text()) if wanted and file.is_file() else {"rows": []}
    rows = {body: [r for r in kept["rows"] if r["body"] == body] for body in BODIES}
    counts = {name: kept[name] for name in COUNTS if name in kept}
    for name in wanted or [*BODIES, *COUNTS]:
        if name in COUNTS:
            counts[name] = COUNTS[name]()
        else:
            rows[name] = [{"body": name} | row for row in BODIES[name]()]
        every = [row for body in rows.values() for row in body]
        save("elements", {"rows": every} | counts, _figure(every))


def _figure(rows: list[dict]) -> plt.Figure:
    """Plot error against run time for the bodies with a known solution."""
    cases = [(b, r) for b, r in dict.fromkeys((row["body"], row["ratio"]) for row in rows if "error" in row)]
    lines = -(-len(cases) // 4)
    figure, all_axes = plt.subplots(lines, 4, figsize=(12.4, 3.2 * lines), squeeze=False, layout="constrained")
    for axes in all_axes.ravel()[len(cases) :]:
        axes.set_visible(False)
    for axes, (body, ratio) in zip(all_axes.ravel(), cases, strict=False):
        for colour, form in zip(COLOURS, FORMS, strict=False):
            own = [r for r in rows if (r["body"], r["ratio"], r["form"]) == (body, ratio, form)]
            if own:
                seconds = [r["run_s"] for r in own]
                axes.loglog(seconds, [100 * abs(r["error"]) for r in own], "o-", color=colour, label=form)
                both = [r for r in own if "corrected_s" in r and r["found"]]
                seconds = [r["corrected_s"] for r in both]
                axes.loglog(seconds, [100 * abs(r["corrected"]) for r in both], "x:", color=colour)
        axes.set_title(body + (f", K/mu = {ratio:g}" if ratio else ""))
        axes.set_xlabel("run time [s]")
        plain_ticks(axes.yaxis)
    for line in all_axes:
        line[0].set_ylabel("error [%] (crosses: corrected)")
    figure.legend(*all_axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=len(FORMS))
    return figure


if __name__ == "__main__":
    main([a for a in sys.argv[1:] if not a.startswith("-")])
