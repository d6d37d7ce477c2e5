"""Check that every entry of a scene has the right type."""

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

#: Types of the entries of a scene. A scene has at most one entry of each type in PARTS, and any number of entries of
#: each type in SEVERAL.
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
    """Raise InputError if an entry has a wrong type, for example node numbers instead of a `Fixed`."""
    for key, kind in PARTS.items():
        own = getattr(scene, key)
        if own is not None and not isinstance(own, kind):
            raise InputError(f"{key} is of type {type(own).__name__}: give {_remedy(kind)}")
    for key, kind in SEVERAL.items():
        own = getattr(scene, key)
        if not isinstance(own, tuple | list):
            raise InputError(f"{key} is of type {type(own).__name__}: give a tuple that contains {_remedy(kind)}")
        for k, each in enumerate(own):
            if not isinstance(each, kind):
                raise InputError(f"{key}.{k} is of type {type(each).__name__}: give {_remedy(kind)}")


def _remedy(kind: type) -> str:
    """Return words that tell a user what to give for an entry of this type, for example "an lj.Body"."""
    families: dict[object, str] = {laws.Law: "a law of lj.laws", Physics: "a physics object, such as lj.Obstacle"}
    return families.get(kind, f"an lj.{kind.__name__}")
