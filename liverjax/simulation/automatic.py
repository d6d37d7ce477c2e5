"""Choice of the linear solver for `linear_solver = "auto"`, from the size and the stiffness of the body.

"auto" chooses a factorisation for a static body of at most 10,000 tetrahedra (a quadratic element counts as eight) in
two cases. In the first case the bulk modulus is more than a thousand times the shear modulus. For a body of at most
1,500 tetrahedra, a ratio above a hundred is enough: during Newton's method the stiffness can have negative eigenvalues,
and conjugate gradients cannot solve such systems. In the second case an element is a sliver (quality below 0.001).
"auto" never chooses a factorisation if the body has friction, nodes that move together, follower pressures, or
pressures as unknowns. In all other cases "auto" chooses conjugate gradients. The limits come from tests in
`experiments/`.
"""

from collections.abc import Iterable, Mapping

import jax
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.scenes.by_element import by_element
from liverjax.scenes.checks.choices import check_volumetric
from liverjax.scenes.scene import Scene, Solve, with_parameters

LARGEST, STIFFEST, THINNEST = 10_000, 1e3, 1e-3
#: A body with at most `SMALL` elements is small. "auto" chooses a factorisation for a small body if its bulk modulus is
#: more than `STIFFEST_OF_SMALL` times its shear modulus.
SMALL, STIFFEST_OF_SMALL = 1500, 1e2


def chosen(scene: Scene) -> Scene:
    """Replace each "auto" in `scene.solve` by a choice: first for `volumetric`, then for `linear_solver`.

    If `newton_iterations` is 1, `newton` is set to "one_step".
    """
    solve = _with_form(scene).solve
    if is_one_step(solve):
        solve = replace(solve, newton="one_step")
    if solve.linear_solver == "auto":
        solve = replace(solve, linear_solver=linear_solver(replace(scene, solve=solve)))
    return replace(scene, solve=solve)


def is_one_step(solve: Solve) -> bool:
    """Return whether a step has only one linear solve, because of `newton` or of `newton_iterations`."""
    return solve.newton == "one_step" or solve.newton_iterations == 1


def with_solver(scene: Scene, rows: Iterable[Mapping[str, object]]) -> Scene:
    """Return the scene with one linear solver for all parameter sets, because one compiled program runs all of them.

    Inside the compiled program the numbers are unknown. So "auto" is replaced here by "direct" if any parameter set
    needs a factorisation. Otherwise the scene does not change.

    Args:
        scene: `Scene`.
        rows: parameter sets: dotted names -> numbers (see `with_parameters`). Numbers that are unknown inside jit, grad
            or vmap are ignored.
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
    """Return the linear solver for a scene: "direct" or "cg". It is "cg" if numbers are unknown (as in jit)."""
    return "direct" if _may_factorise(scene) and (_is_stiff(scene) or _is_thin(scene)) else "cg"


def _may_factorise(scene: Scene) -> bool:
    """Return whether the number of elements and the physics allow a factorisation. Moduli and element shapes are
    ignored."""
    solve = scene.solve
    if solve.volumetric == "mixed" or any(physics.ties for physics in scene.physics):
        return False
    follows = any(load.pressure is not None for load in scene.traction)
    if solve.kind != "static" or _size(scene) > LARGEST or follows:
        return False
    return all(physics.conservative for physics in scene.physics)


def _size(scene: Scene) -> int:
    """Return the number of elements. A quadratic element counts as eight: it has about eight times as many unknowns."""
    return scene.mesh.number_of_elements * (1 if scene.mesh.order == 1 else 8)


def _is_stiff(scene: Scene) -> bool:
    """Return whether the bulk modulus is far above the shear modulus; False if the moduli are unknown (as in jit)."""
    try:
        shear = scene.law.shear_modulus()
        bulk = scene.law.bulk_modulus() if scene.porosity is None else scene.porosity.limit_bulk
    except InputError:  # the ratio is unknown, because the law has no moduli
        return False
    if isinstance(shear, jax.core.Tracer) or isinstance(bulk, jax.core.Tracer):
        return False
    most = STIFFEST_OF_SMALL if _size(scene) <= SMALL else STIFFEST
    return bool(np.any(np.asarray(bulk, float) > most * np.asarray(shear, float)))


def _is_thin(scene: Scene) -> bool:
    """Return whether any element is a sliver; False if the points are unknown (inside jit, grad or vmap)."""
    points, volumes = scene.mesh.points, scene.mesh.volumes
    if isinstance(points, jax.core.Tracer) or isinstance(volumes, jax.core.Tracer):
        return False
    tetrahedra = np.asarray(scene.mesh.tetrahedra)
    return thinnest(np.asarray(points, float), tetrahedra, np.asarray(volumes, float)) < THINNEST


def form_of_volumes(scene: Scene) -> str:
    """Return the scene's setting `volumetric`, the form of the volume changes.

    The setting "auto" becomes "mixed" for quadratic elements if possible, otherwise "element". This choice does not
    depend on the values of parameters, since a run and its derivatives must use the same form.
    """
    name = scene.solve.volumetric
    if name != "auto":
        return name
    if scene.mesh.order == 1:
        return "element"
    return "mixed" if _allows_mixed(scene) else "element"


def _allows_mixed(scene: Scene) -> bool:
    """Return whether `volumetric` can be "mixed" in this scene."""
    try:
        check_volumetric(replace(scene, solve=replace(scene.solve, volumetric="mixed")))
    except InputError:
        return False
    return True


def advice_against_locking(scene: Scene) -> str:
    """Return the advice for quadratic elements that lock: volumetric = "mixed" if possible, otherwise a finer mesh."""
    if _allows_mixed(scene):
        return "write volumetric = 'mixed' in [solve]"
    for key in ("viscosity", "springpots"):
        own = getattr(scene, key)
        if own is not None and _allows_mixed(replace(scene, **{key: replace(own, part="isochoric")})):
            return f"write volumetric = 'mixed' in [solve] and part = 'isochoric' in [{key}]"
    return "use a finer mesh"


def thinnest(points: np.ndarray, tetrahedra: np.ndarray, volumes: np.ndarray) -> float:
    """Return the lowest quality of all elements (see `qualities`)."""
    return float(np.min(qualities(points, tetrahedra, volumes)))


def qualities(points: np.ndarray, tetrahedra: np.ndarray, volumes: np.ndarray) -> np.ndarray:
    """Return the quality (E,) of each element: its volume, divided by the volume of a regular tetrahedron with the same
    mean squared edge length."""
    corners = points[tetrahedra]
    edges = np.stack([corners[:, a] - corners[:, b] for a in range(4) for b in range(a)], axis=1)
    length = np.sqrt(np.mean(np.sum(edges**2, axis=2), axis=1))
    return 6 * np.sqrt(2) * np.abs(volumes) / length**3
