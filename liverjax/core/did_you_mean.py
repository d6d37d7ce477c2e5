"""The hint at the end of a sentence that refuses an unknown word."""

import difflib
from collections.abc import Iterable


def hint(word: str, known: Iterable[str]) -> str:
    """The end of a sentence about an unknown word: the nearest known word, or all where none is near."""
    words = list(known)
    longer = [name for name in words if len(word) > 2 and name.startswith(word)]
    near = longer or difflib.get_close_matches(word, words, n=1, cutoff=0.5 if len(word) < 4 else 0.6)
    return f"did you mean {near[0]}?" if near else f"use one of {', '.join(words)}"
