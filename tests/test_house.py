"""Structure of the code: imports point downwards, and public names are documented."""

import ast
import importlib
import sys
from pathlib import Path

import pytest
from conftest import ROOT

from liverjax.core import addresses

FILES = sorted([*(ROOT / "liverjax").rglob("*.py"), *(ROOT / "fitting").rglob("*.py")])


def _module(file: Path) -> str:
    name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
    return name.removesuffix(".__init__")


TREES = {_module(file): ast.parse(file.read_text()) for file in FILES}


def _imported(tree: ast.Module) -> set[str]:
    """Return the modules of the project that a module imports, also for its types, but not inside its functions."""
    found = set()
    for node in (*tree.body, *(n for own in tree.body if isinstance(own, ast.If) for n in own.body)):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{a.name}" for a in node.names}
            # `from liverjax import mesh` imports the module, not everything that the package offers.
            found |= names if names <= set(TREES) else names | {node.module}
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
    return {m for m in found & set(TREES) if m != "liverjax"}


def test_imports_have_no_circle_and_point_downwards():
    graph = {name: _imported(tree) for name, tree in TREES.items()}
    assert not [(a, b) for a, found in graph.items() for b in found if a.startswith("liverjax") and "fitting" in b]
    done: set[str] = set()

    def visit(module: str, path: list[str]) -> None:
        assert module not in path, " -> ".join([*path, module])
        if module not in done:
            for other in graph[module]:
                visit(other, [*path, module])
            done.add(module)

    for module in graph:
        visit(module, [])


#: Subpackages from the lowest upwards: each may import from those below it, and from itself.
STOREYS = {
    "liverjax": (
        "core",
        "tensors",
        "mesh",
        "laws",
        "elements",
        "solvers",
        "physics",
        "scenes",
        "simulation",
        "reduced",
        "waves",
        "jobs",
        "play",
        "commands",
    ),
    "fitting": ("readers", "rigs", "methods", "waves", "fits", "amplitude", "master", "reports", "commands"),
}
#: Files of a package that belong to no subpackage: the modules for users, and the entry points.
DOORS = {"liverjax": {"check"}, "fitting": {"fit", "joint", "rheometer", "torsion"}}


@pytest.mark.parametrize("package", STOREYS)
def test_every_room_is_known_and_knows_none_above_it(package):
    rooms = STOREYS[package]
    for name, tree in TREES.items():
        own = name.split(".")
        if own[0] != package or len(own) < 2 or own[1] in DOORS[package] | {"__main__"}:
            continue
        assert own[1] in rooms, f"{name} is in no room of {package}: {', '.join(rooms)}"
        known = {m.split(".")[1] for m in _imported(tree) if m.startswith(f"{package}.") and m.count(".")}
        above = known - set(rooms[: rooms.index(own[1]) + 1])
        assert not above, f"{name} imports from {', '.join(sorted(above))}, which is above it"


def test_no_folder_holds_more_than_a_dozen_files():
    folders = {file.parent for file in FILES}
    held = {str(f.relative_to(ROOT)): len([x for x in f.glob("*.py") if x.name != "__init__.py"]) for f in folders}
    assert not {name: n for name, n in held.items() if n > 13}


MOST_PARAMETERS, MOST_LINES = 6, 60


def _functions(tree: ast.Module) -> list[ast.FunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


@pytest.mark.parametrize("module", TREES)
def test_functions_take_few_parameters_and_fit_a_screen(module):
    for function in _functions(TREES[module]):
        a = function.args
        every = (*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg)))
        names = [x.arg for x in every if x.arg not in ("self", "cls")]
        assert len(names) <= MOST_PARAMETERS, f"{function.name}: {names}"
        lines = function.end_lineno - function.lineno + 1
        assert lines <= MOST_LINES, f"{function.name} has {lines} lines"


#: Names that every file of a folder has, because they are the purpose of the folder.
PROTOCOL = {
    "liverjax.commands": {"add", "run"},
    "fitting.commands": {"parser", "run"},
    "fitting.fits": {"fit", "estimate"},
    "fitting.reports": {"figure", "summary", "table", "write"},
    "liverjax.elements": {"energy", "internal_force", "stiffness_matrix"},
    "liverjax.laws.terms": {"blocks", "first_piola", "stress"},
    "liverjax.physics": {"blocks", "check", "first_piola"},
    "liverjax.solvers": {"product", "solve"},
}
EVERYWHERE = {"__getattr__", "main", "_"}
#: Number of names that several modules define nevertheless. New functions need other names.
MOST_HOMONYMS = 15


def test_few_names_are_defined_in_several_modules():
    places: dict[str, set[str]] = {}
    for module, tree in TREES.items():
        for node in tree.body:
            if not isinstance(node, (ast.FunctionDef, ast.ClassDef)) or node.name in EVERYWHERE:
                continue
            if not any(module.startswith(f"{room}.") and node.name in names for room, names in PROTOCOL.items()):
                places.setdefault(node.name, set()).add(module)
    several = {name: sorted(found) for name, found in places.items() if len(found) > 1}
    assert len(several) <= MOST_HOMONYMS, several


#: Number of `Any` where no better type is possible. Lower it with each one that is removed.
MOST_ANY = 370


def test_few_annotations_say_nothing():
    names = (node for tree in TREES.values() for node in ast.walk(tree) if isinstance(node, ast.Name))
    assert sum(node.id == "Any" for node in names) <= MOST_ANY


def _public(tree: ast.Module) -> list:
    kinds = (ast.FunctionDef, ast.ClassDef)
    top = [n for n in tree.body if isinstance(n, kinds) and not n.name.startswith("_")]
    classes = [n for n in top if isinstance(n, ast.ClassDef)]
    return top + [n for c in classes for n in c.body if isinstance(n, kinds) and not n.name.startswith("_")]


@pytest.mark.parametrize("module", TREES)
def test_public_names_have_docstrings_and_hints(module):
    tree = TREES[module]
    assert ast.get_docstring(tree), "the module has no docstring"
    for node in _public(tree):
        assert ast.get_docstring(node), f"{node.name} has no docstring"
    for node in _public(tree):
        if isinstance(node, ast.FunctionDef) and node in tree.body:
            bare = [a.arg for a in node.args.args + node.args.kwonlyargs if a.annotation is None]
            assert not bare and node.returns is not None, f"{node.name} lacks hints: {bare}"


@pytest.mark.parametrize("old", addresses.MOVED)
def test_old_addresses_offer_what_they_offered(old):
    package, _, name = old.partition(".")
    new = importlib.import_module(addresses.MOVED[old])
    # `lj.struct` is the decorator of classes. The module of the same name is found by its address.
    found = sys.modules[old] if name == "struct" else getattr(importlib.import_module(package), name)
    assert {n for n in dir(new) if not n.startswith("_")} <= set(dir(found))
