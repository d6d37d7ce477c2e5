"""Reduced models on disk: one HDF5 file with modes, points, weights and where they come from."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.files import whole
from liverjax.core.versions import versions
from liverjax.reduced.correction import Correction
from liverjax.reduced.model import ReducedModel

#: Arrays of a correction.
_LEARNT = ("fields", "factors", "inverse", "scale", "statement", "left", "ratios")
_UNITS = {"modes": "1", "slopes": "1/m", "weights": "m^3", "points": "1"}


def save_reduced(model: ReducedModel, file: str | Path, scene_text: str = "") -> None:
    """Write a reduced model.

    Args:
        model: `ReducedModel`.
        file: HDF5 file, replaced where it exists.
        scene_text: the scene file it was made from, kept beside it.
    """
    import h5py

    with whole(Path(file)) as new, h5py.File(new, "w") as out:
        for name, unit in _UNITS.items():
            array = np.asarray(getattr(model, name))
            # In files the modes come first.
            out[name] = np.moveaxis(array, -1, 0) if name == "slopes" else array
            out[name].attrs["unit"] = unit
        if model.correction is not None:
            for name in _LEARNT:
                out[f"correction/{name}"] = np.asarray(getattr(model.correction, name))
            out["correction"].attrs["products"] = model.correction.products
        for name, value in model.ranges.items():
            out[f"ranges/{name}"] = np.asarray(value)
        out.attrs["identity"], out.attrs["scene"] = model.identity, scene_text
        out.attrs["versions"] = json.dumps(versions())


def load_reduced(file: str | Path) -> ReducedModel:
    """Read a reduced model that `save_reduced` wrote.

    Raises:
        InputError: no file, or one of something else.
    """
    import h5py

    try:
        with h5py.File(file, "r") as stored:
            arrays = {name: stored[name][()] for name in _UNITS}
            arrays["slopes"] = np.ascontiguousarray(np.moveaxis(arrays["slopes"], 0, -1))
            arrays = {name: jnp.asarray(array) for name, array in arrays.items()}
            ranges = {name: jnp.asarray(value[()]) for name, value in stored.get("ranges", {}).items()}
            identity = str(stored.attrs["identity"])
            return ReducedModel(**arrays, ranges=ranges, correction=_correction(stored), identity=identity)
    except (OSError, KeyError) as error:
        raise InputError(f"{file} is no reduced model ({error}): make one with python -m liverjax reduce") from None


def _correction(stored: Any) -> Correction | None:
    """The correction of an open file, where it has one."""
    if "correction" not in stored:
        return None
    own = stored["correction"]
    arrays = {name: jnp.asarray(own[name][()]) for name in _LEARNT}
    return Correction(**arrays, products=int(own.attrs["products"]))
