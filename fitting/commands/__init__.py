"""Command lines of the fits: one file per sub-command, each with `parser` (its arguments) and `run`."""
