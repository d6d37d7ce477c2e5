"""A scene: a mesh, a law, the physics it has and no other, and what holds, moves and loads it. Read from TOML."""

import copy
import dataclasses
import difflib
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import boundary, laws, porosity, regions, shapes, viscosity
from liverjax.boundary import Displaced, Fixed, Traction
from liverjax.errors import InputError
from liverjax.laws import Law
from liverjax.mesh import UNITS, TetMesh, check_mesh, read_mesh, with_points
from liverjax.porosity import Porosity
from liverjax.regions import Region
from liverjax.struct import param, replace, static, struct
from liverjax.viscosity import Prony


@struct
class Body:
    """Mass and weight."""

    density: Any = param("kg/m^3", "per reference volume", above=0.0)
    gravity: Any = param("m/s^2", "(3,)", default=(0.0, 0.0, 0.0))


@struct
class Solve:
    """How the scene is solved; all but the time step and the tolerance is static."""

    dt: Any = param("s", "time step; None: load steps without time", default=None)
    kind: str = static(default="static", about="static: no inertia; dynamic")
    steps: int = static(default=1, about="load steps, or time steps of dt")
    tolerance: Any = param("1", "of the residual, relative to the forces at work", default=1e-8)
    newton_iterations: int = static(
        default=25, about="of a step; 1 is the chapter's linearly implicit scheme (not for derivatives)"
    )
    integrator: str = static(
        default="euler", about="dynamic: euler (first order) or newmark (average acceleration, second order)"
    )
    precision: str = static(default="float64", about="float64 or float32")
    linear_solver: str = static(
        default="auto", about="cg; direct: factorised on the host; auto: by size and stiffness (`choice`)"
    )
    volumetric: str = static(
        default="element", about="element, or nodal: volume changes averaged at nodes, against locking"
    )
    robust: str = static(
        default="off", about="projected or regularised: make the energy least where a step cannot be followed"
    )


@struct
class Scene:
    """What `simulate` runs; parts that a scene lacks are None or empty and cost nothing."""

    mesh: TetMesh = param("1", "the body")
    law: Law = param("1", "its hyperelastic law")
    region: tuple[Region, ...] = param("1", "parts of the body with other numbers in the law", default=())
    viscosity: Prony | None = param("1", "Prony series", default=None)
    porosity: Porosity | None = param("1", "sponge and fluid", default=None)
    body: Body | None = param("1", "density and gravity", default=None)
    fixed: tuple[Fixed, ...] = param("1", "held nodes", default=())
    displaced: tuple[Displaced, ...] = param("1", "prescribed motion", default=())
    traction: tuple[Traction, ...] = param("1", "loads", default=())
    solve: Solve = param("1", "how", default=Solve())


def element_law(scene: Scene) -> Law:
    """The law that acts element by element: without its volumetric energy where a sponge or the nodes have that."""
    if scene.solve.volumetric == "nodal":
        return laws.isochoric_part(scene.law)
    return porosity.law_in_force(scene.porosity, scene.law)


# -- files ------------------------------------------------------------------------------------------------------------

_KEYS = {
    "mesh": ("file", "unit", "shape", "size", "cells", "radius", "height", "cell_size"),
    "region": ("where", "set", "law"),
    "viscosity": ("ratios", "relaxation_times", "part", "scheme"),
    "porosity": ("bulk", "limit_bulk", "fluid_fraction", "permeability", "drained", "scheme", "keep_bulk"),
    "body": ("density", "gravity"),
    "fixed": ("where", "set", "axes"),
    "displaced": ("where", "set", "axes", "by", "history"),
    "traction": ("where", "set", "value", "pressure"),
    "solve": tuple(f.name for f in dataclasses.fields(Solve)),
}
_SECTIONS = ("mesh", "law", *list(_KEYS)[1:])


def load_scene(path: str | Path) -> Scene:
    """A scene from a TOML file; relative paths in it are relative to it.

    Raises:
        InputError: unreadable file, unknown or missing keys, values that cannot be used, checked before any compile.
    """
    path = Path(path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except IsADirectoryError:
        raise InputError(f"{path} is a folder: give a scene file (TOML)") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): give a scene file (TOML)") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text: give a scene file (TOML)") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not TOML ({error}): mend that line") from None
    try:
        return scene_from(content, path.parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def scene_from(content: dict[str, Any], folder: Path = Path()) -> Scene:
    """A scene from the content of a scene file as nested dictionaries."""
    _known("scene", content, _SECTIONS)
    for name in ("mesh", "law"):
        if name not in content:
            raise InputError(f"the scene has no [{name}]: add it")
    mesh = _mesh(_table("mesh", content["mesh"]), folder)
    prony = _section(content, "viscosity", _prony)
    scene = Scene(
        mesh=mesh,
        law=_law(content["law"]),
        region=tuple(_region(mesh, k, t) for k, t in enumerate(_tables(content, "region"))),
        viscosity=prony,
        porosity=_section(content, "porosity", lambda table: _porosity(mesh, table)),
        body=_section(content, "body", _body),
        fixed=tuple(_fixed(mesh, k, t) for k, t in enumerate(_tables(content, "fixed"))),
        displaced=tuple(_displaced(mesh, k, t, folder) for k, t in enumerate(_tables(content, "displaced"))),
        traction=tuple(_traction(mesh, k, t) for k, t in enumerate(_tables(content, "traction"))),
        solve=_solve(_table("solve", content.get("solve", {}))),
    )
    check_scene(scene)
    return scene


def _known(name: str, table: dict, keys: tuple) -> None:
    for key in table:
        if key not in keys:
            near = difflib.get_close_matches(key, keys, n=1, cutoff=0.0)[0]
            raise InputError(f"{name} has an unknown key {key!r}: did you mean {near}?")


def _table(name: str, value: Any) -> dict:
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


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise InputError(f"{name} = {value!r} is not a number: give one")
    return float(value)


def _numbers(name: str, value: Any, length: int | None = None) -> np.ndarray:
    if not isinstance(value, list) or (length is not None and len(value) != length):
        raise InputError(f"{name} = {value!r} must be a list of {length or 'some'} numbers: give one")
    return np.array([_number(name, v) for v in value])


def _mesh(table: dict, folder: Path) -> TetMesh:
    unit = table.get("unit", "m")
    if unit not in UNITS:
        raise InputError(f"[mesh] unit = {unit!r} is not known: use one of {', '.join(UNITS)}")
    if ("file" in table) == ("shape" in table):
        raise InputError('[mesh] needs either file = "liver.vtu" or shape = "box" (or "cylinder"): give one of them')
    if "file" in table:
        return read_mesh(folder / str(table["file"]), unit)
    scale = UNITS[unit]
    if table["shape"] == "box":
        for key in ("size", "cells"):
            if key not in table:
                raise InputError(f"[mesh] shape = 'box' needs {key}: give three numbers")
        return shapes.box(
            list(scale * _numbers("[mesh] size", table["size"], 3)), list(_numbers("[mesh] cells", table["cells"], 3))
        )
    if table["shape"] == "cylinder":
        for key in ("radius", "height", "cell_size"):
            if key not in table:
                raise InputError(f"[mesh] shape = 'cylinder' needs {key}: give a length")
        return shapes.cylinder(*(scale * _number(f"[mesh] {k}", table[k]) for k in ("radius", "height", "cell_size")))
    raise InputError(f"[mesh] shape = {table['shape']!r} is not known: use box or cylinder, or give a file")


def _law(value: Any) -> Law:
    tables = value if isinstance(value, list) else [value]
    made = []
    for table in tables:
        if not isinstance(table, dict) or "name" not in table:
            raise InputError('[law] needs name = "…": python -m liverjax laws lists them')
        law = laws.create(table["name"], **{k: v for k, v in table.items() if k not in ("name", "continued_below")})
        made.append(laws.continued(law, table["continued_below"]) if "continued_below" in table else law)
    return made[0] if len(made) == 1 else laws.Sum(laws=tuple(made))


def _region(mesh: TetMesh, k: int, table: dict) -> Region:
    name = f"region.{k}"
    where, given = table.get("where"), table.get("law")
    if where is not None and not isinstance(where, dict):
        raise InputError(f"{name} where = {where!r} must be a table: write where = {{z_max = 0.0}}")
    if not isinstance(given, dict) or not given:
        raise InputError(f"{name} needs the numbers that differ there: write law = {{mu = 2000.0}}")
    elements = regions.select(mesh, where, table.get("set"), name)
    return Region(elements=jnp.asarray(elements, jnp.int32), law=dict(_dotted(f"{name} law", given)))


def _dotted(name: str, table: dict) -> list[tuple[str, float]]:
    """Numbers of nested tables and lists, by dotted names."""
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
            raise InputError(f"[viscosity] needs {key}: give a list of numbers, one a mode")
    g, tau = (jnp.asarray(_numbers(f"[viscosity] {k}", table[k])) for k in ("ratios", "relaxation_times"))
    return Prony(ratios=g, relaxation_times=tau, **{k: table[k] for k in ("part", "scheme") if k in table})


def _porosity(mesh: Any, table: dict) -> Porosity:
    values: dict[str, Any] = {}
    for key in ("bulk", "limit_bulk", "fluid_fraction", "permeability"):
        if key not in table:
            raise InputError(f"[porosity] needs {key}: give a number")
        values[key] = _number(f"[porosity] {key}", table[key])
    if not isinstance(table.get("keep_bulk", False), bool):
        raise InputError(f"[porosity] keep_bulk = {table['keep_bulk']!r} must be true or false: give one of them")
    if "drained" in table:
        given = table["drained"]
        by_set = isinstance(given, dict) and set(given) == {"set"}
        values["drained"] = _nodes(mesh, "porosity.drained", given if by_set else {"where": given})
    values |= {k: table[k] for k in ("scheme", "keep_bulk") if k in table}
    return Porosity(**values)


def _body(table: dict) -> Body:
    if "density" not in table:
        raise InputError("[body] needs density in kg/m^3: give e.g. density = 1060.0")
    density = _number("[body] density", table["density"])
    if density <= 0:
        raise InputError(f"[body] density = {density:g} must be above 0: give e.g. 1060.0 kg/m^3")
    return Body(
        density=density, gravity=jnp.asarray(_numbers("[body] gravity", table.get("gravity", [0.0, 0.0, 0.0]), 3))
    )


def _nodes(mesh: TetMesh, name: str, table: dict) -> jax.Array:
    where = table.get("where")
    if where is not None and not isinstance(where, dict):
        raise InputError(f"{name} where = {where!r} must be a table: write where = {{z_max = 0.0}}")
    return jnp.asarray(boundary.select(mesh, where, table.get("set"), f"{name} where"), jnp.int32)


def _axes(name: str, table: dict) -> str:
    axes = table.get("axes", "xyz")
    if not isinstance(axes, str) or not axes or set(axes) - set("xyz") or len(set(axes)) != len(axes):
        raise InputError(f"{name} axes = {axes!r} is not known: give some of the letters xyz")
    return axes


def _fixed(mesh: TetMesh, k: int, table: dict) -> Fixed:
    name = f"fixed.{k}"
    return Fixed(nodes=_nodes(mesh, name, table), axes=_axes(name, table))


def _displaced(mesh: TetMesh, k: int, table: dict, folder: Path) -> Displaced:
    name = f"displaced.{k}"
    if ("by" in table) == ("history" in table):
        raise InputError(f'{name} needs either by = [x, y, z] or history = "ramp.csv": give one of them')
    nodes, axes = _nodes(mesh, name, table), _axes(name, table)
    if "by" in table:
        return Displaced(nodes=nodes, by=jnp.asarray(_numbers(f"{name} by", table["by"], 3)), axes=axes)
    file = folder / str(table["history"])
    try:
        data = np.atleast_1d(np.genfromtxt(file, delimiter=",", names=True, comments="#"))
    except (OSError, ValueError) as error:
        raise InputError(f"{name} history {file} cannot be read ({error}): give columns time,x,y,z") from None
    if not data.dtype.names or not {"time", "x", "y", "z"} <= set(data.dtype.names):
        raise InputError(f"{name} history {file} has columns {data.dtype.names}: give time,x,y,z")
    times, values = data["time"], np.stack([data[a] for a in "xyz"], axis=1)
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(values)) and np.all(np.diff(times) > 0)):
        raise InputError(f"{name} history {file} must hold finite numbers at increasing times: sort and fill it")
    return Displaced(nodes=nodes, times=jnp.asarray(times), history=jnp.asarray(values), axes=axes)


def _traction(mesh: TetMesh, k: int, table: dict) -> Traction:
    name = f"traction.{k}"
    if ("value" in table) == ("pressure" in table):
        raise InputError(f"{name} needs either value = [x, y, z] or pressure = 4.0 (follower), in Pa: give one of them")
    triangles: Any = boundary.boundary_triangles(mesh, _nodes(mesh, name, table))
    if len(triangles) == 0:
        raise InputError(f"{name} where meets nodes but no boundary triangle: widen it to a whole face")
    triangles = jnp.asarray(triangles, jnp.int32)
    if "pressure" in table:
        return Traction(triangles=triangles, pressure=_number(f"{name} pressure", table["pressure"]))
    return Traction(triangles=triangles, value=jnp.asarray(_numbers(f"{name} value", table["value"], 3)))


_CHOICES = {
    "kind": ("static", "dynamic"),
    "integrator": ("euler", "newmark"),
    "precision": ("float64", "float32"),
    "linear_solver": ("auto", "cg", "direct"),
    "volumetric": ("element", "nodal"),
    "robust": ("off", "projected", "regularised"),
}


def _solve(table: dict) -> Solve:
    values = dict(table)
    for key, allowed in _CHOICES.items():
        if key in values and values[key] not in allowed:
            raise InputError(f"[solve] {key} = {values[key]!r} is not known: use {' or '.join(allowed)}")
    for key in ("steps", "newton_iterations"):
        if key in values and (isinstance(values[key], bool) or not isinstance(values[key], int) or values[key] < 1):
            raise InputError(f"[solve] {key} = {values[key]!r} must be a whole number above 0: give e.g. 5")
    for key in ("dt", "tolerance"):
        if key in values and not _number(f"[solve] {key}", values[key]) > 0:
            raise InputError(f"[solve] {key} = {values[key]!r} must be above 0: give a larger number")
    return Solve(**values)


# -- checks and changes ------------------------------------------------------------------------------------------------


def check_choices(scene: Scene) -> None:
    """Refuse choices that mean nothing; looks at no numbers, so that a traced scene passes as well.

    Raises:
        InputError: unknown choices; a load or motion given twice, not at all, of wrong shape.
    """
    for key, allowed in _CHOICES.items():
        value = getattr(scene.solve, key)
        if value not in allowed:
            raise InputError(f"[solve] {key} = {value!r} is not known: use {' or '.join(allowed)}")
    if scene.solve.linear_solver == "direct" and any(load.pressure is not None for load in scene.traction):
        raise InputError("[solve] linear_solver = 'direct' is for symmetric forces: use cg where a pressure follows")
    if scene.solve.volumetric == "nodal":
        _nodal(scene)
    if scene.solve.robust != "off" and any(load.pressure is not None for load in scene.traction):
        raise InputError("[solve] robust needs forces with an energy: leave it out where a pressure follows the body")
    for k, load in enumerate(scene.traction):
        if (load.value is None) == (load.pressure is None):
            raise InputError(f"traction.{k} needs either value (3,) or pressure, in Pa: give one of them")
        name, shape = ("pressure", ()) if load.value is None else ("value", (3,))
        if np.shape(getattr(load, name)) != shape:
            raise InputError(f"traction.{k} {name} has shape {np.shape(getattr(load, name))}: give shape {shape}")
    for k, motion in enumerate(scene.displaced):
        if (motion.by is None) == (motion.history is None):
            raise InputError(f"displaced.{k} needs either by (3,) or times and history: give one of them")


def _nodal(scene: Scene) -> None:
    name = "[solve] volumetric = 'nodal'"
    if scene.porosity is not None:
        raise InputError(f"{name} averages a law's own volumetric energy, a sponge has another: use 'element'")
    if laws.isochoric_part(scene.law) is None or laws.volumetric_part(scene.law) is None:
        raise InputError(f"{name} needs a law with bulk apart from its shear, {type(scene.law).__name__} is none")
    if scene.viscosity is not None and scene.viscosity.part != "isochoric":
        raise InputError(f"{name} needs [viscosity] part = 'isochoric': volumes do not relax there")


def check_scene(scene: Scene) -> None:
    """Refuse a scene that cannot be simulated; host side, before any compile.

    Raises:
        InputError: an unusable mesh or viscosity, missing time step or mass, contradicting conditions, a loose body.
    """
    check_choices(scene)
    check_mesh(scene.mesh)
    for k, load in enumerate(scene.traction):
        if not np.all(np.isfinite(np.asarray(load.pressure if load.value is None else load.value, dtype=float))):
            raise InputError(f"traction.{k} is not finite: give numbers in Pa")
    regions.check(scene.law, scene.region, scene.mesh.number_of_elements)
    if scene.viscosity is not None:
        viscosity.check(scene.viscosity, scene.law)
    if scene.porosity is not None:
        porosity.check(scene.porosity)
    solve = scene.solve
    histories = any(d.history is not None for d in scene.displaced)
    if solve.dt is None:
        for present, what in (
            (scene.viscosity is not None, "viscosity"),
            (scene.porosity is not None, "porosity"),
            (histories, "a history"),
        ):
            if present:
                raise InputError(f"[solve] has no dt, which {what} needs: give the time step in seconds")
        if solve.kind == "dynamic":
            raise InputError("[solve] kind = 'dynamic' needs dt: give the time step in seconds")
    if solve.kind == "dynamic" and scene.body is None:
        raise InputError("[solve] kind = 'dynamic' needs mass: add [body] with a density")
    _no_contradiction(scene)
    if solve.kind == "static":
        _held(scene)


def changed_content(content: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """The content of a scene file with values at dotted names."""
    content = copy.deepcopy(content)
    for name, value in values.items():
        *path, last = [int(key) if key.isdigit() else key for key in name.split(".")]
        table: Any = content if path[:1] != ["mesh"] else None  # the mesh is one for all
        try:
            for k, key in enumerate(path):
                if k == 1 and isinstance(key, int) and isinstance(table, dict):
                    continue  # [traction] for [[traction]]: one table stands for a list of one
                table = table[key] if isinstance(key, int) else table.setdefault(key, {})
            if path == ["law"] and isinstance(table, list) and len(table) == 1:
                table = table[0]
            table[last] = value
        except (KeyError, IndexError, TypeError, AttributeError):
            raise InputError(f"parameter {name!r} is no number of the scene file: name one that stands there") from None
    return content


def check_numbers(content: dict[str, Any]) -> None:
    """Refuse numbers of a scene's content that are out of bounds; looks at no mesh.

    Raises:
        InputError: a parameter of law, viscosity, porosity, body or solve that cannot be used.
    """
    law = _law(content["law"])
    prony = _section(content, "viscosity", _prony)
    if prony is not None:
        viscosity.check(prony, law)
    if "porosity" in content:
        sponge = {k: v for k, v in content["porosity"].items() if k != "drained"}
        porosity.check(_porosity(None, sponge))
    _section(content, "body", _body)
    _solve(_table("solve", content.get("solve", {})))


def _no_contradiction(scene: Scene) -> None:
    taken: dict[tuple[int, str], str] = {}
    for kind in ("fixed", "displaced"):
        for k, condition in enumerate(getattr(scene, kind)):
            for axis in condition.axes:
                for node in np.asarray(condition.nodes).tolist():
                    other = taken.setdefault((node, axis), f"{kind}.{k}")
                    if other != f"{kind}.{k}" and "displaced" in (kind, other.partition(".")[0]):
                        raise InputError(
                            f"{other} and {kind}.{k} both prescribe node {node} along {axis}: make their places differ"
                        )


def _held(scene: Scene) -> None:
    """Every connected piece needs something that holds it, else a static solution does not exist."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    tets, n = np.asarray(scene.mesh.tetrahedra), scene.mesh.number_of_nodes
    rows, columns = np.repeat(tets, 4, axis=1).ravel(), np.tile(tets, (1, 4)).ravel()
    pieces, label = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)), directed=False)
    mask = np.asarray(boundary.free_degrees(scene.mesh, scene.fixed, scene.displaced))
    for piece in range(pieces):
        nodes = np.flatnonzero(label == piece)
        held = [(node, axis) for node, axis in np.argwhere(mask[nodes] == 0)]
        points = np.asarray(scene.mesh.points)[nodes]
        if _rigid_rank(points - points.mean(axis=0), held) < 6:
            which = f"piece {piece} ({len(nodes)} nodes)" if pieces > 1 else "the body"
            raise InputError(f"nothing holds {which} against every rigid motion: add [[fixed]] or kind = 'dynamic'")


def _rigid_rank(points: np.ndarray, held: list) -> int:
    """Rank of the six rigid motions as seen by the held degrees of freedom."""
    if not held:
        return 0
    size = max(np.abs(points).max(), 1e-300)
    motions = []
    for node, axis in held:
        x = points[node] / size
        turns = [np.cross(e, x)[axis] for e in np.eye(3)]
        motions.append([*np.eye(3)[axis], *turns])
    return int(np.linalg.matrix_rank(np.array(motions), tol=1e-6))


def with_parameters(scene: Scene, values: dict[str, Any]) -> Scene:
    """The scene with numbers changed; values may be traced.

    Args:
        scene: `Scene`.
        values: dotted names as in the scene file -> values: ``law.mu`` (``law.1.mu`` of several laws),
            ``viscosity.relaxation_times``, ``viscosity.ratios.0``, ``body.density``, ``displaced.0.by``, ``solve.dt``,
            ``mesh.points``, ``region.0.law.mu``; a number of a law may be one an element (E,).

    Raises:
        InputError: a name that the scene does not have.
    """
    for name, value in values.items():
        scene = _with(scene, name.split("."), value, name)
    return scene


def _with(thing: Any, path: list[str], value: Any, name: str) -> Any:
    if not path:
        if isinstance(thing, tuple):
            return tuple(value)
        return jnp.asarray(value, float) if isinstance(thing, jax.Array) else value
    key, rest = path[0], path[1:]
    if isinstance(thing, dict) and ".".join(path) in thing:
        return thing | {".".join(path): value}
    if isinstance(thing, TetMesh) and path == ["points"]:
        return with_points(thing, value)
    if isinstance(thing, laws.Continued):
        return replace(thing, law=_with(thing.law, path, value, name))
    if isinstance(thing, laws.Sum) and key.isdigit():
        return replace(thing, laws=_with(thing.laws, path, value, name))
    if isinstance(thing, tuple) and key.isdigit() and int(key) < len(thing):
        k = int(key)
        return (*thing[:k], _with(thing[k], rest, value, name), *thing[k + 1 :])
    if key.isdigit() and hasattr(thing, "shape") and thing.ndim and int(key) < thing.shape[0] and not rest:
        return thing.at[int(key)].set(value)
    if dataclasses.is_dataclass(thing):
        known = {f.name: f for f in dataclasses.fields(thing)}
        if key in known and not known[key].metadata.get("static") and getattr(thing, key) is not None:
            return replace(thing, **{key: _with(getattr(thing, key), rest, value, name)})
        offered = [n for n, f in known.items() if not f.metadata.get("static") and getattr(thing, n) is not None]
        near = difflib.get_close_matches(key, offered, n=1, cutoff=0.0)
        raise InputError(
            f"parameter {name!r}: the scene has no {key!r} there: did you mean {near[0] if near else '?'}?"
        )
    raise InputError(f"parameter {name!r}: {key!r} leads nowhere: use the names of the scene file")
