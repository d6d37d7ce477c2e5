"""Abaqus input files: sets over several cards, names of sets in data lines, blocks, and files that cannot be used.

The expected members are those of the keyword reference of Abaqus (``*NSET``, ``*ELSET``), written down by hand.
"""

import meshio
import numpy as np
import pytest

import liverjax as lj
from liverjax.mesh.files import meshio_cells

HEAD = """*HEADING
two elements
** a comment
*Node, nset=all
11, 0, 0, 0
12, 0.1, 0, 0
13, 0, 0.1, 0
14, 0, 0, 0.1
15, 0.1, 0.1, 0.1
*Element, type=c3d4
101, 11, 12, 13, 14
*ELEMENT, TYPE=C3D4H,
 ELSET=right
102, 12, 15, 13,
14
*ELEMENT, TYPE=S3, ELSET=skin
1, 11, 12, 13
"""


def sets_of(tmp_path, cards):
    (tmp_path / "m.inp").write_text(HEAD + cards)
    mesh = lj.read_mesh(tmp_path / "m.inp")
    found = {**mesh.node_sets, **mesh.element_sets}
    return {name: sorted(np.asarray(members).tolist()) for name, members in found.items()}


@pytest.mark.parametrize("order", [1, 2])
def test_surfaces_of_elements_are_groups_of_triangles(tmp_path, order):
    """A surface was left out without a word. Its faces are those of the keyword reference: S1 is 1-2-3, S2 is 1-4-2, S3
    is 2-4-3, S4 is 3-4-1."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    tets, top = np.asarray(mesh.tetrahedra), lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_max"])
    faces = {"S1": (0, 1, 2), "S2": (0, 3, 1), "S3": (1, 3, 2), "S4": (2, 3, 0)}
    wanted = {tuple(sorted(t)) for t in top.tolist()}
    lines = [(e, s) for e, t in enumerate(tets) for s, f in faces.items() if tuple(sorted(t[list(f)])) in wanted]
    alone, by_set = lines[:3], lines[3:]
    text = ["*NODE", *(f"{k + 1}, {x}, {y}, {z}" for k, (x, y, z) in enumerate(np.asarray(mesh.points).tolist()))]
    text += [f"*ELEMENT, TYPE=C3D{4 if order == 1 else 10}"]
    text += [", ".join(map(str, [e + 1, *(nodes + 1)])) for e, nodes in enumerate(meshio_cells(mesh)[1])]
    for s in faces:
        own = [str(e + 1) for e, face in by_set if face == s]
        text += [f"*ELSET, ELSET=_top_{s}, INTERNAL", *own] if own else []
    text += ["*SURFACE, TYPE=ELEMENT, NAME=top", *(f"{e + 1}, {s}" for e, s in alone)]
    text += [f"_top_{s}, {s}" for s in faces if any(face == s for _, face in by_set)]
    text += ["*SURFACE, TYPE=NODE, NAME=other", "1, 1.0"]
    (tmp_path / "m.inp").write_text("\n".join(text) + "\n")
    back = lj.read_mesh(tmp_path / "m.inp")
    assert {tuple(sorted(t)) for t in np.asarray(back.triangle_sets["top"]).tolist()} == wanted
    assert set(np.asarray(back.node_sets["top"])) == set(np.asarray(mesh.node_sets["z_max"]))
    lj.scenes.scene_checks.check_before_run(
        lj.Scene(
            mesh=back,
            law=lj.laws.NeoHookean(mu=1.0, bulk=2.0),
            traction=(lj.Traction(triangles=back.triangle_sets["top"], pressure=1.0),),
        )
    )
    (tmp_path / "m.inp").write_text("\n".join([*text, "*SURFACE, NAME=a", "nothing, S1"]) + "\n")
    with pytest.raises(
        lj.InputError, match=r"\*SURFACE contains nothing, but the file does not define this set of elements"
    ):
        lj.read_mesh(tmp_path / "m.inp")


def test_a_surface_may_have_the_name_of_a_set_of_elements(tmp_path):
    """In Abaqus they are different kinds of names. The surface replaced the elements of the set."""
    cards = "*ELSET, ELSET=BOTTOM\n102,\n*SURFACE, NAME=BOTTOM\nBOTTOM, S1\n*SURFACE, NAME=other\n101, S2\n"
    (tmp_path / "m.inp").write_text(HEAD + cards)
    mesh = lj.read_mesh(tmp_path / "m.inp")
    assert np.asarray(mesh.element_sets["BOTTOM"]).tolist() == [1]
    assert np.sort(np.asarray(mesh.triangle_sets["BOTTOM"])).tolist() == [[1, 2, 4]]
    assert np.sort(np.asarray(mesh.triangle_sets["other"])).tolist() == [[0, 1, 3]]


@pytest.mark.parametrize(
    "more", ["*SURFACE, NAME=b, COMBINE=UNION\na, a\n", "*SURFACE, NAME=b\n,\n", "*SURFACE, NAME=b\nx, SPOS\n"]
)
def test_surfaces_without_listed_faces_are_ignored(tmp_path, more):
    """A combined surface, the whole free surface, or an unknown set of shells made the whole file unreadable."""
    assert "b" not in sets_of(tmp_path, more)
    assert sets_of(tmp_path, "*SURFACE, NAME=a\n101, S1\n" + more)["a"] == [0, 1, 2]


@pytest.mark.parametrize("zero", ["0", "0.0E+00", "0.D0"])
def test_letters_in_a_data_line_after_a_comma(tmp_path, zero):
    """The letter of an exponent or of a face made the first data line a part of the keyword line."""
    text = HEAD.replace("nset=all\n11, 0,", f"nset=all,\n11, {zero},") + "*SURFACE, NAME=a,\n101, S1\n"
    (tmp_path / "m.inp").write_text(text)
    found = lj.read_mesh(tmp_path / "m.inp")
    assert np.asarray(found.node_sets["all"]).tolist() == [0, 1, 2, 3, 4]
    assert np.asarray(found.triangle_sets["a"]).tolist() == [[0, 2, 1]]


def test_surfaces_of_the_part_and_of_the_assembly_are_different_surfaces(tmp_path):
    """They were merged without a word."""
    assembly = (
        "*ASSEMBLY, NAME=A\n*INSTANCE, NAME=P-1, PART=P\n*END INSTANCE\n*SURFACE, NAME=A\nP-1.101, S2\n*END ASSEMBLY\n"
    )
    surfaces = "*SURFACE, NAME=a\n101, S1\n*SURFACE, NAME=own\n101, S3\n"
    (tmp_path / "m.inp").write_text("*PART, NAME=P\n" + HEAD + surfaces + "*END PART\n" + assembly)
    found = lj.read_mesh(tmp_path / "m.inp").triangle_sets
    assert {name: np.asarray(own).tolist() for name, own in found.items() if name != "skin"} == {
        "P.a": [[0, 2, 1]],
        "a": [[0, 1, 3]],
        "own": [[1, 2, 3]],
    }


@pytest.mark.parametrize(
    ("cards", "members"),
    [
        ("*ELSET, ELSET=hard\n101,\n*ELSET, ELSET=hard\n102,\n", {"hard": [0, 1]}),
        ("*NSET, NSET=foot\n11, 12\n*NSET, NSET=FOOT\n13,\n", {"foot": [0, 1, 2]}),
        ("*NSET, NSET=a\n11, 12\n*NSET, NSET=foot\na, 13\n", {"a": [0, 1], "foot": [0, 1, 2]}),
        ("*ELSET, ELSET=hard\nright, 101\n", {"hard": [0, 1]}),
        ("*Nset, nset=odd, generate\n11, 15, 2\n", {"odd": [0, 2, 4]}),
        ("*NSET, NSET=foot, GENERATE\n11, 13\n*ELSET, ELSET=both, GENERATE\n101, 102\n", {"foot": [0, 1, 2]}),
        ("*NSET, NSET=foot, INSTANCE=Part-1-1\n11\n*NSET, NSET=tip\nPart-1-1.15\n", {"foot": [0], "tip": [4]}),
        ("*NSET, NSET=foot, ELSET=right\n", {"foot": [1, 2, 3, 4]}),
        ("*ELSET, ELSET=hard\nlater\n*ELSET, ELSET=later\n101,\n", {"hard": [0], "later": [0]}),
        ("*ELEMENT, TYPE=S4, ELSET=quad\n9, 11, 12, 15, 13\n*ELSET, ELSET=hard\nquad, 101\n", {"hard": [0]}),
        ("*ELSET, ELSET=hard,\n101, 102\n", {"hard": [0, 1]}),
        ("*ELSET, ELSET=Lobe.a\n101\n*ELSET, ELSET=hard\nLobe.a\n", {"hard": [0], "Lobe.a": [0]}),
        ("*NODE PRINT, NSET=foot\nU\n*NSET, NSET=foot\n11\n", {"foot": [0]}),
    ],
)
def test_sets_have_the_members_of_all_their_cards(tmp_path, cards, members):
    found = sets_of(tmp_path, cards)
    assert members.items() <= found.items()
    assert found["all"] == [0, 1, 2, 3, 4] and found["right"] == [1] and found["skin"] == [0, 1, 2]


def test_sets_of_the_part_and_of_the_assembly_are_different_sets(tmp_path):
    """Abaqus/CAE calls the first set of a part Set-1, and the first set of the assembly too. Both were merged."""
    head = HEAD.replace("*Node, nset=all", "*Part, name=Liver\n*Node, nset=all")
    text = (
        head
        + """*Nset, nset=Set-1
11, 12
*Nset, nset=Set-2
13
*End Part
*Assembly, name=Assembly
*Instance, name=Liver-1, part=Liver
*End Instance
*Node
11, 0.05, 0.05, 0.2
*Nset, nset=RP
11
*Nset, nset=Set-1, instance=Liver-1
14
*Nset, nset=both
Set-1, Liver-1.Set-2
*End Assembly
"""
    )
    (tmp_path / "m.inp").write_bytes(b"\xef\xbb\xbf" + text.replace("0.1, 0, 0", "1.0D-1, 0, 0").encode())
    mesh = lj.read_mesh(tmp_path / "m.inp")
    found = {name: sorted(np.asarray(nodes).tolist()) for name, nodes in mesh.node_sets.items()}
    assert mesh.number_of_nodes == 5 and found.pop("skin") == [0, 1, 2] and found.pop("all") == [0, 1, 2, 3, 4]
    assert found == {"Liver.Set-1": [0, 1], "Set-2": [2], "RP": [], "Set-1": [3], "both": [2, 3]}


def test_nodes_and_elements_of_an_instance_are_read(tmp_path):
    """Abaqus/CAE writes an independent instance like this. Its part is empty."""
    mesh = HEAD.partition("** a comment\n")[2] + "*Nset, nset=foot\n11, 12\n"
    text = f"*Part, name=A\n*End Part\n*Assembly\n*Instance, name=A-1, part=A\n{mesh}*End Instance\n"
    (tmp_path / "m.inp").write_text(text + "*Nset, nset=tip, instance=A-1\n15\n*End Assembly\n")
    read = lj.read_mesh(tmp_path / "m.inp")
    assert read.number_of_nodes == 5 and read.node_sets["foot"].tolist() == [0, 1]
    assert read.node_sets["tip"].tolist() == [4]


def test_several_blocks_of_one_set_give_the_sets_of_one_block(tmp_path):
    """meshio writes one card of a set for each block of cells. Read by meshio, the sets lost members."""
    mesh = lj.shapes.box((1, 1, 1), (2, 2, 2))
    sole = lj.boundary.boundary_triangles(mesh, np.asarray(mesh.node_sets["z_min"]))
    tets = meshio_cells(mesh)[1]
    blocks = [("triangle", sole[:3]), ("tetra", tets[:20]), ("triangle", sole[3:]), ("tetra", tets[20:])]
    sets = {"sole": [np.arange(3), [], np.arange(5), []], "hard": [[], np.arange(5, 20), [], np.arange(10)]}
    meshio.Mesh(np.asarray(mesh.points), blocks, cell_sets=sets).write(tmp_path / "m.inp")
    read = lj.read_mesh(tmp_path / "m.inp")
    assert np.array_equal(read.element_sets["hard"], np.arange(5, 30))
    assert np.array_equal(np.sort(read.node_sets["sole"]), np.sort(np.asarray(mesh.node_sets["z_min"])))
    assert len(read.triangle_sets["sole"]) == 8


def test_nodes_of_a_set_of_elements_are_those_of_the_named_set(tmp_path):
    """The part and the assembly have a set of elements `hard`. The part's set of nodes got the nodes of the assembly's
    set, and a name with the instance gave an empty set."""
    head = HEAD.replace("*Node, nset=all", "*Part, name=Liver\n*Node, nset=all")
    cards = """*Elset, elset=hard
101
*Nset, nset=own, elset=hard
*End Part
*Assembly, name=Assembly
*Instance, name=Liver-1, part=Liver
*End Instance
*Elset, elset=hard, instance=Liver-1
102
*Nset, nset=whole, elset=Hard
*Nset, nset=inner, elset=Liver-1.hard
*Surface, name=left
Liver-1.hard, S1
*Surface, name=right
hard, S1
*End Assembly
"""
    (tmp_path / "m.inp").write_text(head + cards)
    mesh = lj.read_mesh(tmp_path / "m.inp")
    found = {name: sorted(np.asarray(mesh.node_sets[name]).tolist()) for name in ("own", "whole", "inner")}
    assert found == {"own": [0, 1, 2, 3], "whole": [1, 2, 3, 4], "inner": [0, 1, 2, 3]}
    faces = {name: sorted(np.ravel(mesh.triangle_sets[name]).tolist()) for name in ("left", "right")}
    assert faces == {"left": [0, 1, 2], "right": [1, 2, 4]}


@pytest.mark.parametrize("name", ["low", "Assembly.low", "Liver-1.low"])
def test_a_set_of_the_assembly_may_have_a_name_before_it(tmp_path, name):
    """With a name before it, this set of elements was not found."""
    head = HEAD.replace("*Node, nset=all", "*Part, name=Liver\n*Node, nset=all")
    cards = f"""*End Part
*Assembly, name=Assembly
*Instance, name=Liver-1, part=Liver
*End Instance
*Elset, elset=low, instance=Liver-1
102
*Nset, nset=nodes, elset={name}
*Surface, name=faces
{name}, S1
*End Assembly
"""
    (tmp_path / "m.inp").write_text(head + cards)
    mesh = lj.read_mesh(tmp_path / "m.inp")
    assert sorted(np.asarray(mesh.node_sets["nodes"]).tolist()) == [1, 2, 3, 4]
    assert sorted(np.ravel(mesh.triangle_sets["faces"]).tolist()) == [1, 2, 4]


def test_a_name_after_that_of_the_assembly_means_its_set(tmp_path):
    """The part has sets with the same names, and these were used."""
    head = HEAD.replace("*Node, nset=all", "*Part, name=Liver\n*Node, nset=all")
    cards = """*Nset, nset=tip
11
*Elset, elset=low
101
*End Part
*Assembly, name=Model
*Instance, name=Liver-1, part=Liver
*End Instance
*Nset, nset=tip, instance=Liver-1
15
*Elset, elset=low, instance=Liver-1
102
*Nset, nset=nodes, elset=Model.low
*Nset, nset=tips
Model.tip
*Nset, nset=own
Liver-1.tip, Model.Liver-1.tip
*End Assembly
"""
    (tmp_path / "m.inp").write_text(head + cards)
    mesh = lj.read_mesh(tmp_path / "m.inp")
    found = {name: sorted(np.asarray(mesh.node_sets[name]).tolist()) for name in ("nodes", "tips", "own")}
    assert found == {"nodes": [1, 2, 3, 4], "tips": [4], "own": [0]}


def test_quadratic_elements_and_included_files(tmp_path):
    mesh = lj.quadratic(lj.shapes.box((1, 1, 1), (1, 1, 1)))
    meshio.Mesh(np.asarray(mesh.points), [meshio_cells(mesh)]).write(tmp_path / "inner.inp")
    (tmp_path / "m.inp").write_text("*INCLUDE, INPUT=inner.inp\n*NSET, NSET=one\n1\n")
    read = lj.read_mesh(tmp_path / "m.inp")
    assert read.order == 2 and np.allclose(read.points, mesh.points) and read.node_sets["one"].tolist() == [0]


@pytest.mark.parametrize(
    ("cards", "message"),
    [
        ("*NODE\n11, 1, 1, 1\n", "two nodes have the same number; export one part"),
        ("*ELEMENT, TYPE=C3D4\n101, 11, 12, 13, 15\n", "two elements have the same number"),
        ("*ELEMENT, TYPE=C3D4\n103, 11, 12, 13\n", r"lines of \*ELEMENT, TYPE=C3D4 are not complete"),
        ("*ELEMENT, TYPE=C3D4\n103, 11, 12, 13, 99\n", "contains node 99, but"),
        ("*ELEMENT, TYPE=C3D8\n103, 11, 12, 13, 14, 11, 12, 13, 14\n", "contains hexahedron in addition"),
        ("*ELEMENT, TYPE=C3D27\n103" + 27 * ", 11" + "\n", "contains hexahedron27 in addition"),
        ("*ELEMENT, TYPE=C3D9\n103" + 9 * ", 11" + "\n", "elements of type C3D9; export tetrahedra"),
        ("*NODE\n16, 1, one, 1\n", "contains a wrong number"),
        ("*NSET, NSET=foot\nnobody\n", "contains nobody, but the file does not define this set"),
        ("*NSET, NSET=foot, ELSET=None\n", r"\*NSET contains None, but the file does not define this set of elements"),
        ("*NSET, NSET=foot, GENERATE\n1, 2, 0\n", "give first, last, step"),
        ("*NGEN\n11, 15\n", r"\*NGEN moves or creates nodes or elements"),
        ("*INSTANCE, NAME=one, PART=two\n0, 0, 5\n", r"\*INSTANCE moves or creates nodes or elements"),
        ("*INCLUDE, INPUT=none.inp\n", "none.inp cannot be read"),
        ("*INCLUDE, INPUT=m.inp\n", "m.inp includes itself"),
        ("*NODE, SYSTEM=C\n16, 1, 30, 1\n", r"\*NODE moves or creates nodes or elements"),
        ("*PART, NAME=a\n*END PART\n*PART, NAME=b\n*END PART\n", "several parts or instances"),
    ],
)
def test_files_that_cannot_be_used_get_one_sentence(tmp_path, cards, message):
    with pytest.raises(lj.InputError, match=message):
        sets_of(tmp_path, cards)
