"""Command lines of the fits: one file a sub-command, each with `parser` (its arguments) and `run`."""
