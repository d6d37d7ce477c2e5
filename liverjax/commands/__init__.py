"""Command lines of the simulator: one file per sub-command, each with `add` (its arguments) and `run`."""
