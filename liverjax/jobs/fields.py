"""Fields of a finished run: stress, strain, stretches, volume ratio, energy, velocity of the fluid.

The equations of every step are evaluated again at the positions of the run, but not solved again. So the history
variables (viscous stress, fluid) are the same as in the run.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.did_you_mean import hint
from liverjax.core.errors import InputError
from liverjax.core.struct import Number
from liverjax.elements.gradients import volume_gradients
from liverjax.laws.base import isochoric_part
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End
from liverjax.physics.registry import law_at_rest
from liverjax.physics.volumes.averaged import Averaged
from liverjax.physics.volumes.mixed import Mixed
from liverjax.scenes.scene import Scene
from liverjax.simulation.equations import Equations, Sizes, State, advanced, equations, force_sizes, initial_state
from liverjax.simulation.run import Result, prepared
from liverjax.tensors.matrices import Matrix, add_matrices, deformation_gradient, determinant, pack

#: Name of each field -> unit.
FIELDS = {
    "cauchy_stress": "Pa",
    "green_strain": "1",
    "principal_stretches": "1",
    "volume_ratio": "1",
    "energy": "Pa",
    "fluid_velocity": "m/s",
}


def check(names: list[str], scene: Scene) -> None:
    """Check that all fields are known and can be computed for the scene.

    Raises:
        InputError: a field is unknown, or needs a porous body that the scene does not have. The message names the
            field.
    """
    for name in names:
        if name not in FIELDS:
            raise InputError(f"[output] fields: {name!r} is not known: {hint(name, FIELDS)}")
    if "fluid_velocity" in names and scene.porosity is None:
        raise InputError("[output] fields contains fluid_velocity, which needs [porosity]: remove fluid_velocity")


def fields(scene: Scene, result: Result, names: list[str], start: jax.Array | None = None) -> dict[str, np.ndarray]:
    """Return fields (T, E, …) of a finished run at T steps, as means over each element.

    The fields are cauchy_stress (3, 3) [Pa] including the fluid pressure, green_strain (3, 3), principal_stretches (3,)
    with the largest first, volume_ratio J, energy [Pa] of the law per reference volume, and fluid_velocity (3,) [m/s]
    relative to the body.

    Args:
        scene: the scene of the run.
        result: the result of the run.
        names: some of `FIELDS`.
        start: the initial positions (V, 3) [m] of the run, as for `simulate`; None: the reference positions.

    Raises:
        InputError: a field is unknown, or needs a porous body that the scene does not have.
    """
    check(names, scene)
    scene, names = prepared(scene), list(dict.fromkeys(names))
    begin = None if start is None else jnp.asarray(start, scene.mesh.points.dtype)
    sizes, state = force_sizes(scene), initial_state(scene, begin)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for k, x in enumerate(np.asarray(result.positions)):
        pressure = None if result.pressure is None else jnp.asarray(result.pressure[k])
        state, at = _put_again(scene, sizes, state, (jnp.asarray(k + 1.0), jnp.asarray(x), pressure))
        P, F, energy, velocity = (np.asarray(a) for a in at)
        found = _means(P, F, energy, velocity, names)
        for name in names:
            rows[name].append(found[name])
    return {name: np.stack(values) for name, values in rows.items()}


@jax.jit
def _put_again(scene: Scene, sizes: Sizes, state: State, given: Any) -> tuple[State, tuple]:
    """Return the state after a step, and values at the integration points of all elements.

    The values are first Piola-Kirchhoff stress, deformation gradient F, energy density and fluid velocity. `given`
    contains the number of the step, the positions x (V, 3) [m] at the end of the step, and the pressures [Pa] or None.
    """
    k, x, pressure = given
    mesh, e = scene.mesh, equations(scene, state, k, sizes)
    F = deformation_gradient(mesh, x)
    if e.mixed is not None:  # the result does not contain the pressures of volumetric = 'mixed'
        pressure = e.mixed.settled(mesh, determinant(F))
    P = _whole_stress(e, F, pressure)
    energy = _energy(scene, e, F, pressure)
    vertices = None if pressure is None else pressure[: mesh.number_of_vertices]
    velocity = (
        jnp.zeros((3, *determinant(F).shape))
        if scene.porosity is None or vertices is None
        else _velocity(scene, F, vertices)
    )
    at = (pack(P), pack(F), jnp.broadcast_to(energy, determinant(F).shape), velocity)
    return advanced(e, End(x, F, vertices)), at


def _energy(scene: Scene, e: Equations, F: Matrix, pressure: jax.Array) -> Number:
    """Return the energy density [J/m^3] of the law. With averaged or mixed volumes, the volumetric energy follows from
    the pressures of the run, because the pressure does not follow from the volume ratio of a single element."""
    law = law_at_rest(scene)
    if not isinstance(e.volume, Averaged | Mixed):
        return law.strain_energy(law.measures(F))
    shape = isochoric_part(law)
    return shape.strain_energy(shape.measures(F)) + e.volume.density(e.mesh, pressure, determinant(F))


def _whole_stress(e: Equations, F: Matrix, pressure: jax.Array) -> Matrix:
    first, *rest = [solid.stress(F) for solid in e.solids]
    for more in rest:
        first = add_matrices(first, more)
    if e.volume is None:
        return first
    own = e.volume.pressure(e.mesh, determinant(F)) if pressure is None else pressure[: e.mesh.number_of_vertices]
    return add_matrices(first, e.volume.stress(e.mesh, own, F))


def _velocity(scene: Scene, F: Matrix, pressure: jax.Array) -> jax.Array:
    """Return the Darcy velocity [m/s]: minus the permeability times the spatial gradient of the pressure.

    Its shape is (3, E), or (3, Q, E) if elements have Q > 1 integration points.
    """
    mesh: TetMesh = scene.mesh
    corner, g, J = pressure[mesh.tetrahedra.T], volume_gradients(mesh, F), determinant(F)
    of = corner if mesh.order == 1 else corner[:, None]
    slope = [sum(of[a] * g[a][i] for a in range(4)) / J for i in range(3)]
    permeability = jnp.asarray(scene.porosity.permeability)  # type: ignore[union-attr]
    return -(permeability[None] if permeability.ndim else permeability) * jnp.stack(slope)


def _means(P: np.ndarray, F: np.ndarray, energy: np.ndarray, velocity: np.ndarray, names: list[str]) -> dict:
    """Return the fields of the elements (E, …) from values at the integration points."""
    turned, J = np.swapaxes(F, -1, -2), np.linalg.det(F)
    make = {
        "cauchy_stress": lambda: P @ turned / J[..., None, None],
        "green_strain": lambda: 0.5 * (turned @ F - np.eye(3)),
        "principal_stretches": lambda: np.linalg.svd(F, compute_uv=False),
        "volume_ratio": lambda: J,
        "energy": lambda: energy,
        "fluid_velocity": lambda: np.moveaxis(velocity, 0, -1),
    }
    found = {name: make[name]() for name in names}
    # All integration points of a quadratic element have the same weight.
    return {name: value if J.ndim == 1 else value.mean(axis=0) for name, value in found.items()}


def at_vertices(mesh: TetMesh, values: np.ndarray) -> np.ndarray:
    """Return fields (T, V, …) at the vertices: means of the values (T, E, …) of the elements around each vertex,
    weighted by volume."""
    tets, volumes = np.asarray(mesh.tetrahedra), np.asarray(mesh.volumes)
    total = np.zeros((len(values), mesh.number_of_vertices, *values.shape[2:]))
    weight = np.zeros(mesh.number_of_vertices)
    weighted = values * volumes.reshape(1, -1, *[1] * (values.ndim - 2))
    for corner in tets.T:
        np.add.at(weight, corner, volumes)
        for t in range(len(values)):
            np.add.at(total[t], corner, weighted[t])
    return total / weight.reshape(1, -1, *[1] * (values.ndim - 2))
