"""Command lines of the simulator. Each sub-command has one file with the functions `add` (arguments) and `run`."""
