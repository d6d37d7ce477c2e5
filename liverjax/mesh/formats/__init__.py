"""Readers of mesh formats that meshio does not read correctly."""
