"""A run of a scene: one step, the whole run, its derivatives, batches."""

from liverjax.simulation.run import Result, prepared, simulate, simulate_part

__all__ = ["Result", "prepared", "simulate", "simulate_part"]
