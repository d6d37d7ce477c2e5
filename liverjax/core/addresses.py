"""Old names of modules that have moved, so that scripts of users still work."""

import importlib
import sys
from types import ModuleType

#: Old name -> new name of each module that has moved.
MOVED = {
    "liverjax.batch": "liverjax.simulation.batch",
    "liverjax.boundary": "liverjax.physics.boundary",
    "liverjax.check": "liverjax.laws.gradient_check",
    "liverjax.design": "liverjax.jobs.design",
    "liverjax.errors": "liverjax.core.errors",
    "liverjax.gradients": "liverjax.simulation.gradients",
    "liverjax.homogeneous": "liverjax.laws.homogeneous",
    "liverjax.jobs.parts": "liverjax.jobs.resumable_parts",
    "liverjax.long_run": "liverjax.jobs.long_run",
    "liverjax.mjed": "liverjax.elements.mjed",
    "liverjax.output": "liverjax.jobs.output",
    "liverjax.physics.averaged_volume": "liverjax.physics.volumes.averaged",
    "liverjax.porosity": "liverjax.physics.porosity",
    "liverjax.reference": "liverjax.elements.reference",
    "liverjax.regions": "liverjax.scenes.regions",
    "liverjax.scene": "liverjax.scenes.scene",
    "liverjax.scene_checks": "liverjax.scenes.scene_checks",
    "liverjax.scene_file": "liverjax.scenes.scene_file",
    "liverjax.shapes": "liverjax.mesh.shapes",
    "liverjax.simulation.checkpoints": "liverjax.simulation.gradient_checkpoints",
    "liverjax.solvers.continuation": "liverjax.solvers.step_cutting",
    "liverjax.status": "liverjax.core.status",
    "liverjax.struct": "liverjax.core.struct",
    "liverjax.sweep": "liverjax.jobs.sweep",
    "liverjax.versions": "liverjax.core.versions",
    "liverjax.viscosity": "liverjax.physics.viscosity",
    "fitting.curves": "fitting.readers.curves",
    "fitting.displacements": "fitting.readers.displacements",
    "fitting.field": "fitting.fits.field",
    "fitting.fit": "fitting.fit",
    "fitting.inclusion": "fitting.fits.inclusion",
    "fitting.joint": "fitting.fits.joint",
    "fitting.least_squares": "fitting.methods.least_squares",
    "fitting.prior": "fitting.methods.prior",
    "fitting.prony": "fitting.methods.generalised_maxwell",
    "fitting.report": "fitting.reports.sweep_report",
    "fitting.rheometer": "fitting.readers.rheometer",
    "fitting.rigs": "fitting.rigs",
    "fitting.scenes": "fitting.fits.scene_numbers",
    "fitting.stress_stretch": "fitting.fits.stress_stretch",
    "fitting.torsion": "fitting.rigs.torsion",
    "fitting.uncertainty": "fitting.methods.uncertainty",
}


def keep_loaded(package: str) -> None:
    """Make loaded modules importable also under their old names (`from PACKAGE.MODULE import …`)."""
    for old, new in MOVED.items():
        if old.startswith(f"{package}.") and new in sys.modules:
            sys.modules.setdefault(old, sys.modules[new])


def moved_module(package: str, name: str) -> ModuleType:
    """Import and return the module that has the old name PACKAGE.NAME.

    Raises:
        AttributeError: no module has this old name.
    """
    if f"{package}.{name}" not in MOVED:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    return importlib.import_module(MOVED[f"{package}.{name}"])
