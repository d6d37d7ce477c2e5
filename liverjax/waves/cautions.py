"""Warnings about a scene with harmonic motion. They are computed from known numbers, outside jit, grad and vmap."""

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.contact.obstacle import Obstacle, touches_without_pressure
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene, named_physics
from liverjax.simulation.cautions.of_mesh import cautions_of_mesh, of_locking
from liverjax.simulation.cautions.of_pressures import of_drained_layer
from liverjax.waves.harmonic import relative_moduli

#: Minimum number of element edges per wavelength of a shear wave. With fewer edges, even quadratic elements cannot
#: describe a wave.
_LEAST_PER_WAVE = 2.0
#: In a part of the body with about equal wavelengths, the logarithms of the wavelengths differ by at most this value.
_ALIKE = 0.3


def cautions_of_waves(scene: Scene, about: jax.Array | None = None) -> list[str]:
    """Return warnings about mesh, volume constraint, density, excitation, ligaments and obstacles of a scene with
    harmonic motion.

    Args:
        scene: `Scene` with known numbers (not inside jit, grad or vmap).
        about: positions (V, 3) [m] about which the body vibrates; None: the reference shape.
    """
    said = [*cautions_of_mesh(scene.mesh), *of_locking(scene)]
    if scene.body is None:
        said.append("the scene has no [body], so the body has no inertia: write density = 1060.0 in [body]")
    inlets = () if scene.porosity is None else scene.porosity.inlet
    if not scene.displaced and not scene.traction and not inlets:
        said.append("the scene has no excitation: give amplitudes as [[displaced]], [[traction]] or [[porosity.inlet]]")
    x = scene.mesh.points if about is None else about
    for name, physics in named_physics(scene):
        if isinstance(physics, Ligament) and physics.is_straight_without_tension(scene.mesh, x):
            said.append(
                f"{name} is straight but has no tension. A real ligament can only pull, but in harmonic motion this "
                "ligament also pushes"
            )
        if isinstance(physics, Obstacle) and touches_without_pressure(physics, scene.mesh, x):
            said.append(
                f"{name} touches the body without pressure. A real obstacle can only push, but in harmonic motion this "
                "obstacle also pulls"
            )
    if scene.solve.frequencies is None:
        return said
    hertz = float(np.max(np.asarray(scene.solve.frequencies)))
    said += _of_short_waves(scene, np.atleast_1d(np.asarray(scene.solve.frequencies)))
    if scene.porosity is not None:
        said += of_drained_layer(scene, 1 / (2 * np.pi * hertz), f"at {hertz:.3g} Hz, within 1/omega = {{:.2g}} s,")
    return said


def _of_short_waves(scene: Scene, hertz: np.ndarray) -> list[str]:
    """Return a warning if the shear waves at one of the frequencies (F,) [Hz] are too short for the elements.

    Each part of the body with waves of about the same length (`_ALIKE`) is checked separately. The sizes in the warning
    are those of the part with the fewest edges per wavelength.
    """
    if scene.body is None:
        return []
    own = by_element(scene)
    try:
        moduli = np.asarray(own.law.shear_modulus(), float)
    except InputError:  # this law defines no shear modulus
        return []
    # If an element has several integration points, the lowest modulus counts.
    moduli = np.broadcast_to(np.atleast_2d(moduli).min(axis=0), scene.mesh.number_of_elements)
    corners = np.asarray(scene.mesh.points)[np.asarray(scene.mesh.tetrahedra)]
    edges = np.linalg.norm(corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]], axis=2)
    factors = np.asarray(relative_moduli(own, 2 * np.pi * jnp.asarray(hertz))).reshape(len(hertz), -1)
    # The wave number of a shear wave is omega / speed. Its real part is 2 pi / wavelength.
    speeds = np.sqrt(factors * moduli / np.median(np.asarray(scene.body.density)))
    lengths = np.abs(speeds) ** 2 / np.maximum(speeds.real, np.finfo(float).tiny) / hertz[:, None]
    found = []
    for frequency, row in zip(hertz, lengths, strict=True):
        parts = np.round(np.log(row) / _ALIKE)
        for own in (parts == part for part in np.unique(parts)):
            found.append((float(frequency), float(np.median(row[own])), float(np.median(edges[own]))))
    at, length, edge = min(found, key=lambda of_part: of_part[1] / of_part[2])
    if length >= _LEAST_PER_WAVE * edge:
        return []
    return [
        f"at {at:.3g} Hz shear waves are about {length:.2g} m long where the edges of the elements are {edge:.2g} m "
        "long. The mesh is too coarse for these waves: use a finer mesh, or lower frequencies (see --mesh-error)"
    ]
