"""Fig. 2 of the chapter: the laws of Table 1 in tension and compression, and stiffness against strain rate.

``python -m experiments fig2_uniaxial`` writes results/fig2_uniaxial.json and .png. All laws have the ground-state shear
modulus of Table 2, 770 Pa. Nothing here is fitted to the measurements that the chapter's figure collects. Fig. 2B and C
show that the liver's stiffness below 10 % strain grows with the strain rate. The right panel shows how much of this
growth follows from Table 2's viscosity, and from its porosity in a cube of 5 cm with drained sides.
"""

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, plt, save, timed
from liverjax import laws
from liverjax.core.plotting import BLUE, COLOURS, GREY, ORANGE
from liverjax.laws import homogeneous
from liverjax.physics import viscosity
from liverjax.tensors.matrices import pack, unpack

#: The chapter's Table 1, and Costa's law (fibres along 1). This law and St Venant-Kirchhoff are not isochoric; they are
#: evaluated at det F = 1.
TABLE_1 = (
    "saint_venant_kirchhoff",
    "neo_hookean",
    "mooney_rivlin",
    "arruda_boyce",
    "ogden",
    "bogen",
    "logarithmic",
    "exponential",
    "fung_demiray",
    "veronda_westmann",
    "costa",
)
TABLE_2 = lj.Prony(ratios=jnp.array([0.235, 0.333]), relaxation_times=jnp.array([0.27, 0.03]))
RATES = np.geomspace(0.003, 22.5, either(25, 7))  # of the studies in Fig. 2 [1/s]
STRAIN = 0.1


def chord_moduli(law: laws.Law, sign: float, steps: int) -> jax.Array:
    """Return the nominal stress over strain at 10 % strain [Pa] of an incompressible sample, for each strain rate in
    RATES.
    """
    law = laws.isochoric_part(law)

    def at_rate(rate):
        dt = STRAIN / rate / steps

        def step(history, k):
            F = homogeneous.deformation_gradient("uniaxial", 1 + sign * STRAIN * (k + 1) / steps)
            Ft = unpack(F[None])
            P = pack(viscosity.first_piola(TABLE_2, viscosity.recall(TABLE_2, history, dt), law, Ft))[0]
            pressure = P[2, 2] * F[2, 2]  # the side is free of stress
            return viscosity.advance(TABLE_2, history, law, Ft, dt), P[0, 0] - pressure / F[0, 0]

        _, stress = jax.lax.scan(step, viscosity.initial_history(TABLE_2, 1), jnp.arange(steps))
        return stress[-1] / (sign * STRAIN)

    return jax.lax.map(at_rate, jnp.asarray(RATES))


def porous_sample(viscous: bool, steps: int) -> lj.Scene:
    """A cube of 5 cm between lubricated plates, with drained sides: Table 2's porous body, with or without
    viscosity.
    """
    size = 0.05
    mesh = lj.shapes.box((size,) * 3, (5, 5, 5))
    sides = np.unique(np.concatenate([np.asarray(mesh.node_sets[f"{a}_{e}"]) for a in "xy" for e in ("min", "max")]))
    corner = {axis: jnp.asarray([int(np.argmin(np.asarray(mesh.points).sum(axis=1)))]) for axis in "xy"}
    edge = int(np.argmax(np.asarray(mesh.points) @ np.array([1.0, -1.0, -1.0])))
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=770.0, bulk=1.0),  # the law's own bulk term is switched off in a porous body
        viscosity=TABLE_2 if viscous else None,
        porosity=lj.Porosity(
            bulk=400.0, limit_bulk=2200.0, fluid_fraction=0.5, permeability=2e-5, drained=jnp.asarray(sides)
        ),
        fixed=(
            lj.Fixed(nodes=mesh.node_sets["z_min"], axes="z"),
            *(lj.Fixed(nodes=nodes, axes=axis) for axis, nodes in corner.items()),
            lj.Fixed(nodes=jnp.asarray([edge]), axes="y"),
        ),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([0.0, 0.0, -STRAIN * size]), axes="z"),),
        solve=lj.Solve(dt=1.0, steps=steps, tolerance=1e-6),
    )


def porous_moduli(scene: lj.Scene, rates: np.ndarray) -> jax.Array:
    """Return the chord moduli [Pa] of a porous sample in compression."""
    steps, top, area = scene.solve.steps, scene.displaced[0].nodes, 0.05**2

    def at_rate(rate):
        result = lj.simulate(lj.with_parameters(scene, {"solve.dt": STRAIN / rate / steps}))
        return -jnp.sum(result.reactions[-1, top, 2]) / area / STRAIN

    return jax.lax.map(at_rate, jnp.asarray(rates))


def linear_moduli() -> np.ndarray:
    """Return the chord moduli [Pa] of linear viscoelasticity, with x = tau rate / strain.

    The formula is 3 G0 (1 - sum g (1 - x (1 - exp(-1/x)))).
    """
    g, tau = np.asarray(TABLE_2.ratios)[:, None], np.asarray(TABLE_2.relaxation_times)[:, None]
    x = tau * RATES[None] / STRAIN
    return 3 * 770.0 * (1 - np.sum(g * (1 - x * (1 - np.exp(-1 / x))), axis=0))


def stress_stretch(named: dict[str, laws.Law]) -> tuple[np.ndarray, dict]:
    """Return the nominal stress of every law at stretches 0.7 to 1.4, its error against autodiff, and its run time."""
    stretch = np.linspace(0.7, 1.4, 141)
    table = {}
    for name, law in named.items():
        F = homogeneous.deformation_gradient("uniaxial", stretch)
        P, t = timed(lambda law, F=F: homogeneous.nominal_stress(law, F), law)
        split = laws.isochoric_part(law)
        exact = lj.reference.first_piola(law if split is None else split, F)
        p = exact[:, 2, 2] * F[:, 2, 2]
        reference = np.asarray(exact[:, 0, 0] - p / F[:, 0, 0])
        stress = np.asarray(P[:, 0, 0])
        error = np.abs(stress - reference).max() / np.abs(stress).max()
        table[name] = {"stress_Pa": stress.tolist(), "error": float(error), "run_s": t.run, "compile_s": t.compile}
    return stretch, table


def main() -> None:
    """Compute both halves of the figure."""
    named = {name: laws.typical(name) for name in TABLE_1}
    stretch, table = stress_stretch(named)
    rates = {}
    for label, sign in (("tension", 1.0), ("compression", -1.0)):
        for name in ("neo_hookean", "arruda_boyce", "fung_demiray"):
            coarse, t = timed(lambda law, sign=sign: chord_moduli(law, sign, 100), named[name], rounds=3)
            fine, _ = timed(lambda law, sign=sign: chord_moduli(law, sign, 800), named[name], rounds=1)
            error = float(np.abs(np.asarray(coarse) / np.asarray(fine) - 1).max())
            rates[f"{name}, {label}"] = {"chord_modulus_Pa": np.asarray(coarse).tolist(), "error": error} | {
                "run_s": t.run,
                "compile_s": t.compile,
            }
            low, high = float(coarse[0]), float(coarse[-1])
            print(f"{name:14s} {label:12s} {low:6.0f} to {high:6.0f} Pa, error {100 * error:.1g} %, {t.run:.2g} s")
    for label, viscous in (("porous sample", False), ("viscous and porous sample", True)):
        coarse, t = timed(porous_moduli, porous_sample(viscous, 20), RATES[::3], rounds=1)
        fine, _ = timed(porous_moduli, porous_sample(viscous, 80), RATES[::3], rounds=1)
        error = float(np.abs(np.asarray(coarse) / np.asarray(fine) - 1).max())
        rates[label] = {"chord_modulus_Pa": np.asarray(coarse).tolist(), "error": error} | {
            "run_s": t.run,
            "compile_s": t.compile,
        }
        print(f"{label:26s} {float(coarse[0]):6.0f} to {float(coarse[-1]):6.0f} Pa, error {100 * error:.1g} %")
    linear = linear_moduli()
    draw(stretch, table, rates, linear)
    for name, row in table.items():
        print(f"{name:24s} error {row['error']:.1e}, {1e3 * row['run_s']:.2f} ms for {len(stretch)} stretches")


def draw(stretch: np.ndarray, table: dict, rates: dict, linear: np.ndarray) -> None:
    """Plot the laws on the left, and stiffness against strain rate on the right."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    for k, (name, row) in enumerate(table.items()):
        style, colour = ("-", "--")[k // len(COLOURS)], COLOURS[k % len(COLOURS)]
        label = f"{name.replace('_', ' ')} ({row['error']:.0e}, {1e3 * row['run_s']:.1f} ms)"
        left.plot(stretch, np.asarray(row["stress_Pa"]) / 1000, style, color=colour, label=label)
    left.set(xlabel="stretch [1]", ylabel="nominal stress [kPa]", ylim=(-4, 3))
    left.set_title("incompressible samples, G0 = 770 Pa (error against autodiff, time of 141 stretches)")
    left.legend(fontsize=7)
    for (name, row), colour, style in zip(
        rates.items(),
        (*(BLUE, ORANGE, COLOURS[2]) * 2, COLOURS[3], COLOURS[3]),
        ("-", "-", "-", "--", "--", "--", "o--", "o-"),
        strict=True,
    ):
        label = f"{name.replace('_', ' ')} ({100 * row['error']:.1g} %, {1e3 * row['run_s']:.1f} ms)"
        moduli = np.asarray(row["chord_modulus_Pa"]) / 1000
        right.semilogx(RATES if len(moduli) == len(RATES) else RATES[::3], moduli, style, color=colour, label=label)
    right.semilogx(RATES, linear / 1000, ":", color=GREY, lw=2, label="linear viscoelasticity")
    right.set(xlabel="strain rate [1/s]", ylabel="chord modulus, 0 to 10 % [kPa]", ylim=(0, None))
    right.set_title("Table 2; porous: a cube of 5 cm, sides drained (time-step error, run time)")
    right.legend(fontsize=7)
    content = {"stretches": stretch.tolist(), "laws": table, "rates_1_per_s": RATES.tolist(), "chord_moduli": rates}
    save("fig2_uniaxial", content | {"linear_Pa": linear.tolist()}, fig)


if __name__ == "__main__":
    main()
