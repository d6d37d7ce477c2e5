"""Read files of waves on voxels (.npz, .npy, HDF5, MATLAB, CSV and NIfTI) as named arrays.

The possible names are displacement (complex), frequencies [Hz], spacing [m], origin [m], mask, labels and unit. Instead
of displacement, a file may have real and imag, phases (real values at instants of a period), or wrapped (phases between
-pi and pi).
"""

import difflib
import itertools
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.readers.tables.text_tables import find_delimiter, refuse_unnamed_numbers, split_cells, text_of, to_number
from liverjax.core.errors import InputError
from liverjax.core.struct import Content

if TYPE_CHECKING:
    import h5py
    import nibabel

NAMES = (
    "displacement",
    "real",
    "imag",
    "phases",
    "wrapped",
    "frequencies",
    "spacing",
    "origin",
    "mask",
    "labels",
    "unit",
)
WAVES = ("displacement", "real", "imag", "phases", "wrapped")
#: Name of the entry for the position of the voxels in space (3, 4) [m]: three columns with the vectors from a voxel to
#: the next voxel along each axis, then a column with the position of the first voxel. Only NIfTI files have this entry.
PLACE = "(place)"
#: If a file states two different voxel sizes, the entry with this name contains the error message.
CONFLICT = "(conflict)"
#: Name of the entry for notes on arrays that are not used, but have names similar to a known name.
NEARLY = "(nearly)"
HDF5 = (".h5", ".hdf5")


def arrays(path: Path) -> Content:
    """Read the named arrays of a file.

    Raises:
        InputError: the file does not exist or cannot be read.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist: give a .npz, .npy, .h5, .mat, .csv, .nii or .nii.gz file")
    ending = "".join(path.suffixes[-2:]).lower() if path.suffix.lower() == ".gz" else path.suffix.lower()
    readers = {
        ".npz": _numpy,
        ".npy": _numpy,
        ".mat": _matlab,
        ".csv": _voxel_table,
        ".txt": _voxel_table,
        ".nii": _nifti,
        ".nii.gz": _nifti,
    }
    readers |= dict.fromkeys(HDF5, _hdf5)
    if ending not in readers:
        raise InputError(
            f"{path}: the ending {ending!r} is not known; give .npz, .npy, .h5, .mat, .csv, .nii or .nii.gz"
        )
    try:
        return readers[ending](path)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, EOFError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path} cannot be read as {ending} ({reason}): write the file again") from None
    except Exception as error:  # damaged files raise many kinds of errors: zip, zlib, NIfTI headers
        raise InputError(f"{path}: the file is damaged ({type(error).__name__}); write the file again") from None


def single(path: Path, name: str, spacing_given: bool = False) -> tuple[np.ndarray, object, object]:
    """Return one array (nx, ny, nz), and the entries `spacing` and `PLACE` of the file. This is the array with the name
    `name`, or else the only array of the file.

    Both entries are None if the file states two different spacings and the user gives the spacing.
    """
    found = arrays(path)
    if CONFLICT in found and not spacing_given:
        raise InputError(found[CONFLICT])
    place = (None, None) if CONFLICT in found else (found.get("spacing"), found.get(PLACE))
    names = (name,) if name in found else ("displacement", "mask", "labels")
    own = [found[k] for k in names if found.get(k) is not None]
    if len(own) != 1:
        raise InputError(
            f"{path}: no array of the file has the name {name}; give this name to the array that contains the {name}"
        )
    a = np.asarray(own[0])
    a = a.reshape(a.shape[:3]) if a.ndim > 3 and a.size == np.prod(a.shape[:3]) else a
    return a, *place


def _numpy(path: Path) -> Content:
    try:
        if path.suffix.lower() == ".npy":
            return {"displacement": np.load(path, allow_pickle=False)}
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file} | _nearly_known(file)
    except ValueError:  # NumPy's message speaks of pickled objects, even for a text file
        raise InputError(
            f"{path}: the file has no arrays of numbers; write the file with numpy.save or numpy.savez"
        ) from None
    return _with_plain_unit(found)


def _matlab(path: Path) -> Content:
    """Read the arrays of a .mat file, in the shapes that MATLAB shows. A file of version 7.3 is an HDF5 file with the
    axes in reverse order."""
    import h5py

    if h5py.is_hdf5(path):
        return _hdf5(path)
    from scipy.io import loadmat

    every = loadmat(path)
    return _with_plain_unit({name: value for name, value in every.items() if name in NAMES} | _nearly_known(every))


def _nearly_known(names: Iterable[str]) -> Content:
    """Return notes on unknown names that are similar to a known name, under the key `NEARLY`. Without these notes, the
    user would not learn that, for example, a mask with a misspelt name is ignored."""
    names = list(names)
    waves = set(WAVES) & set(names)
    wanted = [name for name in NAMES if name not in names and not (waves and name in WAVES)]
    unknown = [name for name in names if name not in NAMES]
    near = {name: difflib.get_close_matches(name.lower(), wanted, n=1, cutoff=0.75) for name in unknown}
    notes = [f"the array {name!r} is not used: did you mean {own[0]}?" for name, own in near.items() if own]
    return {NEARLY: notes} if notes else {}


def _with_plain_unit(found: Content) -> Content:
    """Return the arrays, with the unit as a Python string. Programs may store the unit as bytes, or as an array with
    one string."""
    if found.get("unit") is None:
        return found
    word = np.ravel(found["unit"])[0] if np.size(found["unit"]) else ""
    return found | {"unit": with_micro_sign((word.decode() if isinstance(word, bytes) else str(word)).strip())}


def with_micro_sign(unit: str) -> str:
    """Return a unit with the micro sign (U+00B5) in place of the Greek letter (U+03BC), which looks the same."""
    return unit.replace("\u03bc", "\u00b5")


def _hdf5(path: Path) -> Content:
    import h5py

    with h5py.File(path) as file:
        for name in NAMES:
            if isinstance(file.get(name), h5py.Group):
                inside = ", ".join(list(file[name])[:5]) or "nothing"
                raise InputError(
                    f"{path}: {name} is a group that contains {inside}, not an array: write the arrays at the top level"
                )
        found: Content = {name: _values(file[name]) for name in NAMES if name in file} | _nearly_known(file)
        # Values with these names may also be attributes of the file or of the array of waves.
        for own in (file, *(file[name] for name in WAVES if name in file)):
            found = {name: own.attrs[name] for name in NAMES if name in own.attrs} | found
    return _with_plain_unit(found)


def _values(dataset: "h5py.Dataset") -> object:
    """Return the content of a dataset. If MATLAB wrote the dataset, the array has the shape that MATLAB shows."""
    kind, values = dataset.attrs.get("MATLAB_class"), dataset[()]
    if kind == b"char":
        return "".join(map(chr, np.ravel(values)))
    if getattr(values, "dtype", None) is not None and set(values.dtype.names or ()) >= {"real", "imag"}:
        values = values["real"] + 1j * values["imag"]
    return values if kind is None else np.asarray(values).T


#: Required columns of a table. The columns frequency, label and mask are optional.
COLUMNS = ("x", "y", "z", "u_re_x", "u_im_x", "u_re_y", "u_im_y", "u_re_z", "u_im_z")


#: Other names of the optional columns.
ALSO = {"frequency_hz": "frequency", "hertz": "frequency", "labels": "label", "region": "label"}


_KNOWN = (*COLUMNS, "frequency", "label", "mask")


#: Units at the end of a heading of positions or displacements, and the factors that convert them to metres.
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9}


def _without_units(path: Path, head: list[str]) -> tuple[list[str], dict[str, str]]:
    """Return the headings without units, and the units of positions (key "x") and displacements (key "u"), if the
    headings state units.

    Examples of headings with units are `x_mm`, `x [mm]` and `u_re_x (um)`.
    """
    plain: list[str] = []
    units: dict[str, str] = {}
    for name in head:
        match = re.fullmatch(r"([xyz]|u_(?:re|im)_[xyz])[ _]*[\[(]?([a-zµμ]+)[\])]?", name)
        if match is None or match[2] not in _LENGTHS:
            plain.append(name)
            continue
        plain.append(match[1])
        kind = match[1][0] if match[1][0] == "u" else "x"
        if units.setdefault(kind, match[2]) != match[2]:
            raise InputError(
                f"{path}: heading {name} has a unit other than {units[kind]}; use the same unit in all these headings"
            )
    bare = next((name for name in head if name in COLUMNS and ("u" if name[0] == "u" else "x") in units), None)
    if bare is not None:
        raise InputError(
            f"{path}: heading {bare} has no unit, but similar headings have one: give all of them the same unit"
        )
    return plain, units


def _voxel_table(path: Path) -> Content:
    """Read a table with one row per voxel: x, y, z [m] on a regular grid, real and imaginary parts of the displacement,
    and optional columns for frequency [Hz], label and mask."""
    numbered = enumerate(text_of(path, "waves").splitlines(), 1)
    lines = [(k, line) for k, line in numbered if line.strip() and not line.lstrip().startswith("#")]
    between = find_delimiter(lines[0][1]) if lines else ","
    head = [cell.lower() for cell in split_cells(lines[0][1], between)] if lines else []
    head, units = _without_units(path, [ALSO.get(name, name) for name in head])
    twice = next((name for k, name in enumerate(head) if name in head[:k] and name in _KNOWN), None)
    if twice is not None:
        raise InputError(f"{path}: two columns contain {twice}; remove one of them")
    missing = [name for name in COLUMNS if name not in head]
    if missing:
        raise InputError(
            f"{path}: the column {missing[0]} is missing; give {','.join(COLUMNS)}, and frequency if there are "
            "several frequencies"
        )
    rows = np.full((len(lines) - 1, len(head)), np.nan)
    for k, (number, line) in enumerate(lines[1:]):
        refuse_unnamed_numbers(path, number, written := split_cells(line, between), head, between)
        cells = [_quick_number(cell, between) for cell in written[: len(head)]]
        if None in cells:
            raise InputError(f"{path}: row {number}: {line[:40]!r} has a cell that is not a number; correct this row")
        rows[k, : len(cells)] = cells
    column = dict(zip(head, rows.T, strict=True))
    places = _LENGTHS[units.get("x", "m")] * np.stack([column[a] for a in "xyz"], axis=1)
    hertz, of = (None, np.zeros(len(rows), int))
    if "frequency" in column:
        empty = np.flatnonzero(~np.isfinite(column["frequency"]))
        if len(empty):
            raise InputError(
                f"{path}: row {lines[1 + empty[0]][0]} has no frequency; give a frequency in Hz in every row"
            )
        hertz, of = np.unique(column["frequency"], return_inverse=True)
    at, spacing, origin, shape = _grid(path, places, of)
    if not _all_differ(of, at):
        unknown = [name for name in head if name and name not in _KNOWN]
        perhaps = (
            f", or rename column {unknown[0]} to frequency if this column contains the frequencies" if unknown else ""
        )
        raise InputError(f"{path}: a voxel has two rows for the same frequency; remove one of them{perhaps}")
    U = np.full((1 if hertz is None else len(hertz), *shape, 3), np.nan + 0j)
    for c, axis in enumerate("xyz"):
        U[(of, *at.T, np.full(len(at), c))] = column[f"u_re_{axis}"] + 1j * column[f"u_im_{axis}"]
    found: Content = {"displacement": U, "frequencies": hertz, "spacing": spacing, "origin": origin}
    if "u" in units:
        found["unit"] = units["u"].replace("µ", "u").replace("μ", "u")
    for name, key in (("label", "labels"), ("mask", "mask")):
        if name in column:
            values, own = np.zeros(shape), np.nan_to_num(column[name])
            values[tuple(at.T)] = own
            changed = np.flatnonzero(values[tuple(at.T)] != own)
            if len(changed):
                number = lines[1 + changed[0]][0]
                raise InputError(
                    f"{path}: row {number}: {name} differs from its value at another frequency; give each voxel "
                    f"only one {name}"
                )
            found |= {key: values}
    return found


def _quick_number(text: str, between: str) -> float | None:
    """Return the number in a cell, or None if the cell contains no number. Plain numbers are read by Python's fast
    conversion, because there may be millions of cells."""
    try:
        return float(text)
    except ValueError:
        return to_number(text, between)


#: _JITTER: steps between positions that are shorter than this fraction of the longest step are regarded as errors of
#: the positions, if this gives a regular grid. _UNEVEN: maximum distance of a position from the grid, divided by the
#: spacing. _SPARSE: maximum number of voxels of the grid, divided by the number of positions.
_JITTER, _UNEVEN, _SPARSE = 0.05, 0.05, 1000


def _grid(path: Path, X: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:
    """Return the grid indices (n, 3) of the points X (n, 3) [m], and the spacing [m], origin [m] and shape of their
    regular grid. `of` (n,): index of the frequency of each point."""
    if not np.all(np.isfinite(X)) or not len(X):
        raise InputError(
            f"{path}: the file has no rows, or some rows have no x, y, z; give the position of every voxel in metres"
        )
    origin = X.min(axis=0)
    regular, worst = None, ""
    # Short steps that are errors of the positions must be ignored. In a body with wide gaps, short steps are real: if
    # they are ignored, different voxels get the same index. So both cases are tried along each axis.
    for least in itertools.product((_JITTER, 0.0), repeat=3):
        spacing = np.array([_spacing_along(path, X[:, a] - origin[a], "xyz"[a], least[a]) for a in range(3)])
        at = np.rint((X - origin) / spacing).astype(int)
        off = np.abs(X - origin - at * spacing).max(axis=0) / spacing
        worst = worst or "xyz"[int(off.argmax())]
        found = at, spacing, origin, tuple(int(n) for n in at.max(axis=0) + 1)
        if off.max() <= _UNEVEN and math.prod(found[-1]) <= _SPARSE * len(X):
            if _all_differ(of, at):
                return found
            regular = regular or found
    if regular is None:
        raise InputError(f"{path}: {worst} is not on a regular grid; give voxels with equal spacing")
    return regular


def _all_differ(of: np.ndarray, at: np.ndarray) -> bool:
    """Return whether no voxel (row of `at`) has two rows for the same frequency `of`."""
    return len(np.unique(np.column_stack([of, at]), axis=0)) == len(at)


def _spacing_along(path: Path, x: np.ndarray, axis: str, least: float) -> float:
    """Return the spacing [m] of positions x (n,) along one axis, measured from the first one. Steps shorter than the
    fraction `least` of the longest step do not count."""
    steps = np.diff(np.unique(np.round(x, 9)))
    if not len(steps):
        raise InputError(f"{path}: all voxels have the same {axis}; waves need a volume, not a single slice")
    steps = steps[steps >= least * steps.max()]
    # Positions in a file are rounded, so the total length gives a more exact spacing than single steps.
    return float(x.max() / np.rint(x.max() / steps[steps < 1.5 * steps.min()].mean()))


def _nifti(path: Path) -> Content:
    """Read complex data (nx, ny, nz, 3), or (nx, ny, nz, F, 3) for F frequencies, from a NIfTI file. Real data are
    regarded as labels or a mask. Voxel sizes are in mm, unless the file states another unit."""
    try:
        import nibabel
    except ImportError:
        raise InputError(f"{path}: NIfTI files need nibabel; pip install '.[nifti]', or give a .npz file") from None
    image: Any = nibabel.load(path)
    data = np.asarray(image.dataobj)
    unit = {"meter": 1.0, "micron": 1e-6}.get(image.header.get_xyzt_units()[0], 1e-3)  # mm if the unit is not stated
    size, axes = _voxel_size(path, image), unit * np.asarray(image.affine)[:3]
    found: Content = {"spacing": unit * size} if size.any() else {}
    stated = np.abs(np.asarray(image.header["pixdim"][1:4], float))
    if _has_place(image) and not np.allclose(stated, size, rtol=0.01):
        found[CONFLICT] = (
            f"{path}: the header states the voxel size {stated.tolist()}, but the affine matrix gives "
            f"{size.round(6).tolist()}; correct the wrong one"
        )
    found |= {PLACE: axes} if _has_place(image) else {}
    if not np.iscomplexobj(data):
        return found | {"labels": data}
    if data.ndim == 5:
        data = np.moveaxis(data, 3, 0)
    return found | {"displacement": data, "origin": axes[:, 3]}


def _has_place(image: "nibabel.Nifti1Image") -> bool:
    """Return whether a NIfTI file states the position of its voxels in space."""
    return bool(image.header["sform_code"] > 0 or image.header["qform_code"] > 0)


def _voxel_size(path: Path, image: "nibabel.Nifti1Image") -> np.ndarray:
    """Return the size of the voxels (3,) in the unit of the file. Return zeros if the file states no size."""
    if not _has_place(image):
        stated = np.abs(np.asarray(image.header["pixdim"][1:4], float))
        return stated if np.all(stated) else np.zeros(3)
    columns = np.asarray(image.affine)[:3, :3]
    size = np.linalg.norm(columns, axis=0)
    if not np.all(size > 0) or np.abs(columns.T @ columns / np.outer(size, size) - np.eye(3)).max() > 1e-3:
        raise InputError(f"{path}: the axes of the voxels are not perpendicular; resample to rectangular voxels")
    return size
