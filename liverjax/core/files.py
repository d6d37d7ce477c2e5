"""Check, before a computation, that results can be written. Write each file completely or not at all.

A progress file contains marks (digests) of its problem, so that a run continues only from a file of the same problem.
"""

import glob
import hashlib
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

import numpy as np

from liverjax.core.errors import InputError


def writable(out: Path, files: tuple[str, ...], folders: tuple[str, ...] = (), inputs: Iterable[Path] = ()) -> None:
    """Make the folder `out` for the results, and check that files can be written into this folder.

    Args:
        out: folder of the results.
        files: names of the files that will be written. `*` stands for any characters.
        folders: names of the folders that will be made in `out`.
        inputs: files that are read, and must not be replaced by `files`.

    Raises:
        InputError: `out` is a file or cannot be written, one of `files` is a folder or one of `inputs`, or one of
            `folders` is a file.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} is a file: name a folder for the results")
    for name in files:
        if (out / name).is_dir():
            raise InputError(f"--out {out} contains a folder {name}: name another folder for the results")
    for name in folders:
        if (out / name).exists() and not (out / name).is_dir():
            raise InputError(f"--out {out} contains a file {name}, but a folder {name} is needed: name another folder")
    written = {file.resolve() for name in files for file in (out / name, *out.glob(name))}
    for path in inputs:
        if path.resolve() in written:
            raise InputError(f"{path} would be replaced by the results: give another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise InputError(f"--out {out} cannot be used ({error.strerror}): name a folder that can be written") from None


def named_files(toml: Path) -> list[Path]:
    """Return the files that a TOML file names, for example a mesh. Its paths are relative to its folder."""
    found: list[Path] = []
    values: list[object] = [tomllib.loads(toml.read_text(encoding="utf-8-sig"))]
    while values:
        value = values.pop()
        if isinstance(value, str):
            with suppress(OSError, ValueError):  # a text that cannot be a path
                found += [toml.parent / value] if (toml.parent / value).is_file() else []
        elif isinstance(value, dict | list):
            values += value.values() if isinstance(value, dict) else value
    return found


#: Age [s] above which a temporary file is assumed to be from a killed process.
OLD = 86400.0


@contextmanager
def whole(file: Path) -> Iterator[Path]:
    """Yield a temporary path next to `file`. At the end of the context, the temporary file is renamed to `file`.

    If the process is killed or an error occurs, `file` does not change. After an error the temporary file is removed.
    The temporary name is random, so that several processes on several machines can write `file`. Temporary files of
    killed processes are removed if they are older than `OLD`.
    """
    beside = file.with_suffix(f".{uuid4().hex}.part")
    for left in file.parent.glob(f"{glob.escape(file.stem)}.*.part"):
        with suppress(OSError):  # another process may remove it too
            if left.stat().st_mtime < time.time() - OLD:
                left.unlink()
    try:
        yield beside
        beside.replace(file)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def write_whole(file: Path, text: str) -> None:
    """Write a text file completely or not at all (see `whole`)."""
    with whole(file) as new:
        new.write_text(text)


def write_rows(file: Path, rows: np.ndarray, header: str, formats: str | list[str]) -> None:
    """Write a CSV file completely or not at all (see `whole`). `formats`: see `numpy.savetxt`."""
    with whole(file) as new:
        np.savetxt(new, rows, formats, ",", header=header, comments="")


def mark_of(*arrays: object) -> str:
    """Return a string that is equal only for equal arrays (SHA-256 of type, shape and bytes)."""
    found = hashlib.sha256()
    for a in map(np.asarray, arrays):
        found.update(f"{a.dtype} {a.shape}".encode() + np.ascontiguousarray(a).tobytes())
    return found.hexdigest()


def refuse_other(file: Path, held: Mapping[str, object], marks: Mapping[str, object]) -> None:
    """Raise `InputError` if the marks `held` (from `file`) differ from `marks`.

    Marks are named digests of a problem (`mark_of`). The message lists the names of the marks that differ.
    """
    other = [name for name, own in marks.items() if held.get(name) != own]
    if other:
        raise InputError(
            f"{file} belongs to another fit ({', '.join(other)} differ{'s' * (len(other) == 1)}): remove --resume, or "
            "give another --out"
        )
