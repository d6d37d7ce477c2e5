"""Run a scene: one step, a whole run, derivatives of a run, and batches of runs."""

from liverjax.simulation.run import Result, prepared, simulate, simulate_part

__all__ = ["Result", "prepared", "simulate", "simulate_part"]
