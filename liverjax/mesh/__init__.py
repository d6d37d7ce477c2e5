"""Meshes of tetrahedra: geometry, files, shapes, neighbours of nodes."""
