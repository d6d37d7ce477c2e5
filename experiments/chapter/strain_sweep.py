"""Dynamic strain sweep of section 5.2 on the simulated rheometer: at which strain does linearity end?

``python -m experiments strain_sweep`` writes results/strain_sweep.json and .png. The chapter measured 1-2 % on liver.
"""

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, plt, save, timed
from fitting.rigs import torsion
from fitting.rigs.torsion import Drive
from liverjax.core.plotting import BLUE, GREEN, GREY, ORANGE

STYLES = {
    "neo_hookean": (BLUE, "o-"),
    "mooney_rivlin": (BLUE, "s--"),
    "arruda_boyce": (GREEN, "^-"),
    "fung_demiray": (ORANGE, "v-"),
    "veronda_westmann": (ORANGE, "D--"),
    "saint_venant_kirchhoff": (GREY, "x-"),
}
STRAINS = np.geomspace(1e-4, 0.2, either(12, 4))
TABLE_2 = lj.Prony(ratios=jnp.array([0.235, 0.333]), relaxation_times=jnp.array([0.27, 0.03]))


def main() -> None:
    """Sweep every law at 1 Hz with the viscosity of Table 2. The error is relative to a run with twice as many
    steps.
    """
    rig = torsion.make_rig()
    rows = []
    for name in either(list(STYLES), list(STYLES)[:2]):
        law = lj.laws.typical(name)

        def sweep(law, steps):
            drive = Drive(steps=steps, cycles=3, by="angle")
            return torsion.strain_sweep(rig, law, TABLE_2, jnp.asarray(STRAINS), drive=drive)

        m, t = timed(lambda law, sweep=sweep: sweep(law, 50), law, rounds=1)
        fine, _ = timed(lambda law, sweep=sweep: sweep(law, 100), law, rounds=1)
        change = np.abs(np.asarray(m.storage) / np.asarray(fine.storage) - 1).max()
        limit = torsion.linearity_limit(STRAINS, m.storage)
        rows.append(
            {"law": name, "storage_Pa": np.asarray(m.storage).tolist(), "loss_Pa": np.asarray(m.loss).tolist()}
            | {"limit_5_percent": None if np.isinf(limit) else limit, "error": float(change), "run_s": t.run}
            | {"compile_s": t.compile, "worst_status": int(m.statistics.status.max())}
        )
        shown = "none below 20 %" if np.isinf(limit) else f"{100 * limit:.1f} %"
        print(f"{name:26s} limit {shown:16s} time-step error {100 * change:.3f} %  {t.run:.1f} s", flush=True)
    fig, axes = plt.subplots(figsize=(6.5, 4.2), layout="constrained")
    for row in rows:
        label = f"{row['law'].replace('_', ' ')} ({100 * row['error']:.2g} %, {row['run_s']:.2g} s)"
        colour, style = STYLES[row["law"]]
        ratio = np.asarray(row["storage_Pa"]) / row["storage_Pa"][0]
        axes.plot(100 * STRAINS, ratio, style, color=colour, ms=4, label=label)
    axes.axhspan(0.95, 1.05, color=GREY, alpha=0.15)
    axes.axvspan(1, 2, color=ORANGE, alpha=0.15, label="measured end of linearity (section 5.2)")
    axes.set(xscale="log", xlabel="strain amplitude at the rim [%]", ylabel="G' / G' at 0.01 % [1]")
    axes.set_title("Strain sweep at 1 Hz, Table 2 viscosity (time-step error, run time)")
    axes.legend(fontsize=7)
    save("strain_sweep", {"strains": STRAINS.tolist(), "laws": rows}, fig)


if __name__ == "__main__":
    main()
