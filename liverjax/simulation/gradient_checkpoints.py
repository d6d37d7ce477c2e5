"""Checkpoints of reverse-mode differentiation: the states and roots of all steps are kept, or only a few states.

The root of a step is the solution of its equations (`liverjax.solvers.step_cutting` sets its name for JAX). The root is
kept. So the derivative evaluates forces and tangent at the root again, but does not repeat Newton's iterations. If
fewer states than steps are kept (Griewank and Walther 2008, chapter 12), the steps between two kept states run a second
time.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.solvers.step_cutting import ROOT


def number_kept(store: str | int, steps: int) -> int:
    """Return the number of states that reverse mode keeps in a run of `steps` steps.

    Args:
        store: "all", "sqrt", or a number above 0.

    Raises:
        InputError: `store` has another value.
    """
    if store == "all":
        return steps
    if store == "sqrt":
        return max(1, round(math.sqrt(steps)))
    if isinstance(store, bool) or not isinstance(store, int) or store < 1:
        raise InputError(f"store = {store!r} is not known: give 'all', 'sqrt' or a number of states above 0")
    return min(store, steps)


def lengths(steps: int, kept: int) -> tuple[int, int, int]:
    """Return the number of full segments, the steps per segment, and the steps of a shorter last segment (0: none)."""
    length = math.ceil(steps / kept)
    return steps // length, length, steps % length


def one_step(step: Callable) -> Callable:
    """Wrap the function `step`, so that reverse mode keeps only its arguments and the root."""
    policy = jax.checkpoint_policies.save_only_these_names(ROOT)
    return jax.checkpoint(step, policy=policy, prevent_cse=False)


def scan(step: Callable, start: Any, numbers: jax.Array, kept: int) -> Any:
    """Apply `step` (carry, k) for all `numbers` (T,). Return the outputs of all steps, stacked, without the carry.

    Reverse mode keeps `kept` states.
    """
    steps = len(numbers)
    if kept >= steps:
        return jax.lax.scan(step, start, numbers)[1]
    count, length, rest = lengths(steps, kept)
    beyond = length - rest if rest else 0

    def unless_over(carry, at):
        k, real = at
        nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(step, carry, k)[1])
        return jax.lax.cond(real, step, lambda carry, _: (carry, nothing), carry, k)

    # Only the state at the beginning of a segment is kept. All segments use the same compiled loop with equal length,
    # so the last segment skips the steps after the end of the run.
    @jax.checkpoint
    def segment(carry, at):
        return jax.lax.scan(unless_over, carry, at) if beyond else jax.lax.scan(step, carry, at)

    count += rest > 0
    rows = jnp.pad(numbers, (0, beyond)).reshape(count, length)
    real = (jnp.arange(count * length) < steps).reshape(count, length)
    out = jax.lax.scan(segment, start, (rows, real) if beyond else rows)[1]
    return jax.tree.map(lambda a: a.reshape(count * length, *a.shape[2:])[:steps], out)
