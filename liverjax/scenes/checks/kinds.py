"""Does every part of the scene have the right type?"""

from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import Physics
from liverjax.physics.loads import Traction
from liverjax.physics.porosity import Porosity
from liverjax.physics.prescribed import Displaced, Fixed
from liverjax.physics.viscosity import Prony
from liverjax.scenes.regions import Region
from liverjax.scenes.scene import Body, Scene, Solve
from liverjax.scenes.springpots import SpringpotSeries

#: Types of the parts of a scene: first of single parts, then of parts of which a scene may have several.
PARTS = {
    "mesh": TetMesh,
    "law": laws.Law,
    "viscosity": Prony,
    "springpots": SpringpotSeries,
    "porosity": Porosity,
    "body": Body,
    "solve": Solve,
}
SEVERAL = {"region": Region, "fixed": Fixed, "displaced": Displaced, "traction": Traction, "physics": Physics}


def check_kinds(scene: Scene) -> None:
    """Refuse parts of a wrong type, for example node numbers in place of a `Fixed`."""
    for key, kind in PARTS.items():
        own = getattr(scene, key)
        if own is not None and not isinstance(own, kind):
            raise InputError(f"{key} is of type {type(own).__name__}: give {_remedy(kind)}")
    for key, kind in SEVERAL.items():
        own = getattr(scene, key)
        if not isinstance(own, tuple | list):
            raise InputError(f"{key} is of type {type(own).__name__}: give a tuple, with {_remedy(kind)} in it")
        for k, each in enumerate(own):
            if not isinstance(each, kind):
                raise InputError(f"{key}.{k} is of type {type(each).__name__}: give {_remedy(kind)}")


def _remedy(kind: type) -> str:
    """Words for a message: how a user writes a value of this type."""
    families: dict[object, str] = {laws.Law: "a law of lj.laws", Physics: "a physics, such as lj.Obstacle"}
    return families.get(kind, f"an lj.{kind.__name__}")
