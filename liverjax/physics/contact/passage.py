"""A sphere or a cylinder that goes through the body within a step.

Contact knows how far the surface is from the obstacle, and no more: a sphere deep in the body touches nothing.
"""

import numpy as np

from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.contact.obstacle import Obstacle, centre_in_body, largest_depth

#: Places along the way of a step, over its length in radii, and their largest number.
_PER_RADIUS, _MOST = 2, 64


def passes_through(obstacle: Obstacle, mesh: TetMesh, positions: np.ndarray, moved: np.ndarray) -> bool:
    """Whether the obstacle goes through the body within a step longer than its radius, and ends without contact.

    Args:
        positions: (2, V, 3) [m] at the beginning and at the end of the step. A place on the way counts if the centre is
            in the body in both: a body follows an obstacle that leaves it.
        moved: displacements (2, 3) [m] of the obstacle.
    """
    way, radius = np.asarray(moved[1]) - np.asarray(moved[0]), float(np.asarray(obstacle.radius))
    length = float(np.linalg.norm(way))
    if obstacle.shape not in ("sphere", "cylinder") or not length > radius:
        return False
    if float(largest_depth(obstacle, mesh, positions[1], moved[1])) > 0:
        return False
    count = min(int(np.ceil(_PER_RADIUS * length / radius)), _MOST)
    places = (moved[0] + s * way for s in np.arange(1, count) / count)
    return any(all(centre_in_body(obstacle, mesh, x, place) for x in positions) for place in places)
