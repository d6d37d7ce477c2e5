"""How the volume of an element changes with its nodes."""

from liverjax.mesh.tetrahedra import TetMesh
from liverjax.tensors.matrices import Matrix, Vector, cofactor, matvec


def volume_gradients(mesh: TetMesh, F: Matrix) -> list[Vector]:
    """cof(F) D_a = dJ/dx_a of the four nodes."""
    cof = cofactor(F)
    g = [matvec(cof, tuple(mesh.shape_vectors[a])) for a in range(3)]
    return [tuple(-(x + y + z) for x, y, z in zip(*g, strict=True)), *g]
