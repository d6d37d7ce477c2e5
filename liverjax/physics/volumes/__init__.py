"""Volume changes that are averaged at nodes or have pressures as unknowns, against locking."""
