"""Each physics object of the registry alone: its equations are in the program of a scene with it, and in no other."""

import inspect
from collections.abc import Iterator
from functools import cache
from typing import Any

import jax
import pytest

import liverjax as lj
from liverjax.core import history
from liverjax.core.struct import replace
from liverjax.physics import darcy, inertia, loads, porosity, registry, viscosity
from liverjax.physics.volumes import averaged, mixed
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

TOP = {"where": {"z_min": 0.1}}
SOFT = {"name": "neo_hookean", "mu": 1e4}
PLAIN = {
    "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1]},
    "law": {"name": "neo_hookean", "mu": 770.0, "bulk": 2200.0},
    "fixed": [{"where": {"z_max": 0.0}}],
}
PLANE = {"shape": "plane", "position": [0, 0, 0.11], "axis": [0, 0, -1], "by": [0, 0, -0.02]}
LINE = [[0.02, 0.03, 0.01], [0.06, 0.05, 0.09]]
#: One table for each physics object. A new object in the registry needs a table here.
TABLES: dict[str, dict[str, Any]] = {
    "ElasticSupport": {"support": [TOP | {"normal": 1e4}]},
    "SlidingSupport": {"support": [TOP | {"sliding": True}]},
    "Membrane": {"membrane": [TOP | {"thickness": 1e-4, "law": SOFT}]},
    "Ligament": {"ligament": [TOP | {"to": [0.05, 0.05, 0.2], "stiffness": 1.0, "pre_tension": 0.0}]},
    "Vessel": {"vessel": [{"line": LINE, "radius": 2e-3, "law": SOFT}]},
    "Obstacle": {"obstacle": [PLANE]},
    "RoughObstacle": {"obstacle": [PLANE | {"friction": 0.3}]},
    "PressedObstacle": {"obstacle": [{k: PLANE[k] for k in ("shape", "position", "axis")} | {"force": [0, 0, -1.0]}]},
}
#: The same for physics objects outside the registry: a table that has the object, and the file of its equations.
SOLVE = {"kind": "static", "dt": 0.05, "steps": 2}
FLUID = {"bulk": 1600.0, "limit_bulk": 2200.0, "fluid_fraction": 0.5, "permeability": 2e-5}
OTHERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "viscosity": (viscosity, {"viscosity": {"ratios": [0.3], "relaxation_times": [0.2]}, "solve": SOLVE}),
    "sponge": (porosity, {"porosity": FLUID, "solve": SOLVE}),
    "flow": (darcy, {"porosity": FLUID, "solve": SOLVE}),
    "averaged volumes": (averaged, {"solve": {"volumetric": "nodal"}}),
    "mixed volumes": (mixed, {"solve": {"volumetric": "mixed"}}),
    "inertia": (inertia, {"body": {"density": 1000.0}, "solve": SOLVE | {"kind": "dynamic"}}),
    "weight": (loads, {"body": {"density": 1000.0, "gravity": [0, 0, -1.0]}}),
    "traction": (loads, {"traction": [TOP | {"value": [0, 0, 1.0]}]}),
    "history": (
        history,
        {"traction": [TOP | {"value": [0, 0, 1.0], "history": [[0.0, 0.0], [1.0, 1.0]]}], "solve": SOLVE},
    ),
}
#: Objects that one scene can have together, so that few are traced. No two objects of a scene share a file.
TOGETHER = (
    ("viscosity", "inertia"),
    ("sponge", "flow", "traction"),
    ("averaged volumes", "weight"),
    ("mixed volumes", "history"),
)


def scene_of(order: int, table: dict[str, Any]) -> lj.Scene:
    return scene_from(PLAIN | {"mesh": PLAIN["mesh"] | {"order": order}} | table)


def traced(scene: lj.Scene) -> Any:
    """Return the program of a scene."""
    jax.clear_caches()  # equations that two scenes share would show the source line of the first one
    return jax.make_jaxpr(lj.simulate)(scene)


def files(jaxpr: Any) -> Iterator[str]:
    """Return the source files of the equations of a program, including those of inner programs."""
    for equation in jaxpr.eqns:
        yield from (frame.file_name for frame in equation.source_info.traceback.frames)
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=_inner):
            if _inner(value):
                yield from files(getattr(value, "jaxpr", value))


def _inner(value: Any) -> bool:
    return hasattr(getattr(value, "jaxpr", value), "eqns")


@cache
def files_of_plain(order: int) -> frozenset[str]:
    """Return the source files of the scene without physics objects."""
    return frozenset(files(traced(scene_of(order, {})).jaxpr))


@pytest.mark.ci
@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_only_scenes_that_have_it_hold_its_equations(order):
    scene = scene_of(order, {})
    every = replace(scene, physics=tuple(p for t in TABLES.values() for p in scene_of(order, t).physics))
    assert [type(p) for p in every.physics] == list(registry.NAMED)
    own = {inspect.getfile(kind) for kind in registry.NAMED}
    assert not own & files_of_plain(order)
    assert own <= set(files(traced(every).jaxpr))


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_what_has_no_registry_is_in_no_other_program(order):
    own = {name: module.__file__ for name, (module, _) in OTHERS.items()}
    assert not set(own.values()) & files_of_plain(order)
    assert sorted(name for names in TOGETHER for name in names) == sorted(OTHERS)
    for names in TOGETHER:
        tables = [OTHERS[name][1] for name in names]
        solve = {key: value for table in tables for key, value in table.get("solve", {}).items()}
        scene = scene_of(order, {key: table[key] for table in tables for key in table} | {"solve": solve})
        found, theirs = set(files(traced(scene).jaxpr)) & set(own.values()), {own[name] for name in names}
        assert theirs <= found <= theirs | {loads.__file__}, names  # an object with a history counts as a load


@pytest.mark.parametrize("kind", registry.NAMED, ids=lambda kind: kind.__name__)
def test_a_table_adds_its_physics_and_nothing_else(kind):
    """Two scenes with the same structure, static values and shapes have the same program."""
    plain, scene = scene_of(1, {}), scene_of(1, TABLES[kind.__name__])
    assert [type(p) for p in scene.physics] == [kind]
    assert shapes_of(replace(scene, physics=())) == shapes_of(plain) != shapes_of(scene)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("kind", registry.NAMED, ids=lambda kind: kind.__name__)
def test_the_program_without_it_is_the_same_to_the_letter(kind, order):
    plain, scene = scene_of(order, {}), scene_of(order, TABLES[kind.__name__])
    program = str(traced(plain))
    assert str(traced(replace(scene, physics=()))) == program != str(traced(scene))


def shapes_of(scene: lj.Scene) -> tuple[Any, list[Any]]:
    leaves, structure = jax.tree.flatten(scene)
    return structure, [jax.typeof(leaf) for leaf in leaves]
