"""Meshes of tetrahedra: geometry, files, shapes, neighbours of nodes."""

from liverjax.mesh.tetrahedra import TetMesh, check_mesh, read_mesh, tet_mesh, with_points, write_mesh

__all__ = ["TetMesh", "check_mesh", "read_mesh", "tet_mesh", "with_points", "write_mesh"]
