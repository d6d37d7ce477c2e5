"""Springpots in harmonic motion: factors for each element, about a stretched state, and from scene files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_harmonic import FILE, FREQUENCIES, MU, PRONY, slab, standing, stretched

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.scenes.springpots import check_springpots, springpot_factors

pytestmark = pytest.mark.quick_to_compile

SPRINGPOTS = """
[springpots]
times = [0.0125, 0.002]
exponents = [0.2, 0.6]
limits = [1e9, 4.0]
spring = 0.3
part = "isochoric"
"""


def test_springpots_by_element_are_factors():
    """The factor is (i omega)^0.2 in two halves of the slab, one of them written with one value per element."""
    scene = replace(slab(8, 2), viscosity=None)
    m = (1j * FREQUENCIES / 80) ** 0.2
    whole = lj.harmonic(scene, FREQUENCIES, factors=m)
    parts = lj.harmonic(scene, FREQUENCIES, factors=m[:, None] * np.ones(scene.mesh.number_of_elements))
    assert np.allclose(whole.displacement, parts.displacement, rtol=1e-12, atol=1e-16)
    z = np.asarray(scene.mesh.points)[:, 2]
    # With this coarse mesh, the error is 2 %.
    assert np.abs(np.asarray(whole.displacement[:, :, 0]) - standing(z, MU * m)).max() < 0.02 * 2e-4


@pytest.mark.parametrize("part", [pytest.param("all", marks=pytest.mark.slow), "isochoric"])
def test_springpots_about_a_stretched_state(part):
    """Spring, springpot and limit act in parallel in the stretched slab. All numbers are computed by mpmath from the
    energy.
    """
    mpmath = pytest.importorskip("mpmath")
    own = lj.SpringpotSeries(
        times=jnp.array([0.0125]), exponents=jnp.array([0.2]), limits=jnp.array([4.0]), spring=0.6, part=part
    )
    scene = replace(slab(30, 2), viscosity=None, springpots=own)

    def energy(shear, kept):  # F = diag(1, 1, 1.2) with F_xz = shear; without the volumetric part unless it is kept
        def of(stretch):
            J, trace = stretch, 2 + stretch**2 + shear**2
            volume = 5 * MU * (J - 1) ** 2 if kept else 0  # half of 10 MU
            return mpmath.mpf(MU) / 2 * (J ** mpmath.mpf("-0.666666666666666666666") * trace - 3) + volume

        return of

    def of(kept):  # d2W/dF_xz^2 and S_zz
        A = mpmath.diff(lambda shear: energy(shear, kept)(mpmath.mpf("1.2")), 0, 2)
        return A, mpmath.diff(energy(mpmath.mpf(0), kept), mpmath.mpf("1.2")) / mpmath.mpf("1.2")

    (A, S), (whole, _) = of(part == "all"), of(True)
    C = []
    for hertz in FREQUENCIES:
        springpot = (2j * mpmath.pi * hertz * mpmath.mpf("0.0125")) ** mpmath.mpf("-0.2")
        m = mpmath.mpf("0.6") + 1 / (springpot + mpmath.mpf("0.25"))
        C.append(complex(m * (A - S) + mpmath.mpf("0.6") * S + whole - A))
    found = np.asarray(lj.harmonic(scene, FREQUENCIES, about=stretched(scene, 1.2)).check().displacement[:, :, 0])
    z = np.asarray(scene.mesh.points)[:, 2]
    exact = standing(z, np.array(C))
    assert np.abs(found - exact).max() < 2e-3 * np.abs(exact).max()
    # With the full stress of the law in this state, or with none, the result would be different.
    for wrong in (1.0, 0.0):
        moved = standing(z, np.array(C) + (wrong - 0.6) * float(S))
        assert np.abs(moved - exact).max() > 1e-2 * np.abs(exact).max()


@pytest.mark.parametrize("spring", [0.0, 1.5])
def test_a_springpot_without_spring_or_with_a_stiff_one(spring, tmp_path):
    """The factors are spring + (i omega tau)^0.2. Both springs were refused with words about [viscosity], which the
    file does not have; a support, which has no tension, was refused as well."""
    text = FILE.replace("[3, 1, 1]", "[1, 1, 1]") + "frequencies = [60.0]\n[[support]]\nwhere = {x_min = 0.03}\n"
    springpots = f"[springpots]\ntimes = [0.0125]\nexponents = [0.2]\nspring = {spring}\n"
    (tmp_path / "scene.toml").write_text(text + "stiffness = 1e4\n" + springpots)
    scene = lj.load_scene(tmp_path / "scene.toml")
    bare = replace(scene, springpots=None)
    factors = spring + (2j * np.pi * 60.0 * 0.0125) ** 0.2
    given = lj.harmonic(bare, factors=np.array([factors])).displacement
    np.testing.assert_allclose(lj.harmonic(scene).check().displacement, given, rtol=1e-10, atol=1e-18)
    body = replace(scene.body, gravity=jnp.array([0.0, 0.0, -0.1]))
    if spring == 0:
        with pytest.raises(lj.InputError, match=r"springpots.spring = 0 leaves no shear stiffness at rest"):
            lj.harmonic(replace(scene, body=body))


@pytest.mark.slow
def test_springpots_of_a_scene_file(tmp_path):
    """A springpot, and a springpot in series with a spring, in parallel with 0.3 of the law; factors by mpmath."""
    mpmath = pytest.importorskip("mpmath")
    (tmp_path / "scene.toml").write_text(FILE + "frequencies = [40.0, 60.0]\n" + SPRINGPOTS)
    scene = lj.load_scene(tmp_path / "scene.toml")
    expected = []
    for hertz in (40, 60):
        s = 2 * mpmath.pi * 1j * hertz
        first = 1 / ((s * mpmath.mpf("0.0125")) ** mpmath.mpf("-0.2") + mpmath.mpf("1e-9"))
        second = 1 / ((s * mpmath.mpf("0.002")) ** mpmath.mpf("-0.6") + mpmath.mpf("0.25"))
        expected.append(complex(mpmath.mpf("0.3") + first + second))
    bare = replace(scene, springpots=None, viscosity=replace(PRONY, ratios=jnp.array([0.7]), part="isochoric"))
    found = lj.harmonic(scene).check().displacement
    given = lj.harmonic(bare, factors=np.array(expected)).displacement
    np.testing.assert_allclose(found, given, rtol=1e-10, atol=1e-18)
    # The volumetric part does not relax. With part = "all" the motion is different.
    other = lj.harmonic(replace(scene, springpots=replace(scene.springpots, part="all"))).displacement
    assert np.abs(other - found).max() > 1e-3 * np.abs(found).max()

    def size(exponent):
        own = replace(scene.springpots, exponents=jnp.array([0.2, exponent]))
        return jnp.sum(jnp.abs(lj.harmonic(replace(scene, springpots=own)).displacement) ** 2) * 1e10

    slope, h = jax.grad(size)(0.6), 1e-4
    assert np.isclose(slope, (size(0.6 + h) - size(0.6 - h)) / (2 * h), rtol=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("times = [0.0125, 0.002]", "", "needs times"),
        ("exponents = [0.2, 0.6]", "exponents = [0.2]", "must be lists of equal lengths"),
        ("exponents = [0.2, 0.6]", "exponents = [0.2, 1.6]", "springpots.exponents"),
        ('part = "isochoric"', 'part = "none"', "part = 'none'"),
        (
            "[springpots]",
            "[viscosity]\nratios = [0.1]\nrelaxation_times = [0.1]\n[springpots]",
            "remove one of them",
        ),
        ('kind = "harmonic"\nfrequencies = [40.0]', 'kind = "static"', "needs kind = 'harmonic'"),
    ],
)
def test_springpots_that_cannot_be_are_refused(tmp_path, old, new, words):
    text = FILE + "frequencies = [40.0]\n" + SPRINGPOTS
    assert old in text
    (tmp_path / "scene.toml").write_text(text.replace(old, new))
    with pytest.raises(lj.InputError, match=words):
        lj.load_scene(tmp_path / "scene.toml")


@pytest.mark.parametrize("kind", [list, tuple])
def test_springpots_are_lists_tuples_or_arrays(kind):
    """Lists of exponents or limits ended in a TypeError. Only a list of times was converted to an array."""
    rows = {"times": [0.0125, 0.002], "exponents": [0.2, 0.6], "limits": [1e9, 4.0]}
    exact = lj.SpringpotSeries(**{key: jnp.array(row) for key, row in rows.items()}, spring=0.3)
    own = lj.SpringpotSeries(**{key: kind(row) for key, row in rows.items()}, spring=0.3)
    law, omegas = lj.laws.NeoHookean(mu=770.0, bulk=7700.0), jnp.array([1.0, 30.0])

    def factors(series):
        check_springpots(series, law, None)
        return springpot_factors(series, omegas)

    np.testing.assert_array_equal(factors(own), factors(exact))
    changed = jax.eval_shape(lambda row: factors(replace(own, exponents=kind(row))), rows["exponents"])
    assert changed.shape == (2,)
