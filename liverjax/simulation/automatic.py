"""Which linear solver `linear_solver = "auto"` means: a rule on size and stiffness, measured in `experiments/`.

It means a factorisation for some static bodies of at most 10,000 tetrahedra, if no pressure follows the body and there
is no friction: their bulk modulus is more than a thousand times the shear modulus (a hundred times if they have at most
1,500 tetrahedra: there iterations meet negative eigenvalues on their way, and a factorisation goes through them), or
their worst element is a sliver. For all others it means conjugate gradients.
"""

from collections.abc import Iterable, Mapping

import jax
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.scenes.by_element import by_element
from liverjax.scenes.checks.choices import check_choices
from liverjax.scenes.scene import Scene, with_parameters

LARGEST, STIFFEST, THINNEST = 10_000, 1e3, 1e-3
#: Elements of a small body, and its ratio of bulk to shear modulus from which it is factorised.
SMALL, STIFFEST_OF_SMALL = 1500, 1e2


def chosen(scene: Scene) -> Scene:
    """The scene with choices in place of `auto`: form for volumes, then linear solver."""
    solve = _with_form(scene).solve
    if solve.newton_iterations == 1:
        solve = replace(solve, newton="one_step")
    if solve.linear_solver == "auto":
        solve = replace(solve, linear_solver=linear_solver(replace(scene, solve=solve)))
    return replace(scene, solve=solve)


def with_solver(scene: Scene, rows: Iterable[Mapping[str, object]]) -> Scene:
    """The scene, to be run with the numbers of each row in one program, with the solver that all rows can have.

    Inside a program numbers are not known. So "direct" is chosen here, if any row needs it; "auto" stays otherwise.

    Args:
        scene: `Scene`.
        rows: dotted names -> numbers, as in `with_parameters`; traced ones are not looked at.
    """
    direct = replace(scene, solve=replace(scene.solve, linear_solver="direct"))
    if scene.solve.linear_solver != "auto" or not _may_factorise(_with_form(scene)):
        return scene
    if _is_thin(scene):
        return direct
    for row in rows:
        own = by_element(with_parameters(scene, dict(row)))
        if _is_stiff(own) or (any(name.startswith("mesh.points") for name in row) and _is_thin(own)):
            return direct
    return scene


def _with_form(scene: Scene) -> Scene:
    return replace(scene, solve=replace(scene.solve, volumetric=form_of_volumes(scene)))


def linear_solver(scene: Scene) -> str:
    """The solver for a scene: cg or direct. It is cg if its numbers are traced, since they are not known then."""
    return "direct" if _may_factorise(scene) and (_is_stiff(scene) or _is_thin(scene)) else "cg"


def _may_factorise(scene: Scene) -> bool:
    """Whether size and physics allow a factorisation, whatever the numbers are."""
    solve = scene.solve
    if solve.volumetric == "mixed" or any(physics.ties for physics in scene.physics):
        return False
    follows = any(load.pressure is not None for load in scene.traction)
    if solve.kind != "static" or _size(scene) > LARGEST or follows:
        return False
    return all(physics.conservative for physics in scene.physics)


def _size(scene: Scene) -> int:
    """Number of elements; a quadratic element has about eight times the unknowns of a linear one."""
    return scene.mesh.number_of_elements * (1 if scene.mesh.order == 1 else 8)


def _is_stiff(scene: Scene) -> bool:
    """Whether the bulk modulus is far above the shear modulus; no if they are traced."""
    try:
        shear = scene.law.shear_modulus()
        bulk = scene.law.bulk_modulus() if scene.porosity is None else scene.porosity.limit_bulk
    except InputError:  # a law need not state its moduli: how stiff it is in bulk is then not known
        return False
    if isinstance(shear, jax.core.Tracer) or isinstance(bulk, jax.core.Tracer):
        return False
    most = STIFFEST_OF_SMALL if _size(scene) <= SMALL else STIFFEST
    return bool(np.any(np.asarray(bulk, float) > most * np.asarray(shear, float)))


def _is_thin(scene: Scene) -> bool:
    """Whether an element is a sliver; no if the points are traced."""
    points, volumes = scene.mesh.points, scene.mesh.volumes
    if isinstance(points, jax.core.Tracer) or isinstance(volumes, jax.core.Tracer):
        return False
    tetrahedra = np.asarray(scene.mesh.tetrahedra)
    return thinnest(np.asarray(points, float), tetrahedra, np.asarray(volumes, float)) < THINNEST


def form_of_volumes(scene: Scene) -> str:
    """The form for volume changes: mixed for quadratic elements if possible, else element.

    It does not depend on numbers, since a run and its derivatives must have the same form.
    """
    name = scene.solve.volumetric
    if name != "auto":
        return name
    if scene.mesh.order == 1:
        return "element"
    try:
        check_choices(replace(scene, solve=replace(scene.solve, volumetric="mixed")))
    except InputError:
        return "element"
    return "mixed"


def thinnest(points: np.ndarray, tetrahedra: np.ndarray, volumes: np.ndarray) -> float:
    """The smallest quality of all elements."""
    return float(np.min(qualities(points, tetrahedra, volumes)))


def qualities(points: np.ndarray, tetrahedra: np.ndarray, volumes: np.ndarray) -> np.ndarray:
    """Quality (E,) of elements: volume over the volume of a regular one with the same mean square edge."""
    corners = points[tetrahedra]
    edges = np.stack([corners[:, a] - corners[:, b] for a in range(4) for b in range(a)], axis=1)
    length = np.sqrt(np.mean(np.sum(edges**2, axis=2), axis=1))
    return 6 * np.sqrt(2) * np.abs(volumes) / length**3
