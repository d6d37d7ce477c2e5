"""Slow tests are seldom run as a whole, so a name that a module no longer has could stay in them unseen."""

import ast
import importlib
import types

import pytest
from conftest import ROOT

FILES = sorted((ROOT / "tests").glob("*.py"))


def _modules(tree):
    """Modules of the project by their name in a file."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("liverjax", "fitting"):
            home = importlib.import_module(node.module)
            for own in node.names:
                if not hasattr(home, own.name):
                    importlib.import_module(f"{node.module}.{own.name}")
                value = getattr(home, own.name)
                if isinstance(value, types.ModuleType):
                    found[own.asname or own.name] = value
    return found


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_modules_have_what_tests_use(file):
    tree = ast.parse(file.read_text())
    modules = _modules(tree)
    used = {
        (node.value.id, node.attr)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules
    }
    local = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    assert not [f"{name}.{own}" for name, own in used if name not in local and not hasattr(modules[name], own)]
