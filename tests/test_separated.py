"""Separated form of static displacements (proper generalised decomposition): exact cases, errors, derivatives,
messages.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.reduced.separated import _terms

pytestmark = pytest.mark.quick_to_compile

RANGES = {"law.mu": (600.0, 900.0), "body.gravity.2": (-1.5, -0.2)}


@pytest.fixture(scope="module")
def scene():
    mesh = lj.shapes.box([0.03, 0.01, 0.01], [3, 1, 1])
    held = jnp.asarray(lj.boundary.select(mesh, {"x_max": 0.0}, None, "fixed"))
    body = lj.Body(density=1000.0, gravity=jnp.array([0.0, 0.0, -1.0]))
    law = lj.laws.NeoHookean(mu=800.0, bulk=3000.0)
    return lj.Scene(mesh=mesh, law=law, fixed=(lj.Fixed(nodes=held),), body=body)


@pytest.fixture(scope="module")
def model(scene):
    return lj.separate(scene, RANGES, points=4, tolerance=1e-5)


@pytest.mark.ci
def test_the_error_at_unseen_runs_is_stated(scene, model):
    assert model.left_out < 1e-5 and model.error.shape == (8,)
    for mu, g in ((612.0, -1.45), (750.0, -0.7), (890.0, -0.25)):
        exact = lj.simulate(lj.with_parameters(scene, {"law.mu": mu, "body.gravity.2": g})).check().positions[-1]
        u = lj.separated_displacement(model, {"law.mu": mu, "body.gravity.2": g})
        off = np.linalg.norm(scene.mesh.points + u - exact, axis=1).max() / np.linalg.norm(u, axis=1).max()
        assert 0 < off < 3 * float(model.error.max())
    assert float(model.error.max()) < 0.01


@pytest.mark.slow
def test_more_points_of_the_grid_lower_the_error_by_powers(scene, model):
    """The displacements are analytic in the parameters, and are approximated by polynomials of degree 1 and 3."""
    coarse = lj.separate(scene, RANGES, points=2, tolerance=1e-5)
    assert float(coarse.error.max()) > 10 * float(model.error.max())


def test_products_are_found_as_what_they_are():
    """A tensor is made of three terms of three parameters. These terms reproduce the tensor, and no fourth term is
    added.
    """
    rng = np.random.default_rng(0)
    a, b, c, w = (rng.normal(size=(3, n)) for n in (4, 4, 4, 30))
    tensor = np.einsum("mi,mj,mk,mx->ijkx", a * np.array([[9.0], [3.0], [1.0]]), b, c, w)
    products, factors, left = _terms(tensor.reshape(64, 30), (4, 4, 4), 1e-9, 40)
    assert left < 1e-9
    fields = np.linalg.lstsq(products, tensor.reshape(64, 30), rcond=None)[0]
    np.testing.assert_allclose(products @ fields, tensor.reshape(64, 30), atol=1e-7)
    few = _terms(tensor.reshape(64, 30), (4, 4, 4), 0.9, 40)
    assert few[0].shape[1] == 1 and [f.shape for f in factors] == [factors[0].shape] * 3


@pytest.mark.slow
def test_derivatives_are_those_of_the_runs(scene, model):
    """Derivatives with respect to the load and the modulus are compared with those of the full model."""

    def tip(u):
        return u[-1, 2]

    def full(mu):
        at = lj.simulate(lj.with_parameters(scene, {"law.mu": mu, "body.gravity.2": -0.8}))
        return tip(at.positions[-1])  # positions and displacements have the same derivative

    def separated(mu):
        return tip(lj.separated_displacement(model, {"law.mu": mu, "body.gravity.2": -0.8}))

    own = jax.grad(separated)(740.0)
    assert own == pytest.approx(float(jax.jacfwd(separated)(740.0)), rel=1e-12)
    assert own == pytest.approx(float(jax.grad(full)(740.0)), rel=0.02)
    lanes = jax.jit(jax.vmap(separated))(jnp.array([700.0, 800.0]))
    assert lanes[0] == pytest.approx(float(separated(700.0)), rel=1e-12)


def test_traced_values_outside_of_the_range_have_no_answer(model):
    """Outside the range, the polynomials gave -7 m for a body of 0.1 m, with a derivative."""

    def tip(mu):
        return lj.separated_displacement(model, {"law.mu": mu, "body.gravity.2": -0.8})[-1, 2]

    low, high = np.asarray(model.ranges[model.names.index("law.mu")])
    found = np.asarray(jax.vmap(tip)(jnp.array([low, high, 0.9 * low, 1.1 * high])))
    assert np.array_equal(np.isnan(found), [False, False, True, True])
    assert np.isnan(jax.jit(jax.grad(tip))(1.1 * high)) and np.isfinite(jax.jit(jax.grad(tip))(high))


def test_a_loaded_mesh_is_refused(scene):
    """Displacements were measured from the given shape, in which the runs end, so they were only noise."""
    with pytest.raises(InputError, match=r"cannot have a separated form: use the scene of lj.unloaded"):
        lj.separate(replace(scene, points_are="loaded"), RANGES)


@pytest.mark.parametrize(
    "ranges, more, words",
    [
        ({}, {}, "1 to 4"),
        ({"law.mew": (1.0, 2.0)}, {}, "mu"),
        ({"body.gravity": (1.0, 2.0)}, {}, r"body.gravity.0"),
        ({"law.mu": (900.0, 600.0)}, {}, "lowest and the highest"),
        ({"law.mu": 600.0}, {}, "lowest and the highest"),
        ({"law.mu": (-500.0, 1000.0)}, {}, r"the ranges contain law.mu = -500: law.mu"),
        (RANGES, {"points": 1}, "at least 2 points"),
        (RANGES, {"points": 50}, "at most 2000 runs are needed"),
        pytest.param({"law.mu": (1e-3, 2e-3)}, {"points": 2, "checks": 1}, "narrow the ranges", marks=pytest.mark.slow),
    ],
)
def test_what_cannot_be_separated_gets_a_sentence(scene, ranges, more, words):
    with pytest.raises(lj.InputError, match=words) as told:
        lj.separate(scene, ranges, **more)
    assert "\n" not in str(told.value)


def test_scenes_with_time_and_values_outside_are_refused(scene, model):
    with pytest.raises(lj.InputError, match="static solution"):
        lj.separate(replace(scene, solve=lj.Solve(kind="dynamic", dt=0.1)), RANGES)
    with pytest.raises(lj.InputError, match="outside of the training range 600 to 900"):
        lj.separated_displacement(model, {"law.mu": 500.0, "body.gravity.2": -1.0})
    with pytest.raises(lj.InputError, match=r"add or remove the value of body\.gravity\.2"):
        lj.separated_displacement(model, {"law.mu": 700.0})


@pytest.mark.ci
def test_a_body_that_does_not_move_is_refused(scene):
    """The error of the terms was 0/0."""
    with pytest.raises(lj.InputError, match="no training run moves the body"):
        lj.separate(replace(scene, body=None), {"law.mu": (600.0, 900.0)}, points=2, checks=1)
