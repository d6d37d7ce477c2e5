"""Command lines of the simulator: one file a sub-command, each with `add` (its arguments) and `run`."""
