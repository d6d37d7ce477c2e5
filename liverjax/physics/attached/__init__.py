"""Additional elements between the nodes of a body: membranes, ligaments, vessels."""
