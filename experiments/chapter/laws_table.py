"""Every law: errors of its hand-derived terms, and their run time.

``python -m experiments laws_table`` writes results/laws_table.json and .png: error of stress and tangent against
automatic differentiation of the energy at 2,000 deformation gradients, time of force and stiffness of 20,250 tetrahedra
(medians of interleaved rounds), and compile time.
"""

import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, plt, save
from liverjax import laws
from liverjax.core.plotting import BLUE, GREY, ORANGE
from liverjax.elements import mjed

ROUNDS = either(15, 3)


def gradients(n: int) -> jax.Array:
    """Return n deformation gradients: stretches 0.5 to 2 between random rotations."""
    rng = np.random.default_rng(3)
    Q1, Q2 = (np.linalg.qr(rng.standard_normal((n, 3, 3)))[0] for _ in range(2))
    F = Q1 @ (np.exp(rng.uniform(np.log(0.5), np.log(2.0), (n, 3)))[:, :, None] * Q2)
    return jnp.asarray(F * np.sign(np.linalg.det(F))[:, None, None])


def error(ours: jax.Array, exact: jax.Array, size: float) -> float:
    """Return the largest error of a matrix relative to its largest entry plus `size`, where the energy is finite."""
    ours, exact = (np.asarray(v).reshape(len(ours), -1) for v in (ours, exact))
    keep = np.isfinite(ours).all(axis=1)
    return float((np.abs(ours - exact).max(axis=1) / (np.abs(exact).max(axis=1) + size))[keep].max())


def main() -> None:
    """Compute the table and its figure."""
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (15, 15, 15))
    x = mesh.points + 0.004 * jnp.asarray(np.random.default_rng(0).standard_normal(mesh.points.shape))
    F = gradients(2000)
    programs = {"force": mjed.internal_force, "force and stiffness": force_and_stiffness}
    rows, compiled = {}, {}
    for name in either(list(laws.LAWS), ["neo_hookean", "ogden"]):
        law = laws.typical(name)
        row = {
            "stress_error": error(law.first_piola(F), jax.jit(lj.reference.first_piola)(law, F), law.shear_modulus()),
            "tangent_error": error(law.tangent(F), jax.jit(lj.reference.tangent)(law, F), law.shear_modulus()),
        }
        for label, program in programs.items():
            begin = time.perf_counter()
            compiled[name, label] = jax.jit(program).lower(mesh, law, x).compile(), law
            row[f"{label}_compile_s"] = time.perf_counter() - begin
        rows[name] = row
    seconds = {key: [] for key in compiled}
    for _ in range(ROUNDS):
        for key, (program, law) in compiled.items():
            begin = time.perf_counter()
            jax.block_until_ready(program(mesh, law, x))
            seconds[key].append(time.perf_counter() - begin)
    for (name, label), values in seconds.items():
        rows[name][f"{label}_s"] = statistics.median(values[1:])
    for name, r in rows.items():
        force, both = 1e3 * r["force_s"], 1e3 * r["force and stiffness_s"]
        print(
            f"{name:26s} stress {r['stress_error']:.1e} tangent {r['tangent_error']:.1e}   force {force:5.2f} ms   "
            f"force and stiffness {both:5.2f} ms, compile {r['force and stiffness_compile_s']:.1f} s"
        )
    save("laws_table", {"elements": mesh.number_of_elements, "rounds": ROUNDS, "laws": rows}, draw(rows))


def force_and_stiffness(mesh, law, x):
    """Return nodal forces, and the six blocks of every element from which the other blocks follow."""
    return mjed.internal_force(mesh, law, x), mjed.element_stiffness(mesh, law, x)


def draw(rows: dict):
    """Plot the errors on the left and the run times on the right, with one line for each law."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
    at = np.arange(len(rows))
    left.semilogx([r["stress_error"] for r in rows.values()], at, "o", color=BLUE, label="stress")
    left.semilogx([r["tangent_error"] for r in rows.values()], at, "s", color=ORANGE, label="tangent")
    left.set(yticks=at, yticklabels=[n.replace("_", " ") for n in rows], xlabel="relative error against autodiff [1]")
    left.axvline(1e-11, color=GREY, ls=":")
    left.invert_yaxis()
    right.barh(at - 0.2, [1e3 * r["force_s"] for r in rows.values()], 0.4, color=BLUE, label="force")
    both = [1e3 * r["force and stiffness_s"] for r in rows.values()]
    right.barh(at + 0.2, both, 0.4, color=ORANGE, label="force and stiffness")
    for k, r in enumerate(rows.values()):
        right.text(both[k], k + 0.2, f" compile {r['force and stiffness_compile_s']:.1f} s", va="center", fontsize=7)
    right.set(xlabel="20,250 tetrahedra [ms]", xlim=(0, 1.25 * max(both)))
    for axis in (left, right):
        axis.legend(fontsize=8)
    return fig


if __name__ == "__main__":
    main()
