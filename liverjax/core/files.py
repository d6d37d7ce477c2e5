"""Folders for results, tried before anything is computed; files that are there whole or not at all.

Marks of a problem in the file of its progress let a run go on from a file of its own problem alone.
"""

import hashlib
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from liverjax.core.errors import InputError


def writable(out: Path, files: tuple[str, ...]) -> None:
    """Make the folder `out` and try to write into it, where `files` are going to be.

    Raises:
        InputError: `out` is a file or cannot be written, or one of `files` is a folder.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} is a file: name a folder for the results")
    for name in files:
        if (out / name).is_dir():
            raise InputError(f"--out {out}: {name} in it is a folder; name another folder for the results")
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror}; name a folder that can be written") from None


@contextmanager
def whole(file: Path, ending: str = ".part") -> Iterator[Path]:
    """Give a temporary path beside `file` to write to; at the end it is renamed to `file`.

    A kill leaves `file` as it was. An error leaves it as well, and removes the new file.

    Args:
        file: what is to be there whole or not at all.
        ending: of the path beside; one of its own for each process where several may write `file`.
    """
    beside = file.with_suffix(ending)
    try:
        yield beside
        beside.replace(file)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def mark_of(*arrays: object) -> str:
    """A text that is the same for equal arrays only (SHA-256 of kind, shape and bytes)."""
    found = hashlib.sha256()
    for a in map(np.asarray, arrays):
        found.update(f"{a.dtype} {a.shape}".encode() + np.ascontiguousarray(a).tobytes())
    return found.hexdigest()


def refuse_other(file: Path, held: Mapping[str, object], marks: Mapping[str, object]) -> None:
    """`InputError` where the marks that `file` holds are not these; it names the ones that differ."""
    other = [name for name, own in marks.items() if held.get(name) != own]
    if other:
        raise InputError(
            f"{file} is of another fit ({', '.join(other)} differ{'s' * (len(other) == 1)}): leave out --resume or "
            "name another --out"
        )
