"""Error against run time, and known answers."""
