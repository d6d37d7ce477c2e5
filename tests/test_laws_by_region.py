"""Regions with another kind of law: terms against autodiff, parts in series by hand, all scenes, invalid input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements import mjed, projection, reference
from liverjax.jobs.sweep import read_sweep
from liverjax.scenes.by_element import law_of_elements
from liverjax.scenes.checks import numbers as number_checks
from liverjax.scenes.scene import with_parameters
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation.run import prepared
from liverjax.tensors.matrices import deformation_gradient, unpack
from liverjax.tensors.subsets import in_subset, put_together, subsets

pytestmark = pytest.mark.quick_to_compile

LIVER = lj.laws.NeoHookean(mu=800.0, bulk=3000.0)
TUMOUR = lj.laws.create("ogden", mu=[600.0, 200.0], alpha=[2.0, -3.0], bulk=5000.0)


def block(order=1, cells=(2, 2, 4)):
    mesh = lj.shapes.box((0.01, 0.01, 0.02), cells)
    return lj.quadratic(mesh) if order == 2 else mesh


def upper(mesh):
    centres = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)].mean(axis=1)
    return jnp.asarray(np.flatnonzero(centres[:, 2] > 0.01))


def test_subsets_come_apart_and_together():
    groups = subsets([jnp.array([4, 1]), jnp.array([5])], 6)
    assert [e.tolist() for e in groups.elements] == [[[0, 2, 3]], [[4, 1]], [[5]]]
    numbers = {
        "one": jnp.arange(6.0),
        "points": jnp.arange(12.0).reshape(2, 6),
        "vectors": jnp.arange(18.0).reshape(6, 3),
    }
    second = in_subset(groups, 1, numbers | {"same": 7.0})
    assert second["one"].tolist() == [4, 1] and second["points"].tolist() == [[4, 1], [10, 7]] and second["same"] == 7.0
    assert second["vectors"].tolist() == [[12, 13, 14], [3, 4, 5]]
    found = put_together(groups, [(in_subset(groups, k, numbers["points"]), float(k)) for k in range(3)])
    assert found[0].tolist() == numbers["points"].tolist() and found[1][0].tolist() == [0, 1, 0, 0, 1, 2]
    assert len(subsets([jnp.array([1, 0])], 2).elements) == 1  # no element is left, and there is no empty subset


#: Kinds that depend on different quantities: invariants, I2, stretches, Green's strain with fibres.
KINDS = ("mooney_rivlin", "ogden", "costa", "exponential")


@pytest.mark.parametrize("order, kinds", [pytest.param(k, KINDS, marks=pytest.mark.slow) for k in (1, 2)])
def test_force_and_stiffness_are_derivatives_of_the_energy(order, kinds):
    mesh = block(order, (2, 2, 3))
    E = mesh.number_of_elements
    parts = np.array_split(np.random.default_rng(0).permutation(E)[: E - 5], len(kinds))
    own = tuple(
        lj.Region(elements=jnp.asarray(e), law=lj.laws.typical(kind)) for kind, e in zip(kinds, parts, strict=True)
    )
    by_element = replace(LIVER, mu=jnp.linspace(500.0, 900.0, E))
    law = law_of_elements(by_element, own, E)
    x = mesh.points + 2e-4 * jax.random.normal(jax.random.key(0), mesh.points.shape)

    def energy(x):
        """Return the energy of every element by its own law, without subsets."""
        F = deformation_gradient(mesh, x)
        whole = mesh.at_points(by_element)
        density = whole.strain_energy(whole.measures(F))
        for region in own:
            density = density.at[..., region.elements].set(
                region.law.strain_energy(region.law.measures(F))[..., region.elements]
            )
        return jnp.sum(mesh.weights * density)

    v = jax.random.normal(jax.random.key(1), x.shape)
    (exact, f), (_, product) = jax.jit(lambda x, v: jax.jvp(jax.value_and_grad(energy), (x,), (v,)))(x, v)
    np.testing.assert_allclose(mjed.energy(mesh, law, x), exact, rtol=1e-13)
    np.testing.assert_allclose(mjed.internal_force(mesh, law, x), f, atol=1e-13 * float(jnp.abs(f).max()))
    K, product = mjed.stiffness_matrix(mesh, law, x), np.asarray(product)
    np.testing.assert_allclose(K @ np.asarray(v).ravel(), product.ravel(), atol=1e-12 * np.abs(product).max())
    np.testing.assert_allclose(jax.jit(reference.energy)(mesh, law, x), exact, rtol=1e-13)


@pytest.mark.ci
def test_projected_stiffness_has_no_negative_eigenvalue():
    mesh = block(1, (2, 2, 2))
    E = mesh.number_of_elements
    own = (lj.Region(elements=upper(mesh), law=lj.laws.typical("saint_venant_kirchhoff")),)
    stable = lj.laws.typical("stable_neo_hookean")
    law = law_of_elements(stable, own, E)
    F = unpack(jnp.eye(3)[None] + 0.6 * jax.random.normal(jax.random.key(0), (E, 3, 3)))
    D = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    pairs = tuple((a, b) for a in range(3) for b in range(3))
    S = tuple(tuple(jnp.full(E, 50.0 * (i == j)) for j in range(3)) for i in range(3))
    K = np.array(projection.blocks([(jnp.linspace(0.5, 0.9, E), law)], S, F, D, pairs))
    whole = K.reshape(3, 3, 3, 3, E).transpose(4, 0, 2, 1, 3).reshape(E, 9, 9)
    values = np.linalg.eigvalsh(whole)
    assert values.min() > -1e-10 * values.max()
    # Compare with the scene's law alone, where it acts.
    alone = np.array(projection.blocks([(jnp.linspace(0.5, 0.9, E), stable)], S, F, D, pairs))
    below = np.setdiff1d(np.arange(E), np.asarray(own[0].elements))
    np.testing.assert_allclose(K[..., below], alone[..., below], rtol=1e-12, atol=1e-9)


@pytest.mark.slow
def test_two_laws_in_series_carry_one_force(verified):
    """With fixed sides, each half is stretched uniformly. The nominal stresses are equal, and the stretches add up."""
    mesh = block(1, (1, 1, 4))
    sides = lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes), axes="xy")
    bottom = lj.Fixed(nodes=mesh.node_sets["z_min"], axes="z")
    top = lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([0.0, 0.0, -0.004]), axes="z")
    scene = lj.Scene(
        mesh=mesh,
        law=LIVER,
        region=(lj.Region(elements=upper(mesh), law=TUMOUR),),
        fixed=(sides, bottom),
        displaced=(top,),
        solve=lj.Solve(steps=2, tolerance=1e-12),
    )

    first_piola = jax.jit(lambda law, F: law.first_piola(F))

    def stress(law, stretch):
        return float(first_piola(law, np.diag([1.0, 1.0, stretch]))[2, 2])

    lower = scipy.optimize.brentq(lambda l: stress(LIVER, l) - stress(TUMOUR, 1.6 - l), 0.5, 1.0, xtol=1e-14)
    result = lj.simulate(scene).check()
    force = np.asarray(result.reactions)[-1][np.asarray(mesh.node_sets["z_max"]), 2].sum()
    exact = 1e-4 * stress(LIVER, lower)
    verified("two laws in series, confined compression", "root of one equation", abs(force / exact - 1), 1e-9)
    assert force == pytest.approx(exact, rel=1e-9)
    middle = np.isclose(np.asarray(mesh.points)[:, 2], 0.01)
    np.testing.assert_allclose(np.asarray(result.positions)[-1][middle, 2], 0.01 * lower, rtol=1e-9)


#: Features of a scene: changes and element order.
SCENES = {
    "static": ({}, 1),
    "projected": ({"solve": lj.Solve(steps=2, robust="projected")}, 1),
    "direct": ({"solve": lj.Solve(steps=2, linear_solver="direct")}, 1),
    "viscous": (
        {
            "viscosity": lj.Prony(ratios=jnp.array([0.4]), relaxation_times=jnp.array([0.1]), part="isochoric"),
            "solve": lj.Solve(kind="dynamic", dt=0.02, steps=3, integrator="newmark"),
            "body": lj.Body(density=1060.0, gravity=(0.0, 0.0, -9.81)),
        },
        1,
    ),
    "porous": (
        {
            "porosity": lj.Porosity(bulk=2000.0, limit_bulk=6000.0, fluid_fraction=0.8, permeability=1e-8),
            "solve": lj.Solve(dt=0.02, steps=2),
        },
        1,
    ),
    "mixed": ({"solve": lj.Solve(steps=2, volumetric="mixed")}, 2),
    "quadratic viscous": (
        {
            "viscosity": lj.Prony(ratios=jnp.array([0.4]), relaxation_times=jnp.array([0.1])),
            "solve": lj.Solve(dt=0.02, steps=2, volumetric="element"),
        },
        2,
    ),
    "float32": ({"solve": lj.Solve(steps=1, precision="float32", tolerance=1e-4)}, 1),
}


def pulled(name, region):
    changes, order = SCENES[name]
    mesh = block(order, (2, 2, 2))
    top = lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([0.001, 0.0, 0.002]))
    scene = lj.Scene(
        mesh=mesh,
        law=LIVER,
        region=(region(upper(mesh)),),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        displaced=(top,),
        solve=lj.Solve(steps=2),
    )
    return replace(scene, **changes)


@pytest.mark.slow  # the test of two laws in series is the quick one
@pytest.mark.parametrize("name", SCENES)
def test_a_law_of_its_own_is_that_with_other_numbers(name):
    """A region with a separate neo-Hookean law equals a region with other parameters of the scene's law, in every
    scene.
    """
    other = {"mu": 2000.0, "bulk": 4000.0}
    numbers = lj.simulate(pulled(name, lambda e: lj.Region(elements=e, law=other))).check()
    own = lj.simulate(pulled(name, lambda e: lj.Region(elements=e, law=lj.laws.NeoHookean(**other)))).check()
    away = 1e-5 if name == "float32" else 1e-8
    size = np.abs(np.asarray(numbers.positions) - np.asarray(block(SCENES[name][1], (2, 2, 2)).points)).max()
    np.testing.assert_allclose(own.positions, numbers.positions, atol=away * size)


@pytest.mark.slow
def test_numbers_of_a_law_of_its_own_have_names_and_derivatives():
    scene = pulled("static", lambda e: lj.Region(elements=e, law=lj.laws.typical("mooney_rivlin")))
    top = scene.displaced[0].nodes

    def force(c10):
        changed = with_parameters(scene, {"region.0.law.c10": c10})
        return lj.simulate(changed).reactions[-1, top, 2].sum()

    at, h = 300.0, 0.03
    value, slope = jax.jvp(force, (at,), (1.0,))
    assert float(slope) == pytest.approx(float(force(at + h) - force(at - h)) / (2 * h), rel=1e-5)
    assert abs(float(slope)) * at > 0.1 * abs(float(value))


def test_harmonic_motion_knows_the_laws():
    def moduli(region):
        scene = pulled("static", region)
        solve = lj.Solve(kind="harmonic", frequencies=jnp.array([50.0]))
        return lj.harmonic(replace(scene, solve=solve, body=lj.Body(density=1000.0)))

    other = {"mu": 2000.0, "bulk": 4000.0}
    numbers = moduli(lambda e: lj.Region(elements=e, law=other)).displacement
    own = moduli(lambda e: lj.Region(elements=e, law=lj.laws.NeoHookean(**other))).displacement
    np.testing.assert_allclose(own, numbers, atol=1e-10 * float(jnp.abs(numbers).max()))


@pytest.mark.slow
def test_the_shape_before_the_load_knows_the_laws():
    scene = pulled("static", lambda e: lj.Region(elements=e, law=TUMOUR))
    scene = replace(scene, displaced=(), body=lj.Body(density=1060.0, gravity=(0.0, 0.0, -9.81)))
    scene = replace(scene, solve=lj.Solve(tolerance=1e-12))
    found = lj.unloaded(replace(scene, points_are="loaded"))
    back = lj.simulate(found.scene).check().positions[-1]
    np.testing.assert_allclose(back, scene.mesh.points, atol=1e-10)


CONTENT = {
    "mesh": {"shape": "box", "size": [0.01, 0.01, 0.02], "cells": [2, 2, 4]},
    "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 3000.0},
    "fixed": [{"where": {"z_max": 0.0}}],
    "displaced": [{"where": {"z_min": 0.02}, "by": [0.0, 0.0, 0.001]}],
}
OGDEN = {"name": "ogden", "mu": [600.0, 200.0], "alpha": [2.0, -3.0], "bulk": 5000.0}


def test_scene_files_name_a_law_for_a_region():
    scene = scene_from(CONTENT | {"region": [{"where": {"z_min": 0.01}, "law": OGDEN}]})
    assert isinstance(scene.region[0].law, lj.laws.Ogden)
    assert [float(a) for a in jax.tree.leaves(scene.region[0].law)] == [float(a) for a in jax.tree.leaves(TUMOUR)]
    both = scene_from(CONTENT | {"region": [{"where": {"z_min": 0.01}, "law": [OGDEN, CONTENT["law"]]}]})
    assert len(both.region[0].law.summands()) == 2


@pytest.mark.parametrize(
    "more, sentence",
    [
        ({"region": [{"where": {"z_min": 0.01}, "law": {"name": "ogdn"}}]}, "did you mean ogden"),
        ({"region": [{"where": {"z_min": 0.01}, "law": {"name": "ogden", "mu": [1.0]}}]}, "needs parameter alpha"),
        ({"region": [{"where": {"z_min": 0.01}, "law": [{"mu": 1.0}]}]}, "region.0: law needs name"),
        (
            {"region": [{"where": {"z_min": 0.01}, "law": OGDEN}, {"where": {"z_min": 0.0}, "law": {"mu": 1.0}}]},
            "region.1 changes parameters of elements whose whole law is given by region.0",
        ),
        (
            {
                "region": [
                    {"where": {"z_min": 0.01}, "law": {"name": "saint_venant_kirchhoff", "mu": 1.0, "lame_lambda": 1.0}}
                ],
                "viscosity": {"ratios": [0.5], "relaxation_times": [1.0], "part": "isochoric"},
                "solve": {"dt": 0.1},
            },
            "needs a law with an isochoric part, unlike SaintVenantKirchhoff",
        ),
    ],
)
def test_unusable_laws_of_regions_get_one_sentence(more, sentence):
    with pytest.raises(lj.InputError, match=sentence):
        scene_from(CONTENT | more)


@pytest.mark.parametrize("order", [1, 2])
def test_averaged_volumes_know_laws_of_several_kinds(order):
    """If all volume ratios are equal, averaging changes nothing: each element has the energy of its own law."""
    from liverjax.physics.volumes import averaged

    scene = prepared(pulled("static", lambda e: lj.Region(elements=e, law=replace(TUMOUR, volumetric="log"))))
    mesh = scene.mesh if order == 1 else lj.quadratic(scene.mesh)
    subsets, J = scene.law.subsets, 0.9
    share = [float(jnp.sum(mesh.volumes[e[0]])) for e in subsets.elements]
    own = averaged.nodal_energy(mesh, mesh.at_points(scene.law))
    found = averaged.energy(mesh, own, jnp.full(mesh.weights.shape, J))
    first, second = (law.bulk for law in scene.law.laws)
    exact = share[0] * 0.5 * first * (J - 1) ** 2 + share[1] * 0.5 * second * np.log(J) ** 2
    assert np.isclose(found, exact, rtol=1e-12)
    p = averaged.averaged_pressure(mesh, own, jnp.full(mesh.weights.shape, J))
    # Inside each part the pressure is that of its own law.
    assert np.isclose(p.min(), first * (J - 1), rtol=1e-12) or np.isclose(p.min(), second * np.log(J) / J, rtol=1e-12)
    assert np.isclose(
        jnp.sum(p * averaged._mean(mesh, jnp.ones(mesh.weights.shape))[1]),
        sum(s * slope for s, slope in zip(share, (first * (J - 1), second * np.log(J) / J), strict=True)),
        rtol=1e-12,
    )


@pytest.mark.slow
def test_averaged_volumes_of_a_region_with_the_same_law_written_otherwise():
    """Mooney-Rivlin without its second constant is neo-Hookean. Other parameters of the same law count as
    another law.
    """
    same = lj.laws.MooneyRivlin(c10=LIVER.mu / 2, c01=0.0, bulk=LIVER.bulk)
    nodal = lj.Solve(volumetric="nodal", tolerance=1e-10)

    def ends(region):
        return lj.simulate(replace(pulled("static", region), solve=nodal)).check().positions[-1]

    plain = lj.simulate(replace(pulled("static", lambda e: lj.Region(elements=e, law=same)), region=(), solve=nodal))
    np.testing.assert_allclose(ends(lambda e: lj.Region(elements=e, law=same)), plain.positions[-1], atol=1e-12)
    soft = ends(lambda e: lj.Region(elements=e, law={"bulk": 0.5 * LIVER.bulk}))
    np.testing.assert_allclose(
        ends(lambda e: lj.Region(elements=e, law=replace(same, bulk=0.5 * LIVER.bulk))), soft, atol=1e-12
    )
    assert np.abs(soft - plain.positions[-1]).max() > 1e-6


def test_elements_named_twice_and_reduced_models_are_refused():
    scene = pulled("static", lambda e: lj.Region(elements=jnp.concatenate([e, e[:1]]), law=TUMOUR))
    with pytest.raises(lj.InputError, match="contains an element twice"):
        lj.check_scene(scene)
    from liverjax.reduced.model import refuse_unknown_physics

    with pytest.raises(lj.InputError, match="one kind of law"):
        refuse_unknown_physics(pulled("static", lambda e: lj.Region(elements=e, law=TUMOUR)))


def test_volumes_of_several_kinds_are_not_mixed():
    """With pressures as unknowns there can be only one kind of U(J). With two kinds, all elements had the first one.
    The error was 25 %, without a message.
    """
    own = {"name": "neo_hookean", "mu": 800.0, "bulk": 3000.0, "volumetric": "log"}
    region = {"region": [{"where": {"z_min": 0.01}, "law": own}]}
    with pytest.raises(lj.InputError, match="the same kind of volumetric energy in all laws"):
        scene_from(CONTENT | region | {"solve": {"volumetric": "mixed"}})
    mesh = {"mesh": CONTENT["mesh"] | {"order": 2}}
    scene = scene_from(CONTENT | region | mesh | {"solve": {"volumetric": "auto"}})
    assert prepared(scene).solve.volumetric == "element"
    region["region"][0]["law"]["volumetric"] = "quadratic"
    assert prepared(scene_from(CONTENT | region | mesh | {"solve": {"volumetric": "auto"}})).solve.volumetric == "mixed"


def test_numbers_out_of_bounds_have_their_place():
    with pytest.raises(lj.InputError, match=r"region\.0\.law\.bulk"):
        lj.check_scene(pulled("static", lambda e: lj.Region(elements=e, law=dataclasses.replace(LIVER, bulk=-1.0))))


@pytest.mark.ci
def test_terms_of_a_law_are_not_values_of_elements():
    """In a body of two elements, each element had one of the two terms of a law with arrays."""
    points = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    mesh, numbers = lj.tet_mesh(points, [[0, 1, 2, 3], [1, 2, 3, 4]]), ([700.0, -40.0], [2.5, -4.0])
    fine, F = lj.quadratic(mesh), np.eye(3) + 0.1 * np.arange(9).reshape(3, 3) / 9
    for of in (np.array, jnp.array):
        law, same = (lj.laws.Ogden(mu=m, alpha=a, bulk=7000.0) for m, a in (map(of, numbers), map(tuple, numbers)))
        split = law_of_elements(law, (lj.Region(elements=jnp.array([1]), law=law),), 2)
        for body, own in ((fine, law), (mesh, split)):
            whole = mjed.energy(body, same, body.points @ F.T)
            assert np.isclose(mjed.energy(body, own, body.points @ F.T), whole, rtol=1e-12)


def test_a_negative_shear_modulus_is_refused_only_if_the_whole_law_has_it():
    """Scenes with such laws were accepted."""
    content = {
        "mesh": {"shape": "box", "size": [1.0, 1.0, 1.0], "cells": [1, 1, 2]},
        "law": {"name": "mooney_rivlin", "c10": 300.0, "c01": -85.0, "bulk": 7700.0},
        "fixed": [{"where": {"z_max": 0.0}}],
    }
    soft, top = {"name": "bogen", "mu": -400.0, "alpha": 4.0, "bulk": 7700.0}, {"where": {"z_min": 0.5}}
    scene_from(content)
    scene_from(content | {"law": [{"name": "neo_hookean", "mu": 900.0, "bulk": 7700.0}, soft]})
    bottom = {"where": {"z_max": 0.5}, "law": {"c10": 400.0}}
    for wrong, name in (
        ({"law": soft}, "law"),
        ({"law": [{"name": "neo_hookean", "mu": 700.0, "bulk": 7700.0}, soft]}, "law"),
        ({"law": content["law"] | {"c10": 50.0}, "region": [top | {"law": {"bulk": 9000.0}}]}, "law"),
        ({"region": [top | {"law": {"c10": 50.0}}]}, "region.0: law"),
        ({"region": [bottom, top | {"law": soft}]}, "region.1: law"),
    ):
        with pytest.raises(lj.InputError, match=f"^{name} has .* must not be negative: change its parameters"):
            scene_from(content | wrong)


def test_a_sweep_checks_the_regions_once_and_the_stiffness_only_if_a_law_changes(tmp_path, monkeypatch):
    """Each row checked the elements of all regions and the stiffness again."""
    (tmp_path / "scene.toml").write_text(
        'mesh = {shape = "box", size = [1.0, 1.0, 1.0], cells = [1, 1, 2]}\n'
        'law = {name = "mooney_rivlin", c10 = 300.0, c01 = -85.0, bulk = 7700.0}\n'
        "fixed = [{where = {z_max = 0.0}}]\nbody = {density = 1000.0, gravity = [0.0, 0.0, -1.0]}\n"
        "[[region]]\nwhere = {z_min = 0.5}\nlaw = {c10 = 400.0}\n"
    )
    counts = dict.fromkeys(("check_region_elements", "_least_shear_modulus"), 0)

    def counted(name, check):
        def run(*given):
            counts[name] += 1
            return check(*given)

        return run

    for name in counts:
        monkeypatch.setattr(number_checks, name, counted(name, getattr(number_checks, name)))
    for column, values, stiffness in (("body.density", "1\n2", 1), ("region.0.law.c10", "300\n350", 3)):
        counts.update(dict.fromkeys(counts, 0))
        (tmp_path / "rows.csv").write_text(f"{column}\n{values}\n")
        read_sweep(tmp_path / "scene.toml", tmp_path / "rows.csv")
        assert counts == {"check_region_elements": 1, "_least_shear_modulus": stiffness}
    (tmp_path / "rows.csv").write_text("region.0.law.c10\n300\n50\n")
    with pytest.raises(lj.InputError, match=r"row 2: region\.0: law has a shear modulus"):
        read_sweep(tmp_path / "scene.toml", tmp_path / "rows.csv")
