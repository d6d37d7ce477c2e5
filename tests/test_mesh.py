"""Meshes: geometry, conformity, files, invalid input."""

from collections import Counter

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.files import meshio_cells
from liverjax.mesh.promotion import cubic
from liverjax.mesh.refinement import refined
from liverjax.mesh.selection import check_triangles
from liverjax.scenes.regions import select_elements
from liverjax.simulation.automatic import qualities
from liverjax.tensors.matrices import deformation_gradient, pack

SHAPES = {
    "box": lambda: lj.shapes.box((1.0, 2.0, 3.0), (2, 3, 4)),
    "cylinder": lambda: lj.shapes.cylinder(0.01, 0.004, 0.0025),
}


@pytest.mark.parametrize("name", SHAPES)
def test_generated_mesh_is_conforming(name):
    mesh = SHAPES[name]()
    lj.check_mesh(mesh)
    t = np.asarray(mesh.tetrahedra)
    faces = np.sort(np.concatenate([t[:, [0, 1, 2]], t[:, [0, 1, 3]], t[:, [0, 2, 3]], t[:, [1, 2, 3]]]), axis=1)
    count = Counter(map(tuple, faces))
    assert set(count.values()) == {1, 2}
    # Euler's formula for the boundary of a ball: triangles = 2 * (boundary nodes) - 4.
    outer = [f for f, n in count.items() if n == 1]
    assert len(outer) == 2 * len(np.unique(outer)) - 4


def test_a_set_without_nodes_or_elements_is_no_place():
    """Such a set fixed nothing, and the body fell freely, with status 0."""
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    mesh = replace(mesh, node_sets={"EMPTY": np.empty(0, int)}, element_sets={"EMPTY": np.empty(0, int)})
    with pytest.raises(lj.InputError, match="fixed: the node set 'EMPTY' of the mesh contains no node"):
        lj.boundary.select(mesh, None, "EMPTY", "fixed")
    with pytest.raises(lj.InputError, match="the element set 'EMPTY' of the mesh is empty"):
        select_elements(mesh, None, "EMPTY")


def test_volumes():
    assert np.isclose(SHAPES["box"]().volumes.sum(), 6.0, rtol=1e-14)
    # A regular polygon with 6 n corners has the area (6 n / 2) r^2 sin(2 pi / 6 n), of second order.
    for rings, size in ((4, 0.0025), (8, 0.00125)):
        corners = 6 * rings
        area = corners / 2 * 1e-4 * np.sin(2 * np.pi / corners)
        assert np.isclose(lj.shapes.cylinder(0.01, 0.004, size).volumes.sum(), area * 0.004, rtol=1e-13)


def test_refined_meshes_fill_the_same_body():
    """Each element becomes eight, the mesh is conforming, the volume is the same, and fixed faces and order are
    kept.
    """
    mesh = SHAPES["box"]()
    fine = lj.refined(mesh)
    lj.check_mesh(fine)
    assert fine.number_of_elements == 8 * mesh.number_of_elements
    assert np.isclose(fine.volumes.sum(), 6.0, rtol=1e-14) and fine.volumes.min() > 0
    for name, nodes in fine.node_sets.items():
        axis, side = "xyz".index(name[0]), {"min": 0.0, "max": [1.0, 2.0, 3.0]["xyz".index(name[0])]}[name[2:]]
        on_face = np.flatnonzero(np.isclose(np.asarray(fine.points)[:, axis], side))
        assert sorted(np.asarray(nodes)) == sorted(on_face)
    quadratic = lj.quadratic(mesh)
    np.testing.assert_array_equal(fine.points, quadratic.points)
    twice = lj.refined(quadratic)
    assert twice.order == 2
    np.testing.assert_array_equal(twice.points, lj.quadratic(fine).points)


def _quality(mesh):
    """Return volume over (mean square edge length)^(3/2) of each element (E,), 1 for a regular tetrahedron."""
    corners = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)]
    edges = [np.sum((corners[:, i] - corners[:, j]) ** 2, axis=1) for i in range(4) for j in range(i)]
    return np.asarray(mesh.volumes) * 6 * np.sqrt(2) / np.mean(edges, axis=0) ** 1.5


def test_elements_do_not_become_flatter_with_each_refinement():
    """The inner diagonal depended on the order of the corners, so that the worst element of a box lost half of its
    quality with each refinement.
    """
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    whole = _quality(mesh)
    for cells in (2, 4):
        mesh = lj.refined(mesh)
        np.testing.assert_allclose(_quality(mesh), whole[0], rtol=1e-12)
        same = lj.shapes.box((1.0, 1.0, 1.0), (cells,) * 3)  # also the same elements as a box with smaller cells
        a, b = (
            {tuple(sorted(map(tuple, np.round(m.points[t], 9)))) for t in m.tetrahedra}
            for m in map(_on_host, (mesh, same))
        )
        assert a == b
    # Elements of any shape, in any order of their corners
    rng = np.random.default_rng(1)
    for _ in range(20):
        points = rng.normal(size=(4, 3))
        corners = rng.permutation(4)
        positive = np.linalg.det(points[corners[1:]] - points[corners[0]]) > 0
        one = lj.tet_mesh(points, corners[None] if positive else corners[[1, 0, 2, 3]][None])
        first = lj.refined(one)
        assert _quality(first).min() > 0.6 * _quality(one).min()
        assert _quality(lj.refined(lj.refined(first))).min() > 0.9 * _quality(first).min()


def _on_host(mesh):
    return replace(mesh, points=np.asarray(mesh.points), tetrahedra=np.asarray(mesh.tetrahedra))


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_meshes_refined_near_nodes_are_whole(shape):
    """Refined twice at the edge of a fixed face: faces match, the body is the same, elements keep their shape, and
    fixed faces stay fixed.
    """
    mesh = SHAPES[shape]()
    mesh = replace(mesh, node_sets={"bottom": np.flatnonzero(np.isclose(np.asarray(mesh.points)[:, 2], 0.0))})
    surface = _area(mesh)
    for _ in range(2):
        near = lj.rim(mesh, mesh.node_sets["bottom"])
        fine = lj.refined(mesh, near=near)
        lj.check_mesh(fine)
        # With a hanging node on a neighbour's face, faces of one element only would be inside the body.
        assert np.isclose(_area(fine), surface, rtol=1e-12)
        assert np.isclose(fine.volumes.sum(), mesh.volumes.sum(), rtol=1e-13) and fine.volumes.min() > 0
        assert mesh.number_of_elements < fine.number_of_elements < 8 * mesh.number_of_elements
        before, after = (set(map(tuple, np.asarray(m.pattern.edges).T)) for m in (mesh, fine))
        assert not any(set(edge) & set(near.tolist()) for edge in before & after)
        bottom = np.flatnonzero(np.isclose(np.asarray(fine.points)[:, 2], 0.0))
        assert sorted(np.asarray(fine.node_sets["bottom"])) == sorted(bottom)
        # Bisection of the longest edge makes few shapes: the worst element loses less than half of its quality.
        quality = [qualities(np.asarray(m.points), np.asarray(m.tetrahedra), m.volumes).min() for m in (mesh, fine)]
        assert quality[1] > 0.5 * quality[0]
        mesh = fine
    assert lj.refined(lj.quadratic(SHAPES[shape]()), near=[0]).order == 2


def test_triangles_inside_the_body_are_refined():
    """Only the new surface was searched for parts of these triangles, so the refined set was empty."""
    none = replace(lj.shapes.box((1, 1, 1), (1, 1, 1)), triangle_sets={"none": np.zeros((0, 3), int)})
    assert lj.refined(none).triangle_sets["none"].shape == (0, 3)
    mesh = lj.shapes.box((3, 3, 3), (3, 3, 3))
    tets, centre = np.asarray(mesh.tetrahedra), np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)].mean(axis=1)
    brick = lj.tet_mesh(mesh.points, tets[np.all((centre > 1) & (centre < 2), axis=1)])
    skin = jnp.asarray(lj.boundary.boundary_triangles(brick))
    mesh = replace(mesh, triangle_sets={"tumour": skin}, node_sets={"tumour": jnp.unique(skin)})
    for near, count in ((None, 48), (skin[0], None)):
        fine = refined(mesh, near)
        parts = np.asarray(fine.points)[np.asarray(fine.triangle_sets["tumour"])]
        area = np.linalg.norm(np.cross(parts[:, 1] - parts[:, 0], parts[:, 2] - parts[:, 0]), axis=1).sum() / 2
        assert np.isclose(area, 6.0) and len(parts) == (count or len(parts))
    assert len(lj.quadratic(refined(mesh)).node_sets["tumour"]) == 98


def test_triangles_of_a_refined_surface_point_outward():
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
    top = lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_max"])
    fine = refined(replace(mesh, triangle_sets={"top": jnp.asarray(top)}))
    check_triangles(fine, fine.triangle_sets["top"], "top", outward=True)


def test_volume_ratios_of_cubic_elements_do_not_depend_on_the_order_of_corners():
    """The direction of functions on edges was not used at the vertices: J was -0.37 where it is 0.59."""
    corners, found = np.vstack([np.zeros(3), np.eye(3)]), []
    for order in ([0, 1, 2, 3], [3, 2, 1, 0]):
        mesh = cubic(lj.quadratic(lj.tet_mesh(corners, [order])))
        changed = 0.15 * np.random.default_rng(0).standard_normal((6, 3))
        x = np.asarray(mesh.points).copy()
        x[10:16] += changed  # the functions of order 3 on the edges
        found.append(np.asarray(volume_ratios(mesh, jnp.asarray(x)))[-4:, 0][np.argsort(order)])
    np.testing.assert_allclose(*found, rtol=1e-12)


def _area(mesh: lj.TetMesh) -> float:
    corners = np.asarray(mesh.points)[lj.boundary.boundary_triangles(mesh)]
    return float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())


def test_affine_field_has_its_gradient():
    mesh = SHAPES["cylinder"]()
    A = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.05, 0.0, 1.2]])
    F = pack(deformation_gradient(mesh, jnp.asarray(mesh.points @ A.T)))
    assert np.abs(np.asarray(F) - A).max() < 1e-12


def test_shape_vectors_follow_positions_under_grad():
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    grad = jax.grad(lambda p: lj.tet_mesh(p, mesh.tetrahedra).volumes.sum())(mesh.points)
    # d(volume)/d(scale) = 3 V.
    assert np.isclose((grad * mesh.points).sum(), 3.0)


@pytest.mark.parametrize("suffix", [".vtu", ".msh", ".vtk"])
def test_files_keep_geometry_and_node_sets(tmp_path, suffix):
    mesh = SHAPES["box"]()
    path = tmp_path / f"mesh{suffix}"
    lj.write_mesh(path, mesh)
    back = lj.read_mesh(path, unit="mm")
    assert np.allclose(back.points, 1e-3 * mesh.points, rtol=1e-12)
    assert np.array_equal(back.tetrahedra, mesh.tetrahedra)
    assert np.array_equal(back.node_sets["z_max"], mesh.node_sets["z_max"])


@pytest.mark.parametrize("order", [1, 2])
def test_nodes_of_a_file_without_a_tetrahedron_are_left_out(tmp_path, order):
    mesh = SHAPES["box"]() if order == 1 else lj.quadratic(SHAPES["box"]())
    kind, cells = meshio_cells(mesh)
    points = np.insert(np.asarray(mesh.points), 2, [[9.0, 9.0, 9.0]], axis=0)  # as the centre of an arc
    cells = np.where(cells >= 2, cells + 1, cells)
    top = np.flatnonzero(points[:, 2] == np.asarray(mesh.points)[:, 2].max())
    sets = {"set:top": np.isin(np.arange(len(points)), [2, *top]).astype(int), "set:arc": np.eye(len(points))[2]}
    meshio.Mesh(points, [(kind, cells)], point_data=sets).write(tmp_path / "mesh.vtu")
    with pytest.warns(UserWarning, match="1 nodes belong to no tetrahedron"):
        back = lj.read_mesh(tmp_path / "mesh.vtu")
    assert np.array_equal(back.points, mesh.points)
    assert np.array_equal(back.element_nodes_on_host, mesh.element_nodes_on_host)
    assert np.array_equal(back.node_sets["top"], np.where(top > 2, top - 1, top))
    assert len(back.node_sets["arc"]) == 0


def _refused(match, make):
    with pytest.raises(lj.InputError, match=match) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_refusals(tmp_path):
    points, tets = np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3]])
    inverted = lj.tet_mesh(points, tets[:, [0, 2, 1, 3]])
    _refused("1 of 1 tetrahedra are flat or inverted", lambda: lj.check_mesh(inverted))
    _refused("largest number 7, number of nodes", lambda: lj.check_mesh(lj.tet_mesh(points, [[0, 1, 2, 7]])))
    _refused("no tetrahedron", lambda: lj.check_mesh(lj.tet_mesh(np.vstack([points, [5, 5, 5]]), tets)))
    _refused("finite coordinates", lambda: lj.check_mesh(lj.tet_mesh(points * np.nan, tets)))
    _refused("does not exist", lambda: lj.read_mesh(tmp_path / "none.vtu"))
    _refused("is a folder", lambda: lj.read_mesh(tmp_path))
    _refused("unit = 'inch'", lambda: lj.read_mesh(tmp_path / "none.vtu", unit="inch"))
    (tmp_path / "junk.vtu").write_text("not a mesh")
    _refused("cannot be read by meshio", lambda: lj.read_mesh(tmp_path / "junk.vtu"))
    (tmp_path / "junk.xyz").write_text("not a mesh")
    _refused("cannot be read by meshio", lambda: lj.read_mesh(tmp_path / "junk.xyz"))
    _refused("radius = -1", lambda: lj.shapes.cylinder(-1.0, 1.0, 0.1))
    _refused("cells", lambda: lj.shapes.box((1.0, 1.0, 1.0), (1, 0, 1)))
    _refused("give fewer cells", lambda: lj.shapes.box((1.0, 1.0, 1.0), (10**300,) * 3))
    import meshio

    meshio.Mesh(points, [("triangle", tets[:, :3])]).write(tmp_path / "surface.vtu")
    _refused("contains triangle but no linear or quadratic tetrahedra", lambda: lj.read_mesh(tmp_path / "surface.vtu"))


def test_copies_other_cells_and_millimetres_are_told(tmp_path):
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    twice = lj.tet_mesh(points, np.concatenate([tets, tets[:1, [1, 2, 0, 3]]]))
    with pytest.raises(lj.InputError, match="1 tetrahedra occur twice"):
        lj.check_mesh(twice)
    cells = [("tetra", tets), ("hexahedron", np.array([[0, 1, 2, 3, 4, 5, 6, 7]]))]
    meshio.Mesh(points, cells).write(tmp_path / "mixed.vtk")
    with pytest.raises(lj.InputError, match="contains hexahedron in addition to linear tetrahedra"):
        lj.read_mesh(tmp_path / "mixed.vtk")
    meshio.Mesh(280 * points, [("tetra", tets), ("triangle", tets[:1, :3])]).write(tmp_path / "large.vtk")
    with pytest.warns(UserWarning, match="280 m long: if the coordinates are in millimetres, write unit = 'mm'"):
        lj.read_mesh(tmp_path / "large.vtk")
    assert np.isclose(float(lj.read_mesh(tmp_path / "large.vtk", "mm").volumes.sum()), 0.28**3)


def test_a_bound_in_millimetres_is_told():
    """This bound would exclude nothing and select the whole mesh. A bound far outside is a common way to select
    everything. A bound of 0.5 in a small body was not told.
    """
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
    with pytest.warns(UserWarning, match=r"where: z_max = 50 m excludes no node.*write 0.05 if you meant mm"):
        assert len(lj.boundary.select(mesh, {"z_max": 50})) == 27
    for where in ({"z_min": -1.0}, {"z_max": 1e3}, {"x_max": 0.2}):
        assert len(lj.boundary.select(mesh, where)) == 27
    small = lj.shapes.box((0.004, 0.004, 0.004), (2, 2, 2))
    with pytest.warns(UserWarning, match=r"where: z_max = 0.5 m excludes no node.*write 0.0005 if you meant mm"):
        assert len(lj.boundary.select(small, {"z_max": 0.5})) == 27
    assert len(lj.boundary.select(small, {"z_max": 0.005, "y_max": 1.0})) == 27


@pytest.mark.parametrize("top", [[0.2, 0.2, 2.0], [0.2, 0.2, 0.5]], ids=["around", "inside"])
def test_elements_on_one_side_of_a_face_are_refused(top):
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], top])
    with pytest.raises(lj.InputError, match=r"1 faces have two tetrahedra on the same side .*of element 0"):
        lj.check_mesh(lj.tet_mesh(corners, np.array([[0, 1, 2, 3], [0, 1, 2, 4]])))
    # The other side of the face z = 0 is free.
    lj.check_mesh(
        lj.tet_mesh(corners - 2.5 * np.eye(5)[4][:, None] * [0, 0, 1], np.array([[0, 1, 2, 3], [0, 2, 1, 4]]))
    )


#: Name of a file -> its text and a part of the message. Gmsh's manual, "MSH file format version 1 (Legacy)".
FOREIGN = {
    "old.msh": (
        "$NOD\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n$ENDNOD\n$ELM\n1\n1 4 1 1 4 1 2 3 4\n$ENDELM\n",
        r"Gmsh's format of version 1 \(\$NOD, \$ELM\).*open it in Gmsh and save it as version 4",
    ),
    "surface.vtk": (
        "# vtk DataFile Version 3.0\nsurface\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n0 0 0 1 0 0 0 1 0\n"
        "POLYGONS 1 4\n3 0 1 2\n",
        "VTK polygons.*fill the surface with tetrahedra",
    ),
    "surface.vtp": ('<?xml version="1.0"?>\n<VTKFile type="PolyData" version="0.1"/>\n', "VTK polygons"),
    "junk.msh": ("not a mesh\n", r"the content is not in the format of \.msh files"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_files_are_named_and_nothing_else_is_printed(name, tmp_path, capsys):
    text, sentence = FOREIGN[name]
    (tmp_path / name).write_text(text)
    _refused(sentence, lambda: lj.read_mesh(tmp_path / name))
    printed = capsys.readouterr()
    assert printed.out == printed.err == ""


def test_a_gmsh_file_is_read_without_a_word(tmp_path, capsys):
    lj.write_mesh(tmp_path / "box.msh", lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1)))
    capsys.readouterr()
    lj.read_mesh(tmp_path / "box.msh")
    printed = capsys.readouterr()
    assert printed.out == printed.err == ""


def test_nodes_just_beyond_a_bound_are_told():
    """A bound of six digits missed all nodes at 1/30 m without a word."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (3, 3, 3))
    with pytest.warns(UserWarning, match=r"does not select 16 nodes that lie up to 3e-08 m beyond a bound"):
        nodes = lj.boundary.select(mesh, {"x_max": 0.0333333})
    assert len(nodes) == 16  # the contract stays exact
    assert len(lj.boundary.select(mesh, {"x_max": 0.0334})) == 32
