"""All physics objects (laws, loads, supports, …) that act in a scene, and the kinds that scene files can contain."""

from typing import Any

from liverjax.laws.base import Law, isochoric_part
from liverjax.physics import porosity
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.attached.vessel import Vessel
from liverjax.physics.base import Physics
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.elasticity import Elasticity
from liverjax.physics.inertia import Inertia
from liverjax.physics.loads import Loads
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.physics.viscosity import Viscoelasticity
from liverjax.physics.volumes.averaged import AveragedVolume
from liverjax.physics.volumes.mixed import MixedVolume

#: Classes of physics that have a table in scene files. Add every new class of this kind here.
NAMED: tuple[type[Physics], ...] = (
    ElasticSupport,
    SlidingSupport,
    Membrane,
    Ligament,
    Vessel,
    Obstacle,
    RoughObstacle,
    PressedObstacle,
)


def law_at_rest(scene: Any) -> Law:
    """Return the law of a `Scene`, without viscosity.

    With porosity, the volumetric energy of the law is removed, unless `keep_bulk` is true.
    """
    return porosity.law_in_force(scene.porosity, scene.law)


def physics_of(scene: Any) -> tuple[Physics, ...]:
    """Return all physics objects (law, viscosity, loads, supports, …) that act in a `liverjax.scenes.scene.Scene`."""
    law, averaged, mixed = law_at_rest(scene), scene.solve.volumetric == "nodal", scene.solve.volumetric == "mixed"
    unrelaxed = scene.law if scene.unrelaxed is None else scene.unrelaxed
    if averaged or mixed:
        law = isochoric_part(scene.law)
    solid: Physics = Elasticity(law=law)
    if scene.viscosity is not None:
        solid = Viscoelasticity(law=law, prony=scene.viscosity)
    found: list[Physics] = [solid]
    if scene.porosity is not None:
        found.append(scene.porosity)
    elif averaged:
        found.append(AveragedVolume(law=scene.law))
    elif mixed:
        found.append(MixedVolume(law=unrelaxed))
    body = scene.body
    if body is not None and scene.solve.kind == "dynamic":
        found.append(Inertia(density=body.density, integrator=scene.solve.integrator, mass=body.mass))
    if body is not None or scene.traction:
        keys = ("density", "gravity", "times", "history", "mass")
        weight = {} if body is None else {key: getattr(body, key) for key in keys}
        found.append(Loads(traction=scene.traction, **weight))
    return (*found, *(p.in_body(scene.mesh, unrelaxed) for p in scene.physics))
