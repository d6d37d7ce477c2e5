"""The meaning of the commands' exit codes, for their help."""

EXIT_CODES = "Exit code 0: done; 1: the fit did not converge (its best point is kept, marked); 2: unusable input."
