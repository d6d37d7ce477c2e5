"""The meaning of the exit codes, for the help of the commands."""

EXIT_CODES = (
    "Exit codes: 0 done, 1 the fit did not converge (the parameters with the smallest misfit are kept and marked), "
    "2 unusable input."
)
