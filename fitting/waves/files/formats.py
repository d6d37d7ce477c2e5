"""Files of waves on voxels (.npz, .npy, HDF5, MATLAB, CSV and NIfTI), read as named arrays.

The names are displacement (complex), frequencies [Hz], spacing [m], origin [m], mask, labels and unit. In place of
displacement, a file may have real and imag, or phases (real values at instants of a period).
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.readers.tables.text_tables import find_delimiter, split_cells, text_of, to_number
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
#: Name for the position of NIfTI's voxels in space (3, 4) [m]: the axes, then the corner. No array of another file has
#: this name.
PLACE = "(place)"
#: Name for a sentence that is given if a file contradicts itself about the size of its voxels.
CONFLICT = "(conflict)"
HDF5 = (".h5", ".hdf5")


def arrays(path: Path) -> Content:
    """The named arrays of a file.

    Raises:
        InputError: the file does not exist or cannot be read.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file of waves: give .npz, .npy, .h5, .mat, .csv, .nii or .nii.gz")
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
            f"{path}: the ending {ending!r} is not known: give .npz, .npy, .h5, .mat, .csv, .nii or .nii.gz"
        )
    try:
        return readers[ending](path)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, EOFError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: cannot be read as {ending} ({reason}): write it again") from None
    except Exception as error:  # damaged files raise many kinds of errors: zip, zlib, NIfTI headers
        raise InputError(f"{path}: is damaged ({type(error).__name__}): write it again") from None


def single(path: Path, name: str, spacing_given: bool = False) -> tuple[np.ndarray, object, object]:
    """One array (nx, ny, nz): the array of this name, or the only array of the file; and the spacing and `PLACE` of the
    file.

    If a file contradicts itself about its spacing, but the spacing is given, its spacing and `PLACE` are None.
    """
    found = arrays(path)
    if CONFLICT in found and not spacing_given:
        raise InputError(found[CONFLICT])
    place = (None, None) if CONFLICT in found else (found.get("spacing"), found.get(PLACE))
    if name in found:
        return np.asarray(found[name]), *place
    own = [v for k, v in found.items() if k in ("displacement", "mask", "labels") and v is not None]
    if len(own) != 1:
        raise InputError(f"{path}: has no {name}: name the array {name}")
    a = np.asarray(own[0])
    a = a.reshape(a.shape[:3]) if a.ndim > 3 and a.size == np.prod(a.shape[:3]) else a
    return a, *place


def _numpy(path: Path) -> Content:
    try:
        if path.suffix.lower() == ".npy":
            return {"displacement": np.load(path, allow_pickle=False)}
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file}
    except ValueError:  # NumPy's message is about pickled objects here, even for a text file
        raise InputError(f"{path}: has no arrays of numbers: write it again with numpy.save or numpy.savez") from None
    return _with_plain_unit(found)


def _matlab(path: Path) -> Content:
    """The arrays of a .mat file, in the shapes that MATLAB shows. Version 7.3 is HDF5, with the axes in reverse
    order."""
    import h5py

    if h5py.is_hdf5(path):
        return _hdf5(path)
    from scipy.io import loadmat

    return _with_plain_unit({name: value for name, value in loadmat(path).items() if name in NAMES})


def _with_plain_unit(found: Content) -> Content:
    """The arrays with the unit as text. Programs may store the unit as bytes, or as an array of one word."""
    if found.get("unit") is None:
        return found
    word = np.ravel(found["unit"])[0] if np.size(found["unit"]) else ""
    return found | {"unit": (word.decode() if isinstance(word, bytes) else str(word)).strip()}


def _hdf5(path: Path) -> Content:
    import h5py

    with h5py.File(path) as file:
        found: Content = {name: _values(file[name]) for name in NAMES if name in file}
        # Attributes of the file or of its waves count too.
        for own in (file, *(file[name] for name in WAVES if name in file)):
            found = {name: own.attrs[name] for name in NAMES if name in own.attrs} | found
    return _with_plain_unit(found)


def _values(dataset: "h5py.Dataset") -> object:
    """The content of a dataset. If MATLAB wrote it, the content is as MATLAB shows it."""
    kind, values = dataset.attrs.get("MATLAB_class"), dataset[()]
    if kind == b"char":
        return "".join(map(chr, np.ravel(values)))
    if getattr(values, "dtype", None) is not None and set(values.dtype.names or ()) >= {"real", "imag"}:
        values = values["real"] + 1j * values["imag"]
    return values if kind is None else np.asarray(values).T


#: Columns that a table needs; frequency, label and mask are optional.
COLUMNS = ("x", "y", "z", "u_re_x", "u_im_x", "u_re_y", "u_im_y", "u_re_z", "u_im_z")


#: Other names of the optional columns.
ALSO = {"frequency_hz": "frequency", "hertz": "frequency", "labels": "label", "region": "label"}


_KNOWN = (*COLUMNS, "frequency", "label", "mask")


#: Units with which the headings of positions and displacements may end.
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9}


def _without_units(path: Path, head: list[str]) -> tuple[list[str], dict[str, str]]:
    """The headings without units; and the units of the positions ("x") and of the displacements ("u"), if the headings
    have units.

    `x_mm`, `x [mm]` and `u_re_x (um)` are read.
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
                f"{path}: the heading {name} has another unit than {units[kind]}: give all of them in one unit"
            )
    return plain, units


def _voxel_table(path: Path) -> Content:
    """Read a table of x, y, z [m] on a regular grid, real and imaginary parts, with or without frequency [Hz], label
    and mask."""
    numbered = enumerate(text_of(path, "waves").splitlines(), 1)
    lines = [(k, line) for k, line in numbered if line.strip() and not line.lstrip().startswith("#")]
    between = find_delimiter(lines[0][1]) if lines else ","
    head = [cell.lower() for cell in split_cells(lines[0][1], between)] if lines else []
    head, units = _without_units(path, [ALSO.get(name, name) for name in head])
    twice = next((name for k, name in enumerate(head) if name in head[:k] and name in _KNOWN), None)
    if twice is not None:
        raise InputError(f"{path}: two columns mean {twice}: leave one of them")
    missing = [name for name in COLUMNS if name not in head]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]}: give {','.join(COLUMNS)} and, for several, frequency")
    rows = np.full((len(lines) - 1, len(head)), np.nan)
    for k, (number, line) in enumerate(lines[1:]):
        cells = [_quick_number(cell, between) for cell in split_cells(line, between)[: len(head)]]
        if None in cells:
            raise InputError(f"{path}: row {number}: {line[:40]!r} has a cell that is no number: correct it")
        rows[k, : len(cells)] = cells
    column = dict(zip(head, rows.T, strict=True))
    places = _LENGTHS[units.get("x", "m")] * np.stack([column[a] for a in "xyz"], axis=1)
    at, spacing, origin, shape = _grid(path, places)
    hertz, of = (None, np.zeros(len(rows), int))
    if "frequency" in column:
        empty = np.flatnonzero(~np.isfinite(column["frequency"]))
        if len(empty):
            raise InputError(f"{path}: row {lines[1 + empty[0]][0]} has no frequency: give every row its own, in Hz")
        hertz, of = np.unique(column["frequency"], return_inverse=True)
    if len(np.unique(np.column_stack([of, at]), axis=0)) < len(at):
        unknown = [name for name in head if name and name not in _KNOWN]
        perhaps = f", or name the column of the frequencies frequency (not {unknown[0]})" if unknown else ""
        raise InputError(f"{path}: a voxel has two rows of one frequency: leave one of them{perhaps}")
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
                    f"{path}: row {number}: {name} differs from that of another frequency: give one {name}"
                )
            found |= {key: values}
    return found


def _quick_number(text: str, between: str) -> float | None:
    """The number in a cell. It is fast for texts that Python can read, because there are millions of cells."""
    try:
        return float(text)
    except ValueError:
        return to_number(text, between)


def _grid(path: Path, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:
    """Grid indices (n, 3) of points on a regular grid, and the spacing, origin and shape of the grid."""
    if not np.all(np.isfinite(X)) or not len(X):
        raise InputError(f"{path}: has rows without x, y, z, or none at all: give every voxel its place in metres")
    spacing = np.empty(3)
    for a in range(3):
        steps = np.diff(np.unique(np.round(X[:, a], 9)))
        if not len(steps):
            raise InputError(f"{path}: all voxels have the same {'xyz'[a]}: waves need a volume, not a slice")
        spacing[a] = steps[steps < 1.5 * steps.min()].mean()
    origin = X.min(axis=0)
    # Positions in a file are rounded: the whole length gives the best spacing.
    spacing = np.ptp(X, axis=0) / np.rint(np.ptp(X, axis=0) / spacing)
    at = np.rint((X - origin) / spacing).astype(int)
    off = np.abs(X - origin - at * spacing).max(axis=0) / spacing
    if off.max() > 0.05:
        raise InputError(f"{path}: {'xyz'[int(off.argmax())]} is not on a regular grid: give voxels with even steps")
    return at, spacing, origin, tuple(int(n) for n in at.max(axis=0) + 1)


def _nifti(path: Path) -> Content:
    """Read complex data (nx, ny, nz, 3) or (nx, ny, nz, F, 3). Real data are a mask or labels. Voxel sizes are in mm
    unless the file has another unit."""
    try:
        import nibabel
    except ImportError:
        raise InputError(f"{path}: NIfTI needs nibabel: pip install '.[nifti]', or give .npz") from None
    image: Any = nibabel.load(path)
    data = np.asarray(image.dataobj)
    unit = {"meter": 1.0, "micron": 1e-6}.get(image.header.get_xyzt_units()[0], 1e-3)  # mm if it is not stated
    size, axes = _voxel_size(path, image), unit * np.asarray(image.affine)[:3]
    found: Content = {"spacing": unit * size} if size.any() else {}
    stated = np.abs(np.asarray(image.header["pixdim"][1:4], float))
    if _has_place(image) and not np.allclose(stated, size, rtol=0.01):
        found[CONFLICT] = (
            f"{path}: its header has voxels of {stated.tolist()} and its affine of {size.round(6).tolist()}: correct "
            "the wrong one"
        )
    found |= {PLACE: axes} if _has_place(image) else {}
    if not np.iscomplexobj(data):
        return found | {"labels": data}
    if data.ndim == 5:
        data = np.moveaxis(data, 3, 0)
    return found | {"displacement": data, "origin": axes[:, 3]}


def _has_place(image: "nibabel.Nifti1Image") -> bool:
    """Whether a NIfTI file gives the position of its voxels in space."""
    return bool(image.header["sform_code"] > 0 or image.header["qform_code"] > 0)


def _voxel_size(path: Path, image: "nibabel.Nifti1Image") -> np.ndarray:
    """Size of the voxels (3,) in the unit of the file; zeros if the file gives no size."""
    if not _has_place(image):
        stated = np.abs(np.asarray(image.header["pixdim"][1:4], float))
        return stated if np.all(stated) else np.zeros(3)
    columns = np.asarray(image.affine)[:3, :3]
    size = np.linalg.norm(columns, axis=0)
    if not np.all(size > 0) or np.abs(columns.T @ columns / np.outer(size, size) - np.eye(3)).max() > 1e-3:
        raise InputError(f"{path}: the axes of its voxels are not at right angles: resample it to rectangular voxels")
    return size
