"""The cost of a gradient through a run: time and memory against the number of steps and stored states, and the error.

Every case runs in a separate process, so that its peak memory is measured alone. The error is that of the derivative
with respect to mu. It is measured against forward mode (another way to compute the same number). For short runs of a
small body it is also measured against central differences with several step widths, which gives a V-shaped curve.

    python -m experiments gradient_cost [--quick]
    python -m experiments.benchmarks.gradient_cost complete 1000 all    (runs only these cases again)
"""

import json
import resource
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import RESULTS, plt, save
from experiments.liver import models, with_solve
from liverjax.core.plotting import BLUE, GREEN, ORANGE
from liverjax.core.struct import replace
from liverjax.simulation import gradient_checkpoints, gradients


def small() -> lj.Scene:
    """The complete model on a block of 162 tetrahedra that moves under its weight."""
    mesh = lj.shapes.box((0.03, 0.03, 0.03), (3, 3, 3))
    complete = models()["complete"]
    return replace(
        complete,
        mesh=mesh,
        porosity=replace(complete.porosity, drained=None),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_max"]),),
        solve=replace(complete.solve, tolerance=1e-12),
    )


def scene_of(model: str, steps: int) -> lj.Scene:
    """One of the liver's models solved to 1e-8, or the small one solved to 1e-12, with time steps of 0.05 s."""
    if model == "small":
        return with_solve(small(), 0.05 * steps, 0.05)
    return with_solve(models()[model], 0.05 * steps, 0.05, tolerance=1e-8)


def loss(result: lj.Result) -> jax.Array:
    """Return the mean square of the coordinates [m^2] over the whole run."""
    return jnp.mean(result.positions**2)


def fastest(program, *arguments, rounds: int) -> tuple[float, object]:
    """Return the shortest wall time of some runs, and the result."""
    seconds = []
    for _ in range(rounds):
        begin = time.perf_counter()
        out = jax.block_until_ready(program(*arguments))
        seconds.append(time.perf_counter() - begin)
    return min(seconds), out


def measure(model: str, steps: int, store: str) -> dict:
    """Measure one case in this process."""
    scene, mu = scene_of(model, steps), jnp.asarray(770.0)
    kept = int(store) if store.isdigit() else store
    program = gradients._program_of_gradient(loss, kept, "reverse").lower(scene, {"law.mu": mu})
    begin = time.perf_counter()
    program = program.compile()
    compiling = time.perf_counter() - begin
    rounds = 1 if steps >= 1000 else 3
    gradient_s, found = fastest(program, scene, {"law.mu": mu}, rounds=rounds)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

    def value(mu):
        return loss(lj.simulate(lj.with_parameters(scene, {"law.mu": mu})))

    forward_s, _ = fastest(jax.jit(value).lower(mu).compile(), mu, rounds=rounds)
    row = {
        "model": model,
        "tetrahedra": scene.mesh.number_of_elements,
        "steps": steps,
        "store": store,
        "states_kept": gradient_checkpoints.number_kept(kept, steps),
        "forward_s": forward_s,
        "gradient_s": gradient_s,
        "ratio": gradient_s / forward_s,
        "compile_s": compiling,
        "predicted_bytes": gradients.memory(scene, kept),
        "planned_bytes": program.memory_analysis().temp_size_in_bytes,
        "peak_resident_bytes": peak,
        "code": int(found.status),
    }
    if model == "small" and steps <= 100:
        tangent = jax.jit(lambda mu: jax.jvp(value, (mu,), (jnp.ones_like(mu),))[1])(mu)
        row["against_forward_mode"] = float(abs(found.gradient["law.mu"] / tangent - 1))
        run = jax.jit(value)
        row["differences"] = {}
        for h in 10.0 ** np.arange(-7, -0.5, 0.5):
            slope = float(run(mu * (1 + h)) - run(mu * (1 - h))) / (2 * h * 770.0)
            row["differences"][f"{h:.2g}"] = abs(float(found.gradient["law.mu"]) / slope - 1)
    return row


def main(quick: bool, words: list[str]) -> None:
    """Measure all cases, or those whose name contains all `words`, and write table and figure."""
    cases = [("small", n, s) for n in (10, 100, 1000, 10_000) for s in ("all", "sqrt")]
    cases += [("hyperelastic", 100, "all"), ("viscous", 100, "all")]
    cases += [("complete", n, s) for n in (10, 100, 1000) for s in ("all", "sqrt")]
    if quick:
        cases = [("small", 10, "all")]
    found = {}
    if words:
        kept = json.loads((RESULTS / "gradient_cost.json").read_text())["rows"]
        found = {(r["model"], r["steps"], r["store"]): r for r in kept}
    for case in [case for case in cases if set(words) <= set(map(str, case))]:
        command = [sys.executable, "-m", "experiments.benchmarks.gradient_cost", "--case", *map(str, case)]
        found[case] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        print({k: v for k, v in found[case].items() if k != "differences"}, flush=True)
        rows = list(found.values())
        save("gradient_cost", {"rows": rows}, figure(rows))


def figure(rows: list[dict]) -> plt.Figure:
    """Plot run time ratio and memory against the number of steps, and the V-shaped curve."""
    fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
    for model, colour in (("complete", BLUE), ("small", ORANGE)):
        for store, style in (("all", "o-"), ("sqrt", "s--")):
            of = [r for r in rows if r["model"] == model and r["store"] == store]
            label = f"{model if model == 'small' else 'liver, complete'}, {store}"
            n = [r["steps"] for r in of]
            axes[0].semilogx(n, [r["ratio"] for r in of], style, color=colour, label=label)
            axes[1].loglog(n, [r["planned_bytes"] / 1e6 for r in of], style, color=colour, label=label)
            axes[1].loglog(n, [r["predicted_bytes"] / 1e6 for r in of], "k+")
    axes[0].set(xlabel="steps", ylabel="gradient over run [1]", title="Time (a settled run is cheap)", ylim=(0, 8))
    axes[1].set(xlabel="steps", ylabel="memory [MB] (+: predicted)", title="Memory")
    axes[0].legend(fontsize=7)
    for r in rows:
        if "differences" in r and r["store"] == "all":
            h = [float(k) for k in r["differences"]]
            colour, label = GREEN if r["steps"] == 10 else BLUE, f"{r['steps']} steps, small body"
            axes[2].loglog(h, list(r["differences"].values()), "o-", color=colour, ms=3, label=label)
    axes[2].legend(fontsize=7)
    axes[2].set(xlabel="relative step of central differences", ylabel="relative difference", title="Error of d/d mu")
    return fig


if __name__ == "__main__":
    if "--case" in sys.argv:
        _, _, model, steps, store = sys.argv
        print(json.dumps(measure(model, int(steps), store)))
    else:
        main("--quick" in sys.argv[1:], [a for a in sys.argv[1:] if not a.startswith("-")])
