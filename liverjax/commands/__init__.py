"""Command lines of the simulator: one file for each sub-command, with `add` (its arguments) and `run`."""
