"""Error against run time, and problems with known solutions."""
