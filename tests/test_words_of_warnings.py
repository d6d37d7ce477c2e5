"""Words by which the program finds its own warnings: a warning that is reworded must still contain them."""

import ast

from conftest import ROOT

from fitting.fits import simulated_rheometer, viscoelastic
from fitting.reports import samples_report


def _texts(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_warnings_contain_the_words_by_which_they_are_found():
    """If a warning lost these words, a summary would count 0 of such warnings, without an error."""
    trees = [ast.parse(file.read_text()) for file in (ROOT / "fitting").rglob("*.py")]
    texts = {text for tree in trees for text in _texts(tree)}
    # A named constant is used both in the warning and in the search, so it cannot differ.
    named = {n.value.value for tree in trees for n in tree.body if isinstance(n, ast.Assign) if _is_text(n.value)}
    every = [*viscoelastic.IMPORTANT, *simulated_rheometer.OF_THE_DATA, *(words for words, _ in samples_report.COUNTED)]
    lost = [words for words in every if words not in named and not any(words in t and t != words for t in texts)]
    assert len(every) > 20 and not lost


def _is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
