"""Elements of their own between the nodes of a body: membranes, ligaments, vessels."""
