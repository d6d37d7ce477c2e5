"""The command for waves: tables, maps that continue, one-line messages for invalid input."""

import json
from types import SimpleNamespace

import h5py
import meshio
import numpy as np
import pytest
from test_waves import DENSITY, HERTZ, H, modulus, organ, plane_waves

from fitting import __main__ as command
from fitting.readers import rheometer
from fitting.reports.waves import maps, report
from fitting.waves import (
    balance,
    elastography,
    stiffness_map,
    wave_field,
)
from liverjax.core.errors import InputError

pytestmark = pytest.mark.quick_to_compile


def written(tmp_path, ending, field):
    path = tmp_path / f"waves{ending}"
    arrays = {"displacement": field.displacement, "spacing": field.spacing, "frequencies": field.frequencies}
    if field.labels is not None:
        arrays["labels"] = field.labels
    if ending == ".npz":
        np.savez(path, **arrays)
    elif ending == ".h5":
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values
    elif ending == ".csv":
        rows = ["frequency,x,y,z,u_re_x,u_im_x,u_re_y,u_im_y,u_re_z,u_im_z"]
        for f, hertz in enumerate(field.frequencies):
            for at in np.ndindex(field.mask.shape):
                u = field.displacement[(f, *at)]
                cells = [hertz, *(np.array(at) * H), *np.stack([u.real, u.imag], 1).ravel()]
                rows.append(",".join(f"{v:.12g}" for v in cells))
        path.write_text("\n".join(rows) + "\n")
    else:
        nibabel = pytest.importorskip("nibabel")
        image = nibabel.Nifti1Image(np.moveaxis(field.displacement, 0, 3).astype(np.complex64), np.diag([2, 2, 2, 1.0]))
        nibabel.save(image, path)
    return path


@pytest.mark.ci
@pytest.mark.draws
def test_the_command_writes_regions_and_a_map_and_goes_on(tmp_path, capsys):
    labels = np.ones((7, 7, 9), int)
    labels[..., 5:] = 4
    path = written(tmp_path, ".npz", plane_waves((7, 7, 9), noise=1e-7, labels=labels))
    ask = ["waves", str(path), "--density", "1000", "--out", str(tmp_path / "out"), "--samples", "3"]
    assert command.main(ask) == 0
    first = json.loads((tmp_path / "out" / "waves.json").read_text())
    assert set(first["regions"]) == {"1", "4"} and first["direct_inversion"]["whole"]["storage_Pa"][0] is not None
    for row in first["regions"].values():
        for f, G in enumerate(modulus(HERTZ)):
            e = row["standard_error_storage_Pa"][f]
            assert abs(row["storage_Pa"][f] - row["mesh_bias_storage_Pa"][f] - G.real) < 4 * e + 0.005 * abs(G)
    with h5py.File(tmp_path / "out" / "waves.h5") as file:
        G, sd = file["modulus"][:], file["sd"][:]
        assert G.shape == (2, 7, 7, 9) and file["draws_of_exponent"].shape == (3, 2, 7, 7, 9)
        assert np.all(np.isfinite(G.imag) == np.isfinite(G.real))
        # The voxels are correlated. A bound of one deviation would hold or fail by chance, so it is three.
        assert np.mean(np.abs(G[0].real - 3000) < 3 * sd[0].real) > 0.97
    assert command.main([*ask, "--resume"]) == 0
    again = json.loads((tmp_path / "out" / "waves.json").read_text())
    assert again["map"]["chi2_per_component"] <= 1.001 * first["map"]["chi2_per_component"]
    assert "map: chi2" in capsys.readouterr().out


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("axes", [np.diag([-2.0, 2.0, 2.0]), np.array([[0, 0, 2.0], [-2.0, 0, 0], [0, 2.0, 0]])])
def test_the_map_lies_where_the_affine_of_the_image_says(axes, stride, tmp_path):
    """The body began at the origin of the affine, but extended along x, y and z, so it was mirrored or turned."""
    nibabel, shape = pytest.importorskip("nibabel"), (10, 6, 8)
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes, (90, -60, -30)
    U = np.moveaxis(plane_waves(shape).displacement, 0, 3).astype(np.complex64)
    nibabel.save(nibabel.Nifti1Image(U, affine), tmp_path / "w.nii")
    field = wave_field.read_waves(tmp_path / "w.nii", list(HERTZ))._replace(noise=np.full(2, 1e-7))
    field = wave_field.coarsened(field, stride)
    body = elastography.body_of(field)
    organ_of_file = SimpleNamespace(field=field, body=body)
    moduli = np.full((2, len(body.whole.points)), 3e3 + 1j)
    maps.write_for_paraview(tmp_path / "m.vtu", organ_of_file, SimpleNamespace(modulus=moduli, sd=moduli))
    maps.write_at_voxels(tmp_path / "m.h5", organ_of_file, None, np.zeros(1))
    corners = body.voxel[: len(body.linear.points)]
    there = 1e-3 * ((corners * stride + 0.5 * (stride - 1)) @ axes.T + affine[:3, 3])
    mesh = meshio.read(tmp_path / "m.vtu")
    np.testing.assert_allclose(mesh.points, there, atol=1e-9)
    x = mesh.points[mesh.cells[0].data]
    assert np.linalg.det(x[:, 1:] - x[:, :1]).min() > 0
    with h5py.File(tmp_path / "m.h5") as file:
        place = file["place"][:]
        np.testing.assert_allclose(corners @ place[:, :3].T + place[:, 3], there, atol=1e-9)
        np.testing.assert_allclose(file["origin"][:], place[:, 3])


@pytest.mark.ci
def test_a_large_organ_is_fitted_in_parts(tmp_path, monkeypatch, capsys):
    """Regions, edges, the map and its files extend across the parts."""
    from fitting.commands import waves

    labels = np.ones((9, 9, 13), int)
    labels[..., 8:] = 4
    field = plane_waves((9, 9, 13), noise=1e-7, labels=labels)
    monkeypatch.setattr(elastography, "SIDES", (3,))
    one, parts = (elastography.gigabytes(elastography.body_of(field, side)) for side in (None, 3))
    assert parts < 0.5 * one
    monkeypatch.setattr(waves, "MOST_MEMORY", 0.5 * (one + parts))
    path, out = written(tmp_path, ".npz", field), tmp_path / "out"
    ask = ["waves", str(path), "--density", "1000", "--out", str(out), "--samples", "2"]
    assert command.main(ask) == 0
    assert "divided into 8 parts" in capsys.readouterr().err
    found = json.loads((out / "waves.json").read_text())
    assert found["parts"] == 8 and found["voxels"] == 9 * 9 * 13
    for row in (found["whole"], *found["regions"].values()):
        for f, G in enumerate(modulus(HERTZ)):
            error = row["storage_Pa"][f] - row["mesh_bias_storage_Pa"][f] - G.real
            assert abs(error) < 4 * row["standard_error_storage_Pa"][f] + 0.005 * abs(G)
    with h5py.File(out / "waves.h5") as file:
        G, sd = file["modulus"][:], file["sd"][:]
        assert G.shape == (2, 9, 9, 13) and np.isfinite(G).all()
        assert np.mean(np.abs(G[0].real - 3000) < 3 * sd[0].real) > 0.97
    assert command.main([*ask, "--resume"]) == 0
    assert elastography.body_that_fits(field, 0.5 * (one + parts), most_corners=10) is None
    monkeypatch.setattr(waves, "MOST_MEMORY", 0.5 * parts)
    assert command.main([*ask, "--stride", "1"]) == 2
    assert "--stride 1 needs more than" in capsys.readouterr().err


@pytest.mark.ci
def test_regions_of_a_run_that_was_killed_are_not_searched_for_again(tmp_path, monkeypatch):
    """The run was killed during the map. The regions are read from their file, bit by bit, and only for the
    same waves.
    """
    from fitting.waves import regions

    labels = np.ones((7, 7, 9), int)
    labels[..., 5:] = 4
    path = written(tmp_path, ".npz", plane_waves((7, 7, 9), noise=1e-7, labels=labels))
    ask = ["waves", str(path), "--density", "1000", "--out", str(tmp_path / "out"), "--samples", "0"]

    def killed(*_: object, **__: object):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stiffness_map, "map_of", killed)
        assert command.main(ask) > 2
    searched, search = [], regions.moduli_of_regions
    monkeypatch.setattr(regions, "moduli_of_regions", lambda *a: searched.append(a) or search(*a))
    assert command.main([*ask, "--resume", "--no-map"]) == 0 and not searched
    again = json.loads((tmp_path / "out" / "waves.json").read_text())
    assert command.main([*ask, "--no-map"]) == 0 and len(searched) == 2
    unbroken = json.loads((tmp_path / "out" / "waves.json").read_text())
    for key in ("whole", "regions"):
        assert again[key] == unbroken[key]
    assert command.main([*ask, "--resume", "--no-map", "--noise", "3e-7"]) == 2
    (tmp_path / "out" / "progress_of_regions.h5").write_bytes(b"half")
    assert command.main([*ask, "--resume", "--no-map"]) == 2


@pytest.mark.ci
def test_too_few_balances_and_a_length_in_millimetres_are_refused(tmp_path, capsys):
    """4 x 4 x 4 voxels have one brick, with fewer balance equations than pressures."""
    path = written(tmp_path, ".npz", plane_waves((4, 4, 4)))
    assert command.main(["waves", str(path), "--noise", "1e-7", "--out", str(tmp_path / "out")]) == 2
    assert "give 0 equations more than unknown pressures. At least 10 are" in capsys.readouterr().err
    path = written(tmp_path, ".npz", plane_waves((7, 7, 9), noise=1e-7))
    assert command.main(["waves", str(path), "--out", str(tmp_path / "out"), "--length", "4"]) == 2
    assert "--length 4 m is much longer than the organ (0.016 m)" in capsys.readouterr().err


def test_notes_and_the_length_come_before_the_search(tmp_path, capsys, monkeypatch):
    """They came after the factorisations for the typical modulus, which need minutes in a large organ."""
    monkeypatch.setattr(elastography, "organ_of", lambda *_: pytest.fail("the search began"))
    field = plane_waves((7, 7, 9), noise=1e-7)
    path = written(tmp_path, ".npz", field)
    assert command.main(["waves", str(path), "--out", str(tmp_path / "out"), "--length", "4"]) == 2
    assert "--length 4 m is much longer than the organ (0.016 m)" in capsys.readouterr().err


def test_a_progress_file_that_is_none_gets_a_sentence(tmp_path):
    """The files are a text, and an HDF5 file of another program."""
    own = organ()
    course = stiffness_map.course_of(own.body, own.matrices, own.waves, modulus(HERTZ), 0.01)
    for write in (lambda file: file.write_text("no progress"), lambda file: h5py.File(file, "w").close()):
        file = tmp_path / "progress.h5"
        write(file)
        with pytest.raises(
            InputError, match=r"belongs to another fit|is damaged, or was written by another program: remove --resume"
        ):
            stiffness_map._first_or_resumed(course, file)


@pytest.mark.ci
def test_a_map_that_was_stopped_goes_on_to_the_same_end(tmp_path, monkeypatch):
    """The run stops at the second deviation of the prior. The first one is evaluated again, with the same numbers as
    without a stop.
    """
    own, file = organ(noise=5e-7), tmp_path / "progress.h5"
    monkeypatch.setattr(stiffness_map, "DEVIATIONS", (0.2, 0.4))
    less = own.waves._replace(sd=0.1 * own.waves.sd)  # so that no deviation explains the waves
    course = stiffness_map.course_of(own.body, own.matrices, less, 1.3 * modulus(HERTZ), 0.01)
    told = []
    unbroken = stiffness_map.map_of(course, progress=lambda k, chi2: told.append(k))
    assert told.count(1) >= 2 and unbroken.distance <= stiffness_map.FAR
    assert unbroken.history[0]["steps"] <= 12  # with the Hessian of the starting point alone it takes 24

    def stop(k, chi2):
        stopped.append(k)
        if stopped.count(1) == 2:
            raise KeyboardInterrupt

    stopped = []
    with pytest.raises(KeyboardInterrupt):
        stiffness_map.map_of(course, file, progress=stop)
    again = stiffness_map.map_of(course, file, resume=True)
    assert again.deviation == unbroken.deviation and len(again.history) == len(unbroken.history)
    np.testing.assert_allclose(again.exponent, unbroken.exponent, rtol=1e-9, atol=1e-12)
    for a, b in zip(again.history, unbroken.history, strict=True):
        assert a["evidence"] == pytest.approx(b["evidence"], rel=1e-9)


@pytest.mark.parametrize("other", ["length", "density", "noise", "frequencies", "displacements", "moduli of the organ"])
def test_a_map_goes_on_from_its_own_problem_alone(tmp_path, other):
    own, file, length, w = organ(noise=5e-7), tmp_path / "progress.h5", 0.01, organ(noise=5e-7).waves
    course = stiffness_map.course_of(own.body, own.matrices, w, modulus(HERTZ), length)
    stiffness_map._write(file, course, stiffness_map._first_or_resumed(course, None))
    assert stiffness_map._first_or_resumed(course, file).history == []
    m = balance.matrices(own.body, 1.01 * DENSITY) if other == "density" else own.matrices
    changed = {"noise": "sd", "frequencies": "omega", "displacements": "motion"}.get(other)
    if changed:
        w = w._replace(**{changed: 1.01 * getattr(w, changed)})
    whole = (1.01 if other == "moduli of the organ" else 1.0) * modulus(HERTZ)
    different = stiffness_map.course_of(own.body, m, w, whole, 0.02 if other == "length" else length)
    with pytest.raises(InputError, match=rf"belongs to another fit \({other} differs?\): remove --resume"):
        stiffness_map._first_or_resumed(different, file)


def test_the_moduli_are_written_as_a_sweep_that_fits_read(tmp_path):
    hertz = np.array([40.0, 60.0, 80.0, 100.0])
    G = 2000 + 1500 * (2j * np.pi * hertz / 400) ** 0.4  # a spring in parallel with a springpot
    part = {"storage_Pa": G.real, "loss_Pa": G.imag, "error_storage_Pa": 1e-3 * G.real, "error_loss_Pa": 1e-3 * G.imag}
    whole = {name: values.tolist() for name, values in part.items()}
    content = {"frequencies_Hz": hertz.tolist(), "whole": whole, "regions": None}
    field = plane_waves((5, 5, 5))._replace(frequencies=hertz)
    files = report._sweeps(tmp_path, elastography.Organ(field, None, None, None, DENSITY), content)
    sweep = rheometer.read_sweep(files["whole"])
    np.testing.assert_allclose(sweep.angular_frequency, 2 * np.pi * hertz)
    np.testing.assert_allclose(sweep.storage_sd, part["error_storage_Pa"])
    springpots, told = report._springpots(files)
    assert springpots is not None and told == []
    found = springpots["whole"]
    assert found["model"] == "fractional_kelvin_voigt" and found["mean_relative_error"] < 1e-3
    truth = {"equilibrium_modulus": 2000.0, "springpot": 1500 * 400**-0.4, "exponent": 0.4}
    assert found["numbers"] == pytest.approx(truth, rel=1e-5)
    assert set(found["standard_errors"]) == set(truth) and all(e > 0 for e in found["standard_errors"].values())
    assert report._springpots({}) == (None, [])


@pytest.mark.parametrize(
    "options, words",
    [
        (["--density", "1"], "cannot be the density of an organ"),
        (["--stride", "0"], "--stride 0"),
        (["--noise", "-1"], "--noise -1 must be above 0"),
        (["--frequencies", "0"], "must be above 0 Hz"),
        (["--mask", "none.npz"], "does not exist"),
        (["--stride", "3"], "at least 3 are needed along"),
    ],
)
def test_options_that_cannot_be_are_refused_in_a_sentence(tmp_path, options, words, capsys):
    path = written(tmp_path, ".npz", plane_waves((7, 7, 9)))
    assert command.main(["waves", str(path), *options, "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1


def test_one_component_is_not_enough_for_forces(tmp_path, capsys):
    field = plane_waves((7, 7, 9))
    np.savez(tmp_path / "one.npz", displacement=field.displacement[..., :1], spacing=H, frequencies=HERTZ)
    assert command.main(["waves", str(tmp_path / "one.npz"), "--out", str(tmp_path)]) == 2
    assert "three components" in capsys.readouterr().err


def test_a_sweep_with_the_data_is_not_replaced(tmp_path, capsys):
    """The names of the sweeps that the command writes were not compared with its inputs."""
    data = written(tmp_path, ".csv", plane_waves((5, 5, 5))).rename(tmp_path / "sweep_whole.csv")
    assert command.main(["waves", str(data), "--density", "1000", "--no-map", "--out", str(tmp_path)]) == 2
    assert "sweep_whole.csv would be replaced by the results" in capsys.readouterr().err
