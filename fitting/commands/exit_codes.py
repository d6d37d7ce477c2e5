"""The meaning of the exit codes, for the help of the commands."""

EXIT_CODES = "Exit code 0: done; 1: the fit did not converge (its best point is kept, marked); 2: unusable input."
