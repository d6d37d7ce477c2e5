"""Warnings about the mesh of a run."""

import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.mesh.locate import doubled_vertices, hanging_vertices
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene
from liverjax.simulation.automatic import advice_against_locking, form_of_volumes, qualities
from liverjax.simulation.run import Result

#: No organ is longer than this [m]. If millimetres are read as centimetres, a liver seems to be 2 m long.
LONGEST = 1.0
#: No organ and no sample is shorter than this [m]. If metres are read as millimetres, a liver seems to be 0.2 mm long.
SHORTEST = 1e-3
#: A displacement of at most this fraction of the body's size counts as zero.
_ROUNDOFF = 1e-13
#: Elements with a quality (see `qualities`) below this value are slivers. In slivers, gradients are 100 times less
#: accurate.
SLIVER = 0.01
#: If the mesh error is below this fraction of the largest displacement, no finer mesh is recommended.
_SMALL = 0.02


def mesh_sentence(scene: Scene, result: Result) -> str:
    """Return a sentence about the mesh error of the positions at the last step, with advice if the error is large."""
    assert result.mesh_error is not None
    if np.asarray(result.status)[-1] not in (status.CONVERGED, status.ONE_STEP):
        return "the mesh error is unknown, because the last step failed"
    u = np.asarray(result.positions[-1]) - np.asarray(scene.mesh.points)
    size = float(np.linalg.norm(u, axis=1).max())
    error = float(np.linalg.norm(np.asarray(result.mesh_error.positions[-1]), axis=1).max())
    nothing = _ROUNDOFF * np.ptp(np.asarray(scene.mesh.points))
    found = np.asarray(result.mesh_error.found)
    if size <= nothing and error <= nothing and np.all(found):
        return "the mesh error is zero, because the body does not move"
    part = (
        f"{100 * error / size:.2g} % of the largest displacement ({size:.3g} m)"
        if size > nothing
        else "although the run shows no displacement"
    )
    begin = "mesh error (estimate, last step{})"
    if not found[-1]:
        begin = (
            "mesh error not reliable, because no estimate was found for the last step, or it inverts elements (rough "
            "size{})"
        )
    said = f"{begin}: nodal positions are wrong by up to {error:.2g} m, {part}{{}}"
    said = said.format(*_pressure_errors(result))
    single = next((p.section for p in scene.physics if p.pulls_single_nodes()), None)
    if single is not None:
        said += f". Forces of [[{single}]] at single nodes depend on the mesh; the estimate does not include this"
    if not np.all(found[:-1]):
        count = int(np.sum(~found[:-1]))
        said += f". At {count} earlier step{'s' * (count > 1)} no estimate was found, or the estimate inverts elements"
    if error <= _SMALL * size and found[-1]:
        return said
    return f"{said}: use {'order = 2 in [mesh], or a finer mesh' if scene.mesh.order == 1 else 'a finer mesh'}"


def _pressure_errors(result: Result) -> tuple[str, str]:
    """Return two parts of `mesh_sentence`: a note that the pressure error is omitted, and the pressure error. A part
    may be empty."""
    if result.pressure is None or result.mesh_error is None:
        return "", ""
    if result.mesh_error.pressure is None:
        return ", without the error of the fluid's pressures", ""
    error, size = (float(np.abs(np.asarray(own[-1])).max()) for own in (result.mesh_error.pressure, result.pressure))
    return "", f"; pressures are wrong by up to {error:.2g} Pa (the largest pressure is {size:.3g} Pa)"


def cautions_of_mesh(mesh: TetMesh) -> list[str]:
    """Return warnings about the size of the body, nodes with equal coordinates, hanging nodes, and slivers."""
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    size, quality = float(np.ptp(points, axis=0).max()), qualities(points, tets, np.asarray(mesh.volumes))
    said = []
    if size > LONGEST:
        said.append(f"the body is {size:.3g} m long: check the unit of the mesh, e.g. write unit = 'mm'")
    if size < SHORTEST:
        said.append(
            f"the body is {size:.3g} m long: check this size, and remove unit if the coordinates of the mesh are in m"
        )
    doubled = doubled_vertices(mesh)
    if doubled:
        said.append(
            f"{doubled} nodes have the same coordinates as another node, up to roundoff, so the body is not connected "
            "there: merge these nodes if the body should be connected"
        )
    hanging = hanging_vertices(mesh)
    if hanging:
        said.append(
            f"{hanging} nodes lie on a face or edge of an element without being its corners (hanging nodes), so the "
            "body is not connected there: divide these elements, or make a conforming mesh"
        )
    slivers = np.flatnonzero(quality < SLIVER)
    if len(slivers):
        worst = int(np.argmin(quality))
        said.append(
            f"{len(slivers)} of {len(tets)} elements are slivers, with a quality below {SLIVER:g} (worst: element "
            f"{worst} with {quality[worst]:.2g}; a regular tetrahedron has 1). Stresses there are unreliable: improve "
            "the mesh"
        )
    return said


#: If bulk modulus / shear modulus exceeds this value, quadratic elements without pressure unknowns have errors of 10 %
#: or more (see `experiments/TABLES.md`).
_LOCKING = 100.0


def of_locking(scene: Scene) -> list[str]:
    """Warn if quadratic elements are too stiff (lock). With volumetric = "mixed" these elements would not lock."""
    if scene.mesh.order == 1 or form_of_volumes(scene) != "element" or scene.porosity is not None:
        return []
    try:
        law = by_element(scene).law
        ratio = float(np.max(np.asarray(law.bulk_modulus()) / np.asarray(law.shear_modulus())))
    except InputError:  # a law may have no moduli
        return []
    if ratio <= _LOCKING:
        return []
    return [
        f"the bulk modulus is {ratio:.3g} times the shear modulus, so these quadratic elements are too stiff: "
        f"{advice_against_locking(scene)}"
    ]
