"""Read scenes from TOML files. An unknown key is an error. All numbers are checked."""

import dataclasses
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import laws
from liverjax.core import bounds, history
from liverjax.core.did_you_mean import as_word, hint
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Indices
from liverjax.laws import Law
from liverjax.mesh import shapes
from liverjax.mesh.adjacency import node_numbers
from liverjax.mesh.files import read_mesh
from liverjax.mesh.promotion import quadratic
from liverjax.mesh.surface import triangle_nodes
from liverjax.mesh.tetrahedra import UNITS, TetMesh
from liverjax.physics import boundary
from liverjax.physics.base import Physics
from liverjax.physics.boundary import Displaced, Fixed, Traction
from liverjax.physics.porosity import Inlet, Porosity
from liverjax.physics.prescribed import check_axes
from liverjax.physics.registry import NAMED
from liverjax.physics.viscosity import Prony
from liverjax.scenes import regions
from liverjax.scenes.checks.choices import CHOICES
from liverjax.scenes.idle_settings import refuse_idle
from liverjax.scenes.regions import Region
from liverjax.scenes.scene import Body, Scene, Solve
from liverjax.scenes.scene_checks import check_scene
from liverjax.scenes.springpots import SpringpotSeries

#: Keys of a cylinder. The first three are required, the others are optional.
_CYLINDER = ("radius", "height", "cell_size", "rim_cell", "rings", "match_area")
_KEYS = {
    "mesh": ("file", "unit", "order", "is", "shape", "size", "cells", *_CYLINDER),
    "region": ("where", "set", "law", "viscosity", "porosity"),
    "viscosity": ("ratios", "relaxation_times", "part", "scheme"),
    "springpots": ("times", "exponents", "limits", "spring", "part"),
    "porosity": (
        "bulk",
        "limit_bulk",
        "fluid_fraction",
        "permeability",
        "drained",
        "scheme",
        "keep_bulk",
        "inlet",
        "initial_pressure",
    ),
    "body": ("density", "gravity", "history", "mass"),
    "fixed": ("where", "set", "axes"),
    "displaced": ("where", "set", "axes", "by", "history"),
    "traction": ("where", "set", "value", "pressure", "history"),
    "solve": tuple(f.name for f in dataclasses.fields(Solve)),
    "output": ("fields", "reactions"),
} | {
    section: tuple(dict.fromkeys(key for p in NAMED if p.section == section for key in p.keys))
    for section in dict.fromkeys(p.section for p in NAMED)
}
_SECTIONS = ("mesh", "law", *list(_KEYS)[1:])
#: Keys that select nodes or faces. The other keys of a table define what acts on these nodes or faces.
PLACE = {"where", "set"}


def load_scene(path: str | Path) -> Scene:
    """Read a scene from a TOML file. Paths in the file are relative to the folder of the file.

    Raises:
        InputError: the file cannot be read, a key is unknown or missing, or a value cannot be used. All checks run
            before anything is compiled.
    """
    path = Path(path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except IsADirectoryError:
        raise InputError(f"{path} is a folder: give a scene file (TOML)") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): give a scene file (TOML)") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file: give a scene file (TOML)") from None
    except ValueError as error:  # also for a whole number with too many digits
        raise InputError(f"{path} is not valid TOML ({error}): correct this line") from None
    try:
        return scene_from(content, path.parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def scene_from(content: Content, folder: Path = Path()) -> Scene:
    """Make a scene from the content of a scene file: nested dictionaries, lists and values."""
    _known("scene", content, _SECTIONS)
    content = _with_paths(content, folder)
    for name in ("mesh", "law"):
        if name not in content:
            raise InputError(f"the scene has no [{name}]: add this table")
    output_of(content)
    mesh = _mesh(_table("mesh", content["mesh"]), folder)
    prony = _section(content, "viscosity", _prony)
    scene = Scene(
        mesh=mesh,
        law=_law(content["law"]),
        region=tuple(_region(mesh, k, t) for k, t in enumerate(_tables(content, "region"))),
        viscosity=prony,
        springpots=_section(content, "springpots", _read_springpots),
        porosity=_section(content, "porosity", lambda table: _porosity(mesh, table)),
        body=_section(content, "body", _read_body),
        fixed=tuple(_fixed(mesh, k, t) for k, t in enumerate(_tables(content, "fixed"))),
        displaced=tuple(_displaced(mesh, k, t) for k, t in enumerate(_tables(content, "displaced"))),
        traction=tuple(_traction(mesh, k, t) for k, t in enumerate(_tables(content, "traction"))),
        physics=tuple(_physics(mesh, content)),
        solve=_read_solve(_table("solve", content.get("solve", {}))),
        points_are=content["mesh"].get("is", "reference"),
    )
    refuse_idle(content)
    check_scene(scene)
    return scene


def nodes_under_traction(content: Content, mesh: TetMesh) -> np.ndarray:
    """Return the numbers of the nodes of all triangles with a [[traction]] in a scene file.

    Args:
        content: content of the scene file.
        mesh: the mesh of the scene.

    Raises:
        InputError: an entry selects no triangles of this mesh.
    """
    found = [np.zeros(0, int)]
    for k, table in enumerate(_tables(content, "traction")):
        place = {key: value for key, value in table.items() if key in PLACE}
        load = _traction(mesh, k, place | {"value": [0.0, 0.0, 0.0]})  # the values have no effect on the selection
        found += [np.asarray(nodes) for nodes in triangle_nodes(mesh, load.triangles)]
    return np.unique(np.concatenate(found))


def output_of(content: Mapping[str, object]) -> tuple[list[str], bool]:
    """Return two entries of [output] in a scene file: the names of the fields, and whether reactions are written.

    Raises:
        InputError: a key is unknown, or a value has a wrong type.
    """
    table = _table("output", content.get("output", {}))
    names, reactions = table.get("fields", []), table.get("reactions", False)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f'[output] fields = {names!r} must be a list of names: write fields = ["cauchy_stress"]')
    if not isinstance(reactions, bool):
        raise InputError(f"[output] reactions = {reactions!r} must be true or false: give one of them")
    return list(dict.fromkeys(names)), reactions


def _physics(mesh: TetMesh, content: dict) -> Iterator[Physics]:
    """Read the tables of all sections in `liverjax.physics.registry`, for example [[support]] and [[obstacle]].

    Each table becomes an object of the first class that accepts all keys of the table.
    """
    for section in dict.fromkeys(p.section for p in NAMED):
        for k, table in enumerate(_tables(content, section)):
            name, own = f"{section}.{k}", set(table) - PLACE
            kinds = [p for p in NAMED if p.section == section and own and own <= set(p.keys)]
            if own and not kinds:
                raise InputError(_of_two_kinds(name, own, [set(p.keys) for p in NAMED if p.section == section]))
            if not kinds:
                known = (", ".join(key for key in p.keys if key not in PLACE) for p in NAMED if p.section == section)
                raise InputError(f"{name} contains only where or set: also give {' or '.join(known)}")
            yield kinds[0].read(mesh, table, name)


def _of_two_kinds(name: str, given: set[str], kinds: list[set[str]]) -> str:
    """Return an error message for keys of a table that are known, but cannot be used together."""
    first = min((given - keys for keys in kinds), key=len)
    other = min((given - keys for keys in kinds if first <= keys), key=len, default=given)
    return f"{name} has {', '.join(sorted(first))} together with {', '.join(sorted(other))}: remove one of them"


def _with_paths(content: object, folder: Path) -> Any:
    """Put `folder` before all paths in the content: histories, surfaces and a reduced model. An empty name stays."""
    if isinstance(content, list):
        return [_with_paths(value, folder) for value in content]
    if not isinstance(content, dict):
        return content
    return {
        key: str(folder / value)
        if key in ("history", "reduced", "surface") and isinstance(value, str) and value
        else _with_paths(value, folder)
        for key, value in content.items()
    }


def _known(name: str, table: dict, keys: tuple) -> None:
    for key in table:
        if key not in keys:
            raise InputError(f"{name} has an unknown key {key!r}: {hint(key, keys)}")


def _table(name: str, value: object) -> dict:
    if not isinstance(value, dict):
        raise InputError(f"{name} must be a table: write [{name}] and its keys below")
    if name in _KEYS:
        _known(f"[{name}]", value, _KEYS[name])
    return value


def _tables(content: dict, name: str) -> list[dict]:
    value = content.get(name, [])
    return [_table(name, t) for t in (value if isinstance(value, list) else [value])]


def _section(content: dict, name: str, make: Any) -> Any:
    return make(_table(name, content[name])) if name in content else None


def _number(name: str, value: object) -> float:
    bounds.check_one(name, value)
    return float(value)  # type: ignore[arg-type]


def _numbers(name: str, value: object, length: int | None = None) -> np.ndarray:
    if not isinstance(value, list) or (length is not None and len(value) != length):
        raise InputError(f"{name} = {value!r} must be a list of {length or 'some'} numbers: correct this list")
    return np.array([_number(name, v) for v in value])


def _mesh(table: dict, folder: Path) -> TetMesh:
    mesh, order = _linear_mesh(table, folder), table.get("order")
    if order not in (None, 1, 2) or isinstance(order, bool):
        raise InputError(f"[mesh] order = {order!r} is not known: use 1 (linear) or 2 (quadratic tetrahedra)")
    if order == 1 and mesh.order == 2:
        raise InputError(
            "[mesh] order = 1, but the file contains quadratic tetrahedra: remove order, or export linear tetrahedra"
        )
    return quadratic(mesh) if order == 2 else mesh


def _linear_mesh(table: dict, folder: Path) -> TetMesh:
    unit = table.get("unit", "m")
    if as_word(unit, "[mesh] unit") not in UNITS:
        raise InputError(f"[mesh] unit = {unit!r} is not known: use one of {', '.join(UNITS)}")
    if ("file" in table) == ("shape" in table):
        raise InputError('[mesh] needs either file = "liver.vtu" or shape = "box" (or "cylinder"): give one of them')
    if "file" in table:
        return read_mesh(folder / as_word(table["file"], "[mesh] file"), unit)
    scale = UNITS[unit]
    if table["shape"] == "box":
        for key in ("size", "cells"):
            if key not in table:
                raise InputError(f"[mesh] shape = 'box' needs {key}: give three numbers")
        return shapes.box(
            list(scale * _numbers("[mesh] size", table["size"], 3)), list(_numbers("[mesh] cells", table["cells"], 3))
        )
    if table["shape"] == "cylinder":
        return _cylinder(table, scale)
    raise InputError(f"[mesh] shape = {table['shape']!r} is not known: use box or cylinder, or give a file")


def _cylinder(table: dict, scale: float) -> TetMesh:
    """Make the mesh of a cylinder. Optional keys: refine it near rims, or match the circle's area."""
    for key in ("radius", "height", "cell_size"):
        if key not in table:
            raise InputError(f"[mesh] shape = 'cylinder' needs {key}: give a length")
    radius, height, cell_size = (scale * _number(f"[mesh] {k}", table[k]) for k in ("radius", "height", "cell_size"))
    rim = scale * _number("[mesh] rim_cell", table["rim_cell"]) if "rim_cell" in table else None
    rings = scale * _numbers("[mesh] rings", table.get("rings", []))
    match = table.get("match_area", False)
    if not isinstance(match, bool):
        raise InputError(f"[mesh] match_area = {match!r} is not known: use true or false")
    return shapes.cylinder(radius, height, cell_size, rim, rings.tolist(), match)


def _law(value: object, where: str = "[law]") -> Law:
    tables = value if isinstance(value, list) and value else [value]
    made = []
    for table in tables:
        if not isinstance(table, dict) or "name" not in table:
            raise InputError(where + ' needs name = "…": python -m liverjax laws lists the names')
        if ".py:" in str(table["name"]):
            raise InputError(
                f"{where} name = {table['name']!r}: a scene file can use only included laws (python -m liverjax laws "
                "lists them); put a law of your own into the scene in Python, by dataclasses.replace(scene, law=…)"
            )
        law = laws.create(table["name"], **{k: v for k, v in table.items() if k not in ("name", "continued_below")})
        made.append(laws.continued(law, table["continued_below"]) if "continued_below" in table else law)
    return made[0] if len(made) == 1 else laws.Sum(laws=tuple(made))


def _region(mesh: TetMesh, k: int, table: dict) -> Region:
    name = f"region.{k}"
    where, given = table.get("where"), table.get("law", {})
    if where is not None and not isinstance(where, dict):
        raise InputError(f"{name} where = {where!r} must be a table: write where = {{z_max = 0.0}}")
    viscous, porous = table.get("viscosity", {}), table.get("porosity", {})
    for key, part, kinds in (("law", given, (dict, list)), ("viscosity", viscous, dict), ("porosity", porous, dict)):
        if not isinstance(part, kinds):
            raise InputError(f"{name} {key} = {part!r} must be a table: write e.g. law = {{mu = 2000.0}}")
    if not given and not viscous and not porous:
        raise InputError(f"{name} needs the parameters that differ in the region: write law = {{mu = 2000.0}}")
    elements = regions.select_elements(mesh, where, table.get("set"), name)
    return Region(
        elements=node_numbers(elements),
        law=_law_of_region(name, given),
        viscosity={key: jnp.asarray(_numbers(f"{name} viscosity.{key}", v)) for key, v in viscous.items()} or None,
        porosity={key: _number(f"{name} porosity.{key}", v) for key, v in porous.items()} or None,
    )


def _law_of_region(name: str, given: Any) -> dict[str, object] | Law:
    """Return a complete law if `given` has a name or is a list of laws.

    Otherwise return the parameters that differ from the law of the body, by dotted name.
    """
    if isinstance(given, list) or "name" in given:
        return _law(given, f"{name}: law")
    return dict(_dotted(f"{name} law", given))


def _dotted(name: str, table: dict) -> list[tuple[str, float]]:
    """Return the dotted name and the value of each number in nested tables and lists."""
    out = []
    for key, value in table.items():
        if isinstance(value, (dict, list)):
            inner = value if isinstance(value, dict) else {str(k): v for k, v in enumerate(value)}
            out += [(f"{key}.{rest}", v) for rest, v in _dotted(f"{name}.{key}", inner)]
        else:
            out.append((key, _number(f"{name}.{key}", value)))
    return out


def _prony(table: dict) -> Prony:
    for key in ("ratios", "relaxation_times"):
        if key not in table:
            raise InputError(f"[viscosity] needs {key}: give a list of numbers, one per mode")
    g, tau = (jnp.asarray(_numbers(f"[viscosity] {k}", table[k])) for k in ("ratios", "relaxation_times"))
    return Prony(ratios=g, relaxation_times=tau, **{k: table[k] for k in ("part", "scheme") if k in table})


def _read_springpots(table: dict) -> SpringpotSeries:
    for key in ("times", "exponents"):
        if key not in table:
            raise InputError(f"[springpots] needs {key}: give a list of numbers, one per springpot")
    values: Content = {k: table[k] for k in ("part",) if k in table}
    if "spring" in table:
        values["spring"] = _number("[springpots] spring", table["spring"])
    for key in ("times", "exponents", "limits"):
        if key in table:
            values[key] = jnp.asarray(_numbers(f"[springpots] {key}", table[key]))
    return SpringpotSeries(**values)


def _porosity(mesh: TetMesh, table: dict) -> Porosity:
    values: Content = {}
    for key in ("bulk", "limit_bulk", "fluid_fraction", "permeability"):
        if key not in table:
            raise InputError(f"[porosity] needs {key}: give a number")
        values[key] = _number(f"[porosity] {key}", table[key])
    if not isinstance(table.get("keep_bulk", False), bool):
        raise InputError(f"[porosity] keep_bulk = {table['keep_bulk']!r} must be true or false: give one of them")
    if "drained" in table:
        values["drained"] = _drained(mesh, table["drained"])
    values |= {k: table[k] for k in ("scheme", "keep_bulk") if k in table}
    if "initial_pressure" in table:
        values["initial_pressure"] = _number("[porosity] initial_pressure", table["initial_pressure"])
    given = table.get("inlet", [])
    given = given if isinstance(given, list) else [given]
    return Porosity(**values, inlet=tuple(_inlet(mesh, f"porosity.inlet.{k}", t) for k, t in enumerate(given)))


def _inlet(mesh: TetMesh, name: str, table: object) -> Inlet:
    """Read an inlet: nodes with a given pressure of the fluid, or a surface with a given flux."""
    if not isinstance(table, dict):
        raise InputError(f"{name} must be a table: write [[porosity.inlet]] and its keys below")
    _known(name, table, ("where", "set", "pressure", "flux", "history"))
    if ("pressure" in table) == ("flux" in table):
        raise InputError(f"{name} needs either pressure in Pa or flux in m/s: give one of them")
    nodes, times = _nodes(mesh, name, table), _history(name, table, (1,))
    if "pressure" in table:
        return Inlet(nodes=nodes, pressure=_number(f"{name} pressure", table["pressure"]), **times)
    triangles = boundary.surface_of(mesh, nodes, table.get("set"))
    if not len(triangles):
        raise InputError(
            f"{name}: the selected region contains nodes, but no triangle of the boundary: enlarge the region to a "
            "whole face"
        )
    flux = _number(f"{name} flux", table["flux"])
    return Inlet(triangles=node_numbers(triangles), flux=flux, **times)


def _drained(mesh: TetMesh, given: Any) -> jax.Array:
    """Return the nodes of one region of the boundary, or the nodes of all regions in a list."""
    if given == []:
        raise InputError("porosity.drained = [] selects no nodes: give [{z_max = 0.0}], or remove drained (sealed)")
    name = "porosity.drained"
    places = {f"{name}.{k}": p for k, p in enumerate(given)} if isinstance(given, list) else {name: given}
    nodes = []
    for place, table in places.items():
        by_set = isinstance(table, dict) and set(table) == {"set"}
        nodes.append(_nodes(mesh, place, table if by_set else {"where": table}))
    return jnp.asarray(np.unique(np.concatenate(nodes)))


def _read_body(table: dict) -> Body:
    if "density" not in table:
        raise InputError("[body] needs density in kg/m^3: give e.g. density = 1060.0")
    gravity = _numbers("[body] gravity", table.get("gravity", [0.0, 0.0, 0.0]), 3)
    density = _number("[body] density", table["density"])
    given = _history("[body]", table)
    if "gravity" in table and given and given["history"].ndim == 2:
        raise InputError("[body] has gravity and a history of gravity vectors: remove one of them")
    if "gravity" not in table and given and given["history"].ndim == 1:
        raise InputError("[body] history contains factors that multiply gravity, but gravity is missing: give gravity")
    mass = table.get("mass", Body.mass)
    return Body(density=density, gravity=jnp.asarray(gravity), mass=mass, **given)


def _history(name: str, table: dict, forms: tuple[int, ...] = (1, 3)) -> dict[str, jax.Array]:
    """Return {"times": …, "history": …} for the history in a table, or an empty dictionary if there is no history."""
    if "history" not in table:
        return {}
    times, numbers = history.read_history(table["history"], name, forms)
    return {"times": times, "history": numbers}


def _nodes(mesh: TetMesh, name: str, table: dict) -> jax.Array:
    where = table.get("where")
    if where is not None and not isinstance(where, dict):
        raise InputError(f"{name} where = {where!r} must be a table: write where = {{z_max = 0.0}}")
    return node_numbers(boundary.select(mesh, where, table.get("set"), f"{name} where"))


def _axes(name: str, table: dict) -> str:
    axes = table.get("axes", "xyz")
    check_axes(axes, name)
    return axes


def _fixed(mesh: TetMesh, k: int, table: dict) -> Fixed:
    name = f"fixed.{k}"
    return Fixed(nodes=_nodes(mesh, name, table), axes=_axes(name, table))


def _displaced(mesh: TetMesh, k: int, table: dict) -> Displaced:
    name = f"displaced.{k}"
    if "by" not in table and "history" not in table:
        raise InputError(f'{name} needs by = [x, y, z], or history = "ramp.csv" of displacements: give one of them')
    nodes, axes = _nodes(mesh, name, table), _axes(name, table)
    by = jnp.asarray(_numbers(f"{name} by", table["by"], 3)) if "by" in table else None
    given = _history(name, table, (3,) if by is None else (1,))
    return Displaced(nodes=nodes, by=by, axes=axes, **given)


def _traction(mesh: TetMesh, k: int, table: dict) -> Traction:
    name = f"traction.{k}"
    given = _history(name, table)
    vectors = bool(given) and given["history"].ndim == 2
    if "pressure" in table and vectors:
        raise InputError(f"{name} has a pressure and a history of vectors: write its history as [[time, factor], …]")
    if ("value" in table) + ("pressure" in table) + vectors != 1:
        raise InputError(f"{name} needs either value = [x, y, z] or pressure = 4.0 (follower), in Pa: give one of them")
    triangles: Indices = boundary.surface_of(mesh, _nodes(mesh, name, table), table.get("set"))
    if len(triangles) == 0:
        raise InputError(
            f"{name}: the selected region contains nodes, but no triangle of the boundary: enlarge the region to a "
            "whole face"
        )
    triangles = node_numbers(triangles)
    if "pressure" in table:
        return Traction(triangles=triangles, pressure=_number(f"{name} pressure", table["pressure"]), **given)
    value = None if vectors else jnp.asarray(_numbers(f"{name} value", table["value"], 3))
    return Traction(triangles=triangles, value=value, **given)


def _read_solve(table: dict) -> Solve:
    values = dict(table)
    for key, allowed in CHOICES.items():
        if key in values and values[key] not in allowed:
            raise InputError(f"[solve] {key} = {values[key]!r} is not known: use {' or '.join(allowed)}")
    values |= {
        key: _number(f"[solve] {key}", values[key]) for key in ("dt", "tolerance", "reduced_tolerance") if key in values
    }
    if "frequencies" in values:
        values["frequencies"] = jnp.asarray(_numbers("[solve] frequencies", values["frequencies"]))
    if not isinstance(values.get("reduced", ""), str):
        raise InputError(f'[solve] reduced = {values["reduced"]!r} is not a file: write reduced = "model.h5"')
    return Solve(**values)
