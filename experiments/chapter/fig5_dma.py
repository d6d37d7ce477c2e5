"""Fig. 5 of the chapter: moduli of the simulated rheometer against the data, and possible sources of a 5 % error.

``python -m experiments fig5_dma [--quick]`` writes results/fig5_dma.json and .png: moduli for two laws and both
recursions (updates of the viscous memory from step to step); error against run time, for the number of steps per cycle
and for the mesh size; the contributions of recursion, mesh and number of modes to the error.
"""

import sys

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import ROOT, plain_ticks, plt, save, timed
from fitting.fits import viscoelastic
from fitting.methods import generalised_maxwell
from fitting.readers.rheometer import read_sweep
from fitting.rigs import torsion
from fitting.rigs.torsion import Drive
from liverjax.core.plotting import BLUE, GREEN, GREY, ORANGE
from liverjax.core.struct import replace

DATA = ROOT / "data"
TABLE_2 = lj.Prony(ratios=jnp.array([0.235, 0.333]), relaxation_times=jnp.array([0.27, 0.03]))
SCHEMES = {"exponential": BLUE, "chapter": ORANGE}


def simulate(sweep, law_name: str, scheme: str, steps: int = 50, cell_size: float | None = None, rounds: int = 3):
    """Return corrected and raw moduli of Table 2's liver at the sweep's frequencies, with run times and the rig."""
    rig = torsion.make_rig(cell_size=cell_size)
    law = lj.laws.typical(law_name)
    torque = torsion.torque_for_strain(rig, np.hypot(sweep.storage, sweep.loss), 1e-3)
    viscosity = replace(TABLE_2, scheme=scheme)
    m, timing = timed(
        lambda rig, law, v, w, t: torsion.moduli(rig, law, v, w, t, Drive(steps=steps)),
        *(rig, law, viscosity, jnp.asarray(sweep.angular_frequency), jnp.asarray(torque)),
        rounds=rounds,
    )
    return m, timing, rig


def error(sweep, storage, loss) -> dict[str, float]:
    """Return relative errors against the continuous model: the mean over G' and G'', and the largest of G''."""
    e = np.abs(np.concatenate([np.asarray(storage) / sweep.storage, np.asarray(loss) / sweep.loss]) - 1)
    return {"mean": float(e.mean()), "largest_loss": float(e[len(e) // 2 :].max())}


def moduli_table(sweep) -> list[dict]:
    """Return moduli for two laws and both recursions, with 50 steps per cycle."""
    rows = []
    for law in ("saint_venant_kirchhoff", "neo_hookean"):
        for scheme in SCHEMES:
            m, t, rig = simulate(sweep, law, scheme)
            rows.append(
                {"law": law, "scheme": scheme, "steps": 50, "nodes": rig.mesh.number_of_nodes}
                | {"storage_Pa": np.asarray(m.storage).tolist(), "loss_Pa": np.asarray(m.loss).tolist()}
                | {"error": error(sweep, m.storage, m.loss), "run_s": t.run, "compile_s": t.compile}
                | {"newton_iterations": int(m.statistics.iterations.max())}
            )
    return rows


def steps_table(sweep, steps: tuple[int, ...]) -> list[dict]:
    """Return error and run time for several numbers of steps per cycle."""
    rows = []
    for scheme in SCHEMES:
        for n in steps:
            m, t, _ = simulate(sweep, "neo_hookean", scheme, n)
            row = {"scheme": scheme, "steps": n, "run_s": t.run, "compile_s": t.compile}
            rows.append(row | {"error": error(sweep, m.storage, m.loss)})
    return rows


def mesh_table(sweep, cells: tuple[float, ...]) -> list[dict]:
    """Return the error of the mesh alone, raw and corrected. The reference is the discrete formula of the recursion."""
    omega = jnp.asarray(sweep.angular_frequency)
    dt = 2 * jnp.pi / omega / 50
    G = 770 * (1 - lj.viscosity.complex_ratios(TABLE_2, omega, dt).sum(axis=0))
    own = sweep._replace(storage=np.asarray(G.real), loss=np.asarray(G.imag))
    rows = []
    for cell in cells:
        m, t, rig = simulate(own, "neo_hookean", "exponential", cell_size=cell, rounds=1)
        factor = float(torsion.geometry_factor(rig, lj.laws.typical("neo_hookean")))
        rows.append(
            {"cell_m": cell, "nodes": rig.mesh.number_of_nodes, "tetrahedra": rig.mesh.number_of_elements}
            | {"raw": error(own, factor * m.storage, factor * m.loss), "corrected": error(own, m.storage, m.loss)}
            | {"run_s": t.run, "compile_s": t.compile}
        )
    return rows


def modes_table() -> list[dict]:
    """Return the error of a finite number of modes for a real tissue.

    The chapter's measured points are published only as a picture, so the data are those of lion's mane.
    """
    sweep = read_sweep(DATA / "lions_mane_frequency_sweep.csv")
    dense = generalised_maxwell.spectrum(sweep)
    rows = []
    for modes in (1, 2, 3, 4, 5):
        f = viscoelastic.closed_form(sweep, modes, dense)
        rows.append(
            {"modes": modes, "mean": float(f.relative_errors(sweep).mean()), "run_s": f.run_time}
            | {"compile_s": f.compile_time}
        )
    return rows


def figure(sweep, content) -> plt.Figure:
    """Plot four panels: moduli; error against run time for steps; the same for meshes; error against number of
    modes.
    """
    fig, axes = plt.subplots(2, 2, figsize=(10, 7.2), layout="constrained")
    f = sweep.angular_frequency / (2 * np.pi)
    top = axes[0, 0]
    top.plot(f, sweep.storage, "-", color=GREY, label="closed form of Table 2 (the data it implies)")
    top.plot(f, sweep.loss, "-", color=GREY)
    for row in content["moduli"]:
        marker = "o" if row["law"] == "neo_hookean" else "x"
        label = (
            f"{row['law'].replace('_', ' ')}, {row['scheme']}: {100 * row['error']['mean']:.2g} %, {row['run_s']:.2g} s"
        )
        top.plot(f, row["storage_Pa"], marker, color=SCHEMES[row["scheme"]], ms=5, mfc="none", label=label)
        top.plot(f, row["loss_Pa"], marker, color=SCHEMES[row["scheme"]], ms=5, mfc="none")
    top.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="G' (upper), G'' (lower) [Pa]")
    top.set_title("Simulated moduli, 50 steps a cycle (mean error, run time)")
    top.legend(fontsize=7)

    steps = axes[0, 1]
    for scheme, colour in SCHEMES.items():
        rows = [r for r in content["steps"] if r["scheme"] == scheme]
        run, mean = [r["run_s"] for r in rows], [100 * r["error"]["mean"] for r in rows]
        steps.plot(run, mean, "o-", color=colour, label=f"{scheme} recursion")
        for r, x, y in zip(rows, run, mean, strict=True):
            steps.annotate(str(r["steps"]), (x, y), textcoords="offset points", xytext=(4, 4), fontsize=7)
    steps.axhline(5, color=GREY, ls=":", label="the chapter's 5 %")
    steps.set(xscale="log", yscale="log", xlabel="run time of 16 frequencies [s]", ylabel="mean error of G', G'' [%]")
    plain_ticks(steps.xaxis)
    steps.margins(x=0.08)
    steps.set_title("Time step: error against run time (steps a cycle at the points)")
    steps.legend(fontsize=7)

    mesh = axes[1, 0]
    run = [r["run_s"] for r in content["mesh"]]
    for key, colour in (("raw", ORANGE), ("corrected", BLUE)):
        values = [100 * r[key]["mean"] for r in content["mesh"]]
        mesh.plot(run, values, "o-", color=colour, label=f"{key} moduli")
        for r, x, y in zip(content["mesh"], run, values, strict=True):
            mesh.annotate(str(r["nodes"]), (x, y), textcoords="offset points", xytext=(4, 4), fontsize=7)
    mesh.axhline(5, color=GREY, ls=":", label="the chapter's 5 %")
    mesh.set(xscale="log", yscale="log", xlabel="run time of 16 frequencies [s]", ylabel="mean error of G', G'' [%]")
    plain_ticks(mesh.xaxis)
    mesh.margins(x=0.12)
    mesh.set_title("Mesh: error against run time (nodes at the points)")
    mesh.legend(fontsize=7)

    modes = axes[1, 1]
    rows = content["modes"]
    modes.bar([r["modes"] for r in rows], [100 * r["mean"] for r in rows], color=GREEN)
    for r in rows:
        text = f"{100 * r['mean']:.2g} %\n{1000 * r['run_s']:.0f} ms"
        modes.annotate(text, (r["modes"], 100 * r["mean"]), ha="center", va="bottom", fontsize=7)
    modes.axhline(5, color=GREY, ls=":", label="the chapter's 5 %")
    modes.set(xlabel="relaxation modes", ylabel="mean error of G', G'' [%]", ylim=(0, 35))
    modes.set_title("Modes: closed form on measured lion's mane (31 frequencies)")
    modes.legend(fontsize=7)
    return fig


def main(quick: bool) -> None:
    """Compute all tables and write them."""
    sweep = read_sweep(DATA / "porcine_liver_frequency_sweep.csv")
    content = {
        "moduli": moduli_table(sweep),
        "steps": steps_table(sweep, (20,) if quick else (20, 50, 100, 200, 400)),
        "mesh": mesh_table(sweep, (0.004,) if quick else (0.004, 0.0025, 0.002, 0.00167, 0.00143)),
        "modes": modes_table(),
    }
    save("fig5_dma", content, figure(sweep, content))
    for row in content["moduli"]:
        print(f"{row['law']:24s} {row['scheme']:12s} {100 * row['error']['mean']:7.3f} %  {row['run_s']:.2f} s")
    for row in content["steps"]:
        print(f"{row['steps']:4d} steps  {row['scheme']:12s} {100 * row['error']['mean']:7.3f} %  {row['run_s']:.2f} s")
    for row in content["mesh"]:
        raw, corrected = (100 * row[k]["mean"] for k in ("raw", "corrected"))
        print(f"{row['nodes']:5d} nodes  raw {raw:6.2f} %  corrected {corrected:.2g} %  {row['run_s']:.2f} s")
    for row in content["modes"]:
        print(f"{row['modes']} modes (lion's mane)  {100 * row['mean']:.2f} %  {row['run_s']:.3f} s")


if __name__ == "__main__":
    main("--quick" in sys.argv)
