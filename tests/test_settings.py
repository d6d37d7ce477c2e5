"""Settings of scene files: wrong types, and keys without effect, give a one-line message."""

import copy
import tomllib
import warnings

import pytest

import liverjax as lj
from liverjax.mesh.files import write_mesh
from liverjax.scenes.scene_file import _KEYS, output_of, scene_from

pytestmark = pytest.mark.quick_to_compile

#: Scenes that together have every section and most keys.
SCENES = [
    tomllib.loads(text)
    for text in (
        """
[mesh]
shape = "box"
size = [100.0, 100.0, 100.0]
cells = [1, 1, 1]
unit = "mm"
order = 1
is = "reference"
[[law]]
name = "neo_hookean"
mu = 770.0
bulk = 2200.0
volumetric = "log"
continued_below = 0.1
[[law]]
name = "ogden"
mu = [100.0]
alpha = [2.0]
bulk = 100.0
[[region]]
where = {z_min = 0.0}
[region.law]
0 = {mu = 700.0}
[region.viscosity]
ratios = [0.2]
relaxation_times = [0.2]
[region.porosity]
bulk = 300.0
limit_bulk = 2000.0
fluid_fraction = 0.4
permeability = 1e-5
[viscosity]
ratios = [0.1]
relaxation_times = [0.1]
part = "all"
scheme = "exponential"
[porosity]
bulk = 400.0
limit_bulk = 2200.0
fluid_fraction = 0.5
permeability = 2.0e-5
scheme = "implicit"
keep_bulk = false
initial_pressure = 0.0
drained = [{set = "z_min"}, {x_max = 0.0}]
[[porosity.inlet]]
where = {z_min = 0.1}
pressure = 1.0
history = [[0.0, 0.0], [1.0, 1.0]]
[[porosity.inlet]]
set = "y_max"
flux = 1e-6
[body]
density = 1060.0
gravity = [0.0, 0.0, -1.0]
mass = "lumped"
history = [[0.0, 0.0], [1.0, 1.0]]
[[fixed]]
set = "z_min"
axes = "xyz"
[[displaced]]
where = {z_min = 0.1, x_max = 0.0}
by = [0.0, 0.0, 0.001]
axes = "z"
history = [[0.0, 0.0], [1.0, 1.0]]
[[traction]]
set = "x_max"
pressure = 1.0
history = [[0.0, 0.0], [1.0, 1.0]]
[[traction]]
where = {x_min = 0.1}
value = [1.0, 0.0, 0.0]
[[support]]
where = {y_max = 0.0}
normal = 10.0
tangential = 1.0
history = [[0.0, 0.0], [1.0, 1.0]]
[[support]]
set = "y_max"
stiffness = 1.0
[[support]]
set = "x_min"
sliding = true
[[obstacle]]
shape = "plane"
set = "x_max"
position = [0.11, 0.0, 0.0]
axis = [-1.0, 0.0, 0.0]
by = [-0.001, 0.0, 0.0]
stiffness = 1e5
history = [[0.0, 0.0], [1.0, 1.0]]
[[obstacle]]
shape = "sphere"
radius = 0.01
position = [0.05, 0.05, 0.12]
friction = 0.2
[[obstacle]]
shape = "cone"
half_angle = 30.0
radius = 0.001
axis = [0.0, 0.0, 1.0]
where = {z_min = 0.1}
position = [0.05, 0.04, 0.11]
force = [0.0, 0.0, -0.1]
[[membrane]]
set = "x_max"
thickness = 5e-5
law = {name = "neo_hookean", mu = 1e5}
[[ligament]]
set = "x_max"
to = [0.15, 0.05, 0.05]
stiffness = 10.0
pre_tension = 0.01
[[ligament]]
points = [[0.05, 0.04, 0.01], [0.05, 0.05, 0.09]]
stiffness = 10.0
rest_length = 0.05
[[vessel]]
line = [[0.02, 0.05, 0.01], [0.05, 0.05, 0.09]]
radius = 3e-3
wall = 5e-4
law = {name = "neo_hookean", mu = 1e5}
[solve]
kind = "dynamic"
dt = 0.05
steps = 2
tolerance = 1e-8
newton = "converged"
newton_iterations = 25
integrator = "euler"
precision = "float64"
linear_solver = "auto"
volumetric = "element"
robust = "off"
reduced = "model.h5"
reduced_tolerance = 0.01
[output]
fields = ["energy"]
reactions = true
""",
        """
[mesh]
shape = "cylinder"
radius = 0.01
height = 0.01
cell_size = 0.005
rim_cell = 0.004
rings = [0.005]
match_area = true
[law]
name = "costa"
c = 100.0
b_ff = 1.0
b_ss = 1.0
b_nn = 1.0
b_fs = 1.0
b_fn = 1.0
b_sn = 1.0
bulk = 1000.0
fibre = [1.0, 0.0, 0.0]
sheet = [0.0, 1.0, 0.0]
[springpots]
times = [0.1]
exponents = [0.3]
limits = [10.0]
spring = 1.0
part = "all"
[body]
density = 1060.0
[[displaced]]
set = "bottom"
by = [0.0, 1e-5, 0.0]
[solve]
kind = "harmonic"
frequencies = [60.0]
""",
    )
]
#: A value of every TOML type.
KINDS = (["a", "b"], [1.0, 2.0, 3.0], [], 5, -7.5, "a word", True, {"a": 1}, [{"a": 1}])
#: Sections that a section needs in addition to mesh, law, fixed nodes and [solve].
NEEDS = {"region": ("viscosity", "porosity"), "solve": ("body",), "law": ("body",), "springpots": ("displaced",)}


def _addresses(content, before=()):
    """Yield every key of nested tables and lists of tables."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        yield (*before, key)
        if isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], dict)):
            yield from _addresses(value, (*before, key))


def _changed(scene, address, value):
    """Return the scene with a changed value, without sections and neighbouring tables that have no influence on it."""
    section, *rest = address
    wanted = {"mesh", "law", "fixed", "solve", section, *NEEDS.get(section, ())}
    content = {key: copy.deepcopy(part) for key, part in scene.items() if key in wanted}
    if section not in ("law", "solve") and "dt" in scene["solve"]:
        content["solve"] = {"dt": 0.05}
    place = content
    for key in address[:-1]:
        place = place[key]
    place[address[-1]] = value
    if rest and isinstance(rest[0], int) and section != "law":
        content[section] = [content[section][rest[0]]]
    return content


def _told(content) -> str | None:
    """Return the message for an invalid scene, or None if the scene is read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scene_from(content)
        except lj.InputError as error:
            assert "\n" not in str(error), str(error)
            return str(error)
    return None


CASES = [(k, address) for k, scene in enumerate(SCENES) for address in _addresses(scene)]


def test_the_scenes_are_read_and_have_every_key():
    assert [_told(scene) for scene in SCENES] == [None, None]
    given = {(a[0], a[-1]) for _, a in CASES if isinstance(a[-1], str)}
    # A file and a surface replace what other keys give.
    elsewhere = {("mesh", "file"), ("vessel", "surface"), ("vessel", "unit")}
    wanted = {(section, key) for section, keys in _KEYS.items() for key in keys} - elsewhere
    assert not {(s, k) for s, k in wanted if (s, k) not in given and k not in ("where", "set", "history")}


@pytest.mark.parametrize("section", sorted({a[0] for _, a in CASES}))
def test_a_value_of_another_kind_is_read_or_gets_one_sentence(section):
    for k, address in CASES:
        if address[0] == section:
            told = [_told(_changed(SCENES[k], address, value)) for value in KINDS]
            words = {str(part) for part in address if isinstance(part, str)}
            # No key accepts all types, and each message names the key or its section.
            assert any(told), address
            assert all(sentence is None or any(word in sentence for word in words) for sentence in told), (
                address,
                told,
            )


#: Section [mesh] of the second scene; a change of one of the scenes -> part of the message.
MESHES = {
    "box radius": (
        {"shape": "box", "size": [1, 1, 1], "cells": [1, 1, 1], "radius": 3.0},
        "radius has no effect for shape = 'box'",
    ),
    "box rim": (
        {"shape": "box", "size": [1, 1, 1], "cells": [1, 1, 1], "match_area": True},
        "match_area has no effect",
    ),
    "cylinder": (
        {"shape": "cylinder", "radius": 1.0, "height": 1.0, "cell_size": 1.0, "size": [1, 1, 1]},
        "size has no effect",
    ),
    "file": ({"file": "m.vtu", "cells": [1, 1, 1]}, "cells has no effect for a mesh from a file"),
}
VECTORS = [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -1e-3]]
PLANE = {"shape": "plane", "position": [0, 0, 0.2], "axis": [0, 0, -1], "by": [0, 0, -0.01]}
TOP, LIFT = {"where": {"z_min": 0.1}}, [0, 0, 0.01]
IDLE = {
    "newmark at rest": ({"solve": {"integrator": "newmark"}}, "'newmark' needs kind = 'dynamic', but kind = 'static'"),
    "reduced": ({"solve": {"reduced_tolerance": 0.1}}, "reduced_tolerance needs a reduced model"),
    "obstacle": (
        {"obstacle": [PLANE | {"history": VECTORS}], "solve": {"dt": 0.1}},
        "has both 'by' and a history of displ",
    ),
    "gravity": (
        {"body": {"density": 1.0, "gravity": [0, 0, 1], "history": VECTORS}, "solve": {"dt": 0.1}},
        "gravity and a history of gravity",
    ),
    "factors of no gravity": (
        {"body": {"density": 1.0, "history": [[0.0, 0.0], [1.0, 1.0]]}, "solve": {"dt": 0.1}},
        "factors that multiply gravity, but gravity is missing",
    ),
    "sliding": (
        {"displaced": [TOP | {"by": LIFT}], "support": [TOP | {"sliding": True}]},
        "moves node 1 out of the plane of support.0",
    ),
    "waves": (
        {
            "solve": {"kind": "harmonic", "frequencies": [1.0]},
            "body": {"density": 1.0},
            "output": {"fields": ["energy"]},
        },
        r"\[output\] fields cannot be used with",
    ),
    "masses of waves": (
        {"solve": {"kind": "harmonic", "frequencies": [1.0]}, "body": {"density": 1.0, "mass": "lumped"}},
        r"\[body\] mass = 'lumped' cannot be used with \[solve\] kind = 'harmonic', which uses consistent masses",
    ),
    "forces of waves": (
        {"solve": {"kind": "harmonic", "frequencies": [1.0]}, "body": {"density": 1.0}, "output": {"reactions": True}},
        r"\[output\] reactions cannot be used with",
    ),
}
CUBE = {
    "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1]},
    "law": {"name": "neo_hookean", "mu": 770.0, "bulk": 2200.0},
    "fixed": [{"where": {"z_max": 0.0}}],
}


@pytest.mark.parametrize("case", [*MESHES, *IDLE])
def test_settings_that_would_change_nothing_are_refused(case, tmp_path):
    write_mesh(tmp_path / "m.vtu", lj.shapes.box((1, 1, 1), (1, 1, 1)))
    change, words = ({"mesh": MESHES[case][0]}, MESHES[case][1]) if case in MESHES else IDLE[case]
    with pytest.raises(lj.InputError, match=words) as told:
        scene_from(CUBE | change, tmp_path)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    "mesh",
    [
        {"shape": "cylinder", "radius": 10.0, "height": 10.0, "cell_size": 0.002},
        {"shape": "cylinder", "radius": 10.0, "height": 10.0, "cell_size": 0.002, "match_area": True},
        {"shape": "cylinder", "radius": 0.01, "height": 0.01, "cell_size": 0.002, "rim_cell": 1e-9},
        {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1000, 1000, 1000]},
    ],
)
def test_meshes_that_no_memory_holds_are_refused(mesh):
    remedy = "give fewer cells" if mesh["shape"] == "box" else "use larger cells"
    with pytest.raises(lj.InputError, match=rf"would have about .* tetrahedra.*: {remedy}"):
        scene_from(CUBE | {"mesh": mesh})


def test_settings_that_do_something_are_taken():
    """Allowed are: motion in the plane of a sliding support, factors of given values, and no field of a wave."""
    for change in (
        {"displaced": [TOP | {"by": [0.01, 0, 0]}], "support": [TOP | {"sliding": True}]},
        {"displaced": [TOP | {"by": LIFT}], "support": [{"where": {"x_max": 0.0}, "sliding": True}]},
        {"obstacle": [PLANE | {"history": [[0, 0], [1, 1]]}], "solve": {"dt": 0.1}},
        {"solve": {"kind": "dynamic", "dt": 0.1, "integrator": "newmark"}, "body": {"density": 1.0}},
    ):
        scene_from(CUBE | change)
    assert output_of({"output": {"fields": ["energy", "energy"]}}) == (["energy"], False)
