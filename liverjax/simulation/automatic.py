"""Which linear solver `linear_solver = "auto"` means: a rule on size and stiffness, measured in `experiments/`.

It means a factorisation for some static bodies of at most 10,000 tetrahedra, if no pressure follows the body and there
is no friction: their bulk modulus is more than a thousand times the shear modulus, or their worst element is a sliver.
For all others it means conjugate gradients.
"""

import jax
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.scenes.checks.choices import check_choices
from liverjax.scenes.scene import Scene

LARGEST, STIFFEST, THINNEST = 10_000, 1e3, 1e-3


def chosen(scene: Scene) -> Scene:
    """The scene with choices in place of `auto`: form for volumes, then linear solver."""
    solve = replace(scene.solve, volumetric=form_of_volumes(scene))
    if solve.newton_iterations == 1:
        solve = replace(solve, newton="one_step")
    if solve.linear_solver == "auto":
        solve = replace(solve, linear_solver=linear_solver(replace(scene, solve=solve)))
    return replace(scene, solve=solve)


def linear_solver(scene: Scene) -> str:
    """The solver for a scene: cg or direct. It is cg if its numbers are traced, since they are not known then."""
    mesh, solve = scene.mesh, scene.solve
    # A quadratic element has about eight times the unknowns of a linear one.
    small = mesh.number_of_elements * (1 if mesh.order == 1 else 8) <= LARGEST
    if solve.volumetric == "mixed" or any(physics.ties for physics in scene.physics):
        return "cg"
    follows = any(load.pressure is not None for load in scene.traction)
    if solve.kind != "static" or not small or follows or not all(physics.conservative for physics in scene.physics):
        return "cg"
    try:
        shear = scene.law.shear_modulus()
        bulk = scene.law.bulk_modulus() if scene.porosity is None else scene.porosity.limit_bulk
    except InputError:  # a law need not state its moduli: how stiff it is in bulk is then not known
        shear, bulk = 1.0, 0.0
    numbers = (shear, bulk, mesh.points, mesh.volumes)
    if any(isinstance(a, jax.core.Tracer) for a in numbers):
        return "cg"
    shear, bulk, points, volumes = (np.asarray(a, float) for a in numbers)
    stiff = bool(np.any(bulk > STIFFEST * shear))
    return "direct" if stiff or thinnest(points, np.asarray(mesh.tetrahedra), volumes) < THINNEST else "cg"


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
