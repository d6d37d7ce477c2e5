"""Waves on voxels from files: formats, units, wrapped phases, and unusable files."""

import re
import sys

import h5py
import numpy as np
import pytest
import scipy.io
from test_wave_commands import written
from test_waves import HERTZ, H, plane_waves

from fitting.waves import wave_field
from fitting.waves.files import formats, unwrapping
from liverjax.core.errors import InputError

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.parametrize(
    ("kind", "shape", "words"),
    [
        (
            np.float32,
            (6, 6, 6, 3, 2),
            "the numbers are real, so they are read as labels; give waves as complex numbers",
        ),
        (np.complex64, (6, 6, 6), r"displacement has shape \(6, 6, 6\); give complex numbers \(nx, ny, nz, 3\)"),
    ],
)
def test_images_that_hold_no_waves_are_told_the_layout_of_images(kind, shape, words, tmp_path):
    nibabel = pytest.importorskip("nibabel")
    nibabel.save(nibabel.Nifti1Image(np.ones(shape, kind), np.diag([2.0, 2, 2, 1])), tmp_path / "w.nii")
    with pytest.raises(InputError, match=words):
        wave_field.read_waves(tmp_path / "w.nii", frequencies=[60.0])


@pytest.mark.parametrize("ending", [".npz", ".h5", ".csv", ".nii", ".nii.gz"])
def test_a_file_of_any_format_is_read_as_it_was_written(tmp_path, ending):
    field = plane_waves((5, 6, 7), noise=1e-7)
    asked = list(HERTZ) if ".nii" in ending else None
    found = wave_field.read_waves(written(tmp_path, ending, field), asked)
    np.testing.assert_allclose(found.frequencies, HERTZ)
    np.testing.assert_allclose(found.spacing, H, rtol=1e-6)
    scale = np.abs(field.displacement).max()
    np.testing.assert_allclose(found.displacement, field.displacement, atol=1e-6 * scale)


def test_a_wrong_spacing_of_the_file_is_replaced(tmp_path):
    """A spacing in mm was refused as too large for a voxel, although --spacing gave the right one."""
    field = plane_waves((5, 5, 5))
    np.savez(tmp_path / "w.npz", displacement=field.displacement, frequencies=HERTZ, spacing=1e3 * np.full(3, H))
    found = wave_field.read_waves(tmp_path / "w.npz", spacing=[H, H, H])
    np.testing.assert_allclose(found.spacing, H)
    assert any("the file states a spacing of" in note for note in found.notes)
    np.savez(tmp_path / "u.npz", displacement=field.displacement, frequencies=HERTZ, spacing=np.full(3, H), unit="um")
    other = wave_field.read_waves(tmp_path / "u.npz", unit="mm")
    assert any("states the unit um, but --unit mm is used" in note for note in other.notes)
    with pytest.raises(InputError, match="too large for a voxel"):
        wave_field.read_waves(tmp_path / "w.npz")


def test_a_table_may_have_the_columns_of_other_formats(tmp_path):
    """A column frequency_Hz was ignored if --frequencies was given, and so were mask and labels."""
    field = plane_waves((5, 5, 5))
    path = written(tmp_path, ".csv", field)
    head, *rows = path.read_text().splitlines()
    x = [float(row.split(",")[1]) for row in rows]
    rows = [f"{row},{int(at > 1.5 * H)},{1 + int(at > 2.5 * H)}" for row, at in zip(rows, x, strict=True)]
    path.write_text("\n".join([head.replace("frequency", "frequency_Hz") + ",mask,labels", *rows]) + "\n")
    found = wave_field.read_waves(path)
    np.testing.assert_allclose(found.frequencies, HERTZ)
    assert found.mask.sum() == 75 and found.labels[:, 0, 0].tolist() == [1, 1, 1, 2, 2]
    whole, n = path.read_text(), len(rows) // 2
    path.write_text(whole.replace("labels", "label").replace("mask", "region"))
    with pytest.raises(InputError, match="two columns contain label; remove one of them"):
        wave_field.read_waves(path)
    # Spreadsheets leave empty columns. Two columns of one unknown name have no meaning.
    head, *lines = whole.splitlines()
    for more in (",,", ",note,note"):
        path.write_text("\n".join([head + more, *(line + ",," for line in lines)]) + "\n")
        assert wave_field.read_waves(path).mask.sum() == 75
    last = rows[-1].split(",")
    path.write_text(whole.replace(rows[-1], ",".join([*last[:-2], str(1 - int(last[-2])), last[-1]])))
    with pytest.raises(InputError, match=f"row ({n + 1}|{2 * n + 1}): mask differs from its value at another"):
        wave_field.read_waves(path)


def test_instants_of_a_period_and_other_units_are_the_same_waves(tmp_path):
    field = plane_waves((5, 5, 5))
    t = np.arange(8) / 8
    phases = np.stack([np.real(field.displacement * np.exp(2j * np.pi * one)) for one in t], axis=1)
    np.savez(tmp_path / "phases.npz", phases=1e6 * phases, spacing=H, unit="um")
    found = wave_field.read_waves(tmp_path / "phases.npz", list(HERTZ))
    np.testing.assert_allclose(found.displacement, field.displacement, atol=1e-18)
    assert not any("instants" in note for note in found.notes)
    # The end of the period repeats its beginning. The error of the moduli would be 5 %.
    phases = np.concatenate([phases, phases[:, :1]], axis=1)
    noise = np.random.default_rng(0).normal(size=phases.shape) * 0.1 * np.std(phases)
    np.savez(tmp_path / "phases.npz", phases=phases + noise, spacing=H)
    (note,) = wave_field.read_waves(tmp_path / "phases.npz", list(HERTZ)).notes
    assert "a period of 8 steps fits the 9 instants better" in note


def test_a_group_of_hdf5_is_no_array(tmp_path):
    """The message said that the file is damaged."""
    with h5py.File(tmp_path / "own.h5", "w") as file:
        file["displacement/real"] = np.zeros((3, 3, 3, 3))
    with pytest.raises(InputError, match=r"own\.h5: displacement is a group that contains real, not an array"):
        wave_field.read_waves(tmp_path / "own.h5")


def test_an_array_of_hdf5_may_name_its_own_unit_spacing_and_frequencies(tmp_path):
    field = plane_waves((5, 5, 5))
    with h5py.File(tmp_path / "own.h5", "w") as file:
        file["displacement"] = 1e6 * field.displacement
        file["frequencies"] = HERTZ
        file["displacement"].attrs.update({"unit": "um", "spacing": [H] * 3})
        file["frequencies"].attrs["unit"] = "Hz"
    found = wave_field.read_waves(tmp_path / "own.h5")
    np.testing.assert_allclose(found.displacement, field.displacement, atol=1e-18)
    np.testing.assert_allclose(found.spacing, H)


@pytest.mark.parametrize("ending", [".npy", ".npz"])
def test_text_and_objects_in_place_of_arrays_get_a_sentence_about_numbers(tmp_path, ending):
    path = tmp_path / f"waves{ending}"
    path.write_text("no array")
    with pytest.raises(InputError, match="no arrays of numbers"):
        wave_field.read_waves(path, [60.0], spacing=[H] * 3)
    saved = np.array([{"u": 1}], dtype=object)
    np.save(path, saved) if ending == ".npy" else np.savez(path, displacement=saved)
    with pytest.raises(InputError, match="no arrays of numbers"):
        wave_field.read_waves(path, [60.0], spacing=[H] * 3)


def wrapped_file(path, radians_per_metre=2.8e5):
    """Write phases of waves that exceed 2 pi several times, as a scanner stores them. One corner is not measured."""
    field = plane_waves((12, 12, 14))
    t = np.arange(8) / 8
    motion = np.stack([np.real(field.displacement * np.exp(2j * np.pi * one)) for one in t], axis=1)
    wrapped = np.angle(np.exp(1j * radians_per_metre * motion))
    wrapped[:, :, :2, :2, :2] = np.nan
    np.savez(path, wrapped=wrapped, spacing=H, frequencies=HERTZ)
    return radians_per_metre * field.displacement, np.ptp(radians_per_metre * motion)


def test_wrapped_phases_are_unwrapped(tmp_path):
    pytest.importorskip("skimage")
    exact, reach = wrapped_file(tmp_path / "wrapped.npz")
    assert reach > 2 * np.pi  # otherwise nothing is wrapped
    found = wave_field.read_waves(tmp_path / "wrapped.npz")
    off = (found.displacement - exact)[:, 2:]
    np.testing.assert_allclose(off, 0, atol=1e-12)
    assert np.all(np.isnan(found.displacement[:, :2, :2, :2])) and found.mask.sum() == found.mask.size - 8
    assert not [note for note in found.notes if not note.startswith("component y is zero")]
    wrapped_file(tmp_path / "steep.npz", 6e5)  # more than pi from one voxel to the next
    steep, left, _ = wave_field.read_waves(tmp_path / "steep.npz").notes
    assert "Remove these voxels from the mask" in left
    assert re.match(r"frequency 2 of 2: [\d.]+ % of neighbouring voxels differ by nearly pi", steep)


def test_separate_parts_of_a_mask_are_unwrapped_on_their_own():
    """Each part has its own multiple of 2 pi at every instant. Only the median of all voxels was made continuous."""
    pytest.importorskip("skimage")
    t, x = np.arange(16) / 16, np.arange(12)[:, None, None, None]
    exact = np.stack([6 * np.cos(2 * np.pi * one + 0.1 * x + np.zeros((12, 4, 4, 3))) for one in t])[None]
    exact[:, :, 5:7] = np.nan
    exact[:, :5, 0, 0, 0] = np.nan  # a voxel without a phase at some instants
    found, notes = unwrapping.unwrapped("waves", np.angle(np.exp(1j * exact)))
    assert not notes and np.array_equal(np.isnan(found), np.isnan(exact))
    off = (found - exact)[0, ..., 1:, :]
    np.testing.assert_allclose((off - off[:1])[np.isfinite(off)], 0, atol=1e-12)  # constant in time in each part


def test_phases_of_air_are_not_unwrapped(tmp_path):
    """Noise outside the mask was reported as waves that are too steep."""
    pytest.importorskip("skimage")
    exact, _ = wrapped_file(tmp_path / "wrapped.npz")
    held = dict(np.load(tmp_path / "wrapped.npz"))
    mask = np.ones(held["wrapped"].shape[2:5], int)
    mask[:2] = 0
    noise = np.random.default_rng(0).uniform(-np.pi, np.pi, held["wrapped"].shape)
    held["wrapped"] = np.where((mask == 0)[..., None], noise, held["wrapped"])
    np.savez(tmp_path / "masked.npz", **held, mask=mask)
    found = wave_field.read_waves(tmp_path / "masked.npz")
    np.testing.assert_allclose((found.displacement - exact)[:, 2:], 0, atol=1e-12)
    assert not [note for note in found.notes if "pi" in note]


def test_wrapped_phases_that_are_no_radians_get_a_sentence(tmp_path, monkeypatch):
    wrapped_file(tmp_path / "wrapped.npz")
    held = dict(np.load(tmp_path / "wrapped.npz"))
    np.savez(tmp_path / "grey.npz", **held | {"wrapped": 1300 * held["wrapped"]})
    with pytest.raises(InputError, match="radians between -pi and pi"):
        wave_field.read_waves(tmp_path / "grey.npz")
    monkeypatch.setitem(sys.modules, "skimage.restoration", None)
    with pytest.raises(InputError, match=r"pip install '\.\[unwrap\]'"):
        wave_field.read_waves(tmp_path / "wrapped.npz")


@pytest.mark.parametrize(
    "change, words",
    [
        ({"spacing": None}, "give --spacing"),
        ({"spacing": [2.0, 2.0, 2.0]}, "give metres, not mm"),
        ({"frequencies": None}, "give 2 in Hz, e.g. --frequencies"),
        ({"frequencies": [60.0]}, "1 frequencies for 2 displacement fields"),
        ({"frequencies": [60.0, 60.0]}, "not all different"),
        ({"frequencies": [60.0, -1.0]}, "above 0 Hz"),
        ({"displacement": np.ones((2, 5, 5, 5, 3))}, "no imaginary part"),
        ({"displacement": np.ones((5, 5)) + 1j}, "frequencies first, components last"),
        ({"displacement": np.full((2, 5, 5, 5, 3), 0j)}, "zero or NaN in every voxel"),
        ({"displacement": np.full((2, 5, 5, 5, 3), 1e-300 + 1e-300j)}, "the largest displacement is 1.41e-300"),
        ({"displacement": None}, "store the waves as displacement"),
        ({"mask": np.zeros((5, 5, 5), int)}, "no voxel of the mask"),
        ({"mask": np.ones((4, 5, 5), int)}, "use the same voxels"),
        ({"labels": np.full((5, 5, 5), 0.5)}, "whole numbers"),
        ({"unit": "inch"}, "unit 'inch' is not known"),
        ({"frequencies": ["sixty", "hundred"]}, "does not contain numbers"),
        ({"origin": [0.0, np.nan, 0.0]}, "three coordinates"),
    ],
)
def test_a_file_that_cannot_be_used_gets_a_sentence(tmp_path, change, words):
    field = plane_waves((5, 5, 5))
    arrays = {"displacement": field.displacement, "spacing": field.spacing, "frequencies": HERTZ} | change
    np.savez(tmp_path / "bad.npz", **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(InputError, match=words) as told:
        wave_field.read_waves(tmp_path / "bad.npz")
    assert "bad.npz" in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize("ending", [".npz", ".npy", ".h5", ".csv", ".nii.gz", ".xyz"])
def test_a_damaged_or_unknown_file_gets_a_sentence(tmp_path, ending):
    path = tmp_path / f"waves{ending}"
    path.write_bytes(b"PK\x03\x04 this is no archive\n1,2,3\n")
    with pytest.raises(InputError, match="waves") as told:
        wave_field.read_waves(path, [60.0], spacing=[H] * 3)
    assert "\n" not in str(told.value)
    with pytest.raises(InputError, match="does not exist"):
        wave_field.read_waves(tmp_path / f"none{ending}")


@pytest.mark.parametrize("asked", [[50.0, 70.0], [60.0, 80.0, 100.0], [60.0]])
def test_other_frequencies_than_those_of_the_file_are_refused(tmp_path, asked):
    path = written(tmp_path, ".npz", plane_waves((5, 5, 5)))
    with pytest.raises(InputError, match="remove --frequencies"):
        wave_field.read_waves(path, asked)


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_files_of_matlab_have_the_axes_that_matlab_shows(tmp_path, version):
    """SciPy writes version 5. Version 7.3 is HDF5 with reversed axes, classes as attributes and text as numbers."""
    field = plane_waves((5, 6, 7))
    held = {"displacement": 1e3 * field.displacement, "frequencies": np.array([HERTZ]), "spacing": np.full((1, 3), H)}
    if version == "5":
        scipy.io.savemat(tmp_path / "waves.mat", held | {"unit": "mm"})
    else:
        with h5py.File(tmp_path / "waves.mat", "w") as file:
            for name, values in held.items():
                parts = values.T
                if np.iscomplexobj(values):
                    parts = np.empty(values.T.shape, [("real", "f8"), ("imag", "f8")])
                    parts["real"], parts["imag"] = values.T.real, values.T.imag
                file[name] = parts
                file[name].attrs["MATLAB_class"] = np.bytes_("double")
            file["unit"] = np.array([[ord(letter)] for letter in "mm"], np.uint16)
            file["unit"].attrs["MATLAB_class"] = np.bytes_("char")
    found = wave_field.read_waves(tmp_path / "waves.mat")
    np.testing.assert_allclose(found.displacement, field.displacement, rtol=1e-14)
    np.testing.assert_allclose(found.spacing, H)


def test_units_in_the_headings_of_a_table_are_read(tmp_path):
    field = plane_waves((5, 5, 5))
    path = written(tmp_path, ".csv", field)
    exact = wave_field.read_waves(path)
    head, *rows = path.read_text().splitlines()
    names = head.split(",")
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    for k, name in enumerate(names):
        if name in "xyz":
            names[k], values[:, k] = f"{name} [mm]", 1e3 * values[:, k]
        elif name.startswith("u_"):
            names[k], values[:, k] = f"{name}_um", 1e6 * values[:, k]
    np.savetxt(path, values, delimiter=",", header=",".join(names), comments="", fmt="%.17g")
    found = wave_field.read_waves(path)
    np.testing.assert_allclose(found.displacement, exact.displacement, rtol=1e-12)
    np.testing.assert_allclose(found.spacing, exact.spacing, rtol=1e-12)
    path.write_text(path.read_text().replace("y [mm]", "y_m", 1))
    with pytest.raises(InputError, match="heading y_m has a unit other than mm"):
        wave_field.read_waves(path)
    for name, bare in (("y_m", "y"), ("u_im_y_um", "u_im_y")):  # y was read in mm too
        path.write_text(path.read_text().replace("y_m" if bare == "y" else name, bare, 1))
        with pytest.raises(InputError, match=f"heading {bare} has no unit"):
            wave_field.read_waves(path)
        path.write_text(path.read_text().replace(f",{bare},", ",y [mm]," if bare == "y" else f",{name},", 1))


def test_a_table_with_semicolons_and_decimal_commas_is_read(tmp_path):
    field = plane_waves((5, 5, 5))
    path = written(tmp_path, ".csv", field)
    exact = wave_field.read_waves(path).displacement
    path.write_text(path.read_text().replace(",", ";").replace(".", ","))
    np.testing.assert_array_equal(wave_field.read_waves(path).displacement, exact)
    head, *rows = path.read_text().splitlines()
    at = head.split(";").index("frequency")
    cells = rows[3].split(";")
    rows[3] = ";".join([*cells[:at], "", *cells[at + 1 :]])
    path.write_text("\n".join([head, *rows]))
    with pytest.raises(InputError, match="row 5 has no frequency"):
        wave_field.read_waves(path)


def test_a_component_of_zeros_is_told(tmp_path):
    """A wave may have one direction. But programs also write zeros where they did not measure."""
    field = plane_waves((5, 5, 5), noise=1e-7)
    U = field.displacement.copy()
    U[..., 2] = 0
    np.savez(tmp_path / "two.npz", displacement=U, spacing=H, frequencies=HERTZ, unit=b"m")
    found = wave_field.read_waves(tmp_path / "two.npz")
    assert found.notes == ("component z is zero everywhere: write NaN if this component was not measured",)
    U[..., 2] = np.nan
    np.savez(tmp_path / "two.npz", displacement=U, spacing=H, frequencies=HERTZ)
    assert not wave_field.read_waves(tmp_path / "two.npz").notes


def test_labels_on_voxels_of_another_size_are_refused(tmp_path):
    field = plane_waves((5, 5, 5))
    np.savez(tmp_path / "waves.npz", displacement=field.displacement, spacing=H, frequencies=HERTZ)
    labels = np.ones((5, 5, 5), int)
    np.savez(tmp_path / "labels.npz", labels=labels, spacing=2 * H)
    with pytest.raises(InputError, match="give labels on the voxels of the waves"):
        wave_field.read_waves(tmp_path / "waves.npz", labels=tmp_path / "labels.npz")
    np.savez(tmp_path / "labels.npz", labels=labels)
    assert np.all(wave_field.read_waves(tmp_path / "waves.npz", labels=tmp_path / "labels.npz").labels == 1)


def test_rounded_places_tell_the_spacing_by_their_whole_length(tmp_path):
    """Voxels of 1.5625 mm are written with five decimals, so single steps are 1.56 and 1.57 mm."""
    field = plane_waves((12, 5, 5))
    text = written(tmp_path, ".csv", field).read_text().splitlines()
    rows = [line.split(",") for line in text[1:]]
    for row in rows:
        row[1:4] = [f"{float(x) * 1.5625e-3 / H:.5f}" for x in row[1:4]]
    (tmp_path / "waves.csv").write_text("\n".join([text[0], *(",".join(row) for row in rows)]) + "\n")
    found = wave_field.read_waves(tmp_path / "waves.csv")
    np.testing.assert_allclose(found.spacing, 1.5625e-3, rtol=1e-3)  # 5e-6 m in 6.25 mm
    assert found.spacing[0] == pytest.approx(1.5625e-3, rel=3e-4) and found.mask.all()


def test_a_column_with_another_name_is_told(tmp_path):
    path = written(tmp_path, ".csv", plane_waves((5, 5, 5)))
    head, *rows = path.read_text().replace("frequency", "freq_Hz").splitlines()
    path.write_text("\n".join([f"mask,{head}", *(f"1,{row}" for row in rows)]) + "\n")
    with pytest.raises(InputError, match=r"rename column freq_hz to frequency if this column contains the frequencies"):
        wave_field.read_waves(path)


def _nifti_of_waves(path, affine):
    nibabel, field = pytest.importorskip("nibabel"), plane_waves((7, 7, 7))
    image = nibabel.Nifti1Image(np.moveaxis(field.displacement, 0, 3).astype(np.complex64), affine)
    nibabel.save(image, path)
    return field


SHEARED = np.array([[2.0, 1.0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("affine", "pixdim", "words"),
    [
        (np.diag([2.0, 2, 2, 1]), [1.0, 1, 1], "the header states the voxel size [1.0, 1.0, 1.0], but the affine"),
        (SHEARED, None, "the axes of the voxels are not perpendicular"),
    ],
)
def test_a_nifti_file_whose_voxels_are_not_known_is_refused(tmp_path, affine, pixdim, words):
    """The spacing was taken from the header. Where the affine matrix has another one, the result was 754 Pa for 3000
    Pa.
    """
    path = tmp_path / "w.nii"
    _nifti_of_waves(path, affine)
    if pixdim is not None:  # nibabel writes both alike
        raw = bytearray(path.read_bytes())
        raw[80:92] = np.array(pixdim, "<f4").tobytes()
        path.write_bytes(raw)
    with pytest.raises(InputError, match=re.escape(words)):
        wave_field.read_waves(path, frequencies=list(HERTZ))
    if pixdim is not None:
        found = wave_field.read_waves(path, frequencies=list(HERTZ), spacing=[0.002] * 3)
        assert np.array_equal(found.spacing, [0.002] * 3)
        # A mask with the same wrong header: its position is unknown, so only its shape counts.
        nibabel = pytest.importorskip("nibabel")
        nibabel.save(nibabel.Nifti1Image(np.ones(found.mask.shape, np.int16), affine), tmp_path / "m.nii")
        raw = bytearray((tmp_path / "m.nii").read_bytes())
        raw[80:92] = np.array(pixdim, "<f4").tobytes()
        (tmp_path / "m.nii").write_bytes(raw)
        masked = wave_field.read_waves(path, frequencies=list(HERTZ), spacing=[0.002] * 3, mask=tmp_path / "m.nii")
        assert masked.mask.shape == found.mask.shape


@pytest.mark.parametrize("turned", [False, True])
def test_labels_that_lie_elsewhere_than_the_waves_are_refused(tmp_path, turned):
    """The labels were stored with reversed x, and the soft region replaced the stiff one."""
    field = _nifti_of_waves(tmp_path / "w.nii", np.diag([2.0, 2, 2, 1]))
    nibabel, labels = pytest.importorskip("nibabel"), np.ones(field.mask.shape, np.int16)
    labels[4:] = 2
    affine = np.diag([2.0, 2, 2, 1])
    if turned:
        affine[0, 0], affine[0, 3], labels = -2.0, 12.0, labels[::-1].copy()
    nibabel.save(nibabel.Nifti1Image(labels, affine), tmp_path / "l.nii")
    if turned:
        with pytest.raises(InputError, match="the voxels are not at the positions of the voxels of the waves"):
            wave_field.read_waves(tmp_path / "w.nii", labels=tmp_path / "l.nii", frequencies=list(HERTZ))
        return
    for shape in (labels.shape, (*labels.shape, 1)):  # a mask may have a fourth axis, but such labels were refused
        nibabel.save(nibabel.Nifti1Image(labels.reshape(shape), affine), tmp_path / "l.nii")
        read = wave_field.read_waves(tmp_path / "w.nii", labels=tmp_path / "l.nii", frequencies=list(HERTZ))
        assert np.array_equal(read.labels, labels)


@pytest.mark.parametrize("micro", ["\u00b5", "\u03bc"])  # two letters that look the same
def test_both_letters_for_micro_are_known(tmp_path, micro):
    field = plane_waves((5, 5, 5))
    arrays = {"displacement": 1e6 * field.displacement, "spacing": field.spacing, "frequencies": HERTZ}
    np.savez(tmp_path / "w.npz", **arrays, unit=f"{micro}m")
    for unit in (None, "\u00b5m", "\u03bcm"):
        found = wave_field.read_waves(tmp_path / "w.npz", unit=unit)
        np.testing.assert_allclose(found.displacement, field.displacement, rtol=1e-12)
        assert not any("--unit" in note for note in found.notes)


def test_a_mask_must_be_near_the_waves_at_every_corner(tmp_path):
    """Vectors and origin were compared separately: a mask that was turned by 5 degrees was accepted, although its far
    corner was 11 voxels away. So was a voxel size 0.9 % smaller in an array of 100 voxels.
    """
    place = np.array([[0.002, 0, 0, 0], [0, 0.002, 0, 0], [0, 0, 0.002, 0]])
    nibabel, image = pytest.importorskip("nibabel"), np.ones((100, 90, 5), np.int16)

    def read(angle, size, known=True):
        affine = np.diag([size, size, 2.0, 1.0])
        c, s = np.cos(angle), np.sin(angle)
        affine[:2, :2] = size * np.array([[c, -s], [s, c]])
        nibabel.save(nibabel.Nifti1Image(image, affine), tmp_path / "m.nii")
        return wave_field._on_the_same_voxels(
            tmp_path / "m.nii", "mask", np.full(3, 0.002), place if known else None, False
        )

    assert read(0.0, 2.0).shape == (100, 90, 5) and read(5e-4, 2.0).all() and read(0.0, 1.995, known=False).all()
    for angle in (np.deg2rad(5), 2e-3):
        with pytest.raises(InputError, match="the voxels are not at the positions of the voxels of the waves"):
            read(angle, 2.0)
    with pytest.raises(InputError, match="the voxel size is"):
        read(0.0, 1.982, known=False)
    image = np.ones((4, 5), np.int16)  # the shape is refused later
    assert read(0.0, 2.0).shape == (4, 5)


def test_arrays_of_nearly_known_names_are_told(tmp_path):
    """A mask of a wrong name was ignored without a word."""
    field = plane_waves((5, 5, 5))
    arrays = {"displacement": field.displacement, "spacing": field.spacing, "frequencies": HERTZ}
    np.savez(tmp_path / "waves.npz", **arrays, masks=field.mask, image=np.zeros(3), frequency=np.zeros(3))
    told = [n for n in wave_field.read_waves(tmp_path / "waves.npz").notes if "is not used" in n]
    assert told == ["the array 'masks' is not used: did you mean mask?"]
    arrays["Displacement"] = arrays.pop("displacement")
    np.savez(tmp_path / "waves.npz", **arrays)
    with pytest.raises(InputError, match=r"no waves.*'Displacement' is not used: did you mean displacement"):
        wave_field.read_waves(tmp_path / "waves.npz")


def test_rounded_positions_are_on_the_grid(tmp_path):
    """A turn of the axes in single precision moves positions by nanometres. These were taken for steps of the grid."""
    index = np.stack(np.unravel_index(np.arange(5 * 6 * 7), (5, 6, 7)), axis=1)
    once = np.zeros(len(index), int)
    exact, rng = index * np.array([0.002, 0.0025, 0.003]), np.random.default_rng(0)
    for jitter in (4e-9, 2e-5):
        places = exact + rng.uniform(-jitter, jitter, exact.shape)
        at, spacing, _, shape = formats._grid(tmp_path, places, once)
        np.testing.assert_array_equal(at, index)
        np.testing.assert_allclose(spacing, [0.002, 0.0025, 0.003], rtol=0.01)
        assert shape == (5, 6, 7)
    apart = index + np.where(index[:, :1] > 2, [[60, 0, 0]], 0)  # two bodies, 60 voxels apart
    at, spacing, _, shape = formats._grid(tmp_path, apart * 0.0015, once)
    np.testing.assert_array_equal(at, apart)
    assert np.allclose(spacing, 0.0015) and shape == (65, 6, 7)
    with pytest.raises(InputError, match="is not on a regular grid"):
        formats._grid(tmp_path, exact + rng.uniform(-2e-4, 2e-4, exact.shape), once)
    with pytest.raises(InputError, match="is not on a regular grid"):  # and not a grid of 1 um with 10^9 voxels
        formats._grid(tmp_path, np.round(exact + rng.uniform(-2e-4, 2e-4, exact.shape), 6), once)
    # Neighbouring rows of 1.3333 mm are rounded to 1.33 or 1.34 mm: not a grid of 0.01 mm.
    rounded = np.round(index * 0.0013333 + rng.uniform(-4e-6, 4e-6, exact.shape), 5)
    assert formats._grid(tmp_path, rounded, once)[3] == (5, 6, 7)
