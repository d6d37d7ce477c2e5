"""Write results in parts, so that a killed run can resume. Each finished part is a separate file next to the output."""

import fcntl
import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import h5py
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.files import whole
from liverjax.core.struct import Number


def beside(out: Path) -> Path:
    """Return the folder with the parts of `out`."""
    return out.with_name(out.name + ".parts")


def part(folder: Path, k: int) -> Path:
    """Return the file of part k, counted from 0."""
    return folder / f"part_{k:06d}.h5"


def write(file: Path, content: dict[str, np.ndarray]) -> None:
    """Write datasets to an HDF5 file, completely or not at all.

    Raises:
        OSError: the disk is full.
    """
    # The file is made in memory first: on a full disk HDF5 ends the process, but a plain write raises OSError.
    memory = io.BytesIO()
    with h5py.File(memory, "w") as datasets:
        for name, value in content.items():
            datasets[name] = value
    with whole(file) as new, new.open("wb") as out:
        out.write(memory.getbuffer())
        out.flush()
        os.fsync(out.fileno())


def finished(file: Path) -> bool:
    """Return whether the part exists. A part that cannot be read is removed, so that it is computed again."""
    if not file.exists():
        return False
    try:
        with h5py.File(file):
            return True
    except OSError:
        file.unlink()
        return False


def make_folder(folder: Path) -> None:
    """Make the folder, and test whether files can be written to it.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f"probe.{uuid4().hex}"
        probe.write_text("")
        probe.unlink()
    except OSError as error:
        raise InputError(f"{folder} cannot be written ({error.strerror}): give an --out that can be written") from None


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Hold a lock inside this context. The lock is also released when the process ends.

    Raises:
        InputError: another process holds the lock.
    """
    with file.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"{file.parent} is in use by another process: wait until that process ends, or give another --out"
            ) from None
        yield


def same(identity: Mapping[str, object], file: Path) -> None:
    """Store the input that determines the results, or compare it with the input that is already stored.

    Raises:
        InputError: the parts next to `file` were made with other input, or their input is unknown, or `file` is
            damaged.
    """
    identity = json.loads(json.dumps(identity))
    if not file.exists():
        if any(file.parent.glob("part_*.h5")):
            raise InputError(
                f"{file.parent} contains parts, but not the file {file.name} with their input: give another --out, or "
                "remove this folder"
            )
        with whole(file) as new:
            new.write_text(json.dumps(identity))
        return
    try:
        stored = dict(json.loads(file.read_text()))
    except (ValueError, TypeError):
        raise InputError(
            f"{file} is damaged, so the input of the parts is unknown: give another --out, or remove {file.parent}"
        ) from None
    for key, value in stored.items():
        if identity.get(key) != value:
            raise InputError(
                f"{file.parent} contains parts of another {file.stem} (not the same {key}): give another --out, or "
                "remove this folder"
            )


def remove(folder: Path) -> None:
    """Remove the folder and all of its files. The input file is removed last, so that no parts stay without it."""
    for file in sorted(folder.iterdir(), key=lambda file: file.suffix == ".json"):
        file.unlink(missing_ok=True)
    folder.rmdir()


def digest(*arrays: Number) -> str:
    """Return the SHA-256 digest of the bytes of some arrays."""
    sha = hashlib.sha256()
    for a in arrays:
        sha.update(np.ascontiguousarray(a).tobytes())
    return sha.hexdigest()
