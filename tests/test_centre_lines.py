"""Centre lines and radii from surfaces of tubes: straight, bent, open, closed, a fork; and vessels from a file."""

import meshio
import numpy as np
import pytest

import liverjax as lj
from liverjax.physics.attached.centre_lines import centre_lines
from liverjax.scenes.scene_file import scene_from

RADIUS, LENGTH = 3e-3, 0.1


def tube(path, corners=16, closed=False, radius=RADIUS):
    """Return points and triangles of a tube along a path (n, 3)."""
    t = np.gradient(path, axis=0)
    u = np.cross(t, [0.1, 0.2, 1.0])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(t, u)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    a = np.linspace(0, 2 * np.pi, corners, endpoint=False)[None, :, None]
    points = path[:, None] + radius * (np.cos(a) * u[:, None] + np.sin(a) * v[:, None])
    here = np.arange(len(path) * corners).reshape(len(path), corners)
    after = np.roll(here, -1, axis=1)
    quads = [here[:-1], after[:-1], here[1:], after[1:]]
    a, b, c, d = (q.ravel() for q in quads)
    triangles = [np.stack([a, b, c], 1), np.stack([b, d, c], 1)]
    points = points.reshape(-1, 3)
    if closed:
        n = len(points)
        points = np.concatenate([points, path[[0, -1]]])
        for tip, ring in ((n, here[0]), (n + 1, here[-1])):
            triangles.append(np.stack([np.full(corners, tip), ring, np.roll(ring, -1)], 1))
    return points, np.concatenate(triangles)


def straight():
    s = np.linspace(0, LENGTH, 60)
    return np.stack([s, 0 * s, 0 * s], axis=1)


def bent():
    s = np.linspace(0, LENGTH, 60) / 0.06
    return 0.06 * np.stack([np.cos(s), np.sin(s), 0 * s], axis=1)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("path", [straight, bent])
@pytest.mark.parametrize("corners", [16, 32])
def test_a_tube_has_its_length_and_radius(path, closed, corners):
    found = centre_lines(*tube(path(), corners, closed))
    length = np.linalg.norm(found.end - found.begin, axis=1)
    assert length.sum() == pytest.approx(LENGTH, rel=0.015)
    assert np.sum(length * found.radius) / length.sum() == pytest.approx(RADIUS, rel=0.02)
    # The pieces of the centre line are on the path.
    far = np.linalg.norm(found.begin[:, None] - np.array(path())[None], axis=2).min(axis=1)
    assert far.max() < 0.4 * RADIUS


@pytest.mark.parametrize(("length", "rings", "closed"), [(20, 4, False), (10, 2, False), (5, 2, True)])
def test_a_tube_with_one_ring_left_is_refused(length, rings, closed):
    """Long triangles leave one ring. Half of the centre line was lost, and the other half left the tube."""
    path = np.linspace(0, length, rings)[:, None] * np.array([[1.0, 0.0, 0.0]])
    with pytest.raises(lj.InputError, match="too short or too coarse"):
        centre_lines(*tube(path, 12 if rings == 4 else 24, closed, radius=1.0))


@pytest.mark.parametrize(("length", "rings"), [(2, 9), (3, 13)])
def test_a_tube_shorter_than_its_rings_is_refused(length, rings):
    """All lines of equal distance end at the open ends. They counted as rings, and eight pieces left the tube."""
    path = np.linspace(0, length, rings)[:, None] * np.array([[1.0, 0.0, 0.0]])
    with pytest.raises(lj.InputError, match="too short or too coarse"):
        centre_lines(*tube(path, 24, False, radius=1.0))


@pytest.mark.parametrize("hole", [False, True])
def test_an_oblique_end_and_a_hole_change_no_radius(hole):
    """Lines that end at the border of an oblique end have centres near the wall. The last radius was 22 % too small."""
    points, triangles = tube(np.linspace(0, 20, 81)[:, None] * np.array([[1.0, 0.0, 0.0]]), 24, False, radius=1.0)
    points[:, 0] += 2 * points[:, 1] * points[:, 0] / 20
    if hole:
        triangles = np.delete(triangles, np.flatnonzero(triangles[:, 0] == 40 * 24 + 5), axis=0)
    found = centre_lines(points, triangles)
    np.testing.assert_allclose(found.radius, 1.0, rtol=0.05)


def test_a_narrowing_tube_narrows():
    path = straight()
    radius = np.linspace(2, 1, len(path))[:, None, None] * RADIUS
    found = centre_lines(*tube(path, 24, True, radius))
    at = 0.5 * (found.begin + found.end)[:, 0] / LENGTH
    inner = (at > 0.1) & (at < 0.9)
    np.testing.assert_allclose(found.radius[inner], (2 - at[inner]) * RADIUS, rtol=0.05)


def test_tubes_apart_have_lines_apart():
    one, two = tube(straight()), tube(straight() + np.array([0.0, 0.02, 0.0]))
    both = np.concatenate([one[0], two[0]]), np.concatenate([one[1], two[1] + len(one[0])])
    found = centre_lines(*both)
    assert np.linalg.norm(found.end - found.begin, axis=1).sum() == pytest.approx(2 * LENGTH, rel=0.01)


def test_a_ring_closes():
    """Two branches leave the first band and meet at the far side."""
    around = 0.02 * np.stack([np.cos(a := np.linspace(0, 2 * np.pi, 61)[:-1]), np.sin(a), 0 * a], axis=1)
    corners = 16
    points = np.concatenate([_ring(x, corners) for x in around])
    here = np.arange(len(points)).reshape(len(around), corners)
    after, up = np.roll(here, -1, axis=1), np.roll(here, -1, axis=0)
    both = np.roll(after, -1, axis=0)
    triangles = np.concatenate(
        [np.stack([q.ravel() for q in three], 1) for three in ((here, after, up), (after, both, up))]
    )
    found = centre_lines(points, triangles)
    assert np.linalg.norm(found.end - found.begin, axis=1).sum() == pytest.approx(0.04 * np.pi, rel=0.1)
    assert np.median(found.radius) == pytest.approx(RADIUS, rel=0.05)


def _ring(x, corners):
    """Return points around a cross-section; the centre line is a circle about the origin."""
    out, a = x / np.linalg.norm(x), np.linspace(0, 2 * np.pi, corners, endpoint=False)[:, None]
    return x + RADIUS * (np.cos(a) * out + np.sin(a) * np.array([0.0, 0.0, 1.0]))


# scikit-image 0.26 sets shapes in a way that NumPy 2.5 deprecates.
@pytest.mark.filterwarnings("ignore:Setting the shape:DeprecationWarning")
def test_a_fork_has_three_branches():
    measure = pytest.importorskip("skimage.measure", reason="the surface of a fork needs scikit-image")
    h = 5e-4
    axes = [np.arange(-25e-3, 25e-3, h), np.arange(-25e-3, 25e-3, h), np.arange(-8e-3, 8e-3, h)]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def distance(a, b):
        along = np.array(b) - np.array(a)
        part = np.clip((at - a) @ along / (along @ along), 0, 1)
        return np.linalg.norm(at - a - part[..., None] * along, axis=-1)

    arms = (((-20e-3, 0, 0), 3e-3), ((15e-3, 12e-3, 0), 2.5e-3), ((15e-3, -12e-3, 0), 2e-3))
    field = np.min([distance((0.0, 0.0, 0.0), end) - radius for end, radius in arms], axis=0)
    points, triangles, *_ = measure.marching_cubes(field, 0, spacing=(h,) * 3)
    found = centre_lines(points + [a[0] for a in axes], triangles)
    exact = sum(np.linalg.norm(end) + radius for end, radius in arms)
    assert np.linalg.norm(found.end - found.begin, axis=1).sum() == pytest.approx(exact, rel=0.03)
    for end, radius in arms:
        far = np.linalg.norm(0.5 * (found.begin + found.end) - 0.7 * np.array(end), axis=1)
        assert found.radius[np.argmin(far)] == pytest.approx(radius, rel=0.12)


WALL = {"name": "neo_hookean", "mu": 1e5}


def content(**vessel):
    return {
        "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [2, 2, 2]},
        "law": {"name": "neo_hookean", "mu": 770.0, "bulk": 2200.0},
        "fixed": [{"where": {"x_max": 0.0}}],
        "vessel": [vessel],
    }


def written(folder, scale=1.0, closed=True):
    """Write an STL file as segmentation tools do: triangles do not share points."""
    points, triangles = tube(straight() + np.array([-0.02, 0.045, 0.055]), 16, closed)
    path = folder / "tube.stl"
    own = np.arange(3 * len(triangles)).reshape(-1, 3)
    meshio.Mesh(points[triangles].reshape(-1, 3) / scale, [("triangle", own)]).write(path, binary=True)
    return path


@pytest.mark.parametrize("unit, scale", [("m", 1.0), ("mm", 1e-3)])
def test_a_vessel_from_a_file_is_the_one_along_its_line(tmp_path, unit, scale):
    written(tmp_path, scale)
    found = scene_from(content(surface="tube.stl", unit=unit, wall=5e-4, law=WALL), tmp_path).physics[0]
    line = [[-0.02, 0.045, 0.055], [0.08, 0.045, 0.055]]
    hand = scene_from(content(line=line, radius=RADIUS, wall=5e-4, law=WALL)).physics[0]

    def steel(vessel, mesh):
        """Return the sum of length times section of the pieces in the body."""
        corners = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)[np.asarray(vessel.element)]]
        along = np.einsum("am,mai->mi", np.asarray(vessel.leaves - vessel.enters), corners)
        return np.sum(np.linalg.norm(along, axis=1) * np.asarray(vessel.area()))

    mesh = scene_from(content(line=line, radius=RADIUS, law=WALL)).mesh
    assert steel(found, mesh) == pytest.approx(steel(hand, mesh), rel=0.03)
    given = scene_from(content(surface=str(tmp_path / "tube.stl"), unit=unit, radius=2e-3, law=WALL)).physics[0]
    assert set(np.asarray(given.radius).tolist()) == {2e-3}


@pytest.mark.parametrize(
    "table, words",
    [
        ({"surface": "none.stl"}, "vessel.0 surface .* cannot be read"),
        ({"surface": "tube.stl", "line": [[0, 0, 0], [0, 0, 1]]}, "needs line .* or surface"),
        ({"surface": "tube.stl", "unit": "inch"}, "unit = 'inch' is not known"),
        ({"surface": 3}, "must name a file"),
        ({"surface": "tube.stl", "radius": [1e-3, 2e-3]}, "one number in m"),
        ({"surface": "lump.stl"}, "too short or too coarse"),
        ({"surface": "words.stl"}, "cannot be read|no triangles"),
    ],
)
def test_surfaces_that_are_no_vessels_get_one_sentence(tmp_path, table, words):
    written(tmp_path)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
    meshio.Mesh(corners, [("triangle", faces)]).write(tmp_path / "lump.stl", binary=True)
    (tmp_path / "words.stl").write_text("no surface at all\n")
    with pytest.raises(lj.InputError, match=words) as told:
        scene_from(content(law=WALL, **table), tmp_path)
    assert "\n" not in str(told.value)
