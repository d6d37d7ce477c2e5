"""Reports of fits to waves."""
