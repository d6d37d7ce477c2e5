"""Check that every connected piece of the body is supported against rigid motions."""

from collections.abc import Callable, Container

import numpy as np

from liverjax.core.errors import InputError
from liverjax.mesh.locate import doubled_vertices
from liverjax.physics.base import Physics
from liverjax.physics.prescribed import free_places
from liverjax.scenes.scene import Scene, named_physics


def holding(scene: Scene, only: Container[str] | None = None) -> dict[str, int]:
    """Return how many nodal displacement components each object in `scene.physics` fixes at the beginning of the run.

    The keys are the names of the objects, for example support.0. If `only` is given, only these names are included.
    """
    named = [(name, physics) for name, physics in named_physics(scene) if only is None or name in only]
    return {name: len(physics.holds(scene.mesh)[0]) for name, physics in named}


def check_hold(scene: Scene, before: dict[str, int]) -> None:
    """Check that a static body is still supported against rigid motions after numbers of its scene were changed.

    The check is done only if an object in `scene.physics` now fixes fewer displacement components than `before`.

    Args:
        scene: `Scene` with the changed numbers.
        before: result of `holding` with the old numbers.

    Raises:
        InputError: a connected piece of the body is no longer supported.
    """
    still = scene.solve.kind == "static" or scene.points_are == "loaded"
    if still and any(number < before[name] for name, number in holding(scene, before).items()):
        check_held(scene)


def check_held(scene: Scene) -> None:
    """Raise InputError if a connected piece of the body has a free rigid motion. Then no static solution exists."""
    loose = loose_piece(scene, lambda physics: physics.holds(scene.mesh))
    if loose:
        doubled = doubled_vertices(scene.mesh)
        split = (
            f"merge the {doubled} nodes that coincide with another node (if the mesh should be connected there), or "
        )
        static = scene.solve.kind == "static"  # otherwise the mesh is the loaded body
        or_motion = " or kind = 'dynamic'" if static else ""
        remedy = f"{split if doubled else ''}add [[fixed]]{or_motion}"
        raise InputError(f"the supports do not prevent every rigid motion of {loose}: {remedy}")


def loose_piece(scene: Scene, holds: Callable[[Physics], tuple[np.ndarray, np.ndarray]]) -> str:
    """Describe the first connected piece of the body that has a free rigid motion. Return "" if there is no such piece.

    Args:
        scene: `Scene`.
        holds: function of an object in `scene.physics`. It returns the nodes and directions of constraints, as
            `Physics.holds` does.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    each, n = scene.mesh.element_nodes_on_host, scene.mesh.number_of_nodes
    rows, columns = np.tile(each[0], len(each)), np.concatenate(each)
    pieces, label = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)), directed=False)
    fixed = np.argwhere(~free_places(scene.mesh, scene.fixed, scene.displaced))
    both = [(fixed[:, 0], np.eye(3)[fixed[:, 1]]), *(holds(physics) for physics in scene.physics)]
    points = np.asarray(scene.mesh.points, float)
    for piece in range(pieces):
        inside = label == piece
        size = np.ptp(points[inside], axis=0).max()
        arms = (points - points[inside].mean(axis=0)) / max(size, 1e-300)
        rows = np.concatenate([_rigid_motions(*one, arms, inside) for one in both])
        if not len(rows) or np.linalg.matrix_rank(rows, tol=1e-6) < 6:
            return f"piece {piece} ({inside.sum()} nodes)" if pieces > 1 else "the body"
    return ""


def _rigid_motions(numbers: np.ndarray, directions: np.ndarray, arms: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the components (n, 6) of the six rigid motions of a piece along the n constraints of this piece alone.

    Args:
        numbers: node numbers (N,) or (N, m) of all constraints.
        directions: constrained directions (N, 3) or (N, m, 3) of these nodes.
        arms: positions (V, 3) of all nodes from the middle of the piece, divided by its size.
        inside: whether a node belongs to the piece (V,).
    """
    if numbers.ndim == 1:
        numbers, directions = numbers[:, None], directions[:, None]
    # A rotation about an axis e moves a point x by cross(e, x). The component of this motion along a direction d is
    # cross(x, d) . e.
    motions = np.concatenate([directions, np.cross(arms[numbers], directions)], axis=2).sum(axis=1)
    return motions[inside[numbers].all(axis=1)]
