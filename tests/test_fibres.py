"""Fibre laws: Costa, Guccione, one direction per element, and I4 in user-defined laws."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements import mjed, reference
from liverjax.scenes.by_element import by_element, law_of_elements
from liverjax.scenes.checks.numbers import check_numbers

pytestmark = pytest.mark.quick_to_compile

COSTA = dict(c=200.0, b_ff=8.0, b_ss=4.0, b_nn=3.0, b_fs=5.0, b_fn=4.0, b_sn=2.0, bulk=7700.0)


@lj.struct
class Holzapfel(lj.Law):
    """Neo-Hookean matrix and one family of fibres (Holzapfel, Gasser and Ogden 2000), defined by its energy only."""

    mu: Any = lj.param("Pa", typical=500.0)
    k1: Any = lj.param("Pa", typical=100.0)
    k2: Any = lj.param("1", typical=2.0)
    bulk: Any = lj.param("Pa", typical=5000.0)
    fibre: Any = lj.param("1", each=True, default=(1.0, 0.0, 0.0))
    volumetric: str = lj.static("quadratic")
    invariants: ClassVar = ("I1", "I4", "J")

    def strain_energy(self, I):
        """Return mu/2 (Ibar1 - 3) + k1/(2 k2) (exp(k2 (I4 - 1)^2) - 1) + K/2 (J - 1)^2."""
        fibres = self.k1 / (2 * self.k2) * jnp.expm1(self.k2 * (I.I4 - 1) ** 2)
        return self.mu / 2 * (I.J ** (-2 / 3) * I.I1 - 3) + fibres + self.bulk / 2 * (I.J - 1) ** 2


@lj.struct
class FungOfGreen(lj.Law):
    """A user-defined exponential of Green's strain, without derivatives by hand, fibres or a bulk modulus."""

    c: Any = lj.param("Pa", typical=500.0)

    def green_energy(self, E):
        """Return c (exp(2 E_xx^2 + E_yy^2 + E_xy E_xy + E_yz^2 + E_xx E_zz) - 1)."""
        Q = 2 * E[0][0] ** 2 + E[1][1] ** 2 + E[0][1] ** 2 + E[1][2] ** 2 + E[0][0] * E[2][2]
        return self.c * jnp.expm1(Q)


def directions(n: int) -> np.ndarray:
    """Return one direction per element; their lengths are not 1."""
    return np.random.default_rng(7).standard_normal((n, 3))


def laws(n: int) -> dict:
    """Return laws with one direction, laws with one direction per element, and sums of them."""
    a, b = directions(n), directions(n)[::-1].copy()
    return {
        "costa, one direction": lj.laws.create("costa", **COSTA, fibre=[1.0, 0.2, 0.0], sheet=[0.0, 1.0, 0.3]),
        "costa, one an element": lj.laws.create("costa", **COSTA, fibre=a, sheet=b),
        "I4, one an element": Holzapfel(mu=500.0, k1=100.0, k2=2.0, bulk=5000.0, fibre=a),
        "two families": Holzapfel(mu=500.0, k1=100.0, k2=2.0, bulk=5000.0, fibre=a)
        + Holzapfel(mu=0.0, k1=300.0, k2=1.0, bulk=0.0, fibre=b),
        "user's energy of Green's strain": FungOfGreen(c=500.0) + lj.laws.typical("neo_hookean"),
    }


@pytest.mark.ci
@pytest.mark.parametrize(
    "name",
    [n if n == "I4, one an element" else pytest.param(n, marks=pytest.mark.slow) for n in laws(8)],
)
def test_force_and_stiffness_against_both_references(name, distorted_box):
    mesh, x = distorted_box
    x = 0.5 * (x + mesh.points)  # a smaller deformation for exponentials of Green's strain
    law = laws(mesh.number_of_elements)[name]
    f, K = np.asarray(mjed.internal_force(mesh, law, x)), mjed.stiffness_matrix(mesh, law, x)
    assert np.isclose(mjed.energy(mesh, law, x), reference.energy(mesh, law, x), rtol=1e-13)
    for force in (reference.internal_force, reference.standard_internal_force):
        assert np.abs(np.asarray(force(mesh, law, x)) - f).max() < 1e-11 * np.abs(f).max()
    for stiffness in (reference.stiffness_matrix, reference.standard_stiffness_matrix):
        assert np.abs(stiffness(mesh, law, x) - K).max() < 1e-11 * np.abs(K).max()


def test_one_direction_and_the_same_for_each_element_agree(distorted_box):
    mesh, x = distorted_box
    one = lj.laws.create("costa", **COSTA, fibre=[1.0, 0.2, 0.0], sheet=[0.0, 1.0, 0.3])
    rows = np.ones((mesh.number_of_elements, 1))
    each = lj.laws.create("costa", **COSTA, fibre=rows * [[1.0, 0.2, 0.0]], sheet=rows * [[0.0, 1.0, 0.3]])
    assert np.allclose(mjed.internal_force(mesh, one, x), mjed.internal_force(mesh, each, x), rtol=1e-13, atol=1e-12)


def test_guccione_is_transversely_isotropic_and_stiffer_along_the_fibre():
    # Land et al. 2015: C = 2 kPa, b_f = 8, b_t = 2, b_fs = 4.
    law = lj.laws.Costa.guccione(c=2000.0, b_f=8.0, b_t=2.0, b_fs=4.0, bulk=1e5)
    c, s = np.cos(0.7), np.sin(0.7)
    about_fibre = jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    F = jnp.eye(3) + 0.2 * jnp.asarray(np.random.default_rng(1).standard_normal((3, 3)))
    assert np.isclose(law.energy(F @ about_fibre), law.energy(F), rtol=1e-12)
    E = 0.5 * (F.T @ F - jnp.eye(3))
    Q = 8 * E[0, 0] ** 2 + 2 * (E[1, 1] ** 2 + E[2, 2] ** 2 + 2 * E[1, 2] ** 2) + 4 * 2 * (E[0, 1] ** 2 + E[0, 2] ** 2)
    assert np.isclose(law.energy(F), 1000 * jnp.expm1(Q) + 5e4 * (jnp.linalg.det(F) - 1) ** 2, rtol=1e-12)
    along, across = (law.energy(jnp.diag(jnp.array(v))) for v in ((1.2, 1.0, 1.0), (1.0, 1.2, 1.0)))
    volumetric = 5e4 * 0.2**2
    assert along - volumetric > 4 * (across - volumetric)


def test_derivative_by_the_fibre_angle():
    F = jnp.diag(jnp.array([1.2, 0.9, 1.0]))

    def energy(angle):
        turned = jnp.array([jnp.cos(angle), jnp.sin(angle), 0.0])
        across = jnp.array([-jnp.sin(angle), jnp.cos(angle), 0.0])
        return lj.laws.Costa(**COSTA, fibre=turned, sheet=across).energy(F)

    h = 1e-5
    assert np.isclose(jax.grad(energy)(0.3), (energy(0.3 + h) - energy(0.3 - h)) / (2 * h), rtol=1e-8)


@pytest.mark.parametrize(
    ("directions", "sentence"),
    [
        ({"sheet": [2.0, 0.0, 0.0]}, "'fibre' and 'sheet' are parallel"),
        ({"fibre": [0.0, 0.0, 0.0]}, "one of them is zero"),
        ({"fibre": [1.0, 0.0]}, r"give \(3,\)"),
        ({"fibre": 1.0}, "a list of numbers"),
    ],
)
def test_unusable_directions_are_refused(directions, sentence):
    with pytest.raises(lj.InputError, match=sentence):
        lj.laws.create("costa", **COSTA, **directions)


@pytest.mark.parametrize("fibre", [(1.0, 0.0), ((1.0, 0.0, 0.0),) * 2])
def test_directions_of_another_shape_are_refused(fibre, distorted_box):
    mesh, x = distorted_box
    with pytest.raises(lj.InputError, match="fibre or sheet direction has shape"):
        mjed.internal_force(mesh, Holzapfel(mu=500.0, k1=100.0, k2=2.0, bulk=5000.0, fibre=jnp.array(fibre)), x)


def test_a_fibre_without_length_is_refused():
    """Without this check, the run ended with the message on inverted elements."""
    mesh = lj.shapes.box((0.01, 0.01, 0.01), (1, 1, 1))
    directions = np.tile([1.0, 0.0, 0.0], (mesh.number_of_elements, 1))
    directions[2] = 0.0
    for fibre in ((0.0, 0.0, 0.0), directions):
        law = Holzapfel(mu=500.0, k1=100.0, k2=2.0, bulk=5000.0, fibre=fibre)
        for own in (law, law + lj.laws.NeoHookean(mu=100.0, bulk=None)):
            with pytest.raises(lj.InputError, match="law Holzapfel has a fibre of length 0"):
                lj.simulate(lj.Scene(mesh=mesh, law=own, fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),)))


def test_the_same_fibre_law_twice_is_twice_the_law():
    """A sum with the same object twice once raised KeyError."""
    law = Holzapfel(mu=500.0, k1=100.0, k2=2.0, bulk=5000.0, fibre=(1.0, 0.2, 0.0))
    F = jnp.eye(3) + 0.1 * jnp.asarray(np.random.default_rng(1).standard_normal((3, 3)))
    assert np.allclose((law + law).first_piola(F), 2 * law.first_piola(F), rtol=1e-12)
    assert np.allclose((law + law).tangent(F), 2 * law.tangent(F), rtol=1e-12)


@pytest.mark.ci
def test_directions_in_a_body_of_three_elements():
    """One direction (3,) was regarded as a number of each element, and three directions (3, 3) as columns."""
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]]
    mesh = lj.tet_mesh(np.array(points, float), [[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])
    F, a = np.diag([1.1, 0.9, 1.0]), np.array([1.0, 0.2, 0.0])
    one, array = (lj.laws.Costa(**COSTA, fibre=fibre) for fibre in (tuple(a), jnp.asarray(a)))
    each = lj.laws.Costa(**COSTA, fibre=np.tile(a, (3, 1)), sheet=np.tile([0.0, 1.0, 0.0], (3, 1)))
    whole = mjed.energy(mesh, one, mesh.points @ F)
    for law in (array, each):
        split = law_of_elements(law, (lj.Region(elements=jnp.array([1]), law=law),), 3)
        for body, own in ((lj.quadratic(mesh), law), (mesh, split)):
            assert np.isclose(mjed.energy(body, own, body.points @ F), whole, rtol=1e-12)


def test_the_fibres_of_a_region_may_have_another_direction():
    """Such a region passed all checks, but the run was refused with the shape (3, 48) of its directions."""
    law = lj.laws.Costa(**COSTA)
    mesh = lj.shapes.box((0.02, 0.01, 0.01), (2, 1, 1))
    half = np.arange(mesh.number_of_elements // 2)
    rows = np.tile([1.0, 0.0, 0.0], (mesh.number_of_elements, 1))
    turned = rows.copy()
    turned[half] = (0.0, 0.3, 1.0)
    for body, name in (
        (law, "fibre"),
        (lj.laws.Costa(**COSTA, fibre=rows), "fibre"),
        (lj.laws.NeoHookean(mu=1.0, bulk=None) + law, "1.fibre"),
    ):
        region = lj.Region(elements=half, law={f"{name}.{k}": v for k, v in enumerate((0.0, 0.3, 1.0))})
        scene = lj.Scene(mesh=mesh, law=body, region=(region,))
        check_numbers(scene)
        assert np.array_equal(by_element(scene).law.summands()[-1].fibre, turned)
    F, whole = np.diag([1.1, 0.9, 1.0]), lj.laws.Costa(**COSTA, fibre=(0.0, 0.3, 1.0))
    by_region = law_of_elements(law, (lj.Region(elements=half, law=whole),), mesh.number_of_elements)
    found = mjed.energy(mesh, lj.laws.Costa(**COSTA, fibre=turned), mesh.points @ F)
    assert np.isclose(found, mjed.energy(mesh, by_region, mesh.points @ F), rtol=1e-12)


@pytest.mark.parametrize(
    ("fibre", "sentence"),
    [
        ((0.0, 0.0, 0.0), "region.0: law costa: .* one of them is zero"),
        ((0.0, 1.0, 0.0), "region.0: law costa: the directions 'fibre' and 'sheet' are parallel"),
        ((0.0, 1.0), "region.0: law.fibre does not have three components: give three numbers"),
    ],
)
def test_unusable_directions_of_a_region_are_refused(fibre, sentence):
    mesh = lj.shapes.box((0.02, 0.01, 0.01), (2, 1, 1))
    region = lj.Region(elements=np.array([1]), law={f"fibre.{k}": v for k, v in enumerate(fibre)})
    with pytest.raises(lj.InputError, match=sentence):
        check_numbers(lj.Scene(mesh=mesh, law=lj.laws.Costa(**COSTA), region=(region,)))


def test_directions_of_regions_are_compared_within_each_element():
    """The fibres of a region were compared with the sheets of all elements, and with those of the scene where another
    region changes them. Regions were refused although no element had parallel directions."""
    mesh = lj.shapes.box((0.02, 0.01, 0.01), (2, 1, 1))
    n, (x, y, z) = mesh.number_of_elements, np.eye(3)

    def region(elements, **directions):
        law = {f"{name}.{k}": v for name, own in directions.items() for k, v in enumerate(own)}
        return lj.Region(elements=np.array(elements), law=law)

    def check(law, *regions):
        check_numbers(lj.Scene(mesh=mesh, law=law, region=regions))

    sheet = np.tile(z, (n, 1))
    sheet[:2] = y
    law = lj.laws.Costa(**(COSTA | {"fibre": x, "sheet": sheet}))
    check(law, region([0, 1], fibre=z))
    check(law, region([0, 1, 2], sheet=y), region([0, 2], fibre=z), region([1], fibre=y, sheet=z))
    for regions, named in (
        ([region([1, 2], fibre=z)], "region.0"),
        ([region([0], sheet=z), region([0, 1], fibre=z)], "region.0, region.1"),
    ):
        with pytest.raises(
            lj.InputError, match=f"^{named}: law costa: the directions 'fibre' and 'sheet' are parallel"
        ):
            check(law, *regions)
    jax.jit(lambda k: check(law, region([1, 2], fibre=(0.0, 0.0, k))))(1.0)  # unknown directions are not checked
    with pytest.raises(lj.InputError, match=r"region.0: law costa"):
        jax.jit(lambda c: check(replace(law, c=c), region([1, 2], fibre=z)))(1.0)
    with pytest.raises(lj.InputError, match=f"region.0 has no elements, or element numbers outside 0 to {n - 1}"):
        check(law, region([n], fibre=z))
