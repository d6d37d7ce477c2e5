"""Two methods against volumetric locking: volume changes averaged at nodes, or pressures as unknowns."""
