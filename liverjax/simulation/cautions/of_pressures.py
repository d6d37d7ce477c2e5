"""Warnings about the pressures of a porous run and about the thickness of the elements at drained nodes."""

import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Number
from liverjax.physics.porosity import law_in_force
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene
from liverjax.simulation.run import Result

#: The lagged scheme counts as unstable if the sum of all pressure changes over one step exceeds this multiple of the
#: sum of all pressure changes over two steps.
ALTERNATING = 3.0


def of_pressures(scene: Scene, result: Result) -> list[str]:
    """Warn if pressures overshoot, if elements at drained nodes are too thick, or if scheme = "lagged" is unstable."""
    if scene.porosity is None or result.pressure is None:
        return []
    P = np.asarray(result.pressure)
    if scene.porosity.scheme != "lagged":
        return [
            *_of_overshoot(scene, P[:, : scene.mesh.number_of_vertices]),
            *of_drained_layer(scene, float(scene.solve.dt or 0.0) * len(P), "in {:.3g} s"),
        ]
    if len(P) < 4:
        return []
    once, twice = np.abs(np.diff(P, axis=0)).sum(), np.abs(P[2:] - P[:-2]).sum()
    if not once > ALTERNATING * twice:
        return []
    return [
        "the pressure alternates from step to step, because scheme = 'lagged' is unstable here: write scheme = "
        "'implicit' in [porosity]"
    ]


def _heights_beside(scene: Scene, at: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the heights (n,) [m] of the elements with the numbers `at` (n,), measured from one face of each element.

    The entries of `faces` (E, 4) are true for the three corners of this face.
    """
    corners = np.asarray(scene.mesh.points)[np.asarray(scene.mesh.tetrahedra)[at]]
    base = corners[faces[at]].reshape(-1, 3, 3)
    area = 0.5 * np.linalg.norm(np.cross(base[:, 1] - base[:, 0], base[:, 2] - base[:, 0]), axis=1)
    return np.asarray(3 * np.abs(np.asarray(scene.mesh.volumes)[at]) / area)


#: A warning about the elements at the drained nodes is given if it applies to more than this fraction of these
#: elements.
_MANY = 0.2


def of_drained_layer(scene: Scene, seconds: float, when: str) -> list[str]:
    """Warn if the layer that drains in `seconds` is thinner than many of the elements at the drained nodes.

    The numbers in the warning are medians over these elements. `when` is the beginning of the message. It contains a
    format field for `seconds`.

    In a time t, a layer of the thickness sqrt(c t) drains, with the diffusivity c = kappa / (1/K_lim + 1/M) (Biot
    1941). kappa is the permeability, and 1/K_lim is the storage (see `liverjax.physics.porosity`). M = K0 + 4/3 mu,
    with the bulk modulus K0 of the drained body (sponge and law) and the shear modulus mu. The pressure is linear in
    an element, so an element thicker than this layer loses too much fluid.
    """
    sponge = scene.porosity
    assert sponge is not None
    if sponge.drained is None or not seconds > 0:
        return []
    given = np.isin(np.asarray(scene.mesh.tetrahedra), np.asarray(sponge.drained))
    at = np.flatnonzero(given.sum(axis=1) == 3)
    if not len(at):
        return []
    try:
        M, limit, kappa = _moduli_and_permeability(scene, at)
    except InputError:  # a law may have no moduli
        return []
    heights = _heights_beside(scene, at, given)
    layers = np.sqrt(kappa / (1 / limit + 1 / M) * seconds)
    thick = layers < heights
    if thick.mean() <= _MANY:
        return []
    layer, height = np.median(layers[thick]), np.median(heights[thick])
    where = "the drained nodes" if thick.all() else "some of the drained nodes"
    return [
        f"{when.format(seconds)} the fluid leaves a layer of about {layer:.2g} m at {where}, but the elements there "
        f"are {height:.2g} m thick. These elements lose too much fluid, so pressures and displacements are wrong there "
        "(the mesh error shows how much). Use thinner elements there, or no drained nodes if nothing should flow"
    ]


def _moduli_and_permeability(scene: Scene, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return three properties (n,) of the elements with the numbers `at` (n,): the longitudinal modulus K0 + 4/3 mu
    [Pa], the storage modulus K_lim [Pa], and the permeability [m^4/(N s)]. Parameters of regions are included.

    Raises:
        InputError: the law has no moduli.
    """
    own = by_element(scene)
    sponge = own.porosity
    assert sponge is not None

    def there(value: Number) -> np.ndarray:  # median over the integration points of each element
        shape = np.broadcast_shapes(np.shape(value), (scene.mesh.number_of_elements,))
        return np.asarray(np.median(np.broadcast_to(value, shape)[..., at].reshape(-1, len(at)), axis=0), float)

    K0 = there(sponge.bulk) + there(law_in_force(sponge, own.law).bulk_modulus())
    return K0 + 4 / 3 * there(own.law.shear_modulus()), there(sponge.limit_bulk), there(sponge.permeability)


#: A warning is given if the overshoot, divided by the largest pressure of the step, exceeds this value.
OVERSHOOT = 0.05
#: Smallest dt for which the overshoot stays below `OVERSHOOT`, in units of h^2/(kappa M), for elements of height h,
#: permeability kappa and longitudinal modulus M.
_FOLLOWS = 0.4


def _least_steps(scene: Scene, at: np.ndarray, heights: np.ndarray) -> np.ndarray | None:
    """Return the smallest dt (n,) [s] without overshoot, for the elements `at` with the given heights (n,) [m]. The
    value is 0 if nothing flows. Return None if the law has no moduli."""
    try:
        M, _, kappa = _moduli_and_permeability(scene, at)
    except InputError:
        return None
    return _FOLLOWS * heights**2 / (np.where(kappa > 0, kappa, np.inf) * M)


def _of_overshoot(scene: Scene, P: np.ndarray) -> list[str]:
    """Warn if the pressures P (T, V) of T steps are higher next to the drained nodes than further inside.

    The warning is about the elements at the drained nodes for which dt is too short.

    The fluid volume that leaves an element within a step is distributed to all nodes of the element. In one dimension,
    with dt < h^2/(4 kappa M), this distribution couples neighbouring nodes more strongly than the flow does (h: height
    of the elements, kappa: permeability, M: longitudinal modulus). In three dimensions the smallest dt without
    overshoot is about 1.5 times this bound. Source of such bounds: Vermeer and Verruijt 1981 (Int. J. Numer. Anal.
    Methods Geomech. 5, 1).
    """
    sponge, tets, V = scene.porosity, np.asarray(scene.mesh.tetrahedra), scene.mesh.number_of_vertices
    assert sponge is not None
    if sponge.drained is None:
        return []
    given = np.zeros(V, bool)
    given[np.asarray(sponge.drained)[np.asarray(sponge.drained) < V]] = True
    faces = given[tets]
    at = np.flatnonzero(faces.sum(axis=1) == 3)
    if not len(at):
        return []
    heights = _heights_beside(scene, at, faces)
    least = _least_steps(scene, at, heights)
    short = np.ones(len(at), bool) if least is None else float(scene.solve.dt) < least
    if short.mean() <= _MANY:  # short steps are not the cause of an overshoot
        return []
    beside = np.zeros(V, bool)
    beside[tets[at].ravel()] = True
    beside &= ~given
    inner = np.zeros((V, len(P)))  # the largest |pressure| of neighbours further inside
    for a, b in ((a, b) for a in range(4) for b in range(4) if a != b):
        one = beside[tets[:, a]] & ~given[tets[:, b]] & ~beside[tets[:, b]]
        np.maximum.at(inner, tets[one, a], np.abs(P[:, tets[one, b]]).T)
    known = beside & (inner.max(axis=1) > 0) & np.isin(np.arange(V), tets[at[short]])
    largest = np.abs(P).max(axis=1, initial=0.0)
    if not known.any() or not largest.any():
        return []
    over = np.median(np.abs(P[:, known]) - inner[known].T, axis=1) / np.where(largest > 0, largest, 1.0)
    worst = int(np.argmax(np.where(largest > 0.1 * largest.max(), over, 0.0)))
    if not over[worst] > OVERSHOOT:
        return []
    said = (
        f"the pressure overshoots beside the drained nodes, by {100 * over[worst]:.2g} % at "
        f"{float(scene.solve.dt) * (worst + 1):.3g} s, because the first steps are too short for the elements there"
    )
    if least is None:
        return [f"{said}: use a larger dt, or thinner elements there"]
    enough, height = np.median(least[short]), np.median(heights[short])
    return [
        f"{said}: use a dt of {enough:.2g} s or more, or elements of "
        f"{height * np.sqrt(float(scene.solve.dt) / enough):.2g} m there (the elements are {height:.2g} m thick)"
    ]
