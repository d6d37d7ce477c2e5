"""Are the choices of the scene known and compatible? Numbers are not checked, so a traced scene passes too."""

import numpy as np

from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.physics import viscosity
from liverjax.physics.volumes.mixed import check_mixed_laws
from liverjax.scenes.checks.kinds import check_kinds
from liverjax.scenes.checks.loads import check_loads
from liverjax.scenes.regions import laws_of
from liverjax.scenes.scene import Scene, histories, named_physics

#: Allowed values of the choices in [solve].
CHOICES = {
    "kind": ("static", "dynamic", "harmonic"),
    "newton": ("converged", "one_step"),
    "integrator": ("euler", "newmark"),
    "precision": ("float64", "float32"),
    "linear_solver": ("auto", "cg", "direct"),
    "volumetric": ("element", "nodal", "mixed", "auto"),
    "robust": ("off", "projected", "regularised"),
}


def check_choices(scene: Scene) -> None:
    """Refuse unknown or incompatible choices. Numbers are not checked, so a traced scene passes, too.

    Raises:
        InputError: unknown or incompatible choices; a load or a motion that is given twice, not at all or in a wrong
            shape.
    """
    check_kinds(scene)
    for key, allowed in CHOICES.items():
        value = getattr(scene.solve, key)
        if value not in allowed:
            raise InputError(f"[solve] {key} = {value!r} is not known: use {' or '.join(allowed)}")
    if (scene.solve.kind == "harmonic") != (scene.solve.frequencies is not None):
        raise InputError("[solve] kind = 'harmonic' and frequencies = [60.0] (Hz) go together: give both, or neither")
    if scene.solve.frequencies is not None and not np.size(scene.solve.frequencies):
        raise InputError("[solve] frequencies = [] holds no frequency: give e.g. frequencies = [60.0] (Hz)")
    if scene.solve.reduced and scene.solve.kind == "harmonic":
        raise InputError("[solve] reduced is for runs in time, kind is 'harmonic': leave it out")
    if scene.springpots is not None and scene.solve.kind != "harmonic":
        raise InputError("[springpots] are for kind = 'harmonic': a run in time takes [viscosity], a Prony series")
    if scene.solve.kind == "harmonic":
        _refuse_what_moves_in_time(scene)
    _loaded(scene)
    if scene.solve.linear_solver == "direct" and any(load.pressure is not None for load in scene.traction):
        raise InputError("[solve] linear_solver = 'direct' is for symmetric forces: use cg if a pressure follows")
    if scene.solve.linear_solver == "direct" and any(physics.ties for physics in scene.physics):
        raise InputError(
            "[solve] linear_solver = 'direct' cannot treat nodes that move together: use cg with a rigid plate"
        )
    if scene.solve.volumetric in ("nodal", "mixed"):
        _own_volumes(scene)
    if scene.solve.volumetric == "mixed":
        _mixed(scene)
    if scene.viscosity is not None:
        for law in laws_of(scene.law, scene.region):
            viscosity.check_part(scene.viscosity.part, law, "viscosity")
    check_loads(scene)


def _refuse_what_moves_in_time(scene: Scene) -> None:
    """Refuse histories and moving obstacles in harmonic motion."""
    for name in histories(scene):
        raise InputError(f"{name}.history is for runs in time: give harmonic motion its amplitudes alone")
    for name, part in named_physics(scene):
        if getattr(part, "by", None) is not None:
            raise InputError(
                f"{name}.by is for runs in time: give the obstacle its place in harmonic motion as position"
            )


def _loaded(scene: Scene) -> None:
    if scene.points_are not in ("reference", "loaded"):
        raise InputError(f"[mesh] is = {scene.points_are!r} is not known: use reference or loaded")
    if scene.points_are == "loaded" and scene.porosity is not None:
        raise InputError('[mesh] is = "loaded" cannot have the pressure of a fluid: leave [porosity] out')
    if scene.points_are == "loaded" and any(physics.ties for physics in scene.physics):
        raise InputError('[mesh] is = "loaded" cannot have nodes that move together: leave the rigid plate out')


def _mixed(scene: Scene) -> None:
    check_mixed_laws(laws_of(scene.law, scene.region))


def _own_volumes(scene: Scene) -> None:
    name = f"[solve] volumetric = {scene.solve.volumetric!r}"
    if scene.porosity is not None:
        raise InputError(f"{name} is for a law's own volumetric energy, which a sponge replaces: use 'element'")
    several = laws_of(scene.law, scene.region)
    for law in several:
        if laws.isochoric_part(law) is None or laws.volumetric_part(law) is None:
            raise InputError(
                f"{name} needs a law whose energy is a shear part and a volumetric part, unlike {type(law).__name__}"
            )
    if scene.viscosity is not None and scene.viscosity.part != "isochoric":
        raise InputError(f"{name} needs part = 'isochoric' of [viscosity] or [springpots]: volumes do not relax there")
