"""The shape before the load: there and back, and against a bar under its own weight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

ORDERS = pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])


def content(order: int = 1, **more) -> dict:
    return {
        "mesh": {"shape": "box", "size": [0.04, 0.01, 0.01], "cells": [2, 1, 1], "order": order, "is": "loaded"},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "body": {"density": 1000.0, "gravity": [1.0, 0, -0.5]},
        "fixed": [{"where": {"x_max": 0.0}}],
        "solve": {"tolerance": 1e-12},
    } | more


@ORDERS
def test_there_and_back(order):
    """The run from the reference shape ends in the given one; prescribed parts of other physics go along."""
    skin = {"thickness": 1e-4, "law": {"name": "neo_hookean", "mu": 1e4}, "where": {"z_min": 0.01}}
    scene = scene_from(content(order, membrane=[skin], support=[{"where": {"x_min": 0.04}, "normal": 2e3}]))
    found = lj.unloaded(scene)
    assert found.status == 0 and found.residual <= 1e-12
    given, V = scene.mesh.points, scene.mesh.number_of_vertices
    sag = np.abs(found.scene.mesh.points - given).max()
    assert sag > 2e-3  # far: 5 % of the length
    for run in (found.scene, scene):
        back = lj.simulate(run).check().positions[-1]
        assert np.abs(back - given)[:V].max() < 1e-8 * sag


@ORDERS
def test_a_bar_under_its_own_weight(order, verified):
    """Uniaxial: rho g (L - X) = P(l(X)), so of a bar of loaded length l the reference length solves one equation."""
    mu, rho_g, length = 800.0, 2000.0, 0.04
    # bulk = 2/3 mu makes Poisson's ratio 0 for small strain only, so the sides are held: P of a column.
    table = content(order, body={"density": 1000.0, "gravity": [rho_g / 1000.0, 0, 0]})
    table["mesh"]["cells"] = [8, 1, 1] if order == 1 else [4, 1, 1]
    sides = [
        {"where": w, "axes": a}
        for w, a in (({"y_max": 0.0}, "y"), ({"y_min": 0.01}, "y"), ({"z_max": 0.0}, "z"), ({"z_min": 0.01}, "z"))
    ]
    table["fixed"] += sides
    scene = scene_from(table)
    X = np.asarray(lj.unloaded(scene).scene.mesh.points)
    reference = X[:, 0].max()
    law = lj.laws.NeoHookean(mu=mu, bulk=4000.0)
    # Stretch at every depth from the stress there; the length itself by bisection.
    grid = np.linspace(1.0, 1.2, 400)
    F = np.tile(np.eye(3), (400, 1, 1))
    F[:, 0, 0] = grid
    stress = np.asarray(law.first_piola(F))[:, 0, 0]

    def loaded(L):
        depth = (np.arange(200) + 0.5) / 200 * L
        return float(np.mean(np.interp(rho_g * depth, stress, grid)) * L)

    low, high = 0.035, 0.04
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if loaded(middle) < length else (low, middle)
    change = abs((reference - low) / (length - low))
    verified(f"reference shape of a bar, order {order}", "analytic", change, 0.01)
    assert change < 0.01


@pytest.mark.slow
def test_derivatives_go_through_the_reference_shape():
    """Reference length by mu, and a run from it: its end does not depend on mu at all."""
    scene = scene_from(content())
    tip = lj.boundary.select(scene.mesh, {"x_min": 0.04})

    def length(mu):
        return jnp.mean(lj.unloaded(lj.with_parameters(scene, {"law.mu": mu})).scene.mesh.points[tip, 0])

    def end(mu):
        return jnp.mean(lj.simulate(lj.with_parameters(scene, {"law.mu": mu})).positions[-1, tip, 0])

    by, reverse = jax.jacfwd(length)(800.0), jax.grad(length)(800.0)
    errors = [abs((length(800.0 + h) - length(800.0 - h)) / (2 * h) / by - 1) for h in (80.0, 0.8)]
    assert errors[1] < 1e-5 < 1e-4 < errors[0] and np.isclose(by, reverse, rtol=1e-7)
    assert abs(jax.grad(end)(800.0)) < 1e-6 * abs(by)


@pytest.mark.slow
def test_the_relaxed_body_lies_as_given():
    """A viscous body ends, after long, in the given shape."""
    table = content(viscosity={"ratios": [0.4], "relaxation_times": [0.1]})
    table["solve"] |= {"dt": 0.5, "steps": 12}
    scene = scene_from(table)
    positions = np.asarray(lj.simulate(scene).check().positions)
    given = np.asarray(scene.mesh.points)
    assert np.abs(positions[0] - given).max() > 1e-5 and np.abs(positions[-1] - given).max() < 1e-7


def test_what_cannot_be_is_said():
    with pytest.raises(InputError, match="is = 'slack' is not known"):
        scene_from(content(mesh=content()["mesh"] | {"is": "slack"}))
    sponge = {"bulk": 400.0, "limit_bulk": 2200.0, "fluid_fraction": 0.5, "permeability": 1e-6}
    with pytest.raises(InputError, match="does not know the pressure of a fluid"):
        scene_from(content(porosity=sponge, solve={"dt": 0.1}))
    # Hung by its end under a hundred times its weight, no reference body is that short.
    heavy = scene_from(content(body={"density": 1000.0, "gravity": [-300.0, 0, 0]}))
    with pytest.raises(InputError, match=r"no reference shape was found that these loads bring to the given one"):
        lj.simulate(replace(heavy, solve=lj.Solve()))
