"""Pressure and flux of the fluid at parts of the surface: steady flow through a stiff porous body, and fluid
balance.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.mesh.nodal import integrals
from liverjax.physics import darcy, porosity
from liverjax.physics.base import Step
from liverjax.physics.darcy import Guess
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation.equations import (
    equations,
    flowing_lack,
    flowing_pressure,
    free_directions,
    initial_state,
    residual,
    unknowns,
)

pytestmark = pytest.mark.quick_to_compile

LOW, TOP = {"x_max": 0.0}, {"x_min": 0.1}


def content(inlet: list, order: int = 1, **more) -> dict:
    sponge = {"bulk": 4e8, "limit_bulk": 1e9, "fluid_fraction": 0.5, "permeability": 2e-6, "inlet": inlet}
    return {
        "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [3, 1, 1], "order": order},
        "law": {"name": "neo_hookean", "mu": 8e8, "bulk": 4e9},
        "porosity": sponge | more,
        "fixed": [{"where": LOW}],
        "solve": {"dt": 10.0, "steps": 2},
    }


def pressures(scene: lj.Scene, steps: int = 1) -> np.ndarray:
    """Return the pressures (V,) of a porous body that is so stiff that it does not move."""
    mesh, sponge = scene.mesh, scene.porosity
    memory, J = porosity.initial_fluid(sponge, mesh), jnp.ones_like(mesh.weights)
    for k in range(1, steps + 1):
        step = Step(mesh, mesh.points, float(k), steps, scene.solve.dt, False, 1e-10, free_directions(scene))
        acting = sponge.freeze(memory, step)
        memory = porosity.Fluid(acting.pressure(mesh, J), J, None)
    return np.asarray(memory.pressure)


@pytest.mark.ci
@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_fluid_is_driven_through(order):
    """Steady flow: linear from one given pressure to the other. With a given flux v, the gradient is v/kappa."""
    scene = scene_from(content([{"where": LOW, "pressure": 300.0}, {"where": TOP, "pressure": 100.0}], order))
    x = np.asarray(scene.mesh.points)[: scene.mesh.number_of_vertices, 0]
    assert np.allclose(pressures(scene), 300.0 - 2000.0 * x, rtol=1e-6)
    driven = scene_from(content([{"where": LOW, "flux": 1e-3}, {"where": TOP, "pressure": 100.0}], order))
    assert np.allclose(pressures(driven), 100.0 + 500.0 * (0.1 - x), rtol=1e-6)


@pytest.mark.ci
def test_forces_and_fluid_together_lack_nothing_and_are_symmetric():
    """The derivatives of a step contain forces and fluid, with given pressures among the unknowns."""
    soft = {"bulk": 400.0, "limit_bulk": 2200.0, "permeability": 2e-5}
    body = content([{"where": LOW, "pressure": 300.0}, {"where": TOP, "flux": 1e-3}], **soft)
    scene = scene_from(body | {"law": {"name": "neo_hookean", "mu": 300.0, "bulk": 400.0}})
    e = equations(scene, initial_state(scene), jnp.ones(()))
    rng = np.random.default_rng(0)
    q = unknowns(e, scene.mesh.points + 1e-3 * jnp.asarray(rng.normal(size=scene.mesh.points.shape)))
    n, P = len(q), flowing_pressure(e, q, jnp.ones(()), Guess(jnp.zeros(scene.mesh.number_of_nodes), 1.0))
    r, left = flowing_lack(e, q, P)
    flow = e.volume.flow
    allowed = 10 * flow.tolerance * jnp.linalg.norm(darcy.flow_product(flow, flow.given))
    assert np.allclose(r, residual(e, q, jnp.ones(()))[0], rtol=1e-6) and jnp.linalg.norm(left) < allowed
    given = np.asarray(flow.mask) == 0
    assert np.array_equal(np.flatnonzero(given), np.flatnonzero(np.asarray(scene.mesh.points)[:, 0] == 0))
    moved = flowing_lack(e, q, P + 7.0 * jnp.asarray(given))
    assert np.allclose(moved[0], r, rtol=1e-12) and np.allclose(moved[1][given], -7.0)
    D = np.asarray(jax.jit(jax.jacfwd(lambda u: jnp.concatenate(flowing_lack(e, u[:n], u[n:]))))(jnp.append(q, P)))
    for rows in (slice(n), slice(n, None)):
        for columns in (slice(n), slice(n, None)):
            size = np.abs(D[rows, columns]).max()
            assert size > 0 and np.abs(D[rows, columns] - D[columns, rows].T).max() < 1e-13 * size


@pytest.mark.parametrize("steps", [1, 4])
def test_a_sealed_sponge_keeps_what_enters(steps):
    """The mean pressure rises by K_lim A/V times the integral of the flux. A history is a factor, and a starting
    pressure is kept. The flux at the end of each step was used for the whole step, which gave 30 s in place of 25 s.
    """
    inlet = [{"where": LOW, "flux": 1e-9, "history": [[0.0, 0.0], [10.0, 2.0], [20.0, 1.0]]}]
    scene = scene_from(content(inlet, initial_pressure=7.0) | {"solve": {"dt": 20.0 / steps, "steps": steps}})
    P = pressures(scene, steps)
    mean = float(integrals(scene.mesh, jnp.ones_like(scene.mesh.weights)) @ P / np.sum(scene.mesh.volumes))
    assert np.isclose(mean, 7.0 + 1e9 * 1e-9 * 25.0 / 0.1, rtol=1e-8)


@pytest.mark.parametrize("history", [[[0.0, 0.0], [1e-6, 1.0]], [[0.0, 1.0], [1.0, 1.0], [1.000001, 0.0]]])
def test_a_flux_may_jump_between_two_steps(history):
    """A flux that begins or ends within a microsecond has the same integral for all steps."""
    table = content([{"where": LOW, "flux": 1e-9, "history": history}])
    scene = scene_from(table | {"solve": {"dt": 0.5, "steps": 2 if history[0][1] == 0.0 else 4}})
    every = [porosity.inflow(scene.porosity, scene.mesh, 0.5 * (k + 1), 0.5)[1].sum() for k in range(scene.solve.steps)]
    steady = replace(scene.porosity.inlet[0], times=None, history=None)
    whole = porosity.inflow(replace(scene.porosity, inlet=(steady,)), scene.mesh, 1.0, 1.0)[1].sum()
    assert np.isclose(sum(every), whole, rtol=2e-6)


@pytest.mark.slow
def test_the_energy_has_the_force_for_its_gradient():
    """Robust steps need this energy. Given pressures act as they are, free pressures by the change of their fluid."""
    import jax

    from liverjax.simulation.equations import energy, equations, initial_state, residual, unknowns

    scene = scene_from(
        content(
            [{"where": LOW, "pressure": 300.0}, {"where": {"z_min": 0.1}, "flux": 1e-3}], bulk=400.0, limit_bulk=2200.0
        )
    )
    e = equations(scene, initial_state(scene), 1.0)
    q = unknowns(e, scene.mesh.points * (1 + 0.02 * jnp.sin(40 * scene.mesh.points[:, :1])))
    r, start = residual(e, q, 1.0)[0], q
    assert np.allclose(jax.grad(lambda q: energy(e, q, start))(q) - r, 0.0, atol=1e-6 * np.abs(r).max())


@pytest.mark.slow
def test_perfusion_swells_a_soft_sponge():
    """With pressure p on two sides of a free porous body, the final state has sigma(J) = p of the drained body, without
    shear.
    """
    table = content([{"where": w, "pressure": 50.0} for w in (LOW, TOP)], bulk=400.0, limit_bulk=2200.0)
    table |= {"law": {"name": "neo_hookean", "mu": 100.0, "bulk": 400.0}, "solve": {"dt": 50.0, "steps": 4}}
    table["fixed"] = [
        {"where": LOW, "axes": "x"},
        {"where": {"y_max": 0.0}, "axes": "y"},
        {"where": {"z_max": 0.0}, "axes": "z"},
    ]
    scene = scene_from(table)
    x = np.asarray(lj.simulate(scene).check().positions[-1])
    J = np.prod(np.ptp(x, axis=0)) / 1e-3
    assert np.isclose(porosity.volumetric_stress(scene.porosity, J), 50.0, rtol=1e-3)


@pytest.mark.parametrize(
    ("inlet", "words"),
    [
        ({"where": LOW}, "porosity.inlet.0 needs either pressure"),
        ({"where": LOW, "pressure": 1.0, "flux": 1.0}, "porosity.inlet.0 needs either pressure"),
        ({"where": LOW, "presure": 1.0}, "did you mean pressure"),
        ({"where": LOW, "pressure": 1.0, "history": [[0, 0, 0, 0]]}, "porosity.inlet.0 history has rows of 4 numbers"),
    ],
)
def test_bad_inlets_are_refused(inlet, words):
    with pytest.raises(InputError, match=words):
        scene_from(content([inlet]))


def test_inlets_that_would_do_nothing_are_refused():
    """A node has one pressure. Through a surface with given pressures, incoming fluid leaves at once. Edges may be
    shared.
    """
    low, top = {"where": LOW, "pressure": 1.0}, {"where": TOP, "flux": 1e-3}
    side = {"where": {"y_max": 0.0}, "pressure": 2.0}
    scene_from(content([low, top, side]))
    scene_from(content([low, side, top], drained=[{"z_max": 0.0}]))
    for inlets, drained, words in (
        ([low, dict(low, pressure=-3.0)], [], "porosity.inlet.0 has no effect, because porosity.inlet.1"),
        ([low], [LOW], "porosity.drained has no effect, because porosity.inlet.0"),
        ([low, top], [TOP], "porosity.inlet.1 is a flux through a surface"),
    ):
        with pytest.raises(InputError, match=words):
            scene_from(content(inlets, **({"drained": drained} if drained else {})))


def test_places_of_the_fluid_that_hold_middles_of_edges_alone_are_refused():
    """Pressures belong to vertices. At x = 0.05, between vertices at 0.033 and 0.067, there are none."""
    middle = {"x_min": 0.04, "x_max": 0.06}
    for more in ({"inlet": [{"where": middle, "pressure": 5.0}]}, {"inlet": [], "drained": [middle]}):
        with pytest.raises(InputError, match="contains only midside nodes, which have no pressure"):
            scene_from(content(more["inlet"], 2, **{k: v for k, v in more.items() if k == "drained"}))
