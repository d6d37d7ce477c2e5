"""Check that the nodes and triangles of every entry of a scene are in the mesh, and that every inlet has an effect."""

import jax
import numpy as np

from liverjax.core.errors import InputError
from liverjax.mesh.selection import check_nodes, check_triangles
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.porosity import Porosity
from liverjax.scenes.scene import Scene


def check_known_nodes(scene: Scene) -> None:
    """Raise InputError if nodes are not in the mesh, or elements are inverted. Arrays inside jit are not checked."""
    mesh = scene.mesh
    named: dict[str, object] = {f"fixed.{k}.nodes": hold.nodes for k, hold in enumerate(scene.fixed)}
    named |= {f"displaced.{k}.nodes": motion.nodes for k, motion in enumerate(scene.displaced)}
    named |= {f"traction.{k}.triangles": load.triangles for k, load in enumerate(scene.traction)}
    if scene.porosity is not None:
        named["porosity.drained"] = scene.porosity.drained
        for key in ("nodes", "triangles"):
            named |= {f"porosity.inlet.{k}.{key}": getattr(i, key) for k, i in enumerate(scene.porosity.inlet)}
    for name, nodes in named.items():
        if nodes is not None and not isinstance(nodes, jax.core.Tracer):
            numbers = np.asarray(nodes)
            check_nodes(numbers.ravel() if name.endswith("triangles") else numbers, mesh.number_of_nodes, name, least=0)
    for k, motion in enumerate(scene.displaced):
        if getattr(motion.by, "ndim", 1) == 2 and not isinstance(motion.nodes, jax.core.Tracer):
            check_nodes(motion.nodes, mesh.number_of_nodes, f"displaced.{k}.nodes", once=True)
    if mesh.order < 3 and not isinstance(mesh.tetrahedra, jax.core.Tracer):
        _check_loaded_triangles(scene)
    if not isinstance(mesh.volumes, jax.core.Tracer):
        wrong = int(np.sum(~(np.asarray(mesh.volumes) > 0)))
        if wrong:
            raise InputError(
                f"the mesh has {wrong} elements that are inverted or have no volume: correct their vertices"
            )


def _check_loaded_triangles(scene: Scene) -> None:
    """Check the triangles of loads and fluxes that are known (not inside jit)."""
    inlets = () if scene.porosity is None else scene.porosity.inlet
    named = [(f"traction.{k}.triangles", own.triangles, own.pressure) for k, own in enumerate(scene.traction)]
    named += [(f"porosity.inlet.{k}.triangles", own.triangles, None) for k, own in enumerate(inlets)]
    for name, triangles, pressure in named:
        if triangles is not None and not isinstance(triangles, jax.core.Tracer):
            check_triangles(scene.mesh, triangles, name, outward=pressure is not None)


def check_places(scene: Scene) -> None:
    """Raise InputError if nodes or triangles are not in the mesh, or if an inlet has no effect."""
    mesh = scene.mesh
    for kind in ("fixed", "displaced"):
        for k, condition in enumerate(getattr(scene, kind)):
            check_nodes(condition.nodes, mesh.number_of_nodes, f"{kind}.{k}.nodes", least=0)
    _check_loaded_triangles(scene)
    if scene.porosity is None:
        return
    if scene.porosity.drained is not None:
        check_nodes(scene.porosity.drained, mesh.number_of_nodes, "porosity.drained")
        _has_vertices(mesh, scene.porosity.drained, "porosity.drained")
    for k, inlet in enumerate(scene.porosity.inlet):
        if inlet.nodes is not None:
            check_nodes(inlet.nodes, mesh.number_of_nodes, f"porosity.inlet.{k}.nodes")
            _has_vertices(mesh, inlet.nodes, f"porosity.inlet.{k}")
    _inlets_that_act(scene.porosity)


def _has_vertices(mesh: TetMesh, nodes: object, name: str) -> None:
    """Raise InputError if `nodes` of a drained region or an inlet contain no vertex.

    Only vertices have pressures.
    """
    if not np.any(np.asarray(nodes, int) < mesh.number_of_vertices):
        raise InputError(f"{name} contains only midside nodes, which have no pressure: select a region with vertices")


def _inlets_that_act(sponge: Porosity) -> None:
    """Raise InputError if an inlet or the drained region has no effect, as other pressures are given at all its nodes.

    Inlets may have some common nodes. There, the later inlet counts. Drained nodes count only where there is no inlet.
    """
    pressures = {k: set(np.asarray(own.nodes).tolist()) for k, own in enumerate(sponge.inlet) if own.nodes is not None}
    for k, own in pressures.items():
        over = next((later for later, nodes in pressures.items() if later > k and own <= nodes), None)
        if over is not None:
            raise InputError(
                f"porosity.inlet.{k} has no effect, because porosity.inlet.{over} gives the pressure at all of its "
                "nodes: give the larger inlet first, or select different nodes"
            )
    drained = set() if sponge.drained is None else set(np.asarray(sponge.drained).tolist())
    over = next((k for k, nodes in pressures.items() if drained and drained <= nodes), None)
    if over is not None:
        raise InputError(
            f"porosity.drained has no effect, because porosity.inlet.{over} gives the pressure at all of its nodes: "
            "remove one of them, or select different nodes"
        )
    given = [*pressures.values(), drained]
    for k, inlet in enumerate(sponge.inlet):
        corners = set() if inlet.triangles is None else set(np.ravel(inlet.triangles).tolist())
        if inlet.nodes is None and any(corners <= place for place in given):
            raise InputError(
                f"porosity.inlet.{k} is a flux through a surface whose nodes are drained or have a given pressure, so "
                "this flux has no effect: select another surface"
            )
