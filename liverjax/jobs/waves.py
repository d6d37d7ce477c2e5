"""Solve the harmonic motion of scene files, and write it as HDF5 and for ParaView."""

import json
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.files import whole
from liverjax.core.struct import replace
from liverjax.jobs.output import read_by_step
from liverjax.jobs.reactions import held_forces
from liverjax.mesh.files import meshio_cells
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene, Solve
from liverjax.scenes.scene_file import nodes_under_traction
from liverjax.simulation.equations import forces_at
from liverjax.simulation.run import prepared
from liverjax.simulation.unloaded import resting
from liverjax.waves.cautions import cautions_of_waves
from liverjax.waves.harmonic import Harmonic, harmonic, largest_in_period, refuse_not_harmonic
from liverjax.waves.mesh_error import HarmonicError, harmonic_errors
from liverjax.waves.rest import under_its_weight

#: The program warns if the reactions of the relaxed body and of the run differ by more than this fraction.
_RESTED = 0.05
#: Maximum residual of the last step of a run with newton = "one_step", if the body is to vibrate about this state.
_LARGEST_RESIDUAL = 1e-3
#: Two reference shapes are equal if their nodes differ by less than this fraction of the largest coordinate. The
#: roundoff of files in float32 is 1e-7.
_SAME_SHAPE = 1e-6


class Waves(NamedTuple):
    """Amplitudes of the harmonic motion of a scene, their mesh error, the computing time [s], and warnings."""

    found: Harmonic
    mesh_error: HarmonicError | None
    seconds: float
    cautions: list[str]


def solved_waves(scene: Scene, about: Path | None, mesh_error: bool) -> Waves:
    """Compute the harmonic motion of a scene with kind = "harmonic".

    Args:
        scene: `Scene`.
        about: result.h5 of a run with the same mesh and the same reference shape. The body vibrates about the last
            state of this run. If `about` is None, the body vibrates about the state of rest under gravity and
            pre-tension. If neither acts, it vibrates about the reference shape.
        mesh_error: whether to estimate the discretisation error of the mesh.

    Raises:
        InputError: `harmonic` cannot solve the scene, or the file `about` is not a result of this mesh.
    """
    refuse_not_harmonic(scene)  # first, because messages of the run under gravity do not fit harmonic motion
    x, reactions = (under_its_weight(scene), None) if about is None else _last_state(about, scene)
    begin = time.perf_counter()
    found = jax.block_until_ready(harmonic(scene, about=x))
    seconds = time.perf_counter() - begin
    said = cautions_of_waves(scene, x)
    error = None
    if mesh_error:
        try:
            error = harmonic_errors(scene, found, about=x)
        except InputError as e:  # the motion is returned without its mesh error
            said.append(str(e))
    if x is not None and reactions is not None:
        said += _of_rest(scene, x, reactions, f"--about {about}")
    return Waves(found, error, seconds, said)


def _last_state(file: Path, scene: Scene) -> tuple[jax.Array, np.ndarray]:
    """Read positions [m] and reactions [N] (V, 3) of the last step in the file.

    A reaction also balances the traction at its node. So the reactions are NaN at held nodes under a traction of the
    run.
    """
    import h5py

    try:
        with h5py.File(file) as given:
            x, reactions = (np.asarray(given[name][-1]) for name in ("positions", "reactions"))
            reference = np.asarray(given["reference"])
            code = int(np.ravel(read_by_step(given, "status"))[-1])
            left = float(np.ravel(read_by_step(given, "residual"))[-1]) if code == status.ONE_STEP else 0.0
            text = str(given.attrs.get("scene", ""))
    except FileNotFoundError:
        raise InputError(f"--about {file} does not exist: give the result.h5 of a run of this scene") from None
    except (OSError, KeyError, IndexError) as error:
        raise InputError(
            f"--about {file} contains no positions or no reference shape: give the result.h5 of a run of this scene"
        ) from error
    if x.shape != scene.mesh.points.shape:
        raise InputError(
            f"--about {file} has {len(x)} nodes, but the scene has {scene.mesh.number_of_nodes}: give a run of the "
            "same mesh"
        )
    points = np.asarray(scene.mesh.points)
    apart = float(np.abs(reference - points).max())
    if apart > _SAME_SHAPE * np.abs(points).max():
        raise InputError(
            f"--about {file} has another reference shape than the scene (nodes differ by up to {apart:.2g} m): give a "
            'run of the same shape; if that run has a loaded mesh, repeat it with --vtu, and write file = "…" with its '
            "file vtu/step_00001.vtu into [mesh] of the scene. This file is in metres and has no sets: remove unit, "
            "and select nodes and elements with where"
        )
    if code not in (status.CONVERGED, status.ONE_STEP):
        raise InputError(
            f"--about {file}: the last step of this run is {status.NAMES[code]}; give a run that ended in equilibrium"
        )
    if not left <= _LARGEST_RESIDUAL:
        raise InputError(
            f"--about {file}: the last step of this run has the residual {left:.1g} of all forces, so the body is not "
            'in equilibrium: repeat the run with smaller steps or with newton = "converged"'
        )
    loaded = _nodes_under_traction_of(text, scene)
    reactions[loaded[np.any(reactions[loaded] != 0, axis=1)]] = np.nan
    return jnp.asarray(x), reactions


def _nodes_under_traction_of(text: str, scene: Scene) -> np.ndarray:
    """Return the nodes under the tractions of a run on the same mesh. `text`: the scene file of this run. If it cannot
    be used, no nodes are returned."""
    try:
        return nodes_under_traction(tomllib.loads(text.lstrip("\ufeff")), scene.mesh)
    except (tomllib.TOMLDecodeError, InputError):
        return np.zeros(0, int)


def _of_rest(scene: Scene, x: jax.Array, reactions: np.ndarray, name: str) -> list[str]:
    """Return a warning if the reactions (V, 3) [N] of a run differ from the reactions of the relaxed body at x.

    Components that are 0 or not known (NaN) in the run are not compared. If the reactions differ, the stress of the run
    also differs from the relaxed stress. There is no warning for a porous body.
    """
    norms = np.linalg.norm(reactions, axis=1)
    pulled = np.nan_to_num(norms)
    if scene.porosity is not None or not norms.any():
        return []
    if not pulled.any():
        return [
            f"whether the stress in the state of {name} is relaxed was not checked, because a traction of that run "
            "acts at all nodes with a reaction"
        ]
    # Along a free axis, a reaction is 0.
    at = (pulled > 0.01 * pulled.max())[:, None] & (reactions != 0)
    # Membranes, ligaments, springs and obstacles also pull or push at fixed nodes. Sliding supports do not.
    pulling = tuple(own for own in scene.physics if not isinstance(own, SlidingSupport))
    still = resting(replace(by_element(scene), traction=(), fixed=(), displaced=(), physics=pulling))
    still = replace(still, solve=Solve(volumetric=still.solve.volumetric))
    relaxed = np.asarray(jax.jit(forces_at)(prepared(still), x))
    apart = float(np.linalg.norm((relaxed - reactions)[at]) / np.linalg.norm(reactions[at]))
    if apart <= _RESTED:
        return []
    obstacles = any(isinstance(own, Obstacle) for own in scene.physics)
    place = ", and give each obstacle of this scene its last position in the run" if obstacles else ""
    return [
        f"in the state of {name}, the forces of the relaxed body differ from the forces of the run by "
        f"{100 * apart:.2g} %. The harmonic motion is computed for the relaxed body: let the body rest in the run for "
        f"much longer than its relaxation times, and use the same material in both scenes{place}"
    ]


def missing_parts(scene: Scene, waves: Waves) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative mesh errors of motion (F,) and of support forces (F,) at F frequencies.

    The norm of the error is divided by the norm of the motion. The largest error of a support force is divided by the
    largest support force; both are the largest values during a period. The errors are NaN at frequencies without motion
    or without force. The mesh error must have been estimated before.
    """
    error, found = waves.mesh_error, waves.found
    if error is None:
        raise ValueError("the mesh error was not estimated: use mesh_error = True")
    sizes = [np.linalg.norm(np.asarray(u), axis=(1, 2)) for u in (error.displacement, found.displacement)]
    more, force = (held_forces(scene, np.asarray(own)) for own in (error.reactions, found.reactions))

    def largest(forces: dict[str, np.ndarray]) -> np.ndarray:
        return np.max([largest_in_period(own) for own in forces.values()], axis=0, initial=0.0)

    sizes += [largest(more) if more else 0 * sizes[0], largest(force) if force else 0 * sizes[0]]
    with np.errstate(invalid="ignore", divide="ignore"):
        return sizes[0] / np.where(sizes[1] > 0, sizes[1], np.nan), sizes[2] / np.where(sizes[3] > 0, sizes[3], np.nan)


def write_waves(file: Path, scene: Scene, waves: Waves, attributes: Mapping[str, object]) -> None:
    """Write an HDF5 file with F frequencies, complex displacements and reactions (F, V, 3), pressures (F, V), the mesh
    and `attributes`."""
    import h5py

    arrays = {name: (getattr(waves.found, name), unit) for name, unit in _UNITS.items()}
    if waves.found.pressure is not None:
        arrays["pressure"] = (waves.found.pressure, "Pa")
    arrays["reference"] = (scene.mesh.points, "m")
    if waves.mesh_error is not None:
        arrays["mesh_error/displacement"] = (waves.mesh_error.displacement, "m")
        arrays["mesh_error/reactions"] = (waves.mesh_error.reactions, "N")
        if waves.mesh_error.pressure is not None:
            arrays["mesh_error/pressure"] = (waves.mesh_error.pressure, "Pa")
    with whole(file) as new, h5py.File(new, "w") as out:
        for name, (values, unit) in arrays.items():
            out[name] = np.asarray(values)
            out[name].attrs["unit"] = unit
        out["tetrahedra"] = meshio_cells(scene.mesh)[1]
        for name, value in attributes.items():
            out.attrs[name] = value if isinstance(value, (str, int, float)) else json.dumps(value)


_UNITS = {"frequencies_Hz": "Hz", "displacement": "m", "reactions": "N", "residual": "1"}


def write_waves_vtu(folder: Path, scene: Scene, found: Harmonic) -> Path:
    """Write one VTU file per frequency with the complex displacement, and the series file that ParaView opens."""
    import meshio

    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for k, u in enumerate(np.asarray(found.displacement)):
        name = f"frequency_{k + 1:03d}.vtu"
        data = {"displacement_real": u.real, "displacement_imaginary": u.imag}
        if found.pressure is not None:
            p = np.asarray(found.pressure[k])
            data |= {"pressure_real": p.real, "pressure_imaginary": p.imag}
        meshio.Mesh(np.asarray(scene.mesh.points), [meshio_cells(scene.mesh)], point_data=data).write(folder / name)
        entries.append({"name": name, "time": float(found.frequencies_Hz[k])})
    series = folder / "result.vtu.series"
    series.write_text(json.dumps({"file-series-version": "1.0", "files": entries}, indent=1) + "\n")
    return series
