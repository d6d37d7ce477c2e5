"""Check that different entries of a scene do not prescribe the motion of the same node along the same direction."""

import jax
import numpy as np

from liverjax.core.errors import InputError
from liverjax.mesh.selection import AXES
from liverjax.physics.prescribed import free_places
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.scene import Scene, named_physics

#: A displacement component smaller than this fraction of the largest one counts as 0: it is roundoff, e.g. of a
#: rotation.
_NO_MOTION = 1e-12


def check_moved_where_fixed(scene: Scene) -> None:
    """Raise InputError if a node is fixed along an axis, and also has a displacement other than 0 along this axis.

    Arrays inside jit are not checked.
    """
    for k, motion in enumerate(scene.displaced):
        by = motion.history if motion.by is None else motion.by
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((by, motion.nodes))):
            continue
        numbers, vectors = np.asarray(motion.nodes).ravel(), np.asarray(by, float)
        if motion.by is None or vectors.ndim == 1:  # all nodes of `motion` have the same displacement
            vectors = np.broadcast_to(np.abs(vectors.reshape(-1, 3)).max(axis=0), (len(numbers), 3))
        nothing = _NO_MOTION * float(np.abs(vectors).max(initial=0.0))
        for n, hold in enumerate(scene.fixed):
            if isinstance(hold.nodes, jax.core.Tracer):
                continue
            shared = np.isin(numbers, np.asarray(hold.nodes))
            for axis in (a for a in motion.axes if a in hold.axes):
                wrong = numbers[shared & (np.abs(vectors[:, AXES.index(axis)]) > nothing)]
                if len(wrong):
                    raise InputError(
                        f"fixed.{n} and displaced.{k} both prescribe node {wrong[0]} along {axis}: select different "
                        "nodes"
                    )


def check_plates_alone(scene: Scene) -> None:
    """Raise InputError if nodes of a rigid plate have another support or motion. Arrays inside jit are not checked."""
    named = [(f"{kind}.{k}", part) for kind in ("fixed", "displaced") for k, part in enumerate(getattr(scene, kind))]
    every = named_physics(scene)
    plates = [(name, physics) for name, physics in every if physics.ties]
    named += [(name, physics) for name, physics in every if isinstance(physics, SlidingSupport)]
    for k, (name, plate) in enumerate(plates):
        for other, part in named + plates[:k]:
            nodes = [getattr(own, "nodes", None) for own in (plate, part)]
            if any(own is None or isinstance(own, jax.core.Tracer) for own in nodes):
                continue
            both = np.intersect1d(np.asarray(nodes[0]), np.asarray(nodes[1]))
            if len(both):
                raise InputError(
                    f"{name} and {other} share node {both[0]}, but only the plate may move this node: select different "
                    "nodes"
                )


def check_normals(scene: Scene) -> None:
    """Raise InputError if a node slides in two planes that are not normal to x, y or z (oblique planes).

    An error is also raised if a node slides in an oblique plane, and the plane's normal has components along both a
    constrained and a free axis of this node. Arrays inside jit, grad or vmap are not checked.
    """
    slides = [(name, physics) for name, physics in named_physics(scene) if isinstance(physics, SlidingSupport)]
    nodes = [*(f.nodes for f in scene.fixed), *(d.nodes for d in scene.displaced), *(s.nodes for _, s in slides)]
    if all(slide.axis for _, slide in slides) or any(isinstance(n, jax.core.Tracer) for n in nodes):
        return
    for name, slide in slides:
        if not _is_unknown(slide.normal):
            slide.check(scene.mesh, name)
    taken: dict[int, str] = {}
    mask = free_places(scene.mesh, scene.fixed, scene.displaced)
    for _, physics in slides:
        if physics.axis:
            mask[np.asarray(physics.nodes), AXES.index(physics.axis)] = False
    for name, physics in slides:
        if physics.axis or _is_unknown(physics.normal):
            continue
        across = np.abs(np.asarray(physics.normal)) > 1e-12
        for node in np.asarray(physics.nodes).tolist():
            other = taken.setdefault(node, name)
            if other != name:
                raise InputError(
                    f"{other} and {name} share node {node}, but a node can slide in only one oblique plane: rotate the "
                    "body so that the planes are normal to x, y or z, select different nodes, or remove one plane"
                )
            if 0 < mask[node, across].sum() < across.sum():
                raise InputError(
                    f"{name} and another condition constrain node {node} in directions that are not at right angles: "
                    "select different nodes"
                )


def _is_unknown(value: object) -> bool:
    """Return whether a number, or a number in a tuple or list, is unknown (inside jit, grad or vmap)."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))


def check_prescribed_once(scene: Scene) -> None:
    """Raise InputError if two conditions prescribe a node along the same axis. Two `fixed` conditions are allowed.

    Do not call this function inside jit.
    """
    taken: dict[tuple[int, str], str] = {}
    for kind in ("fixed", "displaced"):
        for k, condition in enumerate(getattr(scene, kind)):
            for axis in condition.axes:
                for node in np.asarray(condition.nodes).tolist():
                    other = taken.setdefault((node, axis), f"{kind}.{k}")
                    if other != f"{kind}.{k}" and "displaced" in (kind, other.partition(".")[0]):
                        raise InputError(
                            f"{other} and {kind}.{k} both prescribe node {node} along {axis}: select different nodes"
                        )


def check_motion_in_planes(scene: Scene) -> None:
    """Check that prescribed motions do not move nodes out of their sliding planes.

    Do not call this function inside jit.

    Raises:
        InputError: a motion moves a node out of its plane. The message begins with the name of the motion.
    """
    for name, physics in named_physics(scene):
        if not isinstance(physics, SlidingSupport):
            continue
        nodes, normals = physics.holds(scene.mesh)
        for k, motion in enumerate(scene.displaced):
            both = np.isin(np.asarray(motion.nodes), nodes)
            vectors = np.array(motion.history if motion.by is None else motion.by, float)
            vectors[..., [a for a in range(3) if AXES[a] not in motion.axes]] = 0.0
            own = vectors[both] if motion.by is not None and vectors.ndim == 2 else vectors
            if both.any() and np.any(np.abs(own @ normals[0]) > 1e-9 * np.abs(vectors).max()):
                node = np.asarray(motion.nodes)[both][0]
                raise InputError(
                    f"displaced.{k} moves node {node} out of the plane of {name}: select different nodes, or remove "
                    "this direction from axes"
                )
