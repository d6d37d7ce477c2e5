"""Meshes of tetrahedra: geometry, files, generated shapes, and neighbours of nodes."""

from liverjax.mesh.files import read_mesh, write_mesh
from liverjax.mesh.promotion import quadratic
from liverjax.mesh.tetrahedra import TetMesh, check_mesh, tet_mesh, with_points

__all__ = ["TetMesh", "check_mesh", "quadratic", "read_mesh", "tet_mesh", "with_points", "write_mesh"]
