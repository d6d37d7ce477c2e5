"""Forms of the volume change against locking: averages at nodes, or pressures as unknowns."""
