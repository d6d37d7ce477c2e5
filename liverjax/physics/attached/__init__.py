"""Additional elements that connect nodes of the body: membranes, ligaments, vessels."""
