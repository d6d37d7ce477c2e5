"""Fig. 6: the liver phantom (not an anatomy) falls into its supports under a fifth of gravity.

Bottom: motion of the tip for the hyperelastic, viscous, complete and porohyperelastic model. Top: fluid pressure during
the first oscillation of the porohyperelastic model, as shown in the chapter. Table: steps per second, and error
relative to a run with steps of 5 ms, for the chapter's scheme (one Newton iteration) and for Newton to 1e-6.

    python -m experiments fig6_liver
"""

import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import liverjax as lj
from experiments.common import either, plain_ticks, plt, save
from experiments.liver import ONE_STEP, error, models, timed_run, with_solve
from liverjax.core.plotting import COLOURS
from liverjax.core.struct import replace
from liverjax.physics.boundary import boundary_triangles

SECONDS, AT = either((2.4, (0.6, 1.2, 1.8, 2.4)), (1.2, (0.6, 1.2)))
PICTURES = (0.05, 0.15, 0.25, 0.4, 0.8)


def main() -> None:
    """Compute the runs, the table and two figures."""
    rows, curves, tip = [], {}, None
    for name, scene in models().items():
        fine = exact(scene)
        moved = np.linalg.norm(np.asarray(fine.positions) - np.asarray(scene.mesh.points), axis=-1)
        tip = int(moved.max(axis=0).argmax()) if tip is None else tip
        curves[name] = curve(scene, fine, tip)
        for dt in either((0.3, 0.15, 0.05), (0.05,)):
            for newton in either((1, 25), (25,)):
                result, row = timed_run(with_solve(scene, SECONDS, dt, **(ONE_STEP if newton == 1 else {})))
                off = error(result.times, result.positions, fine.times, fine.positions, AT)
                rows.append({"model": name, "newton": newton, "error": off} | row)
                print({k: v if isinstance(v, str) else round(v, 4) for k, v in rows[-1].items()}, flush=True)
    scene = replace(models()["complete"], viscosity=None)
    fine = exact(scene)
    curves["porohyperelastic"] = curve(scene, fine, tip)
    content = {"rows": rows, "curves": curves, "summary": summary(curves), "tip": tip}
    save("fig6_liver", content | {"tetrahedra": scene.mesh.number_of_elements}, motion(curves, rows))
    save("fig6_pressure", pressure_content(fine), pressure_row(scene.mesh, fine))


def exact(scene: lj.Scene) -> lj.simulation.Result:
    """Run with steps so short that their error is not visible."""
    return timed_run(with_solve(scene, SECONDS, either(0.005, 0.02), integrator="newmark"), rounds=1)[0]


def curve(scene: lj.Scene, result: lj.simulation.Result, tip: int) -> dict:
    """Return the displacement of node `tip` along gravity over time."""
    path = (np.asarray(result.positions)[:, tip] - np.asarray(scene.mesh.points)[tip])[:, 1]
    return {"times": np.asarray(result.times).tolist(), "tip_m": path.tolist()}


def summary(curves: dict) -> dict:
    """Return for every curve its range after a quarter of the time, its peak and its last value."""
    return {
        name: {
            "amplitude_m": float(np.ptp(np.array(c["tip_m"])[len(c["tip_m"]) // 4 :])),
            "largest_m": float(max(c["tip_m"])),
            "last_m": c["tip_m"][-1],
        }
        for name, c in curves.items()
    }


def motion(curves: dict, rows: list) -> plt.Figure:
    """Plot the path of the tip, and the error of positions against the ratio of simulated time to run time."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
    for (name, curve), colour in zip(curves.items(), COLOURS, strict=False):
        left.plot(curve["times"], 100 * np.array(curve["tip_m"]), color=colour, label=name)
        for newton, marker in ((1, "o"), (25, "s")):
            own = [r for r in rows if r["model"] == name and r["newton"] == newton and r["converged"]]
            if not own:  # this model was not timed
                continue
            right.loglog(
                [r["steps_per_s"] * r["dt"] for r in own],
                [100 * r["error"] for r in own],
                marker + "-",
                color=colour,
                label=f"{name}, {'one iteration' if newton == 1 else 'to 1e-6'}",
            )
    left.set(xlabel="time [s]", ylabel="tip along gravity [cm]", title="liver phantom, 2 m/s$^2$, steps of 5 ms")
    left.legend(loc="upper right", ncols=2, fontsize=7)
    left.set_ylim(top=12.5)
    plain_ticks(right.xaxis, right.yaxis)
    right.axvline(1.0, color="black", lw=0.8)
    right.set(
        xlabel="simulated time / run time (right of 1: faster than real time)",
        ylabel="error of positions [%]",
        title="implicit Euler, steps of 0.05, 0.15, 0.3 s (left to right)",
    )
    right.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def _at(result) -> list[int]:
    return [int(np.argmin(abs(np.asarray(result.times) - t))) for t in PICTURES]


def pressure_content(result) -> dict:
    """Return the smallest and largest pressure at the times of the pictures."""
    P = np.asarray(result.pressure)[_at(result)]
    return {"times": PICTURES, "least_Pa": P.min(axis=1).tolist(), "greatest_Pa": P.max(axis=1).tolist()}


def pressure_row(mesh, result) -> plt.Figure:
    """Plot the surface, coloured by the fluid pressure, at five times of the first oscillation."""
    triangles = boundary_triangles(mesh)
    P = np.asarray(result.pressure)[_at(result)]
    most = np.abs(P).max()
    fig = plt.figure(figsize=(12, 2.9), layout="constrained")
    all_axes = []
    for n, k in enumerate(_at(result)):
        axes = fig.add_subplot(1, len(PICTURES), n + 1, projection="3d")
        x = 100 * np.asarray(result.positions[k])
        surface = Poly3DCollection(x[triangles], lw=0.05, edgecolor="black")
        surface.set_array(P[n][triangles].mean(axis=1))
        surface.set_cmap("RdBu_r")
        surface.set_clim(-most, most)
        axes.add_collection3d(surface)
        rest = 100 * np.asarray(mesh.points)
        middle, half = (rest.min(axis=0) + rest.max(axis=0)) / 2, np.ptp(rest, axis=0).max() / 2
        for d, letter in enumerate("xyz"):
            getattr(axes, f"set_{letter}lim")(middle[d] - half, middle[d] + half)
        axes.set_box_aspect((1, 1, 1), zoom=1.3)
        axes.view_init(elev=25, azim=-70)
        axes.set_axis_off()
        axes.set_title(f"t = {PICTURES[n]:.2f} s")
        all_axes.append(axes)
    fig.colorbar(surface, ax=all_axes, shrink=0.8, label="fluid pressure [Pa]")
    return fig


if __name__ == "__main__":
    main()
