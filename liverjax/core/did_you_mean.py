"""Check words that users have written, and make the hint in a message about an unknown word."""

import difflib
from collections.abc import Iterable

from liverjax.core.errors import InputError


def hint(word: str, known: Iterable[str], before: str = "") -> str:
    """Return the hint for a message about an unknown word. The hint is the end of the message.

    It contains the most similar known word, or all known words if none is similar. `before` is written before each
    known word, for example "law.".
    """
    words = list(known)
    longer = [name for name in words if len(word) > 2 and name.startswith(word)]
    near = longer or difflib.get_close_matches(word, words, n=1, cutoff=0.5 if len(word) < 4 else 0.6)
    return f"did you mean {before}{near[0]}?" if near else f"use one of {', '.join(before + name for name in words)}"


def as_word(value: object, where: str) -> str:
    """Return the value if it is a string, and raise InputError if not. Only a string can be compared with known words.

    Args:
        value: a value of a scene file.
        where: name of the value, for the message.

    Raises:
        InputError: the value is not a string.
    """
    if not isinstance(value, str):
        raise InputError(f"{where} = {value!r} is not a string: write one word in quotes")
    return value
