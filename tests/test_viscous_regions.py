"""Regions with separate viscosity: compared with whole bodies of either kind, in harmonic motion, and invalid input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.scenes.by_element import by_element
from liverjax.scenes.checks.regions import check_region_viscosity
from liverjax.scenes.scene_checks import check_scene
from liverjax.scenes.scene_file import scene_from
from liverjax.waves.harmonic import element_operator

pytestmark = pytest.mark.quick_to_compile

LIVER = {"ratios": jnp.array([0.3, 0.2]), "relaxation_times": jnp.array([0.3, 0.03])}
LESION = {"ratios": jnp.array([0.1, 0.5]), "relaxation_times": jnp.array([0.1, 0.01])}


def block(order=1, viscosity=LIVER, part="all", region=(), **changes):
    """A block of 2 x 1 x 1 cm. Its nodes all have the same stretch and shear, or only its end is moved."""
    mesh = lj.shapes.box((0.02, 0.01, 0.01), (4, 2, 2))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    affine = mesh.points @ jnp.array([[0.1, 0.05, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    given = {
        "displaced": (lj.Displaced(nodes=jnp.arange(mesh.number_of_nodes), by=affine),),
        "solve": lj.Solve(dt=0.02, steps=4),
    } | changes
    law = lj.laws.NeoHookean(mu=800.0, bulk=3000.0)
    return lj.Scene(mesh=mesh, law=law, viscosity=lj.Prony(**viscosity, part=part), region=region, **given)


def lower(mesh):
    """Return the elements of the half y < 5 mm."""
    centres = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)].mean(axis=1)
    return jnp.asarray(np.flatnonzero(centres[:, 1] < 0.005))


@pytest.mark.slow
@pytest.mark.parametrize("order, part", [(1, "all"), (2, "isochoric")])
def test_a_body_of_two_has_the_forces_of_both(order, part):
    """All nodes are moved, so every element has a separate stress. The force is half of that of each whole body."""
    scene = block(order, part=part)
    end = np.asarray(scene.mesh.node_sets["x_max"])
    half = lj.Region(elements=lower(scene.mesh), viscosity=LESION)

    def force(scene):
        return np.asarray(lj.simulate(scene).check().reactions)[:, end].sum(axis=1)

    liver, lesion, both = (force(s) for s in (scene, block(order, LESION, part), replace(scene, region=(half,))))
    assert np.abs(liver - lesion).max() > 0.05 * np.abs(liver).max()
    np.testing.assert_allclose(both, 0.5 * (liver + lesion), atol=1e-12 * np.abs(liver).max())


@pytest.mark.slow
def test_a_later_region_wins():
    every = jnp.arange(block().mesh.number_of_elements)
    both = (lj.Region(elements=every, viscosity=LESION), lj.Region(elements=every, viscosity=LIVER))
    plain = lj.simulate(block()).check().reactions
    np.testing.assert_allclose(lj.simulate(block(region=both)).check().reactions, plain, atol=1e-15)


@pytest.mark.slow
def test_what_a_region_leaves_out_stays():
    every = jnp.arange(block().mesh.number_of_elements)
    times = lj.Region(elements=every, viscosity={"relaxation_times": LESION["relaxation_times"]})
    mixed = block(viscosity=LIVER | {"relaxation_times": LESION["relaxation_times"]})
    expected = lj.simulate(mixed).check().reactions
    np.testing.assert_allclose(lj.simulate(block(region=(times,))).check().reactions, expected, atol=1e-15)


@pytest.mark.ci
def test_harmonic_motion_takes_the_region_as_factors():
    mesh = block().mesh
    below = lower(mesh)
    moved = (lj.Displaced(nodes=mesh.node_sets["x_max"], by=jnp.array([0.0, 1e-4, 0.0])),)
    held = (lj.Fixed(nodes=mesh.node_sets["x_min"]),)
    scene = block(displaced=moved, fixed=held, body=lj.Body(density=1000.0), solve=lj.Solve())
    hertz = np.array([20.0, 40.0])
    found = lj.harmonic(replace(scene, region=(lj.Region(elements=below, viscosity=LESION),)), hertz).check()

    def share(series):
        w = 2 * np.pi * hertz[:, None]
        return 1 - np.sum(np.asarray(series["ratios"]) / (1 + 1j * w * np.asarray(series["relaxation_times"])), axis=1)

    factors = np.repeat(share(LIVER)[:, None], mesh.number_of_elements, axis=1)
    factors[:, np.asarray(below)] = share(LESION)[:, None]
    expected = lj.harmonic(scene, hertz, factors=jnp.asarray(factors)).check()
    np.testing.assert_allclose(found.displacement, expected.displacement, atol=1e-15)
    # About a stretched state, the part that never relaxes also has one value per element.
    about = mesh.points * jnp.array([[1.1, 1.0, 1.0]])
    every = lj.Region(elements=jnp.arange(mesh.number_of_elements), viscosity=LESION)
    one = element_operator(replace(scene, region=(every,)), about)
    two = element_operator(replace(scene, viscosity=lj.Prony(**LESION)), about)
    np.testing.assert_allclose(one.rest, two.rest, atol=1e-12 * np.abs(two.rest).max())


@pytest.mark.slow
def test_the_derivative_by_a_ratio_of_a_region_is_the_difference():
    scene = block(region=(lj.Region(elements=lower(block().mesh), viscosity=LESION),))

    def pull(g):
        own = lj.with_parameters(scene, {"region.0.viscosity.ratios": jnp.stack([jnp.asarray(0.1), g])})
        return 1e3 * jnp.sum(lj.simulate(own).reactions[-1, scene.mesh.node_sets["x_max"], 0])

    half = jnp.asarray(0.5)
    slope = float(jax.grad(pull)(half))
    errors = [abs(float(pull(half + h) - pull(half - h)) / (2 * h) / slope - 1) for h in (1e-2, 1e-4)]
    assert slope != 0 and min(errors) < 1e-8


@pytest.mark.slow
def test_the_shape_before_the_load_is_that_of_a_relaxed_region():
    held = (lj.Fixed(nodes=block().mesh.node_sets["x_min"]),)
    weight = lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -2.0]))
    scene = block(displaced=(), fixed=held, body=weight, solve=lj.Solve(dt=0.1))
    every = lj.Region(elements=jnp.arange(scene.mesh.number_of_elements), viscosity=LESION)
    found = lj.unloaded(replace(scene, region=(every,))).scene.mesh.points
    expected = lj.unloaded(replace(scene, viscosity=lj.Prony(**LESION))).scene.mesh.points
    assert np.abs(expected - scene.mesh.points).max() > 1e-5
    np.testing.assert_allclose(found, expected, atol=1e-12)


TEXT = {
    "mesh": {"shape": "box", "size": [0.02, 0.01, 0.01], "cells": [4, 2, 2]},
    "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 3000.0},
    "viscosity": {"ratios": [0.3, 0.2], "relaxation_times": [0.3, 0.03]},
    "fixed": [{"where": {"x_max": 0.0}}],
    "solve": {"dt": 0.1},
}


def of_region(**table):
    return scene_from(TEXT | {"region": [{"where": {"y_max": 0.005}, **table}]})


def test_a_scene_file_gives_a_region_its_viscosity():
    scene = of_region(viscosity={"ratios": [0.1, 0.5]}, law={"mu": 2000.0})
    assert scene.region[0].law == {"mu": 2000.0}
    np.testing.assert_array_equal(scene.region[0].viscosity["ratios"], [0.1, 0.5])


@pytest.mark.parametrize(
    "viscosity, words",
    [
        ({"ratios": [0.1]}, "1 numbers, but the scene has 2 modes"),
        ({"ratios": [0.6, 0.5]}, "region.0: .*less than 1"),
        ({"ratios": [0.1, -0.5]}, "region.0: "),
        ({"relaxation_times": [0.1, 0.0]}, "region.0: "),
        ({"part": "all"}, "numbers|part"),
        ({"times": [0.1, 0.2]}, "only ratios and relaxation_times"),
        ("slow", "must be a table"),
    ],
)
def test_a_viscosity_that_no_region_can_have_gets_a_sentence(viscosity, words):
    with pytest.raises(lj.InputError, match=words) as told:
        of_region(viscosity=viscosity)
    assert "\n" not in str(told.value)


def test_scenes_without_viscosity_and_reduced_models_refuse_it():
    region = lj.Region(elements=jnp.array([0]), viscosity=LESION)
    with pytest.raises(lj.InputError, match=r"needs \[viscosity\] in the scene"):
        check_region_viscosity(None, region, "region.0")
    short = lj.Region(elements=jnp.array([0]), viscosity={"ratios": jnp.array([0.2])})
    with pytest.raises(lj.InputError, match="1 numbers, but the scene has 2 modes"):  # from Python, before compilation
        lj.simulate(block(region=(short,)))
    plain = block()
    each = {key: jnp.tile(numbers[:, None], plain.mesh.number_of_elements) for key, numbers in LIVER.items()}
    for scene in (block(region=(region,)), block(viscosity=each)):
        with pytest.raises(lj.InputError, match="a reduced model can have only one viscosity"):
            lj.reduce_scene(scene, {"law.mu": [800.0]})


@pytest.mark.parametrize("keys", [["ratios"], ["relaxation_times"], ["ratios", "relaxation_times"]])
def test_a_region_changes_a_viscosity_with_values_per_element(keys):
    """This gave an error of shapes, or a false sentence about the numbers of ratios and times."""
    mesh = block().mesh
    half = lower(mesh)
    each = {key: jnp.tile(numbers[:, None], mesh.number_of_elements) for key, numbers in LIVER.items()}
    scene = block(viscosity=each, region=(lj.Region(elements=half, viscosity={key: LESION[key] for key in keys}),))
    check_scene(scene)
    found = by_element(scene).viscosity
    for key, numbers in each.items():
        wanted = np.array(numbers)
        if key in keys:
            wanted[:, np.asarray(half)] = np.asarray(LESION[key])[:, None]
        np.testing.assert_array_equal(getattr(found, key), wanted)
    wrong = lj.Region(elements=half, viscosity={"ratios": jnp.array([0.6, 0.5])})
    with pytest.raises(lj.InputError, match=r"region\.0: viscosity\.ratios = .* must add up to less than 1"):
        check_region_viscosity(scene.viscosity, wrong, "region.0")


@pytest.mark.parametrize("name", ["viscosity.ratios.0", "region.0.viscosity.ratios.0"])
def test_ratios_in_tuples_can_be_unknown(name):
    """The check of regions gave a tuple of JAX tracers to NumPy, so the derivative ended with a traceback."""
    region = lj.Region(elements=jnp.arange(4), viscosity={"ratios": (0.1, 0.5)})
    scene = block(viscosity={"ratios": (0.3, 0.2), "relaxation_times": (0.3, 0.03)}, region=(region,))
    found = jax.eval_shape(lambda value: lj.simulate(lj.with_parameters(scene, {name: value})).positions, 0.25)
    assert found.shape[1:] == scene.mesh.points.shape
