"""Refuse settings of a scene file that would change nothing, so that no setting is silently ignored."""

from liverjax.core.errors import InputError
from liverjax.core.struct import Content

#: Keys of [mesh] that are valid for all meshes; then the further keys of each kind of mesh.
_EVERY_MESH = ("unit", "order", "is")
_MESHES = {
    "file": ("file",),
    "box": ("shape", "size", "cells"),
    "cylinder": ("shape", "radius", "height", "cell_size", "rim_cell", "rings", "match_area"),
}


def refuse_idle(content: Content) -> None:
    """Refuse settings without effect in the content of a scene file. The values must have been checked before.

    Raises:
        InputError: a key that this mesh, this kind of motion or this run does not use.
    """
    mesh, solve, output = (content.get(name, {}) for name in ("mesh", "solve", "output"))
    kind = "file" if "file" in mesh else mesh["shape"]
    for key in mesh:
        if key not in (*_EVERY_MESH, *_MESHES[kind]):
            what = "a mesh from a file" if kind == "file" else f"shape = {kind!r}"
            raise InputError(f"[mesh] {key} does nothing for {what}: leave it out")
    motion = solve.get("kind", "static")
    if motion != "dynamic" and solve.get("integrator") == "newmark":
        raise InputError(
            f"[solve] integrator = 'newmark' is for kind = 'dynamic', here it is {motion!r}: leave the integrator out"
        )
    if "reduced_tolerance" in solve and not solve.get("reduced"):
        raise InputError('[solve] reduced_tolerance needs a reduced model: add reduced = "model.h5", or leave it out')
    for key in ("fields", "reactions"):
        if motion == "harmonic" and output.get(key):
            raise InputError(f"[output] {key} is for runs in time, [solve] kind is 'harmonic': leave it out")
    for place, key in (("solve", "dt"), ("solve", "steps"), ("porosity", "initial_pressure")):
        if motion == "harmonic" and key in content.get(place, {}):
            raise InputError(f"[{place}] {key} is for runs in time, [solve] kind is 'harmonic': leave it out")
    if motion == "harmonic" and content.get("body", {}).get("mass") == "lumped":
        raise InputError(
            "[body] mass = 'lumped' is for runs in time, harmonic motion has consistent masses: leave it out, or call "
            "lj.harmonic(scene, mass='lumped')"
        )
