"""Files and scenes of quadratic elements."""

import meshio
import numpy as np
import pytest
from test_quadratic import MESH

import liverjax as lj
from liverjax.core.struct import replace

pytestmark = pytest.mark.quick_to_compile


def test_vtu_and_gmsh_keep_quadratic_elements(tmp_path):
    for name in ("body.vtu", "body.msh"):
        lj.write_mesh(tmp_path / name, MESH)
        found = lj.read_mesh(tmp_path / name)
        assert found.order == 2 and np.allclose(found.points, MESH.points, atol=1e-15)
        for a, b in zip(found.element_nodes, MESH.element_nodes, strict=True):
            assert np.array_equal(a, b)
    kept = lj.read_mesh(tmp_path / "body.vtu").node_sets["x_min"]
    assert np.array_equal(kept, np.sort(MESH.node_sets["x_min"]))


def test_a_curved_file_is_made_straight_and_said(tmp_path):
    lj.write_mesh(tmp_path / "body.vtu", MESH)
    data = meshio.read(tmp_path / "body.vtu")
    data.points[-1] += [0, 0, 1e-4]
    data.write(tmp_path / "curved.vtu")
    with pytest.warns(UserWarning, match="1 midside nodes lie up to 0.0001 m off their straight edges"):
        found = lj.read_mesh(tmp_path / "curved.vtu")
    assert np.allclose(found.points, MESH.points, atol=1e-15)


@pytest.mark.parametrize("rounded", [False, True])
def test_middles_in_another_order_are_refused(rounded, tmp_path):
    """Gmsh and VTK number the last two edges in opposite order. Without a check, "curved" middle nodes were reported.
    Rounded coordinates gave this warning in both orders.
    """
    lj.write_mesh(tmp_path / "body.vtu", MESH)
    data = meshio.read(tmp_path / "body.vtu")
    moved = data.points + np.array([0.11, -0.36, 0.21])
    data.points = moved.astype(np.float32) if rounded else data.points
    data.write(tmp_path / "body.vtu")
    assert lj.read_mesh(tmp_path / "body.vtu").order == 2  # without a warning
    cells = data.cells[0].data.copy()
    for kept, words in (
        (0, "not in the order of the file format"),
        (len(cells) - 1, r"the node at \[0\.\d+, .* m is the middle node of two"),
    ):
        data.cells[0].data[:] = cells
        data.cells[0].data[kept:, [8, 9]] = cells[kept:, [9, 8]]
        data.write(tmp_path / "swapped.vtu")
        with pytest.raises(lj.InputError, match=words):
            lj.read_mesh(tmp_path / "swapped.vtu")


def test_a_scene_file_asks_for_the_order(tmp_path):
    table = {"shape": "box", "size": [0.01, 0.01, 0.01], "cells": [1, 1, 1]}
    content = {"law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0}, "fixed": [{"where": {"z_max": 0.0}}]}
    scene = lj.scenes.scene_file.scene_from(content | {"mesh": table | {"order": 2}})
    assert scene.mesh.order == 2 and len(scene.fixed[0].nodes) == 9
    with pytest.raises(lj.InputError, match=r"\[mesh\] order = 3 is not known: use 1"):
        lj.scenes.scene_file.scene_from(content | {"mesh": table | {"order": 3}})
    lj.write_mesh(tmp_path / "body.vtu", MESH)
    with pytest.raises(lj.InputError, match="order = 1, but the file contains quadratic"):
        lj.scenes.scene_file.scene_from(content | {"mesh": {"file": str(tmp_path / "body.vtu"), "order": 1}})


@pytest.mark.parametrize("suffix", [".mesh", ".xdmf"])
def test_quadratic_meshes_are_not_written_in_formats_without_them(suffix, tmp_path):
    """The file had no tetrahedra, or could not be read again."""
    mesh = lj.shapes.box((1, 1, 1), (1, 1, 1))
    mesh = lj.quadratic(replace(mesh, triangle_sets={"all": lj.boundary.boundary_triangles(mesh, np.arange(8))}))
    with pytest.raises(lj.InputError, match=f"quadratic mesh cannot be written in the format {suffix}: write a .vtu"):
        lj.write_mesh(tmp_path / f"body{suffix}", mesh)
    assert not list(tmp_path.iterdir())
