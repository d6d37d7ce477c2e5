"""Graded cylinders and their sectors: positions of rings and layers, areas, conformity, quality."""

from collections import Counter

import numpy as np
import pytest

import liverjax as lj
from liverjax.mesh import cylinders
from liverjax.mesh.shapes import cylinder
from liverjax.simulation.automatic import qualities

pytestmark = pytest.mark.quick_to_compile


def _surface(mesh):
    t = np.asarray(mesh.tetrahedra)
    faces = np.sort(np.concatenate([t[:, f] for f in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3])]), axis=1)
    count = Counter(map(tuple, faces))
    assert set(count.values()) == {1, 2}
    return [f for f, n in count.items() if n == 1]


def _whole(aspect, ring, rim):
    return cylinder(1.0, aspect, 0.33, rim_cell=rim, rings=(ring,), match_area=True)


@pytest.mark.parametrize("aspect", [0.2, 1.0, 5.0])
@pytest.mark.parametrize(("ring", "rim"), [(0.4, 0.05), (0.05, 0.02), (0.9, 0.01)])
def test_graded_cylinders_conform_and_have_the_circles_area(aspect, ring, rim):
    mesh = _whole(aspect, ring, rim)
    lj.check_mesh(mesh)
    outer = np.array(_surface(mesh))
    # Euler's formula for the boundary of a ball: triangles = 2 * (boundary nodes) - 4.
    assert len(outer) == 2 * len(np.unique(outer)) - 4
    assert np.isclose(mesh.volumes.sum(), np.pi * aspect, rtol=1e-12)
    # The polygon of the ring has the area of the circle of that radius, so its triangles on the top have this area too.
    points, top = np.asarray(mesh.points), mesh.node_sets["top"]
    assert np.allclose(points[top, 2], aspect) and np.allclose(points[mesh.node_sets["bottom"], 2], 0)
    distance = np.hypot(*points[top, :2].T)
    ends = np.flatnonzero(np.diff(distance) > 1e-9)
    on_top = outer[np.isin(outer, top).all(axis=1)]
    a, b, c = points[on_top][..., :2].transpose(1, 0, 2)
    areas = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    inside = [areas[np.isin(on_top, top[: e + 1]).all(axis=1)].sum() for e in ends]
    assert np.min(np.abs(np.array(inside) - np.pi * ring**2)) < 1e-12


@pytest.mark.parametrize("aspect", [0.2, 1.0, 5.0])
def test_elements_keep_their_shape(aspect):
    """Where the widest ring meets two thin ones, the quality falls with the square of their ratio."""
    for rim in (0.33, 0.05):
        mesh = _whole(aspect, 0.4, rim)
        quality = qualities(np.asarray(mesh.points), np.asarray(mesh.tetrahedra), np.asarray(mesh.volumes))
        # Volume h h L / 6, and three of six edges of length L give 4 (h / L)^2. A third of a regular prism has about
        # 0.6.
        assert quality.min() > min(0.5, 4 * (rim / 0.33) ** 2) and np.median(quality) > 0.3


def test_places_are_where_they_were_asked_for():
    for length, cells in ((1.0, {0.4: 0.01, 1.0: 0.05}), (5.0, {0.0: 0.02, 5.0: 1e-4}), (1.0, {1.0: 1.0})):
        x = cylinders.graded(length, cells, 0.5)
        assert x[0] == 0 and x[-1] == length and np.diff(x).max() <= 0.5 * (1 + 1e-3)
        for place, size in cells.items():
            assert np.any(x == place)
            near = np.diff(x)[
                [k for k in (np.argmin(abs(x - place)) - 1, np.argmin(abs(x - place))) if 0 <= k < len(x) - 1]
            ]
            # Within a cell the wanted size varies by at most exp(GROWTH).
            assert np.all(near < size * np.exp(cylinders.GROWTH) * 1.01)


@pytest.mark.parametrize(("corners", "slices"), [(24, 1), (16, 4), (5, 2)])
def test_a_sector_is_its_part_of_the_whole(corners, slices):
    found = cylinders.sector([0.0, 0.3, 0.5, 0.51], [0.0, 0.1, 0.4], corners, slices)
    mesh, points = found.mesh, np.asarray(found.mesh.points)
    lj.check_mesh(mesh)
    outer = _surface(mesh)
    assert len(outer) == 2 * len(np.unique(outer)) - 4
    assert np.isclose(mesh.volumes.sum() * found.parts, np.pi * 0.51**2 * 0.4, rtol=1e-12)
    sets = {name: np.asarray(nodes) for name, nodes in mesh.node_sets.items()}
    for name, off in {
        "start": points[:, 1],
        "end": points @ found.normal,
        "axis": np.hypot(*points[:, :2].T),
        "bottom": points[:, 2],
        "top": points[:, 2] - 0.4,
        "mantle": np.hypot(*points[:, :2].T) - 0.51 * found.stretch,
    }.items():
        assert set(sets[name]) == set(np.flatnonzero(np.abs(off) < 1e-14)), name


def test_default_numbers_are_those_of_always():
    """Options do not change the default mesh. These sums over positions and elements are from before there were
    options.
    """
    mesh = cylinder(0.01, 0.004, 0.0025)
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    assert points.shape == (183, 3) and tets.shape == (576, 4)
    assert np.isclose(np.sum(points * np.sqrt(np.arange(549).reshape(183, 3))), 6.7126336648132545, rtol=1e-14)
    assert np.sum(tets * np.arange(2304).reshape(576, 4) % 97) == 108199


SCENE = """
[mesh]
shape = "cylinder"
radius = 10.0
height = 5.0
cell_size = 4.0
unit = "mm"
{more}
[law]
name = "neo_hookean"
mu = 1.0
bulk = 3.0
[[fixed]]
where = {{z_max = 0.0}}
"""


def test_scene_files_make_the_same_cylinders(tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text(SCENE.format(more="rim_cell = 1.0\nrings = [4.0]\nmatch_area = true"))
    mesh, same = lj.load_scene(file).mesh, cylinder(0.01, 0.005, 0.004, 0.001, (0.004,), True)
    assert np.array_equal(mesh.tetrahedra, same.tetrahedra) and np.allclose(mesh.points, same.points, rtol=1e-14)
    for more, words in (("rings = [40.0]", "rings"), ("match_area = 3", "match_area"), ("rim_cell = 0", "rim_cell")):
        file.write_text(SCENE.format(more=more))
        with pytest.raises(lj.InputError, match=words):
            lj.load_scene(file)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cylinder(1.0, 1.0, 0.3, rings=(1.2,)), "rings"),
        (lambda: cylinder(1.0, 1.0, 0.3, rim_cell=-0.1), "rim_cell"),
        (lambda: cylinders.graded_cylinder([0.0, 0.5, 0.4], [0.0, 1.0]), "radii"),
        (lambda: cylinders.graded_cylinder([0.1, 0.5], [0.0, 1.0]), "begin with 0"),
        (lambda: cylinders.graded_cylinder([0.0, 0.5], [1.0]), "heights"),
        (lambda: cylinders.sector([0.0, 1.0], [0.0, 1.0], 8, 4), "slices = 4"),
    ],
)
def test_bad_places_are_one_sentence(make, words):
    with pytest.raises(lj.InputError, match=words):
        make()
