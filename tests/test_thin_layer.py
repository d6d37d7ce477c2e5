"""Indenters on a bonded layer: compared with the half-space, a published factor, the thin-layer limit, and the
series.
"""

import numpy as np
import pytest

from fitting.rigs import thin_layer
from fitting.rigs.thin_layer import Indenter, Layer
from liverjax.core.errors import InputError


def thick(shape: str) -> Indenter:
    """Return a layer a million times as thick as the indenter."""
    return Indenter(shape, 1e3, 0.3, radius=1e-3, half_angle=60.0)


@pytest.mark.ci
def test_on_a_thick_layer_the_force_is_that_on_a_half_space():
    """Compare with Hertz, Sneddon and Boussinesq, as published in handbooks."""
    d, plane, R = 1e-4, 1 - 0.3**2, 1e-3
    known = {"sphere": 4 / 3 * np.sqrt(R) * d**1.5, "cone": 2 / np.pi * np.tan(np.pi / 3) * d**2, "punch": 2 * R * d}
    for shape, force in known.items():
        # The layer changes the force by contact radius over thickness, 1e-6.
        assert np.allclose(Layer(thick(shape)).force(np.array([-d, 0.0, d])), [0, 0, force / plane], rtol=3e-6)


def test_poisson_s_ratio_may_be_an_array():
    """An array without dimensions ended in a TypeError."""
    found = [Layer(Indenter("sphere", 1e-3, nu, 1e-3)).force(np.array([1e-5]))[0] for nu in (0.5, np.array(0.5))]
    assert found[0] == found[1]


def test_the_first_term_is_the_printed_one():
    """Dimitriadis et al. 2002, equation 12, has 1.133, from an integral that they fitted to a percent."""
    chi = 1e-6
    assert np.isclose((thin_layer.series(np.array(chi), 0.5) - 1) / chi, 1.133, rtol=0.01)


def test_a_wide_punch_presses_like_a_column():
    """Inside a wide punch, the force is confined modulus times area over thickness. The edge adds a ring, not
    an area.
    """
    E, nu = 1.0, 0.3
    confined = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))

    def force(width):
        return thin_layer.punch_factor(width, 1.0, nu) * 2 * width * E / (1 - nu**2)

    # Second differences cancel the ring's part of the force: force = column + c width + c'.
    second = force(8.0) - 2 * force(6.0) + force(4.0)
    assert np.isclose(second, np.pi * confined * (64 - 2 * 36 + 16), rtol=1e-3)


@pytest.mark.parametrize("poisson", [0.3, 0.4, 0.499, 0.5])
def test_small_contacts_follow_the_series(poisson):
    """The rest falls with the fourth power of chi."""
    table = thin_layer.factors(poisson, "sphere")
    rows = np.searchsorted(table.reach, (0.004, 0.012))
    chi, factor = table.reach[rows], table.factor[rows]
    rest = np.abs(thin_layer.series(chi, poisson) - factor)
    order = np.log(rest[1] / rest[0]) / np.log(chi[1] / chi[0])
    assert 3.7 < order < 4.3


def test_the_printed_series_fails_at_a_fifth():
    """The error of the series is 1 % at a fifth of the thickness, and a sixth at chi = 1, for an incompressible
    layer.
    """
    layer = Layer(Indenter("sphere", 1.0, 0.5, radius=1.0))
    chi = np.array([0.1, 0.2, 1.0])
    exact = layer.force(chi**2) / thin_layer.half_space(layer.rig, chi**2)
    off = thin_layer.dimitriadis(chi) / exact - 1
    assert np.abs(off[0]) < 0.005 and -0.02 < off[1] < -0.01 and -0.18 < off[2] < -0.15


def test_more_points_change_nothing(monkeypatch):
    """This is tested at the widest contact, where the integrand varies fastest."""
    before = thin_layer._contact(8.0, 0.5, "sphere")
    monkeypatch.setattr(thin_layer, "_WAVES", 240)
    monkeypatch.setattr(thin_layer, "_POINTS", 72)
    assert np.allclose(thin_layer._contact(8.0, 0.5, "sphere"), before, rtol=1e-8)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"shape": "cube"}, "use sphere, cone, punch"),
        ({"radius": -1e-3}, "radius = -0.001"),
        ({"thickness": 0.0}, "thickness = 0.0"),
        ({"poisson": 0.6}, "poisson = 0.6"),
        ({"shape": "cone", "half_angle": 90.0}, "half_angle = 90.0"),
        ({"shape": "punch", "thickness": 1e-5}, "use a smaller punch"),
    ],
)
def test_one_sentence_for_what_cannot_be_used(changes, sentence):
    with pytest.raises(InputError, match=sentence):
        Layer(Indenter("sphere", 1e-2, 0.5, radius=5e-3)._replace(**changes))


def test_depths_beyond_the_table_are_refused():
    with pytest.raises(InputError, match="remove all deeper points"):
        Layer(Indenter("cone", 1e-3, 0.4)).force(np.array([1.0]))
    for rig in (Indenter("punch", 1e-2, 0.5, radius=1e-3), Indenter("sphere", 1e-2, 0.5, radius=5e-3)):
        with pytest.raises(InputError, match="depth = nan m is not within"):
            Layer(rig).force(np.array([1e-5, np.nan]))
