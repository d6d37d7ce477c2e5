"""Solves: a static cube in one load step and its gradient, dynamic steps of the liver, preconditioners, factorisation.

``python -m experiments solve_benchmark`` (6 minutes) writes results/solve_benchmark.json and .png. Times are medians of
interleaved rounds without compilation. Each time is listed together with the error or residual that was reached.
"""

import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, plain_ticks, plt, save
from experiments.liver import ONE_STEP, found, models, with_solve
from liverjax.core import status
from liverjax.core.plotting import BLUE, GREY, ORANGE
from liverjax.core.struct import replace
from liverjax.physics import boundary
from liverjax.simulation import tangent
from liverjax.simulation.equations import equations, initial_state
from liverjax.solvers.krylov import conjugate_gradients
from liverjax.solvers.preconditioner import Coarse

ROUNDS = either(5, 1)
CELLS, RATIOS, STIFFER = either((15, (10.0, 50.0, 500.0), (1e1, 1e3, 1e5)), (8, (50.0,), (1e1,)))
STEPS = either(((0.01, 60), (0.05, 40), (0.3, 20)), ((0.05, 10),))  # size [s] and number of the steps
SIZE = 0.1


def medians(programs: dict, rounds: int = ROUNDS) -> tuple[dict, dict]:
    """Return results and median seconds of {name: (function, *arguments)}. All are compiled first and then run
    in turn.
    """
    compiled = {n: (jax.jit(f).lower(*a).compile(), a) for n, (f, *a) in programs.items()}
    results = {n: jax.block_until_ready(p(*a)) for n, (p, a) in compiled.items()}
    seconds = {n: [] for n in compiled}
    for _ in range(rounds):
        for n, (program, arguments) in compiled.items():
            begin = time.perf_counter()
            jax.block_until_ready(program(*arguments))
            seconds[n].append(time.perf_counter() - begin)
    return results, {n: statistics.median(s) for n, s in seconds.items()}


def finite(x: float) -> float | None:
    """Return the number, or None if it is not finite, because JSON has no such numbers."""
    return float(x) if np.isfinite(x) else None


def cube(cells: int = CELLS, bulk: float = 10000.0, **solve: Any) -> lj.Scene:
    """A cube with both ends fixed, the upper one displaced by 20 %."""
    mesh = lj.shapes.box((SIZE, SIZE, SIZE), (cells, cells, cells))
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1000.0, bulk=bulk),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([0.0, 0.0, 0.2 * SIZE])),),
        solve=lj.Solve(**solve),
    )


def static_cube() -> dict:
    """Measure one load step to 20 %, and the derivative of the upper end's force with respect to mu."""
    scene = cube()
    top = jnp.asarray(scene.mesh.node_sets["z_max"])

    def force(mu, tolerance=1e-8):
        changed = lj.with_parameters(scene, {"law.mu": mu})
        result = lj.simulate(replace(changed, solve=replace(scene.solve, tolerance=tolerance)))
        return jnp.sum(result.reactions[-1, top, 2]), result

    def gradient(mu):
        return jax.value_and_grad(lambda mu: force(mu)[0])(mu)

    results, seconds = medians({"forward": (force, 1000.0), "with gradient": (gradient, 1000.0)})
    exact = jax.jit(lambda mu: force(mu, 1e-12)[0])
    differences = [float(exact(1000.0 + h) - exact(1000.0 - h)) / (2 * h) for h in (0.3, 1.0, 3.0)]
    slope = float(results["with gradient"][1])
    s = results["forward"][1].statistics
    return {
        "tetrahedra": scene.mesh.number_of_elements,
        "seconds": seconds["forward"],
        "residual": float(s.residual[0]),
        "newton": int(s.iterations[0]),
        "linear": int(s.linear_iterations[0]),
        "gradient_over_forward": seconds["with gradient"] / seconds["forward"],
        "gradient_error": min(abs(d / slope - 1) for d in differences),
    }


def liver_steps() -> list[dict]:
    """Measure steps per second of the hyperelastic liver, with one Newton iteration and with Newton to 1e-8.

    Both run under mild and under full gravity.
    """
    base = models()["hyperelastic"]
    programs, scenes = {}, {}
    for load, part in (("mild", 0.2), ("full", 1.0)):
        gravity = part * 9.81 / jnp.linalg.norm(base.body.gravity) * base.body.gravity
        heavy = replace(base, body=replace(base.body, gravity=gravity))
        for dt, steps in STEPS:
            for iterations in (1, 25):
                scene = with_solve(heavy, dt * steps, dt, **(ONE_STEP if iterations == 1 else {"tolerance": 1e-8}))
                scenes[load, dt, iterations] = scene
                programs[load, dt, iterations] = (lj.simulate, scene)
    results, seconds = medians(programs, 3)
    rest, rows = np.asarray(base.mesh.points), []
    for (load, dt, iterations), result in results.items():
        x, exact = (np.asarray(results[load, dt, n].positions) for n in (iterations, 25))
        s, steps = result.statistics, len(result.times)
        converged = found(result)
        rows.append(
            {
                "gravity": load,
                "dt": dt,
                "newton": "one" if iterations == 1 else "to 1e-8",
                "steps_per_s": steps / seconds[load, dt, iterations],
                "linear_per_step": float(s.linear_iterations.sum()) / steps,
                "newton_per_step": float(s.iterations.sum()) / steps,
                "largest_residual": finite(np.max(np.asarray(s.residual))),
                "error_of_positions": float(abs(x - exact).max() / abs(exact - rest).max()),
                "failed_steps": int(np.sum(~converged)),
            }
        )
        print({k: round(v, 6) if isinstance(v, float) else v for k, v in rows[-1].items()}, flush=True)
    return rows


def preconditioners() -> list[dict]:
    """Solve with the liver's tangent at rest by conjugate gradients to 1e-8, with and without the coarse space."""
    base, rows = models()["hyperelastic"], []
    mask = boundary.free_degrees(base.mesh, base.fixed, ())
    mass = base.body.density * boundary.nodal_volumes(base.mesh)
    b = (mask * jnp.asarray(base.body.gravity)[None] * mass[:, None]).T.ravel()
    for ratio in RATIOS:
        law = replace(base.law, bulk=ratio * float(base.law.shear_modulus()))
        for dt, _ in STEPS:

            def solved(law, dt, coarse):
                scene = replace(base, law=law, solve=replace(base.solve, dt=dt))
                e = equations(scene, initial_state(scene), 1.0)
                K = tangent.tangent(e, None, base.mesh.points, 1.0)
                slow = Coarse(K.slow.inverse, K.slow.used & coarse)
                precondition = tangent.preconditioner(e, K._replace(slow=slow))
                return conjugate_gradients(tangent.product(e, K), b, precondition, 1e-8, 5000)[1]

            results, seconds = medians({n: (solved, law, dt, n == "two-level") for n in ("two-level", "block-Jacobi")})
            rows.append({"bulk_over_mu": ratio, "dt": dt})
            for n, s in results.items():
                rows[-1][n] = {"iterations": int(s.iterations), "seconds": seconds[n], "residual": float(s.residual)}
            print(rows[-1], flush=True)
    return rows


def factorisation() -> list[dict]:
    """Solve a smaller cube with larger and larger bulk modulus: conjugate gradients against a factorisation on the
    host.
    """
    rows = []
    for ratio in STIFFER:
        results, seconds = medians(
            {n: (lj.simulate, cube(8, 1000.0 * ratio, linear_solver=n, tolerance=1e-7)) for n in ("cg", "direct")}, 3
        )
        rows.append({"bulk_over_mu": ratio})
        for n, r in results.items():
            s = r.statistics
            rows[-1][n] = {
                "seconds": seconds[n],
                "newton": int(s.iterations[0]),
                "linear": int(s.linear_iterations[0]),
                "residual": float(s.residual[0]),
                "converged": int(r.status[0]) == status.CONVERGED,
            }
        print(rows[-1], flush=True)
    return rows


def draw(steps: list[dict], ways: list[dict]):
    """Plot steps per second with their error, and iterations with and without the coarse space."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for load, marker in (("mild", "o"), ("full", "s")):
        for newton, colour in (("one", ORANGE), ("to 1e-8", BLUE)):
            rows = [r for r in steps if r["gravity"] == load and r["newton"] == newton]
            label = f"{'one iteration' if newton == 'one' else 'Newton to 1e-8'}, {load} gravity"
            left.plot(
                [r["dt"] for r in rows], [r["steps_per_s"] for r in rows], marker + "-", color=colour, label=label
            )
            for r in rows:
                text = f"{100 * r['error_of_positions']:.2g} %" if newton == "one" else f"{r['largest_residual']:.0e}"
                text = f"failed steps: {r['failed_steps']}" if r["failed_steps"] else text
                left.annotate(text, (r["dt"], r["steps_per_s"]), fontsize=6, xytext=(4, 4), textcoords="offset points")
    left.plot([dt for dt, _ in STEPS], [1 / dt for dt, _ in STEPS], ":", color=GREY, label="real time")
    left.set(xscale="log", yscale="log", xlabel="time step [s]", ylabel="steps a second")
    left.set_title("beside: error of positions (one), residual (to 1e-8)")
    for ratio, marker in zip(RATIOS, "os^", strict=False):
        rows = [r for r in ways if r["bulk_over_mu"] == ratio]
        for n, colour in (("block-Jacobi", ORANGE), ("two-level", BLUE)):
            counts = [r[n]["iterations"] for r in rows]
            right.plot([r["dt"] for r in rows], counts, marker + "-", color=colour, label=f"{n}, K/mu = {ratio:g}")
            for r in rows:
                at = (r["dt"], r[n]["iterations"])
                text = f"{1e3 * r[n]['seconds']:.0f} ms"
                right.annotate(text, at, fontsize=6, xytext=(4, 4), textcoords="offset points")
    right.set(xscale="log", yscale="log", xlabel="time step [s]", ylabel="iterations to a residual of 1e-8")
    for axis in (left, right):
        plain_ticks(axis.xaxis, axis.yaxis)
        axis.legend(fontsize=7)
    return fig


def main() -> None:
    """Run all parts."""
    static = static_cube()
    print(static, flush=True)
    steps, ways, direct = liver_steps(), preconditioners(), factorisation()
    content = {"rounds": ROUNDS, "static_cube": static, "liver": steps, "preconditioners": ways, "direct": direct}
    save("solve_benchmark", content, draw(steps, ways))


if __name__ == "__main__":
    main()
