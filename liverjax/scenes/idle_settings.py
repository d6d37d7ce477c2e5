"""Find settings of a scene file that have no effect, so that no setting is silently ignored."""

from liverjax.core.errors import InputError
from liverjax.core.struct import Content

#: Keys of [mesh] that are valid for all meshes, and the additional keys for each kind of mesh.
_EVERY_MESH = ("unit", "order", "is")
_MESHES = {
    "file": ("file",),
    "box": ("shape", "size", "cells"),
    "cylinder": ("shape", "radius", "height", "cell_size", "rim_cell", "rings", "match_area"),
}


def refuse_idle(content: Content) -> None:
    """Check that all settings in the content of a scene file have an effect.

    The values in `content` must have been checked before.

    Raises:
        InputError: a key is not used, because of the kind of mesh, the kind of motion or another setting.
    """
    mesh, solve, output = (content.get(name, {}) for name in ("mesh", "solve", "output"))
    kind = "file" if "file" in mesh else mesh["shape"]
    for key in mesh:
        if key not in (*_EVERY_MESH, *_MESHES[kind]):
            what = "a mesh from a file" if kind == "file" else f"shape = {kind!r}"
            raise InputError(f"[mesh] {key} has no effect for {what}: remove this key")
    motion = solve.get("kind", "static")
    if motion != "dynamic" and solve.get("integrator") == "newmark":
        raise InputError(
            f"[solve] integrator = 'newmark' needs kind = 'dynamic', but kind = {motion!r}: remove integrator"
        )
    if "reduced_tolerance" in solve and not solve.get("reduced"):
        raise InputError(
            '[solve] reduced_tolerance needs a reduced model: add reduced = "model.h5", or remove reduced_tolerance'
        )
    for key in ("fields", "reactions"):
        if motion == "harmonic" and output.get(key):
            raise InputError(f"[output] {key} cannot be used with [solve] kind = 'harmonic': remove this key")
    for place, key in (("solve", "dt"), ("solve", "steps"), ("porosity", "initial_pressure")):
        if motion == "harmonic" and key in content.get(place, {}):
            raise InputError(f"[{place}] {key} cannot be used with [solve] kind = 'harmonic': remove this key")
    for key, idle in (("newton", "converged"), ("robust", "off")):
        if motion == "harmonic" and solve.get(key, idle) != idle:
            raise InputError(
                f"[solve] {key} = {solve[key]!r} has no effect with kind = 'harmonic', and it does not change the "
                "state of rest: remove this key"
            )
    if motion == "harmonic" and content.get("body", {}).get("mass") == "lumped":
        raise InputError(
            "[body] mass = 'lumped' cannot be used with [solve] kind = 'harmonic', which uses consistent masses: "
            "remove mass, or call lj.harmonic(scene, mass='lumped')"
        )
