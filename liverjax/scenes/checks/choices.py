"""Check that the choices (words) of a scene are known and compatible. Numbers are not checked here."""

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
    """Check that the choices of a scene are known and compatible.

    Numbers are not checked. Their values may be unknown inside jit.

    Raises:
        InputError: a choice is unknown, or cannot be combined with another choice; a load or a motion is given twice,
            not at all or in a wrong shape.
    """
    check_kinds(scene)
    for key, allowed in CHOICES.items():
        value = getattr(scene.solve, key)
        if value not in allowed:
            raise InputError(f"[solve] {key} = {value!r} is not known: use {' or '.join(allowed)}")
    if (scene.solve.kind == "harmonic") != (scene.solve.frequencies is not None):
        raise InputError(
            "[solve] kind = 'harmonic' can be used only together with frequencies: give both, e.g. frequencies = "
            "[60.0] (Hz), or neither"
        )
    if scene.solve.frequencies is not None and not np.size(scene.solve.frequencies):
        raise InputError("[solve] frequencies = [] contains no frequency: give e.g. frequencies = [60.0] (Hz)")
    if scene.solve.reduced and scene.solve.kind == "harmonic":
        raise InputError("[solve] reduced cannot be used with kind = 'harmonic': remove reduced")
    if scene.springpots is not None and scene.solve.kind != "harmonic":
        raise InputError("[springpots] needs kind = 'harmonic': for a static or dynamic run, use [viscosity] instead")
    if scene.solve.kind == "harmonic":
        _refuse_what_moves_in_time(scene)
    _loaded(scene)
    if scene.solve.linear_solver == "direct" and any(load.pressure is not None for load in scene.traction):
        raise InputError(
            "[solve] linear_solver = 'direct' cannot be used with a follower pressure: use linear_solver = 'cg'"
        )
    if scene.solve.linear_solver == "direct" and any(physics.ties for physics in scene.physics):
        raise InputError("[solve] linear_solver = 'direct' cannot be used with a rigid plate: use linear_solver = 'cg'")
    check_volumetric(scene)
    if scene.viscosity is not None:
        for law in laws_of(scene.law, scene.region):
            viscosity.check_part(scene.viscosity.part, law, "viscosity")
    check_loads(scene)


def _refuse_what_moves_in_time(scene: Scene) -> None:
    """Raise InputError if an entry of a scene with harmonic motion has a history, or if an obstacle moves."""
    for name in histories(scene):
        raise InputError(f"{name}.history cannot be used with kind = 'harmonic': give only the amplitudes")
    for name, part in named_physics(scene):
        if getattr(part, "by", None) is not None:
            raise InputError(
                f"{name}.by cannot be used with kind = 'harmonic': remove 'by', and give the position after the "
                "displacement"
            )


def _loaded(scene: Scene) -> None:
    if scene.points_are not in ("reference", "loaded"):
        raise InputError(f'[mesh] is = {scene.points_are!r} is not known: use "reference" or "loaded"')
    if scene.points_are == "loaded" and scene.porosity is not None:
        raise InputError('[mesh] is = "loaded" cannot be used with a fluid: remove [porosity]')
    if scene.points_are == "loaded" and any(physics.ties for physics in scene.physics):
        raise InputError('[mesh] is = "loaded" cannot be used with a rigid plate: remove the plate')


def check_volumetric(scene: Scene) -> None:
    """Check that the materials of a scene can be used with its setting `volumetric`. Other keys of `[solve]` are not
    checked.

    Raises:
        InputError: the materials do not allow pressures as unknowns.
    """
    if scene.solve.volumetric not in ("nodal", "mixed"):
        return
    name = f"[solve] volumetric = {scene.solve.volumetric!r}"
    if scene.porosity is not None:
        raise InputError(
            f"{name} needs the volumetric energy of the law, which [porosity] replaces: use volumetric = 'element'"
        )
    several = laws_of(scene.law, scene.region)
    for law in several:
        if laws.isochoric_part(law) is None or laws.volumetric_part(law) is None:
            raise InputError(
                f"{name} needs a law with separate isochoric and volumetric energies, unlike {type(law).__name__}: use "
                "another law, or volumetric = 'element'"
            )
    if any(own is not None and own.part != "isochoric" for own in (scene.viscosity, scene.springpots)):
        raise InputError(
            f"{name} needs a volumetric stress that does not relax: use part = 'isochoric' in [viscosity] or "
            "[springpots]"
        )
    if scene.solve.volumetric == "mixed":
        check_mixed_laws(several)
