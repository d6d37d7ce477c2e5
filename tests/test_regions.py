"""Other parameters in parts of a body: every law, sets of elements from mesh files, scene files, invalid regions."""

import warnings

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.mesh.locate import elements_at
from liverjax.mesh.promotion import quadratic
from liverjax.scenes.by_element import law_of_elements
from liverjax.scenes.regions import select_elements
from liverjax.scenes.scene import numbers_at, with_parameters

pytestmark = pytest.mark.quick_to_compile


def _pulled(law: lj.Law, region: tuple = ()) -> lj.Scene:
    mesh = lj.shapes.box((0.04, 0.02, 0.02), (4, 2, 2))
    move = lj.Displaced(nodes=mesh.node_sets["x_max"], by=jnp.array([0.004, 0.0, 0.0]))
    return lj.Scene(
        mesh=mesh, law=law, region=region, fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),), displaced=(move,)
    )


QUICK = ("neo_hookean", "ogden")


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in lj.laws.LAWS])
def test_every_number_of_every_law_may_differ_by_element(name):
    """A region of all elements equals the scene with this value. The forces of half a body are those of its
    elements.
    """
    law = lj.laws.typical(name)
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (2, 1, 1))
    E = mesh.number_of_elements
    x = mesh.points + 0.02 * jnp.asarray(np.random.default_rng(1).normal(size=mesh.points.shape))
    all_of_it, half = jnp.arange(E), jnp.arange(E // 2)
    for field in lj.laws.parameters(law):
        value = getattr(law, field.name)
        if field.name in ("fibre", "sheet") or value is None:
            continue
        label = f"{field.name}.0" if isinstance(value, tuple) else field.name
        base = value[0] if isinstance(value, tuple) else value
        if label.startswith("alpha") and isinstance(value, tuple):
            continue  # the sign of an exponent is part of how a stretch law is evaluated
        other = 1.1 * float(base)
        changed = replace(law, **{field.name: (other, *value[1:]) if isinstance(value, tuple) else other})
        whole = law_of_elements(law, (lj.Region(elements=all_of_it, law={label: other}),), E)
        force = lj.mjed.internal_force(mesh, changed, x)
        scale = float(jnp.abs(force).max())
        np.testing.assert_allclose(lj.mjed.internal_force(mesh, whole, x), force, atol=1e-13 * scale)
        mixed = law_of_elements(law, (lj.Region(elements=half, law={label: other}),), E)
        parts = []
        for numbers, one in ((np.arange(E // 2), changed), (np.arange(E // 2, E), law)):
            part = lj.tet_mesh(mesh.points, np.asarray(mesh.tetrahedra)[numbers])
            parts.append(lj.mjed.internal_force(part, one, x))
        np.testing.assert_allclose(lj.mjed.internal_force(mesh, mixed, x), parts[0] + parts[1], atol=1e-12 * scale)


def test_one_number_of_a_list_of_a_region_has_a_name():
    """A sweep could not vary a relaxation time of a region: the name with the index led nowhere."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (1, 1, 2))
    prony = lj.Prony(ratios=jnp.array([0.3, 0.1]), relaxation_times=jnp.array([0.2, 0.05]))
    region = (lj.Region(elements=jnp.arange(6), viscosity={"relaxation_times": jnp.array([0.3, 0.04])}),)
    scene = lj.Scene(mesh=mesh, law=lj.laws.NeoHookean(mu=700.0, bulk=7000.0), viscosity=prony, region=region)
    name = "region.0.viscosity.relaxation_times"
    assert numbers_at(scene, f"{name}.1") == 0.04
    changed = with_parameters(scene, {f"{name}.0": 0.9})
    assert np.array_equal(numbers_at(changed, name), [0.9, 0.04])
    whole = replace(scene, region=(replace(region[0], viscosity={"relaxation_times": np.array([20, 2])}),))
    assert np.array_equal(numbers_at(with_parameters(whole, {f"{name}.1": 0.5}), name), [20, 0.5])
    with pytest.raises(lj.InputError, match="'2' is not a name or index here: use an index from 0 to 1"):
        numbers_at(scene, f"{name}.2")


@pytest.mark.slow
def test_a_region_runs_as_the_array_it_stands_for_and_has_a_gradient():
    law = lj.laws.NeoHookean(mu=800.0, bulk=3000.0)
    inside = jnp.arange(20, 50)
    scene = _pulled(law, (lj.Region(elements=inside, law={"mu": jnp.asarray(2400.0)}),))
    mu = jnp.full(scene.mesh.number_of_elements, 800.0).at[inside].set(2400.0)
    arrays = _pulled(replace(law, mu=mu))
    lj.check_scene(scene)
    np.testing.assert_allclose(lj.simulate(scene).check().positions, lj.simulate(arrays).positions, atol=1e-12)

    def work(result):
        return jnp.sum(result.reactions**2)

    one = lj.value_and_gradient(work, scene, {"region.0.law.mu": 2400.0}).gradient["region.0.law.mu"]
    each = lj.value_and_gradient(work, arrays, {"law.mu": mu}).gradient["law.mu"]
    np.testing.assert_allclose(one, each[inside].sum(), rtol=1e-8)


def test_a_uniform_scene_pays_nothing():
    """Without regions, the program of a scene has no array with one value per element, apart from those of the mesh."""
    scene = _pulled(lj.laws.NeoHookean(mu=800.0, bulk=3000.0))
    assert len(jax.tree.leaves(scene.region)) == 0
    assert all(np.ndim(leaf) == 0 for leaf in jax.tree.leaves(scene.law))


def test_sets_of_elements_come_from_the_file(tmp_path):
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (2, 2, 2))
    X, T = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    group = (X[T].mean(axis=1)[:, 0] > 0.5).astype(np.int32) + 3
    meshio.Mesh(X, [("tetra", T)], cell_data={"medit:ref": [group]}).write(tmp_path / "a.vtu")
    read = lj.read_mesh(tmp_path / "a.vtu")
    assert set(read.element_sets) == {"medit:ref=3", "medit:ref=4"}
    np.testing.assert_array_equal(read.element_sets["medit:ref=4"], np.flatnonzero(group == 4))
    # In Gmsh's file, triangles of the surface come before the tetrahedra, and the groups have names.
    triangles = lj.boundary.boundary_triangles(mesh)
    tags = [np.full(len(triangles), 7), group]
    named = meshio.Mesh(
        X,
        [("triangle", triangles), ("tetra", T)],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        field_data={"lesion": np.array([4, 3]), "skin": np.array([7, 2])},
    )
    named.write(tmp_path / "b.msh", file_format="gmsh22", binary=False)
    read = lj.read_mesh(tmp_path / "b.msh")
    np.testing.assert_array_equal(np.sort(read.element_sets["lesion"]), np.flatnonzero(group == 4))
    lj.write_mesh(tmp_path / "c.vtu", read)
    again = lj.read_mesh(tmp_path / "c.vtu")
    np.testing.assert_array_equal(np.sort(again.element_sets["lesion"]), np.flatnonzero(group == 4))


_SCENE = """
[mesh]
shape = "box"
size = [0.04, 0.02, 0.02]
cells = [4, 2, 2]
[law]
name = "ogden"
mu = [500.0, 300.0]
alpha = [2.0, -2.0]
bulk = 3000.0
{region}
[[fixed]]
where = {{x_max = 0.0}}
[[displaced]]
where = {{x_min = 0.04}}
by = [0.004, 0, 0]
"""


def _load(tmp_path, region: str) -> lj.Scene:
    (tmp_path / "scene.toml").write_text(_SCENE.format(region=region))
    return lj.load_scene(tmp_path / "scene.toml")


def test_regions_of_a_scene_file(tmp_path):
    scene = _load(tmp_path, "[[region]]\nwhere = {x_min = 0.02}\nlaw = {mu = [1500.0, 900.0], bulk = 6000.0}")
    (region,) = scene.region
    assert set(region.law) == {"mu.0", "mu.1", "bulk"}
    middle = np.asarray(scene.mesh.points)[np.asarray(scene.mesh.tetrahedra)].mean(axis=1)
    np.testing.assert_array_equal(region.elements, np.flatnonzero(middle[:, 0] > 0.02))
    softer = lj.with_parameters(scene, {"region.0.law.mu.1": 10.0})
    assert softer.region[0].law["mu.1"] == 10.0
    law = law_of_elements(softer.law, softer.region, scene.mesh.number_of_elements)
    assert float(law.mu[1].min()) == 10.0 and float(law.mu[1].max()) == 300.0


def test_a_border_that_goes_through_elements_is_told(tmp_path):
    with pytest.warns(UserWarning, match=r"region.0: x_min = 0.013 cuts elements.* the region begins at 0.0"):
        _load(tmp_path, "[[region]]\nwhere = {x_min = 0.013}\nlaw = {bulk = 6000.0}")


def test_bounds_on_the_surface_or_outside_of_the_body_are_not_told():
    """A round body ends inside its bounding box. A bound outside the body cuts no element."""
    mesh = lj.shapes.cylinder(0.01, 0.02, 0.005)
    half = float(np.median(np.unique(np.asarray(mesh.points)[:, 2])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for where in ({"z_min": half, "y_min": -1.0, "y_max": 1.0}, {"z_max": half, "x_min": -0.01, "x_max": 0.01}):
            assert len(select_elements(mesh, where, None))
    with pytest.warns(UserWarning, match="x_min = 0.001 cuts elements"):
        select_elements(mesh, {"x_min": 0.001, "y_min": -1.0}, None)


def test_bounds_and_points_on_a_face_are_found_in_single_precision():
    """The tolerance was 1e-9 of the size: rounded nodes were not on the bound, without a warning. A point on the face
    was refused.
    """
    exact = lj.shapes.box((0.2, 0.1, 0.12), (10, 5, 6))
    rounded = lj.tet_mesh(np.asarray(exact.points).astype(np.float32), exact.tetrahedra)
    for where in ({"z_min": 0.06, "x_max": 0.0}, {"z_min": 0.12}, {"z_max": 0.06, "y_max": 0.02}):
        assert np.array_equal(lj.boundary.select(exact, where), lj.boundary.select(rounded, where))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(select_elements(rounded, {"z_min": 0.06}, None)) == 900
    fine = lj.shapes.box((0.31, 0.3, 0.3), (100, 1, 1))  # a bound just beside a layer of nodes selected this layer
    assert len(lj.boundary.select(fine, {"x_min": 1e-6})) == 400
    single = [np.float32(units * np.asarray(fine.points)).astype(float) / units for units in (1.0, 1e3)]
    with pytest.warns(UserWarning, match="does not select 4 nodes that lie up to 1e-08 m beyond"):
        assert len(lj.boundary.select(fine, {"x_min": 1e-8})) == 400  # exact coordinates: within 1e-9 of the size
    for points in single:
        assert len(lj.boundary.select(lj.tet_mesh(points, fine.tetrahedra), {"x_min": 1e-8})) == 404
    curved = lj.tet_mesh(np.asarray(rounded.points).astype(float), rounded.tetrahedra)
    assert len(lj.boundary.select(quadratic(curved), {"z_min": 0.12})) == len(
        lj.boundary.select(quadratic(exact), {"z_min": 0.12})
    )
    elements_at(rounded, np.array([[0.1, 0.05, 0.12], [0.2, 0.1, 0.12]]), "points")
    with pytest.raises(lj.InputError, match="outside the body"):
        elements_at(rounded, np.array([[0.1, 0.05, 0.12001]]), "points")


@pytest.mark.slow
def test_a_scene_file_with_a_region_runs(tmp_path):
    scene = _load(tmp_path, "[[region]]\nwhere = {x_min = 0.02}\nlaw = {mu = [1500.0, 900.0], bulk = 6000.0}")
    assert np.isfinite(np.asarray(lj.simulate(scene).check().positions)).all()


def test_regions_that_lie_over_each_other_may_add_to_each_other(tmp_path):
    """A region has no effect only if later regions replace all its values everywhere."""
    half, more = "[[region]]\nwhere = {x_min = 0.02}\n", "[[region]]\nwhere = {x_min = 0.0}\n"
    scene = _load(tmp_path, "")
    numbers = lj.Region(elements=np.arange(3), law={"bulk": 5000.0})
    law = lj.Region(elements=np.arange(4), law=lj.laws.NeoHookean(mu=700.0, bulk=5000.0))
    with pytest.raises(lj.InputError, match=r"region\.0 changes nothing"):
        lj.check_scene(replace(scene, region=(numbers, law)))
    own = f"{half}law = {{mu = [1500.0, 900.0]}}\n{more}law = {{mu = [1500.0, 900.0]}}\n"
    with pytest.raises(lj.InputError, match=r"region\.0 changes nothing"):
        _load(tmp_path, own)
    for first, second in ((half, half), (more, half), (half, more)):
        law = "law = {mu = [1500.0, 900.0]}\n" if first is not more else "law = {bulk = 6000.0}\n"
        scene = _load(tmp_path, f"{first}{law}{second}law = {{bulk = 5000.0}}\n")
        assert len(scene.region) == 2


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ('[[region]]\nset = "lesion"\nlaw = {bulk = 1.0}', "no element set 'lesion'"),
        ("[[region]]\nwhere = {x_min = 0.02}", "needs the parameters"),
        ("[[region]]\nwhere = {x_min = 0.02}\nlaw = {c10 = 3.0}", "no number 'c10'"),
        ("[[region]]\nwhere = {x_min = 0.02}\nlaw = {mu = 3.0}", "is a list of 2"),
        ("[[region]]\nwhere = {x_min = 0.02}\nlaw = {bulk = -3.0}", "must be above 0"),
        ("[[region]]\nwhere = {x_min = 0.02}\nlaw = {bulk = 'a'}", "is not a number"),
        ("[[region]]\nwhere = {x_min = 0.02}\nlaw = {bulk = nan}", "is not a number"),
        ("[[region]]\nwhere = {x_min = 0.039}\nlaw = {bulk = 1.0}", "no whole element"),
        ("[[region]]\nwhere = {x_min = 0.1}\nlaw = {bulk = 1.0}", "selects no node"),
        ("[[region]]\nwhere = 3\nlaw = {bulk = 1.0}", "must be a table"),
        (2 * "[[region]]\nwhere = {x_min = 0.02}\nlaw = {bulk = 1.0}\n", "region.0 changes nothing, because later"),
        ("[[region]]\nplace = {x_min = 0.02}\nlaw = {bulk = 1.0}", "unknown key 'place'"),
    ],
)
def test_bad_regions_are_one_sentence(tmp_path, region, words):
    with pytest.raises(lj.InputError, match=words) as error:
        _load(tmp_path, region)
    assert "\n" not in str(error.value)
