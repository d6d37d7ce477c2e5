"""Warnings on wave data: wrong units, wrong signs, gaps, noise alone."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage
from test_waves import DENSITY, HERTZ, H, plane_waves

from fitting.reports.waves import cautions, report
from fitting.waves import (
    elastography,
    regions,
    wave_field,
)
from fitting.waves.files import components
from liverjax.core.errors import InputError

pytestmark = pytest.mark.quick_to_compile


def test_gaps_within_the_organ_are_told():
    field = plane_waves((9, 9, 13))
    assert not elastography.notes_on_gaps(field)
    field.displacement[0, [2, 4, 6], [4, 6, 4], [4, 6, 8], 1] = np.nan
    (note,) = elastography.notes_on_gaps(field)
    left = len(np.asarray(elastography.body_of(field).linear.tetrahedra)) / 6 / (4 * 4 * 6)
    assert f"3 voxels within the organ have no displacement or are not in the mask, so only {100 * left:.2g} %" in note


def test_voxels_in_no_element_are_told():
    assert not elastography.notes_on_layers(plane_waves((9, 9, 13)))
    (note,) = elastography.notes_on_layers(plane_waves((10, 9, 8)))
    assert (
        f"{720 - 9 * 9 * 7} of 720 voxels are in outer layers" in note and "along x (10 voxels), z (8 voxels)" in note
    )


def test_columns_of_the_table_stay_apart_where_nothing_fits():
    own = {"phase_velocity_m_s": [7.8], "chi2_per_component": [2.67e11]}
    own |= {key: [1.0] for key in ("storage_Pa", "loss_Pa", "error_storage_Pa", "error_loss_Pa")}
    direct = {"whole": {"storage_Pa": [None], "loss_Pa": [None]}}
    blank = {"regions": None, "springpots": None, "map": None, "frequencies_Hz": [60.0]}
    *_, row, reason = report.table({"whole": own, "direct_inversion": direct, **blank}).splitlines()
    assert row.split()[-3:] == ["7.8", "2.7e+11", "none"] and reason.startswith(
        "direct: none where every voxel is near"
    )


def test_a_frequency_of_noise_alone_is_named_and_a_number_at_its_bound():
    field = plane_waves((9, 9, 9))
    size = float(np.sqrt(np.mean(np.abs(field.displacement[0]) ** 2) / 2))
    assert not cautions._of_no_motion(field._replace(noise=np.array([0.05 * size])), 0)
    (said,) = cautions._of_no_motion(field._replace(noise=np.array([0.98 * size])), 0)
    assert "are hardly larger than their noise" in said and said.endswith("remove the data of this frequency")
    own = {"numbers": {"exponent": 1.0, "springpot": 2.0}, "standard_errors": {"exponent": None, "springpot": 0.1}}
    blank = {"regions": None, "map": None, "frequencies_Hz": [], "whole": {}, "direct_inversion": {"whole": {}}}
    spring = {"whole": own | {"model": "springpot", "frequencies": 3, "mean_relative_error": 0.043}}
    last = report.table(blank | {"springpots": spring}).splitlines()[-1]
    assert "4.3 % off on average: exponent = 1 (at its bound), springpot = 2 ± 0.1" in last


@pytest.mark.ci
def test_too_large_a_noise_is_told():
    field = plane_waves((7, 7, 7), noise=1e-7)
    for factor, told in ((1, False), (10, True)):
        stated = field._replace(noise=factor * field.noise)
        organ = elastography.organ_of(stated, elastography.body_of(stated), DENSITY)
        said = cautions.cautions_of_elastography(organ, elastography.regions_of(organ), None)
        assert any("as much as the stated noise, and the standard errors are too large" in s for s in said) == told
        assert not any("enlarged 1 times" in s for s in said)


def test_another_spacing_than_that_of_the_file_is_told(tmp_path):
    field = plane_waves((3, 3, 3))
    arrays = {"displacement": field.displacement, "frequencies": HERTZ, "spacing": field.spacing}
    np.savez(tmp_path / "w.npz", **arrays)
    (_,) = wave_field.read_waves(tmp_path / "w.npz", spacing=list(field.spacing)).notes  # a component is 0
    note, _ = wave_field.read_waves(tmp_path / "w.npz", spacing=list(2 * field.spacing)).notes
    assert "the file states a spacing of" in note and note.endswith("to the square of the spacing")


def test_a_springpot_that_misses_the_moduli_is_told(tmp_path):
    """The moduli are those of three different solids at three frequencies. No springpot has such a change."""
    rows = ["frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,storage_modulus_sd_Pa,loss_modulus_sd_Pa"]
    rows += ["50,3200,600,17,17", "75,2500,1900,17,17", "100,3800,300,17,17"]
    (tmp_path / "s.csv").write_text("\n".join(rows) + "\n")
    _, told = report._springpots({"whole": tmp_path / "s.csv"})
    assert any("misses the moduli over the frequencies by" in w for w in told)


def _sweep_file(folder, hertz, G, sd):
    """Write moduli G (n,) and their standard deviations sd (n,) [Pa] as a sweep, and return the file."""
    rows = ["frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,storage_modulus_sd_Pa,loss_modulus_sd_Pa"]
    columns = (hertz, G.real, G.imag, sd.real, sd.imag)
    rows += [",".join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True)]
    (folder / "s.csv").write_text("\n".join(rows) + "\n")
    return folder / "s.csv"


@pytest.mark.parametrize("number", [4, 8])
def test_an_error_that_all_frequencies_share_is_in_the_springpot(tmp_path, number):
    """An error of 10 % at every frequency became 0.1 % of the springpot at 8 frequencies."""
    hertz = np.linspace(40, 110, number)
    G = 1000 * (2j * np.pi * hertz) ** 0.2 * (1 + 0.002 * np.random.default_rng(0).normal(size=number))
    file, row = _sweep_file(tmp_path, hertz, G, 0.1 * G), {}
    for kind, part in (("error", 0.1), ("standard_error", 0.002), ("edge_error", 0.0), ("mesh_bias", -0.0999)):
        row |= {f"{kind}_storage_Pa": part * G.real, f"{kind}_loss_Pa": part * G.imag}
    found, _ = report._springpots({"whole": file}, {"frequencies_Hz": hertz, "whole": row, "regions": None})
    errors = found["whole"]["standard_errors"]
    assert found["whole"]["model"] == "springpot" and errors["springpot"] == pytest.approx(100, rel=0.02)
    assert errors["exponent"] < 0.002  # a common factor does not change the exponent
    found, _ = report._springpots({"whole": file})  # all of the error is noise
    assert 0.1 / np.sqrt(2 * number) < found["whole"]["standard_errors"]["springpot"] / 1000 < 0.15


@pytest.mark.parametrize(("part", "told"), [(0.01, True), (0.15, False)])
def test_a_springpot_is_not_blamed_for_the_noise_of_the_moduli(tmp_path, part, told):
    """A springpot that was within the errors was said to miss the moduli, which had larger errors than its own."""
    hertz, noise = np.linspace(60, 130, 8), np.random.default_rng(1).normal(size=(2, 8))
    G = 3000 + 2j * np.pi * hertz
    G = G.real * (1 + 0.1 * noise[0]) + 1j * G.imag * (1 + 0.1 * noise[1])
    found, said = report._springpots({"whole": _sweep_file(tmp_path, hertz, G, part * G)})
    assert found["whole"]["mean_relative_error"] > report.MISSED
    assert any("misses the moduli" in one for one in said) == told


def test_a_label_without_a_modulus_is_named():
    """The last of an even number of layers is in no element. Its label was missing in the results without a word."""
    field, labels = plane_waves((7, 7, 8)), np.ones((7, 7, 8), int)
    labels[..., 7] = 2
    found = SimpleNamespace(labels=np.array([1]))
    (said,) = cautions._of_lost_labels(field._replace(labels=labels), found)
    assert said.startswith("regions 2: no voxel of these regions is in an element")
    assert cautions._of_lost_labels(field._replace(labels=np.ones_like(labels)), found) == []
    assert cautions._of_lost_labels(field, SimpleNamespace(labels=None)) == []


@pytest.mark.parametrize("width", [0.7, 1.0])
def test_a_frequency_of_smoothed_noise_is_named(width):
    """Fourth differences of smoothed noise give a noise that is 2.5 to 7 times too small."""
    rng, field = np.random.default_rng(2), plane_waves((7, 7, 9))
    noise = rng.normal(size=field.displacement.shape[1:]) + 1j * rng.normal(size=field.displacement.shape[1:])
    noise = 3e-6 * ndimage.gaussian_filter(noise, (width, width, width, 0))
    for U, alone in ((noise, True), (field.displacement[1] + noise, False)):
        own = field._replace(frequencies=HERTZ[1:], displacement=U[None])
        own = own._replace(noise=wave_field.noise_of(own))
        organ = elastography.organ_of(own, elastography.body_of(own), DENSITY)
        found = elastography.regions_of(organ)
        assert not cautions._of_no_motion(own, 0) and found.whole.correlations[0].seen
        said = cautions.cautions_of_elastography(organ, found, None)
        named = [one.startswith("100 Hz: the displacements") and "remove the data" in one for one in said]
        assert any(named) == alone and cautions.frequencies_with_motion(own, found) == [0][alone:]


def test_misfit_of_the_model_is_no_noise():
    """A layered body without labels had residuals as large as its motion, and its data were to be removed."""
    field = plane_waves((5, 5, 5))
    size = np.sqrt(np.mean(np.abs(field.displacement[0][field.mask]) ** 2) / 2)
    each = SimpleNamespace(correlations=[SimpleNamespace(seen=True, level=size)] * len(field.noise))
    found = SimpleNamespace(whole=each, parts=None)
    for noise, said in ((0.03 * size, 0), (0.2 * size, 1)):
        own = field._replace(noise=np.full(len(field.noise), noise))
        assert len(cautions._of_no_motion(own, 0, found)) == said


def test_errors_that_all_frequencies_share_do_not_explain_scatter():
    """A common bias of 10 % excused any scatter around the springpot."""
    n, rng = 8, np.random.default_rng(0)
    G = np.linspace(1000, 2000, n)
    wrong = 1 + 0.05 * rng.standard_normal(n)
    fit = SimpleNamespace(storage=G, loss=G / 5, solution=SimpleNamespace(u=np.zeros(2)))
    shared = np.concatenate([0.1 * G, 0.1 * G / 5])[None]
    for factor, beyond in ((1.1, False), (wrong, True)):
        sweep = SimpleNamespace(storage=G * factor, loss=G / 5 * factor, storage_sd=0.002 * G, loss_sd=0.002 * G / 5)
        assert report._beyond_errors(fit, sweep, shared) == beyond


def test_sweeps_are_without_frequencies_of_noise(tmp_path):
    part = {key: [1.0, 2.0, 3.0, 4.0] for key in ("storage_Pa", "loss_Pa", "error_storage_Pa", "error_loss_Pa")}
    content = {"frequencies_Hz": [40.0, 60.0, 80.0, 100.0], "whole": part, "regions": None}
    organ = SimpleNamespace(field=SimpleNamespace(frequencies=np.array(content["frequencies_Hz"])))
    for moves, rows in (([0, 2, 3], ["40", "80", "100"]), ([0, 2], ["40", "60", "80", "100"])):
        file = report._sweeps(tmp_path, organ, content, moves)["whole"]
        assert [row.split(",")[0] for row in file.read_text().splitlines()[1:]] == rows
        assert any("without 60 Hz" in s for s in report._of_frequencies_left_out(organ, moves)) == (len(rows) == 3)


@pytest.mark.parametrize("noise", [0.0, 4e-7])
@pytest.mark.parametrize(
    ("order", "signs", "told"),
    [
        ((0, 2, 1), (1, 1, 1), "(x, z, y)"),
        ((1, 2, 0), (1, 1, 1), "(z, x, y)"),
        ((0, 1, 2), (-1, 1, 1), "-"),  # exchange of x or z: waves across y do not show it
    ],
)
def test_components_that_do_not_follow_the_axes_are_told(noise, order, signs, told):
    """Shear waves keep the volume. With exchanged components or a wrong sign they would not."""
    field = plane_waves((9, 9, 9), noise=noise)
    said = components.order_sentence(
        field._replace(displacement=np.asarray(signs) * field.displacement[..., list(order)])
    )
    assert said is not None and told in said and "the displacements change the volume much less" in said


@pytest.mark.parametrize("noise", [0.0, 4e-7, 4e-6])
@pytest.mark.parametrize("sign", [1, -1])
def test_components_that_follow_the_axes_are_never_accused(noise, sign):
    """Noise changes the volume equally in every order. A common sign of all components has no effect."""
    field = plane_waves((9, 9, 9), noise=noise)
    assert components.order_sentence(field._replace(displacement=sign * field.displacement)) is None


def test_a_component_that_is_zero_may_not_have_been_measured():
    """Without a component, the others change the volume, and another order changes it less."""
    field = plane_waves((9, 9, 9), noise=4e-7)
    said = components.order_sentence(field._replace(displacement=np.array([1.0, 1.0, 0.0]) * field.displacement))
    assert said is not None and said.endswith(
        "The cause may be a component that was not measured (z): write NaN instead of zeros"
    )


@pytest.mark.parametrize(
    ("moduli", "words"),
    [
        ([1338 + 400j, 6756 + 2000j], "to the power of 4"),  # fields of 3000 Pa, each with the frequency of the other
        ([6756 + 2000j, 1338 + 400j], "to the power of -4"),
        ([3000 + 900j, 3300 + 990j], ""),
        ([30 + 9j, 33 + 9j], "check the spacing"),
        ([1e6 + 9e4j, 1.1e6 + 9e4j], "check the spacing"),
    ],
)
def test_scales_that_no_tissue_has_are_told(moduli, words):
    """The balance of forces has no scale: chi^2 is 1 also with a wrong spacing, or with exchanged frequencies."""
    G = np.array(moduli)[:, None]
    own = SimpleNamespace(waves=SimpleNamespace(omega=2 * np.pi * np.array([50.0, 75.0])), density=DENSITY)
    found = SimpleNamespace(whole=SimpleNamespace(modulus=G, standard_errors=0.01 * np.abs(G) * (1 + 1j)))
    said = cautions._of_scales(own, found, [0, 1])
    assert len(said) == bool(words) and all(words in s for s in said)


def test_moduli_have_no_preferred_size():
    """Modulus and squared frequency are multiplied by the same number, so the displacements stay the same. Relative to
    this number, the fit is the same too, and the warning about the wave speed appears. Before, the search found 250 Pa
    instead of 9 Pa. The pressure term had a fixed size for 3 kPa, so moduli of 200 kPa or more were wrong.
    """
    field, found = plane_waves((7, 7, 9), noise=3e-8), []
    X = np.moveaxis(np.indices((7, 7, 9)), 0, -1) - 3.0
    field.displacement[...] += 4e-6 * X * [1.0, -1.0, 0.0]  # a motion without curl, which has a pressure
    for scale in (1.0, 3e-3, 300.0):
        own = field._replace(frequencies=HERTZ * np.sqrt(scale))
        organ = elastography.organ_of(own, elastography.body_of(own), DENSITY)
        each = elastography.regions_of(organ)
        assert np.all(each.whole.converged)
        found.append(each.whole.modulus[:, 0] / scale)
        said = cautions._of_scales(organ, each, [0, 1])
        assert ["check the spacing" in s for s in said] == [True] * (scale != 1)
    np.testing.assert_allclose(found, np.broadcast_to(found[0], (3, 2)), rtol=1e-4)


def test_the_typical_modulus_comes_from_the_frequency_with_the_clearest_motion():
    """It came from the lowest frequency, also if this had only noise: 31 kPa instead of 3 kPa."""
    field, rng = plane_waves((7, 7, 9), noise=3e-8), np.random.default_rng(0)
    U, sd = field.displacement.copy(), 0.2 * np.sqrt(np.mean(np.abs(field.displacement[0]) ** 2) / 2)
    U[0] = 0.02 * U[0] + sd * (rng.standard_normal(U[0].shape) + 1j * rng.standard_normal(U[0].shape))
    poor = field._replace(displacement=U, noise=np.array([sd, field.noise[1]]))
    organ = elastography.organ_of(poor, elastography.body_of(poor), DENSITY)
    assert 2400 < organ.matrices.typical < 3600


def test_a_frequency_of_noise_does_not_spoil_the_others():
    """The search at 60 Hz started from the modulus of the noise and found 0.02 Pa instead of 3000 Pa, and so did the
    search for the regions. Warnings were about the labels, the size of the regions and the spacing.
    """
    good, rng, labels = plane_waves((7, 7, 7), noise=3e-8), np.random.default_rng(7), np.zeros((7, 7, 7), int)
    U = good.displacement[[0, 0]]
    U[0] = 1e-6 * (rng.standard_normal(U[0].shape) + 1j * rng.standard_normal(U[0].shape))
    labels[..., 3:] = 1
    own = good._replace(displacement=U, noise=np.array([1e-6, 3e-8]), labels=labels, frequencies=np.array([20.0, 60.0]))
    organ = elastography.organ_of(own, elastography.body_of(own), DENSITY)
    found = elastography.regions_of(organ)
    for each in (found.whole, found.parts):
        assert each.converged[1]
        np.testing.assert_allclose(each.modulus[1].real, 3000, rtol=0.05)
    assert abs(found.whole.modulus[0, 0]) < 300  # the search in noise also converges, but to another modulus
    (said,) = cautions.cautions_of_elastography(organ, found, None)
    assert said.startswith("20 Hz: the displacements") and said.endswith("remove the data of this frequency")


def test_a_region_without_equations_hides_no_warning_of_other_regions():
    """Its standard error was NaN, and the largest of several numbers with NaN is NaN."""
    blank = {"farther": np.zeros((1, 2)), "chi2": np.ones(1), "iterations": np.ones(1), "converged": np.ones(1, bool)}
    covariance = np.diag([100.0, np.inf, 100.0, np.inf])[None]
    parts = regions.Regions(np.full((1, 2), 3000 + 600j), covariance, components=1, **blank)
    assert parts.standard_errors[0, 0] == 10 + 10j
    assert np.isposinf(parts.standard_errors[0, 1].real) and np.isposinf(parts.standard_errors[0, 1].imag)
    bias = np.full((1, 2), 0.02 + 0j)
    found = elastography.Found(parts, np.array([4, 7]), parts, bias[:, 0], bias, bias)
    (said,) = cautions._of_voxel_size(60.0, found, 0)
    assert "the modulus of region 4 by 2 %" in said


def test_fields_without_a_common_voxel_are_told():
    """The message was that all three components have to be measured, although they were."""
    field = plane_waves((7, 7, 7))
    field.displacement[0, :4], field.displacement[1, 4:] = np.nan, np.nan
    with pytest.raises(InputError, match="no voxel is measured at all frequencies; fit each frequency separately"):
        elastography.body_of(field)
    field.displacement[0, ..., 2] = np.nan
    with pytest.raises(InputError, match="measure all three"):
        elastography.body_of(field)


@pytest.mark.parametrize(
    ("hertz", "told"),
    [
        ([376.991, 565.487], True),
        ([18.85, 37.7], True),
        ([60.0, 90.0], False),
        ([710.0, 1420.0], False),
        ([62.8, 94.2], False),
    ],
)
def test_frequencies_in_radians_are_told(hertz, told):
    """A liver with 1.8 m/s becomes one with 11 m/s, which a stiff tissue may have, and its modulus is 39 times as
    large.
    """
    G = np.array([123e3 + 27e3j, 129e3 + 29e3j])[:, None]
    own = SimpleNamespace(waves=SimpleNamespace(omega=2 * np.pi * np.array(hertz)), density=DENSITY)
    found = SimpleNamespace(whole=SimpleNamespace(modulus=G, standard_errors=0.01 * np.abs(G) * (1 + 1j)))
    said = cautions._of_scales(own, found, [0, 1])
    assert [s.startswith("the frequencies") and "if the given numbers are in rad/s" in s for s in said] == [True] * told


def test_moduli_that_no_springpot_has_are_written_all_the_same(tmp_path):
    """In a nearly elastic phantom, noise makes the loss negative."""
    file = tmp_path / "sweep_whole.csv"
    file.write_text(
        "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,storage_modulus_sd_Pa,loss_modulus_sd_Pa\n"
        "40,3000,-30,24,22\n60,3000,4,9,8\n80,3000,1,5,4\n"
    )
    found, told = report._springpots({"whole": file})
    assert found == {} and len(told) == 1 and told[0].startswith("whole: no springpot is fitted over the frequencies")


def test_a_field_that_holds_no_number_is_named(tmp_path):
    field = plane_waves((6, 6, 6), noise=1e-7)
    for part, words in ((slice(None), "noise at 100 Hz cannot .* remove this displacement field"), (slice(0, 3), "")):
        U = field.displacement.copy()
        U[1, part] = np.nan
        np.savez(tmp_path / "w.npz", displacement=U, spacing=[H] * 3, frequencies=HERTZ)
        found = wave_field.read_waves(tmp_path / "w.npz")
        if words:
            with pytest.raises(InputError, match=words):
                wave_field.with_noise(found, None)
        else:
            assert any("108 of 216 voxels have no displacement at some frequencies" in n for n in found.notes)


def test_zeros_at_one_frequency_are_no_measurement(tmp_path):
    """Zeros were taken for motion, with the result 2396 +- 35 for 3000."""
    field = plane_waves((6, 6, 6), noise=1e-7)
    U = field.displacement.copy()
    U[1, :2] = 0.0
    U[0, 4, 4, :, 2] = 0.0
    np.savez(tmp_path / "w.npz", displacement=U, spacing=[H] * 3, frequencies=HERTZ)
    found = wave_field.read_waves(tmp_path / "w.npz")
    assert np.isnan(found.displacement[1, :2]).all() and np.isfinite(found.displacement[0, :2]).all()
    assert any("72 voxels do not move in field 2, but move in other" in n for n in found.notes)
    assert any("field 1 has 6 components that are exactly 0" in n for n in found.notes)


def test_zeros_around_the_organ_are_not_measured(tmp_path):
    field = plane_waves((5, 6, 7), noise=1e-7)
    U = np.zeros((2, 9, 9, 9, 3), complex)
    U[:, 2:7, 1:7, 1:8] = field.displacement
    U[0, 0, 0, 0, 0] = np.inf
    np.savez(tmp_path / "zeros.npz", displacement=U, spacing=H, frequencies=HERTZ)
    found = wave_field.read_waves(tmp_path / "zeros.npz")
    assert found.mask.sum() == 5 * 6 * 7 and "do not move at all" in found.notes[0]
    assert np.all(np.isfinite(found.displacement[:, found.mask]))
