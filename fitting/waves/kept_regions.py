"""Store the moduli of regions in a file. Then an interrupted run can continue without computing these moduli again."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from fitting.waves.correlated_noise import Correlation
from fitting.waves.regions import Regions
from liverjax.core.errors import InputError
from liverjax.core.files import mark_of, refuse_other, whole
from liverjax.core.versions import versions

#: A function (name, find) -> regions. It returns the regions that are stored under this name. If no regions are
#: stored, it calls `find`, stores the result and returns it.
Keep = Callable[[str, Callable[[], Regions]], Regions]
_NUMBERS = tuple(name for name in Regions._fields if name != "correlations")


def kept_in(file: Path, resume: bool, marks: dict[str, object]) -> Keep:
    """Return a function `Keep` that stores the fitted moduli of an organ (`Regions`) in `file`, each result under its
    name.

    Args:
        file: HDF5 file. It is written again after each new result. An interruption leaves the earlier file unchanged.
        resume: whether results that are already in the file are used; if not, a new file is made.
        marks: dictionary with a mark for each name. A mark is a digest or a value that identifies the organ and its
            data.

    Raises:
        InputError: the marks in the file differ from `marks`, or the file cannot be read.
    """
    held = _read_regions(file, marks) if resume and file.is_file() else {}

    def keep(name: str, find: Callable[[], Regions]) -> Regions:
        if name not in held:
            held[name] = find()
            _write_regions(file, held, marks)
        return held[name]

    return keep


def marks_of(omega: np.ndarray, motion: np.ndarray, sd: np.ndarray, voxel: np.ndarray, **others: object) -> dict:
    """Return a dictionary of marks (see `kept_in`), which identify the measured waves (see `MeasuredWaves`), the voxels
    of the body, and other arrays or values."""
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
        raise InputError(f"{file} is damaged, or was written by another program: remove --resume") from None


def _of_group(group: h5py.Group) -> Regions:
    numbers = {field: group[field][()] for field in _NUMBERS}
    numbers["components"] = int(numbers["components"])
    if "correlations" not in group:
        return Regions(**numbers)
    beyond, seen, enlarged, level = (group[f"correlations/{field}"][:] for field in Correlation._fields)
    every = zip(beyond, seen, enlarged, level, strict=True)
    return Regions(**numbers, correlations=tuple(Correlation(float(b), bool(s), e, float(v)) for b, s, e, v in every))
