"""Named groups of triangles and cells in files of meshes."""

import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.mesh.files import meshio_cells
from liverjax.mesh.refinement import refined


def _with_surface(file, order: int, cells: str, names: dict, **more) -> lj.TetMesh:
    """Write a cube with its lower face as triangles, grouped and named as by Gmsh, and read it again."""
    mesh = lj.shapes.box((1, 1, 1), (2, 2, 2))
    triangles = lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_min"])
    if order == 2:
        mesh = lj.quadratic(mesh)
        ends = np.sort(triangles[:, [[0, 1], [1, 2], [0, 2]]], axis=2)
        edges = {tuple(e): mesh.number_of_vertices + k for k, e in enumerate(np.asarray(mesh.pattern.edges).T.tolist())}
        middles = [[edges[tuple(e)] for e in three] for three in ends.tolist()]
        triangles = np.hstack([triangles, middles]) if cells == "triangle6" else triangles
    blocks, count = [(cells, triangles), meshio_cells(mesh)], mesh.number_of_elements
    groups = {
        key: [np.full(len(triangles), k), np.full(count, 3)]
        for key, k in (("gmsh:physical", 7), ("gmsh:geometrical", 1))
    }
    meshio.Mesh(np.asarray(mesh.points), blocks, cell_data=groups, field_data=names, **more).write(file, "gmsh22")
    return lj.read_mesh(file)


@pytest.mark.parametrize("order, cells", [(1, "triangle"), (2, "triangle6"), (2, "triangle")])
def test_a_named_group_of_triangles_is_a_place(order, cells, tmp_path):
    """The set contains all nodes of the face, also middle nodes that the file has in the tetrahedra only."""
    names = {"bottom": np.array([7, 2]), "liver": np.array([3, 3])}
    mesh = _with_surface(tmp_path / "m.msh", order, cells, names)
    below = np.flatnonzero(np.asarray(mesh.points)[:, 2] == 0)
    assert len(below) == (9 if order == 1 else 25)
    assert sorted(np.asarray(mesh.node_sets["bottom"]).tolist()) == below.tolist()
    assert len(mesh.element_sets["liver"]) == 48 and "bottom" not in mesh.element_sets
    assert set(_with_surface(tmp_path / "m.msh", order, cells, {}).node_sets) == set()


@pytest.mark.parametrize("order, cells", [(1, "triangle"), (2, "triangle6")])
def test_a_load_on_a_group_of_triangles_leaves_others_between_its_nodes_alone(order, cells, tmp_path):
    """The plate is one cell thick. The group of its two faces contains all nodes of the rim, but no triangle of the
    rim.
    """
    mesh = lj.shapes.box((0.2, 0.2, 0.01), (4, 4, 1))
    z = np.asarray(mesh.points)[:, 2]
    outer = lj.boundary.boundary_triangles(mesh)
    faces = outer[np.ptp(z[outer], axis=1) < 1e-6]
    if order == 2:
        mesh = lj.quadratic(mesh)
        edges = {tuple(e): mesh.number_of_vertices + k for k, e in enumerate(np.asarray(mesh.pattern.edges).T.tolist())}
        pairs = np.sort(faces[:, [[0, 1], [1, 2], [0, 2]]], axis=2).tolist()
        faces = np.hstack([faces, [[edges[tuple(e)] for e in three] for three in pairs]])
    blocks, count = [(cells, faces), meshio_cells(mesh)], mesh.number_of_elements
    groups = {key: [np.full(len(faces), 7), np.full(count, 3)] for key in ("gmsh:physical", "gmsh:geometrical")}
    names = {"faces": np.array([7, 2])}
    meshio.Mesh(np.asarray(mesh.points), blocks, cell_data=groups, field_data=names).write(tmp_path / "m.msh", "gmsh22")
    read = lj.read_mesh(tmp_path / "m.msh")
    assert set(range(read.number_of_vertices)) <= set(np.asarray(read.node_sets["faces"]).tolist())
    for own in (read, refined(read)):
        triangles = lj.boundary.surface_of(own, own.node_sets["faces"], "faces")
        assert len(triangles) == 64 * (1 if own is read else 4)
        load = lj.Traction(triangles=jnp.asarray(triangles), value=jnp.array([0.0, 0.0, 0.1]))
        force = np.asarray(lj.boundary.nodal_tractions(own, (load,)))
        assert np.allclose(force.sum(axis=0), [0, 0, 2 * 0.2**2 * 0.1], rtol=1e-12, atol=1e-15)


#: Two tetrahedra; the second one and the first triangle are in two groups.
_OVERLAP = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
4
2 1 "low"
2 2 "outer"
3 7 "stiff"
3 8 "organ"
$EndPhysicalNames
$Entities
0 0 2 2
1 0 0 0 1 1 0 2 1 2 0
2 0 0 0 1 1 1 1 2 0
1 0 0 0 1 1 1 1 8 0
2 0 0 0 1 1 1 2 7 8 0
$EndEntities
$Nodes
1 5 1 5
3 1 0 5
1
2
3
4
5
0 0 0
1 0 0
0 1 0
0 0 1
1 1 1
$EndNodes
$Elements
4 4 1 4
2 1 2 1
1 1 2 3
2 2 2 1
2 2 3 5
3 1 4 1
3 1 2 3 4
3 2 4 1
4 2 3 4 5
$EndElements
"""


def test_cells_in_several_groups_of_gmsh_are_in_all_of_them(tmp_path):
    """meshio gives each cell the number of its first group only. Half of the organ was lost without a message."""
    (tmp_path / "two.msh").write_text(_OVERLAP)
    mesh = lj.read_mesh(tmp_path / "two.msh")
    assert {name: len(mesh.element_sets[name]) for name in ("stiff", "organ")} == {"stiff": 1, "organ": 2}
    assert {name: len(t) for name, t in mesh.triangle_sets.items()} == {"low": 1, "outer": 2}
    assert len(mesh.node_sets["outer"]) == 4 and len(mesh.node_sets["low"]) == 3


@pytest.mark.parametrize("order", [1, 2])
def test_files_keep_groups_of_triangles(tmp_path, order):
    """The groups were lost, and a load on such a group acted on all triangles between its nodes."""
    (tmp_path / "two.msh").write_text(_OVERLAP)
    mesh = lj.read_mesh(tmp_path / "two.msh")
    mesh = mesh if order == 1 else lj.quadratic(mesh)
    lj.write_mesh(tmp_path / "again.vtu", mesh)
    back = lj.read_mesh(tmp_path / "again.vtu")
    for own, read in ((mesh.triangle_sets, back.triangle_sets), (mesh.element_sets, back.element_sets)):
        assert {name: np.asarray(part).tolist() for name, part in own.items()} == {
            name: np.asarray(part).tolist() for name, part in read.items()
        }
    assert {n: sorted(np.asarray(s)) for n, s in mesh.node_sets.items()} == {
        n: sorted(np.asarray(s)) for n, s in back.node_sets.items()
    }
    with pytest.warns(UserWarning, match="not written in Gmsh's format"):
        lj.write_mesh(tmp_path / "again.msh", mesh)


def test_triangles_of_a_group_that_are_inside_are_told():
    mesh = lj.shapes.box((1, 1, 1), (2, 2, 2))
    outer = lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_min"])
    inside = next(t for t in np.asarray(mesh.tetrahedra).T[[0, 1, 2]].T if 13 in t)  # node 13 is in the middle
    mixed = replace(mesh, triangle_sets={"both": np.vstack([outer, inside])})
    with pytest.warns(UserWarning, match="1 of 9 triangles of 'both' are not on the surface"):
        found = lj.boundary.surface_of(mixed, None, "both")
    assert len(found) == 8


@pytest.mark.parametrize("kind", [np.int64, np.float32, np.float64])
def test_numbers_of_regions_may_be_of_any_type(kind, tmp_path):
    """ParaView's filters write whole numbers as floats. Numbers with fractions are not regions."""
    mesh = lj.shapes.box((1, 1, 1), (2, 2, 2))
    region = np.repeat([1, 2], 24).astype(kind)
    data = {"region": [region], "density": [np.linspace(1, 2, 48)]}
    meshio.Mesh(np.asarray(mesh.points), [meshio_cells(mesh)], cell_data=data).write(tmp_path / "m.vtu")
    read = lj.read_mesh(tmp_path / "m.vtu")
    assert set(read.element_sets) == {"region=1", "region=2"}
    assert np.array_equal(read.element_sets["region=2"], np.arange(24, 48))


def test_sets_of_triangles_in_other_files_and_names_that_collide(tmp_path):
    mesh = lj.shapes.box((1, 1, 1), (2, 2, 2))
    below = np.asarray(mesh.node_sets["z_min"])
    blocks = [("triangle", lj.boundary.boundary_triangles(mesh, below)), meshio_cells(mesh)]
    mask = [np.ones(8, int), np.zeros(48, int)]
    own = {f"set:{name}": np.isin(np.arange(27), nodes).astype(int) for name, nodes in (("a", below), ("b", below[:3]))}
    for name in ("a", "c"):
        meshio.Mesh(np.asarray(mesh.points), blocks, own, {f"set:{name}": mask}).write(tmp_path / "m.vtu")
        read = lj.read_mesh(tmp_path / "m.vtu")
        assert sorted(np.asarray(read.node_sets[name]).tolist()) == below.tolist() and len(read.node_sets["b"]) == 3
    meshio.Mesh(np.asarray(mesh.points), blocks, own, {"set:b": mask}).write(tmp_path / "m.vtu")
    with pytest.raises(lj.InputError, match="'b' is a set of 3 nodes and a group of triangles with 9 nodes; rename"):
        lj.read_mesh(tmp_path / "m.vtu")
    sets = {"sole": [np.arange(8), []], "half": [[], np.arange(24)]}
    meshio.Mesh(np.asarray(mesh.points), blocks, cell_sets=sets).write(tmp_path / "m.inp")
    read = lj.read_mesh(tmp_path / "m.inp")
    assert (
        sorted(np.asarray(read.node_sets["sole"]).tolist()) == below.tolist() and len(read.element_sets["half"]) == 24
    )


def test_gmsh_groups_without_their_entities_are_named(tmp_path):
    """The message ended in a bare number in brackets, and asked for a Gmsh file, which this was."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    cells, groups = [("triangle", tets[:1, :3]), ("tetra", tets)], [np.array([1]), np.full(len(tets), 3)]
    data = meshio.Mesh(points, cells, cell_data={"gmsh:physical": groups, "gmsh:geometrical": groups})
    data.field_data = {"top": np.array([1, 2]), "body": np.array([3, 3])}
    data.point_data["gmsh:dim_tags"] = np.tile([3, 3], (len(points), 1))
    data.write(tmp_path / "groups.msh", file_format="gmsh", binary=False)
    with pytest.raises(
        lj.InputError, match=r"\(it does not know or does not find the entry 1\); export the mesh as VTU or Gmsh"
    ):
        lj.read_mesh(tmp_path / "groups.msh")
