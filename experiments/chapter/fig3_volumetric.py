"""Fig. 3, right: volumetric stress of the porous body before and after its logarithm is replaced by a tangent line.

python -m experiments fig3_volumetric
"""

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import plt, save
from liverjax.core.plotting import BLUE, GREY, ORANGE
from liverjax.physics import porosity


def main() -> None:
    """Plot two fluid fractions: 0.8 as drawn in the chapter, and 0.5 from Table 2."""
    fig, all_axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained", sharey=True)
    rows = []
    for axes, r_w in zip(all_axes, (0.8, 0.5), strict=True):
        sponge = lj.Porosity(bulk=400.0, limit_bulk=2200.0, fluid_fraction=r_w, permeability=2e-5)
        J = np.linspace(0.05, 1.3, 2001)
        mended = 1 - r_w + r_w * 400 / 2200
        printed = 1 - r_w + 400 / 2200
        with np.errstate(invalid="ignore", divide="ignore"):
            before = 400 * r_w * np.log((r_w + J - 1) / r_w)
        after = np.asarray(porosity.volumetric_stress(sponge, jnp.asarray(J)))
        slope = np.asarray(porosity.volumetric_slope(sponge, jnp.asarray(J)))
        axes.plot(J, before / 1e3, color=GREY, lw=1, label=r"before: $K_0 r_w \ln J^*$")
        axes.plot(J, after / 1e3, color=BLUE, label="after: its tangent line below $J_0$")
        axes.axvline(mended, color=ORANGE, ls="--", lw=0.8, label=f"$J_0$ = {mended:.3f}: slope $K_{{lim}}$")
        axes.axvline(printed, color=GREY, ls=":", lw=0.8, label=f"as printed, {printed:.3f}: slope $r_w K_{{lim}}$")
        axes.set(xlabel="J [1]", title=f"fluid fraction {r_w}", ylim=(-2.2, 0.3))
        axes.legend(fontsize=7, loc="lower right")
        smallest = float(before[np.isfinite(before)].min())
        rows.append(
            {
                "fluid_fraction": r_w,
                "J0": mended,
                "J0_printed": printed,
                "stress_at_J0_Pa": float(400 * r_w * np.log(400 / 2200)),
                "slope_below_Pa": float(slope[0]),
                "logarithm_ends_at_J": 1 - r_w,
                "least_finite_logarithm_Pa": smallest,
            }
        )
        print(rows[-1])
    all_axes[0].set_ylabel("volumetric stress [kPa]")
    save("fig3_volumetric", {"rows": rows}, fig)


if __name__ == "__main__":
    main()
