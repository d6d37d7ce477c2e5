"""Does porosity prevent large deformations (chapter, section 5.4, iii)? Fig. 6's loading with and without porosity.

The liver phantom under a fifth of gravity: hyperelastic, viscous, porohyperelastic and complete. Then K0, K_lim and
permeability of the porous body, the law's own bulk (`keep_bulk`), the rate of loading and the mesh are varied. Every
run is compared with the same body without porosity. The claim holds if the ratio of their largest displacements is
below 1. All numbers are those of linear tetrahedra, which are too stiff in bending: compare them with each other, not
with a liver.

    python -m experiments porosity_claim
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, plt, save
from experiments.identification.lesion import refined
from experiments.liver import models, with_solve
from liverjax.core import status
from liverjax.core.plotting import BLUE, COLOURS, ORANGE
from liverjax.core.struct import replace
from liverjax.simulation import equations, run
from liverjax.tensors.matrices import deformation_gradient, determinant

SECONDS, DT = either(1.8, 0.2), either(0.02, 0.05)
#: Parameters of the complete model that are varied, one at a time. K_lim must stay above K0.
VARIED = {
    "bulk": either((200.0, 800.0, 1600.0, 2100.0), (1600.0,)),
    "limit_bulk": either((600.0, 8800.0, 35200.0), (35200.0,)),
    "permeability": either((0.0, 2e-8, 2e-7, 2e-6, 2e-4), (0.0,)),
}
RAMPS = either((0.3, 1.0, 3.0), (0.3,))
#: The first peak of the viscous and of the complete body is before this time [s], so the finer mesh is run up to it
#: only.
FIRST_PEAK = either(0.8, 0.1)


@jax.jit
def one_step(scene: lj.Scene, state: Any, k: Any, part: Any) -> tuple:
    """Return the state after step k with a fraction of gravity, the largest displacement, the smallest J and the
    status.
    """
    now = replace(scene, body=replace(scene.body, gravity=part * scene.body.gravity))
    result, state = run.simulate_part(now, state, k, 1)
    moved = jnp.linalg.norm(result.positions[0] - scene.mesh.points, axis=-1).max()
    return state, moved, determinant(deformation_gradient(scene.mesh, result.positions[0])).min(), result.status[0]


def path(scene: lj.Scene, ramp: float = 0.0, seconds: float = SECONDS) -> dict[str, Any]:
    """Return the largest displacement over time. Gravity acts at once, or grows linearly over `ramp` seconds."""
    scene = run.prepared(with_solve(scene, 1e4, DT, integrator="newmark"))
    begin = scene if ramp == 0 else lj.with_parameters(scene, {"body.gravity": jnp.zeros(3)})
    state, moved, least, codes = equations.initial_state(begin), [], [], []
    for k in range(1, round((seconds + ramp) / DT) + 1):
        state, u, J, code = one_step(scene, state, float(k), 1.0 if ramp == 0 else min(k * DT / ramp, 1.0))
        moved.append(float(u))
        least.append(float(J))
        codes.append(int(code))
    return {
        "largest_m": max(moved),
        "peak_s": DT * (1 + int(np.argmax(moved))),
        "last_m": moved[-1],
        "least_J": min(least),
        "converged": all(c == status.CONVERGED for c in codes),
        "moved_m": moved,
    }


def finer(scene: lj.Scene) -> lj.Scene:
    """Return the scene with every tetrahedron cut into eight. New nodes between fixed nodes are fixed too."""
    n = scene.mesh.number_of_nodes
    points, tets, edges = refined(np.asarray(scene.mesh.points), np.asarray(scene.mesh.tetrahedra))
    held = [np.asarray(f.nodes) for f in scene.fixed]
    more = [np.r_[h, n + np.flatnonzero(np.isin(edges, h).all(axis=1))] for h in held]
    return replace(scene, mesh=lj.tet_mesh(points, tets), fixed=tuple(lj.Fixed(nodes=h) for h in more))


def beside(what: str, value: Any, complete: dict, without: dict) -> dict[str, Any]:
    """Return a row with a run with porosity, the run without it, and the ratio of their largest displacements."""
    row = {k: v for k, v in complete.items() if k != "moved_m"}
    row |= {"without_m": without["largest_m"], "ratio": complete["largest_m"] / without["largest_m"]}
    row["converged"] = complete["converged"] and without["converged"]
    print(what, value, {k: v if isinstance(v, bool) else round(v, 4) for k, v in row.items()}, flush=True)
    return {"varied": what, "value": value} | row


def variations(scenes: dict[str, lj.Scene], viscous: dict) -> list[dict]:
    """Vary parameters of the complete model. Each run is compared with the viscous model under the same load."""
    complete, rows = scenes["complete"], []
    for name, values in VARIED.items():
        for value in values:
            found = path(lj.with_parameters(complete, {f"porosity.{name}": value}))
            rows.append(beside(name, value, found, viscous))
    kept = replace(complete, porosity=replace(complete.porosity, keep_bulk=True))
    rows.append(beside("keep_bulk", True, path(kept), viscous))
    soft = lj.with_parameters(scenes["viscous"], {"law.bulk": complete.porosity.bulk})
    rows.append(beside("law's bulk of the rival", complete.porosity.bulk, path(complete), path(soft)))
    for ramp in RAMPS:
        rows.append(beside("ramp_s", ramp, path(complete, ramp), path(scenes["viscous"], ramp)))
    fine = [path(finer(scenes[name]), seconds=FIRST_PEAK) for name in ("complete", "viscous")]
    rows.append(beside("tetrahedra", 8 * complete.mesh.number_of_elements, *fine))
    return rows


def main() -> None:
    """Run four models and the variations, and plot a figure."""
    scenes = models()
    scenes["porohyperelastic"] = replace(scenes["complete"], viscosity=None)
    found = {name: path(scene) for name, scene in scenes.items()}
    porosity = scenes["complete"].porosity
    table_2 = {name: float(getattr(porosity, name)) for name in VARIED}
    rows = [
        beside("Table 2, elastic", None, found["porohyperelastic"], found["hyperelastic"]),
        beside("Table 2", None, found["complete"], found["viscous"]),
        *variations(scenes, found["viscous"]),
    ]
    content = {
        "tetrahedra": scenes["complete"].mesh.number_of_elements,
        "law_bulk_Pa": float(scenes["complete"].law.bulk),
        "table_2": table_2,
        "dt_s": DT,
        "seconds": SECONDS,
        "models": found,
        "rows": rows,
    }
    save("porosity_claim", content, draw(found, rows))


def draw(found: dict, rows: list) -> plt.Figure:
    """Plot the largest displacement over time, and the ratio of displacements with and without porosity for
    every row.
    """
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained", width_ratios=(1, 1.2))
    for (name, r), colour in zip(found.items(), COLOURS, strict=False):
        moved = 100 * np.array(r["moved_m"])
        left.plot(DT * np.arange(1, len(moved) + 1), moved, color=colour, label=name)
    left.set(xlabel="time [s]", ylabel="largest displacement [cm]", title="liver phantom, 2 m/s$^2$ at once, Table 2")
    left.set_ylim(bottom=0)
    left.legend(fontsize=7)
    at = np.arange(len(rows))
    right.axvline(1.0, color="black", lw=0.8)
    ratios = [r["ratio"] for r in rows]
    right.barh(at, np.array(ratios) - 1, left=1, height=0.7, color=[BLUE if x < 1 else ORANGE for x in ratios])
    right.set_yticks(at, [named(r) for r in rows], fontsize=7)
    right.invert_yaxis()
    right.set(xlabel="largest displacement with the sponge over that without [1]", title="blue: the claim holds")
    return fig


def named(row: dict) -> str:
    """Return a description of the varied parameter of a row."""
    value = row["value"]
    return {
        "Table 2": "complete / viscous, Table 2",
        "Table 2, elastic": "porohyperelastic / hyperelastic, Table 2",
        "bulk": f"K0 = {value:g} Pa" if value else "",
        "limit_bulk": f"K_lim = {value:g} Pa" if value else "",
        "permeability": f"permeability {value:g} m$^4$/(N s)" if value is not None else "",
        "keep_bulk": "keep_bulk: the law's bulk stays on",
        "law's bulk of the rival": "Table 2 / viscous with K0 as the law's bulk",
        "ramp_s": f"gravity grows over {value} s",
        "tetrahedra": f"{value} tetrahedra, first peak",
    }[row["varied"]]


if __name__ == "__main__":
    main()
