"""Command lines of the fits. Each sub-command has one file with `parser` (the arguments) and `run`."""
