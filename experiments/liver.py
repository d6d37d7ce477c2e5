"""The liver phantom of `scenes/liver_gravity.toml` in its three models, and timed runs of these models."""

import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import liverjax as lj
from liverjax.core import status
from liverjax.core.struct import replace

SCENE = Path(__file__).parent / "scenes" / "liver_gravity.toml"


def models() -> dict[str, lj.Scene]:
    """Return the three models: hyperelastic, viscous, and the chapter's complete model."""
    complete = lj.load_scene(SCENE)
    viscous = replace(complete, porosity=None)
    return {"hyperelastic": replace(viscous, viscosity=None), "viscous": viscous, "complete": complete}


def with_solve(scene: lj.Scene, seconds: float, dt: float, **changes) -> lj.Scene:
    """Return the scene with a duration of `seconds` in steps of `dt`, and other changes of its solver settings."""
    return replace(scene, solve=replace(scene.solve, dt=dt, steps=round(seconds / dt), **changes))


#: The chapter's scheme: one linear solve per step, to a relative residual of 1e-4.
ONE_STEP: dict[str, Any] = {"newton": "one_step", "tolerance": 1e-3}


def found(result: lj.Result) -> np.ndarray:
    """Return whether each step ended as its scheme intends. One Newton iteration need not meet the tolerance."""
    return np.isin(np.asarray(result.status), (status.CONVERGED, status.ONE_STEP))


def timed_run(scene: lj.Scene, rounds: int = 2) -> tuple[lj.Result, dict]:
    """Return the result, and times and iterations of the run. The run time is the shortest of some runs after
    compilation.
    """
    begin = time.perf_counter()
    program = jax.jit(lj.simulate).lower(scene).compile()
    compiling, seconds = time.perf_counter() - begin, []
    for _ in range(rounds):
        begin = time.perf_counter()
        result = jax.block_until_ready(program(scene))
        seconds.append(time.perf_counter() - begin)
    steps, s = len(result.times), result.statistics
    return result, {
        "dt": scene.solve.dt,
        "run_s": min(seconds),
        "compile_s": compiling,
        "steps_per_s": steps / min(seconds),
        "newton_per_step": float(s.iterations.sum()) / steps,
        "linear_per_step": float(s.linear_iterations.sum()) / steps,
        "cuts": int(s.cuts.sum()),
        "converged": bool(found(result).all()),
    }


def error(times: np.ndarray, x: np.ndarray, reference_times: np.ndarray, reference: np.ndarray, at: tuple) -> float:
    """Return the largest distance of a node from the reference at some times, over the largest displacement
    there [1].
    """
    pick = [np.argmin(abs(np.asarray(times) - t)) for t in at]
    of = [np.argmin(abs(np.asarray(reference_times) - t)) for t in at]
    x, exact = np.asarray(x)[pick], np.asarray(reference)[of]
    rest = np.asarray(lj.load_scene(SCENE).mesh.points)
    distance = np.linalg.norm(x - exact, axis=-1).max()
    return float(distance / np.linalg.norm(exact - rest, axis=-1).max()) if np.isfinite(distance) else float("inf")
