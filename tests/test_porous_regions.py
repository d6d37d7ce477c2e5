"""Regions with separate porosity: flow through two layers by hand, whole bodies of each kind, invalid input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.physics.porosity import Inlet
from liverjax.scenes.by_element import by_element
from liverjax.scenes.checks.numbers import check_bounds
from liverjax.scenes.checks.regions import check_region_porosity
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

LIVER = {"bulk": 1600.0, "limit_bulk": 5000.0, "fluid_fraction": 0.7, "permeability": 1e-9}
SCAR = {"bulk": 4000.0, "limit_bulk": 9000.0, "fluid_fraction": 0.4, "permeability": 2e-10}


def column(order=1, sponge=LIVER, region=(), scheme="implicit", **changes):
    """A column of 2 cm, drained and compressed at its top."""
    mesh = lj.shapes.box((0.01, 0.01, 0.02), (2, 2, 4))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    given = {
        "fixed": (lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        "displaced": (lj.Displaced(nodes=mesh.node_sets["z_max"], by=jnp.array([0.0, 0.0, -0.001])),),
        "solve": lj.Solve(dt=0.05, steps=3),
    } | changes
    porosity = lj.Porosity(**sponge, drained=mesh.node_sets["z_max"], scheme=scheme)
    law = lj.laws.NeoHookean(mu=800.0, bulk=3000.0)
    return lj.Scene(mesh=mesh, law=law, porosity=porosity, region=region, **given)


def upper(mesh):
    centres = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)].mean(axis=1)
    return jnp.asarray(np.flatnonzero(centres[:, 2] > 0.01))


def everywhere(mesh, numbers):
    return (lj.Region(elements=jnp.arange(mesh.number_of_elements), porosity=numbers),)


@pytest.mark.parametrize(
    "order, scheme",
    [
        pytest.param(1, "implicit", marks=pytest.mark.slow),
        pytest.param(1, "lagged", marks=pytest.mark.slow),
        pytest.param(2, "implicit", marks=pytest.mark.slow),
    ],
)
def test_a_region_of_all_elements_is_the_body(order, scheme):
    mesh = column(order).mesh
    alone = lj.simulate(column(order, SCAR, scheme=scheme)).check()
    found = lj.simulate(column(order, region=everywhere(mesh, SCAR), scheme=scheme)).check()
    other = lj.simulate(column(order, scheme=scheme)).check()
    size = np.abs(np.asarray(alone.pressure)).max()
    assert np.abs(np.asarray(other.pressure) - np.asarray(alone.pressure)).max() > 0.05 * size
    np.testing.assert_allclose(found.pressure, alone.pressure, atol=1e-6 * size)
    np.testing.assert_allclose(found.positions, alone.positions, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_flow_through_two_layers(order, verified):
    """Between two pressures the same flux passes both layers, so the gradients are inverse to the permeabilities."""
    mesh = column(order).mesh
    inlet = Inlet(nodes=mesh.node_sets["z_min"], pressure=1.0)
    held = (lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes)),)
    region = (lj.Region(elements=upper(mesh), porosity={"permeability": 2e-10}),)
    scene = column(order, region=region, fixed=held, displaced=(), solve=lj.Solve(dt=1e4, steps=3, tolerance=1e-10))
    scene = replace(scene, porosity=replace(scene.porosity, inlet=(inlet,)))
    pressure = np.asarray(lj.simulate(scene).check().pressure)[-1]
    z = np.asarray(mesh.points)[: len(pressure), 2]
    middle = 1 - 2e-10 / (1e-9 + 2e-10)
    exact = np.where(z < 0.01, 1 + (middle - 1) * z / 0.01, middle * (0.02 - z) / 0.01)
    verified(f"flow through two layers, order {order}", "by hand", np.abs(pressure - exact).max(), 1e-8)
    np.testing.assert_allclose(pressure, exact, atol=1e-8)


@pytest.mark.ci
def test_the_fluid_s_velocity_is_that_of_each_layer():
    from liverjax.jobs.fields import fields

    mesh = column().mesh
    inlet = Inlet(nodes=mesh.node_sets["z_min"], pressure=1.0)
    held = (lj.Fixed(nodes=jnp.arange(mesh.number_of_nodes)),)
    region = (lj.Region(elements=upper(mesh), porosity={"permeability": 2e-10}),)
    scene = column(region=region, fixed=held, displaced=(), solve=lj.Solve(dt=1e4, steps=3, tolerance=1e-10))
    scene = replace(scene, porosity=replace(scene.porosity, inlet=(inlet,)))
    found = fields(scene, lj.simulate(scene).check(), ["fluid_velocity"])["fluid_velocity"][-1]
    np.testing.assert_allclose(found[:, 2], 2e-10 * (1e-9 / 1.2e-9) / 0.01, rtol=1e-6)


@pytest.mark.slow
def test_the_derivative_by_a_permeability_of_a_region_is_the_difference():
    mesh = column().mesh
    scene = column(region=(lj.Region(elements=upper(mesh), porosity={"permeability": 2e-10}),))

    def pressed(log):
        own = lj.with_parameters(scene, {"region.0.porosity.permeability": jnp.exp(log)})
        return lj.simulate(own).reactions[-1, mesh.node_sets["z_max"], 2].sum()

    at = jnp.log(2e-10)
    slope = float(jax.grad(pressed)(at))
    errors = [abs(float(pressed(at + h) - pressed(at - h)) / (2 * h) / slope - 1) for h in (1e-2, 1e-3)]
    assert slope != 0 and min(errors) < 1e-5


@pytest.mark.slow
def test_the_mesh_s_error_knows_the_region():
    mesh = column().mesh
    solve = lj.Solve(dt=0.05, steps=1)
    alone = lj.simulate(column(sponge=SCAR, solve=solve), mesh_error=True).check()
    found = lj.simulate(column(region=everywhere(mesh, SCAR), solve=solve), mesh_error=True).check()
    size = np.abs(np.asarray(alone.mesh_error.positions)).max()
    np.testing.assert_allclose(found.mesh_error.positions, alone.mesh_error.positions, atol=1e-5 * size)


TEXT = {
    "mesh": {"shape": "box", "size": [0.01, 0.01, 0.02], "cells": [2, 2, 4]},
    "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 3000.0},
    "porosity": LIVER,
    "fixed": [{"where": {"z_max": 0.0}}],
    "solve": {"dt": 0.1},
}


def of_region(**table):
    return scene_from(TEXT | {"region": [{"where": {"z_min": 0.01}, **table}]})


def test_a_scene_file_gives_a_region_its_porosity():
    assert of_region(porosity={"permeability": 1e-10}).region[0].porosity == {"permeability": 1e-10}


@pytest.mark.parametrize(
    "porosity, words",
    [
        ({"permeability": -1.0}, "region.0: .*permeability"),
        ({"bulk": 6000.0}, "region.0: .*must be above bulk"),
        ({"drained": 1.0}, "cannot differ in a region"),
        ({"permeabilty": 1.0}, "did you mean permeability"),
        (1.0, "must be a table"),
    ],
)
def test_a_porosity_that_no_region_can_have_gets_a_sentence(porosity, words):
    with pytest.raises(lj.InputError, match=words) as told:
        of_region(porosity=porosity)
    assert "\n" not in str(told.value)


def test_scenes_without_porosity_refuse_it():
    region = lj.Region(elements=jnp.array([0]), porosity={"permeability": 1e-9})
    with pytest.raises(lj.InputError, match=r"needs \[porosity\] in the scene"):
        check_region_porosity(None, region, "region.0")
    several = lj.Region(elements=jnp.array([0]), porosity={"permeability": jnp.array([1e-9, 1e-9])})
    with pytest.raises(lj.InputError, match="has 2 numbers; give one"):
        lj.simulate(column(region=(several,)))


def test_overlapping_regions_are_checked_together():
    """Each region was checked alone: a limit_bulk below bulk passed, and valid values of two regions were refused."""
    mesh = column().mesh

    def check(bulk, limit):
        regions = (*everywhere(mesh, {"bulk": bulk}), lj.Region(elements=upper(mesh), porosity={"limit_bulk": limit}))
        check_bounds(column(sponge=LIVER | {"bulk": 300.0, "limit_bulk": 1e4}, region=regions))

    check(5000.0, 6000.0)
    with pytest.raises(lj.InputError, match=r"region\.0, region\.1: .*= 1000 must be above bulk = 5000"):
        check(5000.0, 1000.0)
    with pytest.raises(lj.InputError, match="= 10000 must be above bulk = 20000"):  # outside the second region
        check(2e4, 1e6)
    both = (*everywhere(mesh, {"bulk": 2e4}), *everywhere(mesh, {"limit_bulk": 1e6}))
    check_bounds(column(region=both))


@pytest.mark.parametrize("points", [1, 4])
def test_a_region_changes_a_scene_with_values_at_integration_points(points):
    """by_element failed with an error of NumPy, and limit_bulk was not compared with bulk."""
    mesh = column(2).mesh
    numbers = jnp.full((points, mesh.number_of_elements), 1600.0)
    region = (lj.Region(elements=upper(mesh), porosity={"bulk": 4000.0}),)
    scene = column(2, LIVER | {"bulk": numbers}, region)
    check_bounds(scene)
    found = np.asarray(by_element(scene).porosity.bulk)
    assert found.shape == numbers.shape and np.all(found[:, upper(mesh)] == 4000) and found.min() == 1600
    region = (lj.Region(elements=upper(mesh), porosity={"bulk": 6000.0}),)
    with pytest.raises(lj.InputError, match=r"region\.0: .*must be above bulk = 6000"):
        check_bounds(replace(scene, region=region))
