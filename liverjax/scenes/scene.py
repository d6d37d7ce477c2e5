"""A scene: mesh, material law, supports, prescribed motions, loads, and further physics objects.

"A physics" is one object that adds forces or constraints, for example a support or an obstacle.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import names
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers, param, replace, static, struct, unnamed
from liverjax.laws import Law
from liverjax.mesh.tetrahedra import TetMesh, with_points
from liverjax.physics.base import Physics
from liverjax.physics.loads import Traction
from liverjax.physics.porosity import Porosity
from liverjax.physics.prescribed import Displaced, Fixed
from liverjax.physics.viscosity import Prony
from liverjax.scenes.regions import Region
from liverjax.scenes.springpots import SpringpotSeries

#: Maximum frequency [Hz] of harmonic motion. Tissue has no waves of higher frequency, and the squared frequency must
#: not overflow.
HIGHEST_HZ = 1e9


@struct
class Body:
    """Mass and weight of the body.

    In linear elements, the lumped mass of a node is its density times a quarter of the volume of its elements. With
    consistent masses and one density per node, each element has one density: its lumped mass divided by its volume. The
    weight belongs to the same masses, also in static runs. In quadratic elements with lumped masses, the weights of
    single nodes differ from their masses times gravity, and only the totals agree.
    """

    density: Number = param(
        "kg/m^3", "mass per reference volume; one number, or one per node (V,)", above=0.0, typical=1060.0
    )
    gravity: Numbers = param("m/s^2", "acceleration (3,)", default=(0.0, 0.0, 0.0))
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param(
        "1", "factors (T,) that multiply gravity, or gravity itself (T, 3) [m/s^2]", default=None
    )
    mass: str = static(
        default="lumped", about="mass for inertia in time steps: lumped, or consistent (as in the weight)"
    )


@struct
class Solve:
    """Settings of the solution of a scene.

    New values of time step, tolerances and frequencies use the same compiled program. A change of any other setting
    compiles a new program.
    """

    dt: Any = param("s", "time step; None: load steps without time", above=0.0, default=None)
    kind: str = static(default="static", about="static: no inertia; dynamic; harmonic: waves at `frequencies`")
    steps: int = static(default=1, about="load steps, or time steps of dt", lower=1)
    tolerance: Any = param(
        "1", "tolerance of the residual, relative to the size of all forces", above=0.0, upper=0.5, default=1e-8
    )
    newton: str = static(
        default="converged",
        about="converged: iterations to the tolerance; one_step: the chapter's linearly implicit scheme, one linear "
        "solve per step (not for derivatives)",
    )
    newton_iterations: int = static(
        default=25,
        about="maximum number of iterations in a step, or in a substep of a divided step; 1 means newton = one_step",
        lower=1,
    )
    integrator: str = static(
        default="euler", about="dynamic: euler (first order) or newmark (average acceleration, second order)"
    )
    precision: str = static(default="float64", about="float64 or float32")
    linear_solver: str = static(
        default="auto", about="cg; direct: factorised on the CPU; auto: chosen by size and stiffness"
    )
    volumetric: str = static(
        default="element",
        about="element; against locking: mixed (pressures are unknowns) or nodal (averaged at nodes); auto: mixed for "
        "quadratic elements if possible",
    )
    robust: str = static(
        default="off", about="projected or regularised: minimise the energy if Newton's method fails in a step"
    )
    frequencies: Numbers | None = param(
        "Hz", "frequencies (F,) of harmonic motion", above=0.0, upper=HIGHEST_HZ, default=None
    )
    reduced: str = static(default="", about="file of a reduced model, written by `python -m liverjax reduce`")
    reduced_tolerance: Number = param(
        "1",
        "estimated error divided by largest displacement; above this value the full model runs",
        above=0.0,
        default=0.01,
    )


@struct
class Scene:
    """Input of `simulate`. Missing entries are None or empty tuples, and need no computing time."""

    mesh: TetMesh = param("1", "the body")
    law: Law = param("1", "its hyperelastic law")
    region: tuple[Region, ...] = param("1", "parts of the body with other parameters or another law", default=())
    viscosity: Prony | None = param("1", "Prony series", default=None)
    springpots: SpringpotSeries | None = param("1", "fractional model, for harmonic motion only", default=None)
    porosity: Porosity | None = param("1", "sponge and fluid", default=None)
    body: Body | None = param("1", "density and gravity", default=None)
    fixed: tuple[Fixed, ...] = param("1", "held nodes", default=())
    displaced: tuple[Displaced, ...] = param("1", "prescribed motion", default=())
    traction: tuple[Traction, ...] = param("1", "loads", default=())
    physics: tuple[Physics, ...] = unnamed("further physics: supports, …", places="named", default=())
    solve: Solve = param("1", "how it is solved", default=Solve())
    #: The law before relaxation, if `law` is the relaxed law (`liverjax.simulation.unloaded.resting`). The default
    #: stiffness of obstacles and the terms of mixed elements depend on this law, as in the run.
    unrelaxed: Law | None = param("1", "law before its stress relaxed; None: the law itself", default=None)
    points_are: str = static(
        default="reference", about="reference: the mesh is unloaded; loaded: the mesh is the shape under the loads"
    )

    def named(self, section: str) -> list[int]:
        """Return the indices in `physics` of the objects with the table [[section]] in scene files."""
        return [k for k, physics in enumerate(self.physics) if physics.section == section]


def named_physics(scene: Scene) -> list[tuple[str, Physics]]:
    """Return each object in `scene.physics` (support, obstacle, …) with its name in scene files, e.g. support.0."""
    places = {k: f"{p.section}.{n}" for p in scene.physics for n, k in enumerate(scene.named(p.section))}
    return [(places[k], physics) for k, physics in enumerate(scene.physics)]


def histories(scene: Scene) -> dict[str, object]:
    """Return all entries of a scene that have a history, by name: body, motions, loads, inlets, supports, obstacles."""
    inlets = () if scene.porosity is None else scene.porosity.inlet
    parts: dict[str, object] = {"body": scene.body}
    for key, several in (("displaced", scene.displaced), ("traction", scene.traction), ("porosity.inlet", inlets)):
        parts |= {f"{key}.{k}": part for k, part in enumerate(several)}
    parts |= dict(named_physics(scene))
    return {name: part for name, part in parts.items() if getattr(part, "history", None) is not None}


def with_parameters(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """Return the scene with changed numbers. The values may be unknown (inside jit, grad or vmap).

    Args:
        scene: `Scene`.
        values: dotted names as in the scene file -> values: ``law.mu`` (``law.1.mu`` of several laws),
            ``viscosity.relaxation_times``, ``viscosity.ratios.0``, ``body.density``, ``displaced.0.by``, ``solve.dt``,
            ``mesh.points``, ``region.0.law.mu``. A parameter of a law may have one value per element (E,).

    Raises:
        InputError: the scene has no number with one of these names, or one number is given instead of several.
    """
    for name, value in values.items():
        if name == "mesh.points":
            scene = replace(scene, mesh=with_points(scene.mesh, value))
            continue
        if name.startswith("mesh."):
            raise InputError(
                f"{_refusal(name)}; a mesh can be changed only through all its positions together: use mesh.points"
            )
        old = names.get(scene, name, _refusal(name))
        if isinstance(old, tuple) and not isinstance(value, tuple | list) and np.ndim(value) == 0:
            raise InputError(
                f"{name} has shape (): give {len(old)} numbers, or name one of them, for example {name}.{len(old) - 1}"
            )
        like = (
            tuple(value) if isinstance(old, tuple) else jnp.array(value, float) if isinstance(old, jax.Array) else value
        )
        scene = names.put(scene, name, like, _refusal(name))
    return scene


def numbers_at(scene: Scene, name: str) -> Any:
    """Return the value (one number or an array) that a scene has for a dotted name, for example `law.mu`.

    Raises:
        InputError: the scene has no value with this name, or the value is not a floating-point number.
    """
    if name.startswith("mesh.") and not name.startswith("mesh.points"):
        raise InputError(
            f"{_refusal(name)}; a mesh can be changed only through all its positions together: use mesh.points"
        )
    found = names.get(scene, name, _refusal(name))
    # A single whole number is allowed (`mu = 770`). Arrays of whole numbers are not allowed: they are node or element
    # numbers.
    if not all(isinstance(v, int) or np.issubdtype(np.asarray(v).dtype, np.floating) for v in jax.tree.leaves(found)):
        raise InputError(f"{_refusal(name)}: use a number, for example law.mu")
    return found if isinstance(found, tuple) else jnp.asarray(found, float)


def _refusal(name: str) -> str:
    return f"parameter {name!r} is not a number of the scene file"
