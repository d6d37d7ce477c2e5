"""Write and read reduced models: one HDF5 file with modes, points, weights, the scene file and the versions of
the software."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.files import whole
from liverjax.core.struct import replace
from liverjax.core.versions import versions
from liverjax.reduced.correction import Correction
from liverjax.reduced.model import PressureModes, ReducedModel

if TYPE_CHECKING:
    import h5py

#: Names of the arrays of a correction.
_LEARNT = ("fields", "factors", "inverse", "scale", "statement", "left", "ratios")
_UNITS = {"modes": "m^-1.5", "slopes": "m^-2.5", "weights": "m^3", "points": "1"}
#: Names and units of the arrays of the pressure modes.
_PRESSURES = {"modes": "m^-1.5", "values": "m^-1.5", "parts": "m^-1.5", "slopes": "m^-2.5"}


def save_reduced(model: ReducedModel, file: str | Path, scene_text: str = "") -> None:
    """Write a reduced model to an HDF5 file.

    Args:
        model: `ReducedModel`.
        file: HDF5 file, which is replaced if it exists.
        scene_text: content of the scene file from which the model was made. It is stored in the HDF5 file.
    """
    import h5py

    with whole(Path(file)) as new, h5py.File(new, "w") as out:
        for name, unit in _UNITS.items():
            array = np.asarray(getattr(model, name))
            # In the file, the first axis of `modes` and of `slopes` counts the modes.
            out[name] = np.moveaxis(array, -1, 0) if name == "slopes" else array
            out[name].attrs["unit"] = unit
        if model.correction is not None:
            for name in _LEARNT:
                out[f"correction/{name}"] = np.asarray(getattr(model.correction, name))
            out["correction"].attrs["products"] = model.correction.products
        if model.pressures is not None:
            for name, unit in _PRESSURES.items():
                out[f"pressures/{name}"] = np.asarray(getattr(model.pressures, name))
                out[f"pressures/{name}"].attrs["unit"] = unit
        for name, value in model.ranges.items():
            out[f"ranges/{name}"] = np.asarray(value)
        if model.loads is not None:
            loads = out.create_group("loads")  # may be empty
            for name, value in model.loads.items():
                loads[name] = np.asarray(value)
        out.attrs["identity"], out.attrs["others"], out.attrs["scene"] = model.identity, model.others, scene_text
        out.attrs["versions"] = json.dumps(versions())


def load_reduced(file: str | Path) -> ReducedModel:
    """Read a reduced model that `save_reduced` wrote.

    Raises:
        InputError: the file does not exist, is damaged, or is not a reduced model.
    """
    import h5py

    if not Path(file).is_file():
        raise InputError(f"{file} does not exist: make a reduced model with python -m liverjax reduce")
    try:
        with h5py.File(file, "r") as stored:
            arrays = {name: stored[name][()] for name in _UNITS}
            arrays["slopes"] = np.ascontiguousarray(np.moveaxis(arrays["slopes"], 0, -1))
            arrays = {name: jnp.asarray(array) for name, array in arrays.items()}
            ranges = {name: jnp.asarray(value[()]) for name, value in stored.get("ranges", {}).items()}
            loads = {name: jnp.asarray(value[()]) for name, value in stored.get("loads", {}).items()}
            identity, others = str(stored.attrs["identity"]), str(stored.attrs.get("others", ""))
            # Models of an earlier version of the program contain region.0.law.['mu'] in place of region.0.law.mu.
            others = others.replace("['", "").replace("']", "")
            correction, fluid = _correction(stored), _pressures(stored)
            found = ReducedModel(
                **arrays, ranges=ranges, correction=correction, pressures=fluid, identity=identity, others=others
            )
            model = replace(found, loads=loads if "loads" in stored else None)
        wrong = _wrong(model)
    except (OSError, KeyError, AttributeError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{file} is not a reduced model ({error}): make a model with python -m liverjax reduce"
        ) from None
    if wrong:
        raise InputError(f"{file} is damaged: {wrong}; make the model again with python -m liverjax reduce")
    return model


def _wrong(model: ReducedModel) -> str:
    """Return an error message for the first array that has a wrong shape or values that are not finite. The string is
    empty if all arrays are right."""
    n, V, S = *jnp.shape(model.modes)[:2], *jnp.shape(model.weights)[:1]
    shapes: dict[str, tuple] = {"modes": (n, V, 3), "slopes": (9, S, n), "weights": (S,), "points": (S,)}
    arrays = {name: getattr(model, name) for name in shapes}
    own, fluid = model.correction, model.pressures
    if own is not None:
        (k, m), R = jnp.shape(own.factors), jnp.size(own.left)
        shapes |= {"fields": (m, V, 3), "factors": (k, m), "inverse": (k, k), "scale": (), "statement": (4,)}
        shapes |= {"left": (R,), "ratios": (R,)}
        arrays |= {name: getattr(own, name) for name in _LEARNT}
    if fluid is not None:
        m, vertices = jnp.shape(fluid.modes)
        of_fluid = {"modes": (m, vertices), "values": (S, m), "parts": (m, 4, S), "slopes": (m, 3, S)}
        shapes |= {f"pressures.{name}": shape for name, shape in of_fluid.items()}
        arrays |= {f"pressures.{name}": getattr(fluid, name) for name in of_fluid}
    for name, bounds in model.ranges.items():
        shapes[f"ranges of {name}"], arrays[f"ranges of {name}"] = (2, *jnp.shape(bounds)[1:]), bounds
    for name, bounds in (model.loads or {}).items():
        shapes[f"loads of {name}"], arrays[f"loads of {name}"] = (2, *jnp.shape(bounds)[1:]), bounds
    for name, array in arrays.items():
        if jnp.shape(array) != shapes[name]:
            return f"{name} has shape {jnp.shape(array)}, not {shapes[name]}"
        if not np.all(np.isfinite(np.asarray(array))):
            return f"{name} has values that are not finite"
    return ""


def _correction(stored: "h5py.File") -> Correction | None:
    """Read the correction from an open file. Return None if the file has no correction."""
    if "correction" not in stored:
        return None
    own = stored["correction"]
    arrays = {name: jnp.asarray(own[name][()]) for name in _LEARNT}
    return Correction(**arrays, products=int(own.attrs["products"]))


def _pressures(stored: "h5py.File") -> PressureModes | None:
    """Read the pressure modes from an open file. Return None if the file has no pressure modes."""
    if "pressures" not in stored:
        return None
    return PressureModes(**{name: jnp.asarray(stored["pressures"][name][()]) for name in _PRESSURES})
