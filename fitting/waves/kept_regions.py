"""Moduli of regions are kept in a file, so that a run that was killed can go on without searching for them again."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from fitting.waves.correlated_noise import Correlation
from fitting.waves.regions import Regions
from liverjax.core.errors import InputError
from liverjax.core.files import mark_of, refuse_other, whole
from liverjax.core.versions import versions

#: A function from `name` and `find` to the regions kept under this name, or else to the result of `find`.
Keep = Callable[[str, Callable[[], Regions]], Regions]
_NUMBERS = tuple(name for name in Regions._fields if name != "correlations")


def kept_in(file: Path, resume: bool, marks: dict[str, object]) -> Keep:
    """Return a function that keeps the regions of an organ in `file`, under their names.

    Args:
        file: it is written each time new regions are found, completely or not at all.
        resume: use the regions that the file has already. Otherwise begin a new file.
        marks: marks that identify the organ and its data, by name.

    Raises:
        InputError: the file has other marks, or cannot be read.
    """
    held = _read_regions(file, marks) if resume and file.is_file() else {}

    def keep(name: str, find: Callable[[], Regions]) -> Regions:
        if name not in held:
            held[name] = find()
            _write_regions(file, held, marks)
        return held[name]

    return keep


def marks_of(omega: np.ndarray, motion: np.ndarray, sd: np.ndarray, voxel: np.ndarray, **others: object) -> dict:
    """Marks of measured waves (`MeasuredWaves`) at the voxels of a body, and of other arrays, by name."""
    arrays = {"frequencies": omega, "displacements": motion, "noise": sd, "mask": voxel, **others}
    marks = {name: "none" if values is None else mark_of(values) for name, values in arrays.items()}
    return marks | {"versions of the programs": str(versions())}


def _write_regions(file: Path, held: dict[str, Regions], marks: dict[str, object]) -> None:
    with whole(file) as new, h5py.File(new, "w") as f:
        f.attrs.update(marks)
        for name, own in held.items():
            group = f.create_group(name)
            for field in _NUMBERS:
                group[field] = getattr(own, field)
            if own.correlations:
                for field in Correlation._fields:
                    group[f"correlations/{field}"] = np.array([getattr(c, field) for c in own.correlations])


def _read_regions(file: Path, marks: dict[str, object]) -> dict[str, Regions]:
    try:
        with h5py.File(file) as f:
            refuse_other(file, f.attrs, marks)
            return {name: _of_group(group) for name, group in f.items()}
    except (OSError, KeyError):
        raise InputError(f"{file} is damaged, or of another program: leave out --resume") from None


def _of_group(group: h5py.Group) -> Regions:
    numbers = {field: group[field][()] for field in _NUMBERS}
    numbers["components"] = int(numbers["components"])
    if "correlations" not in group:
        return Regions(**numbers)
    beyond, seen, enlarged = (group[f"correlations/{field}"][:] for field in Correlation._fields)
    every = zip(beyond, seen, enlarged, strict=True)
    return Regions(**numbers, correlations=tuple(Correlation(float(b), bool(s), e) for b, s, e in every))
