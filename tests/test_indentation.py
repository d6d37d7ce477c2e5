"""Modulus and contact point of indentation curves: other contact laws, coverage, files, the command."""

import json

import numpy as np
import pytest

from fitting.__main__ import main
from fitting.methods.contact_point import fit_contact, fit_with_offset
from fitting.readers.indentation_curves import _end_of_loading, read_indentation
from fitting.rigs.thin_layer import Indenter, Layer, half_space
from liverjax.core.errors import InputError

R, H, E, START = 5e-3, 10e-3, 2400.0, 2e-4
DEPTH = np.linspace(0.0, 7e-4, 80)


def hertz(depth: np.ndarray) -> np.ndarray:
    """Return the force [N] of an incompressible half-space."""
    return 16 / 9 * E * np.sqrt(R) * np.maximum(depth, 0.0) ** 1.5


def test_a_thick_layer_gives_hertz_back():
    layer = Layer(Indenter("sphere", 1e3 * H, 0.5, R))
    found = fit_contact(DEPTH, hertz(DEPTH - START), layer.force)
    # The layer is 10 m thick, so 1.133 chi is 1.8e-4 at the deepest point.
    assert np.isclose(found.modulus, E, rtol=3e-4) and np.isclose(found.contact_point, START, atol=3e-8)
    exact = fit_contact(DEPTH, E * layer.force(DEPTH - START), layer.force)
    assert exact.independent is None  # structure of rounding errors is not correlated noise


def test_a_thin_layer_by_the_first_terms_of_its_series():
    """Compare with Hertz times 1 + 1.133 chi + 1.497 chi^2 (c and 7/6 c^2), for chi up to 0.1. The rest is
    below 0.2 %.
    """
    depth = np.linspace(0.0, 4e-4, 80)
    chi = np.sqrt(R * np.maximum(depth - START, 0.0)) / H
    force = hertz(depth - START) * (1 + 1.133 * chi + 1.497 * chi**2)
    found = fit_contact(depth, force, Layer(Indenter("sphere", H, 0.5, R)).force)
    assert np.isclose(found.modulus, E, rtol=0.01) and np.isclose(found.contact_point, START, atol=2e-6)


@pytest.mark.parametrize(
    ("draws", "low", "high"), [(60, 0.87, 1.0), pytest.param(120, 0.9, 0.99, marks=pytest.mark.slow)]
)
def test_intervals_cover_with_five_percent_of_noise(draws, low, high):
    """Curves of Hertz's law have noise of 5 % of the largest force. The mean is within 5 %, and 95 % are covered."""
    force, layer = hertz(DEPTH - START), Layer(Indenter("sphere", 1e3 * H, 0.5, R))
    rng, found = np.random.default_rng(0), []
    for _ in range(draws):
        noisy = force + 0.05 * force.max() * rng.normal(size=len(force))
        found.append(fit_contact(DEPTH, noisy, layer.force))
    moduli, points = np.array([f.modulus for f in found]), np.array([f.contact_point for f in found])
    errors = np.array([f.standard_errors for f in found])
    assert abs(np.median(moduli) / E - 1) < 0.05 and abs(np.median(points) - START) < 1e-5
    for values, sd, true in ((moduli, errors[:, 0], E), (points, errors[:, 1], START)):
        covered = np.mean(np.abs(values - true) < found[0].quantile * sd)
        assert low <= covered <= high, covered  # the binomial standard deviation is 0.028 for 60 draws, 0.020 for 120


def _shared(rng: np.random.Generator, n: int, part: float = 0.7) -> np.ndarray:
    """Return noise (n,) of variance 1 from an autoregression: each value contains a part of the value before."""
    own, out = rng.normal(size=n), np.empty(n)
    out[0] = own[0]
    for k in range(1, n):
        out[k] = part * out[k - 1] + np.sqrt(1 - part**2) * own[k]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shared", "larger with the force"])
def test_intervals_hold_with_noise_that_is_not_independent_or_equal(kind):
    """Errors for equal, independent noise covered only 57 and 84 % with the 95 % intervals of the modulus."""
    depth = np.linspace(0.0, 7e-4, 160)
    force, layer = hertz(depth - START), Layer(Indenter("sphere", 1e3 * H, 0.5, R))
    rng, held = np.random.default_rng(3), []
    for _ in range(50):
        noise = _shared(rng, 160) * 0.02 * force.max() if kind == "shared" else 0.05 * force * rng.normal(size=160)
        found = fit_contact(depth, force + noise, layer.force)
        held.append(abs(found.modulus - E) < found.quantile * found.standard_errors[0])
        if kind == "shared":  # 0.7 leaves the information of (1 - 0.7) / (1 + 0.7) of the points
            assert found.independent is not None and 8 < found.independent < 90
        else:
            assert found.independent is None or len(held) > 1
    # 50 draws: the binomial standard deviation is 0.031 at 95 %.
    assert np.mean(held) > 0.85, np.mean(held)


def test_noise_of_the_depth_is_no_shared_noise():
    """The derivatives are computed at the noisy depths, so they scatter as the residuals do. This is not a
    correlation.
    """
    depth, layer = np.linspace(0.0, 7e-4, 200), Layer(Indenter("sphere", 1e3 * H, 0.5, R))
    force = hertz(depth - START)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        noisy = force + 1e-3 * force.max() * rng.normal(size=200)
        found = fit_contact(depth + 5e-6 * rng.normal(size=200), noisy, layer.force)
        assert found.independent is None and found.standard_errors[0] < 0.03 * E


def test_adhesion_is_named(tmp_path, capsys):
    """A tensile force of 5 % of the largest force after contact increased the noise estimate that it was
    compared with.
    """
    depth = np.linspace(0.0, 7e-4, 200)
    force = hertz(depth - START)
    force += force.max() * np.where(depth > START, -0.05, 0.0)
    force += 0.003 * force.max() * np.random.default_rng(0).normal(size=200)
    np.savetxt(tmp_path / "c.csv", np.column_stack([depth, force]), "%.9g", ",", header="depth_m,force_N", comments="")
    command = ["indentation", str(tmp_path / "c.csv"), "--radius", str(R), "--thickness", "1", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "this is probably adhesion" in capsys.readouterr().err


@pytest.mark.draws
def test_the_command_reads_units_and_leaves_the_unloading_out(tmp_path, capsys):
    back = DEPTH[-2::-1]
    depth = np.concatenate([DEPTH, back])
    force = np.concatenate([hertz(DEPTH - START), 0.8 * hertz(back - START)])
    force = force + 1e-6 * np.random.default_rng(1).normal(size=len(force))
    rows = "\n".join(f"{1e6 * d:.9g},{1e3 * f:.9g}" for d, f in zip(depth, force, strict=True))
    (tmp_path / "c.csv").write_text(f"# a sphere\nIndentation (µm),Load [mN]\n{rows}\n")
    command = ["indentation", str(tmp_path / "c.csv"), "--radius", str(R), "--thickness", "10", "--out", str(tmp_path)]
    assert main(command) == 0
    content = json.loads((tmp_path / "fit.json").read_text())
    assert np.isclose(content["young_modulus"], E, rtol=0.01) and np.isclose(content["shear_modulus"], E / 3, rtol=0.01)
    assert np.isclose(content["contact_point"], START, atol=2e-6) and not content["warnings"]
    assert (tmp_path / "fit.png").stat().st_size > 1000
    told = capsys.readouterr()
    assert "79 points after the deepest one are ignored" in told.err and "half-space" in told.out


@pytest.mark.parametrize(
    ("text", "more", "words"),
    [
        ("a,b\n1,2\n", [], "no header names depth and force"),
        ("depth,force\n1,2\n", [], "no header names depth and force"),
        ("Depth (mm),Load (gf)\n1,2\n", [], "unit 'gf' of 'Load (gf)' is not known; use N, mN, uN, nN, pN"),
        ("depth_mil;force_N\n1;2\n", [], "unit 'mil' of 'depth_mil' is not known; use m, mm, um, nm"),
        ("depth_m,force_N\n0,0\n1e-4,x\n", [], "line 3: 'x' is not a finite number"),
        ("depth_m,force_N\n0,0\n1e-4,1\n", [], "the loading has 2 points"),
        ("depth_m,force_N\n" + "".join(f"-{k}e-5,-{k}e-3\n" for k in range(8)), [], "so change its sign"),
        (
            "depth_m,force_N\n" + "".join(f"{k}e-5,-{k**2}e-3\n" for k in range(30)),
            [],
            "the force falls while the depth grows, so change its sign",
        ),
        (
            "depth_m,force_N\n" + "".join(f"{k}e-5,{k**2}e-3\n" for k in range(30, 0, -1)),
            [],
            "depth and force fall from row to row, so reverse the order of the rows",
        ),
        ("depth_m,force_N\n", [], "there are no numbers below the header in line 1"),
        ("depth_m,force_N\n" + "".join(f"{k}e-5,0\n" for k in range(8)), [], "the force is the same in all rows"),
        ("depth_m,force_N\n" + "".join(f"{k}e-5,{k}e200\n" for k in range(8)), [], "beyond any measurement"),
        ("depth_m,force_N\n0," + 200000 * "1" + "\n", [], "line 2 has more than"),
        ("depth_m,force_N\n0,0\n", ["--thickness", "-1"], "must be above 0"),
        ("depth_m,force_N\n0,0\n", ["--poisson", "0.7"], "must be from 0 to 0.5"),
        ("depth_m,force_N\n0,0\n", ["--radius", "0"], "must be above 0"),
    ],
)
def test_bad_curves_and_options_are_one_sentence(tmp_path, capsys, text, more, words):
    (tmp_path / "c.csv").write_text(text)
    command = ["indentation", str(tmp_path / "c.csv"), "--radius", "0.005", "--thickness", "0.01", *more]
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert words in told and len(told.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "header",
    [
        "Displacement (um),Indentation (um),Force (mN)",
        "Displacement (um),Indentation depth [um],Load / mN",
        "Displacement rate um,Eindringtiefe (um),Kraft (mN)",
        "Time (s),Indentation,Force\ns,um,mN",
        "Displacement rate um,Depth (um),Load cell (mN)",
    ],
)
def test_the_right_column_of_several_is_read(tmp_path, header):
    rows = np.column_stack([1.5e6 * DEPTH, 1e6 * DEPTH, 1e3 * hertz(DEPTH - START)])
    lines = [",".join(f"{v:.9g}" for v in row) for row in rows]
    lines[5:5] = [",,"]
    (tmp_path / "c.csv").write_text("\n".join([header, *lines, ""]))
    curve = read_indentation(tmp_path / "c.csv")
    assert np.allclose(curve.depth, DEPTH) and np.allclose(curve.force, hertz(DEPTH - START))
    told = any("not from 'Displacement (um)'" in note for note in curve.notes)
    assert told == header.startswith("Displacement (um)")


@pytest.mark.parametrize("points", [20, 200])
def test_an_unloading_is_no_second_loading(tmp_path, points):
    depth = np.concatenate([np.linspace(0, 1, points), np.linspace(1, 0, points)[1:]])
    text = "depth_mm,force_mN\n" + "".join(f"{d:.9g},{d**1.5:.9g}\n" for d in depth)
    (tmp_path / "c.csv").write_text(text)
    curve = read_indentation(tmp_path / "c.csv")
    assert not any("several loadings" in note for note in curve.notes) and len(curve.depth) <= points


def test_no_such_file():
    with pytest.raises(InputError, match="does not exist"):
        read_indentation("nothing.csv")


def held_at_the_end(kind):
    """Return a loading followed by what instruments do: hold the depth (the force relaxes), hold the force (the depth
    creeps), or cycle.
    """
    rng, late = np.random.default_rng(2), np.linspace(0, 1, 160)
    if kind == "cycles":
        depth = np.concatenate([DEPTH, DEPTH[-2::-1], 1.01 * DEPTH[1:]])
        return depth, hertz(depth - START) * np.where(np.arange(len(depth)) < len(DEPTH), 1.0, 0.8)
    if kind == "depth":
        depth = np.concatenate([DEPTH, DEPTH[-1] + 1e-6 * rng.standard_normal(160)])
        return depth, np.concatenate([hertz(DEPTH - START), hertz(DEPTH[-1] - START) * (0.6 + 0.4 * np.exp(-5 * late))])
    depth = np.concatenate([DEPTH, DEPTH[-1] * (1 + 0.3 * (1 - np.exp(-4 * late)))])
    return depth, np.concatenate([hertz(DEPTH - START), np.full(160, hertz(DEPTH[-1] - START))])


@pytest.mark.parametrize("kind", ["depth", "force", "cycles"])
def test_only_the_first_loading_is_fitted(tmp_path, kind):
    depth, force = held_at_the_end(kind)
    force = force + 2e-6 * np.random.default_rng(1).standard_normal(len(force))
    np.savetxt(tmp_path / "c.csv", np.column_stack([depth, force]), "%.9g", ",", header="depth_m,force_N", comments="")
    curve = read_indentation(tmp_path / "c.csv")
    assert abs(len(curve.depth) - len(DEPTH)) <= 2 and curve.notes
    assert ("several loadings" in curve.notes[0]) == (kind == "cycles")
    found = fit_contact(curve.depth, curve.force, Layer(Indenter("sphere", 1e3 * H, 0.5, R)).force)
    assert np.isclose(found.modulus, E, rtol=0.01) and np.isclose(found.contact_point, START, atol=3e-6)


def test_an_offset_of_the_sensor_is_taken_off_and_decimals_follow_the_table(tmp_path, capsys):
    force = hertz(DEPTH - START) + 1e-6 * np.random.default_rng(1).standard_normal(len(DEPTH))
    command = ["indentation", str(tmp_path / "c.csv"), "--radius", str(R), "--thickness", "10", "--out", str(tmp_path)]
    for offset in (0.0, 0.08 * force.max()):
        rows = "".join(f"{1e9 * d:,.0f};{1e3 * (f + offset):.6f}\n" for d, f in zip(DEPTH, force, strict=True))
        text = "depth_nm;force_mN\n" + rows.replace(".", "x").replace(",", ".").replace("x", ",")  # 1.000,5
        (tmp_path / "c.csv").write_text(text)
        assert main(command) == 0
        assert ("this offset of the sensor is subtracted" in capsys.readouterr().err) == bool(offset)
        content = json.loads((tmp_path / "fit.json").read_text())
        assert np.isclose(content["young_modulus"], E, rtol=0.01) and not content["warnings"]
        assert np.isclose(content["contact_point"], START, atol=3e-6)
        # The remaining offset is fitted. Its error is the noise of a point, 1e-6 N, over the root of some 20 points.
        assert abs(content["force_offset_N"]) < 1e-6 and 1e-7 < content["force_offset_standard_error_N"] < 5e-7
    # A curve that begins in contact has no measurable offset.
    np.savetxt(
        tmp_path / "c.csv", np.column_stack([DEPTH, force])[40:], "%.9g", ",", header="depth_m,force_N", comments=""
    )
    assert np.allclose(read_indentation(tmp_path / "c.csv").force, force[40:], rtol=1e-7)


@pytest.mark.ci
@pytest.mark.parametrize("offset", [0.05, *(pytest.param(v, marks=pytest.mark.slow) for v in (0.3, 0.0, -0.05))])
def test_the_zero_of_the_force_is_fitted_with_its_error(offset):
    """An offset of 5 % of the largest force changed the modulus by 11 %, and by 3 to 17 standard errors with 5 % of
    noise.
    """
    force, layer = hertz(DEPTH - START), Layer(Indenter("sphere", 1e3 * H, 0.5, R))
    rng, hits = np.random.default_rng(0), []
    for _ in range(40):
        noisy = force + force.max() * (offset + 0.05 * rng.normal(size=len(force)))
        found = fit_with_offset(DEPTH, noisy, layer.force)
        true = (E, START, offset * force.max())
        errors = (*found.standard_errors, found.offset_error)
        values = (found.modulus, found.contact_point, found.offset)
        hits.append([abs(v - t) < found.quantile * e for v, t, e in zip(values, true, errors, strict=True)])
    assert np.all(np.mean(hits, axis=0) >= 0.88), np.mean(hits, axis=0)  # 95 % of 40: 35 or more in 97 % of cases


@pytest.mark.ci
def test_a_large_offset_is_fitted_whatever_the_noise_before_contact():
    """By chance, the noise before contact rises by more than two standard errors in one of twenty curves. The offset
    then became a contact force, and the modulus was half of the true one."""
    layer, depth = Layer(Indenter("sphere", 1.0, 0.5, R)), np.linspace(-5e-4, 1e-3, 200)
    force = E * layer.force(depth)
    for seed in range(40):
        noise = 0.01 * np.random.default_rng(seed).standard_normal(200)
        found = fit_with_offset(depth, force + force.max() * (0.3 + noise), layer.force)
        assert abs(found.modulus - E) < 0.1 * E


def test_a_negative_offset_that_is_fitted_is_no_adhesion(tmp_path, capsys):
    force = hertz(DEPTH - START) * (1 + 0.003 * np.random.default_rng(0).normal(size=80))
    rng = np.random.default_rng(1)
    rows = np.column_stack([DEPTH, force - 0.3 * force.max() + 0.02 * force.max() * rng.normal(size=80)])
    np.savetxt(tmp_path / "c.csv", rows, "%.9g", ",", header="depth_m,force_N", comments="")
    command = ["indentation", str(tmp_path / "c.csv"), "--radius", str(R), "--thickness", "10", "--out", str(tmp_path)]
    assert main(command) == 0
    assert json.loads((tmp_path / "fit.json").read_text())["force_offset_N"] < -0.2 * force.max()
    assert "adhesion" not in capsys.readouterr().err


def written(tmp_path, depth: np.ndarray, force: np.ndarray) -> dict:
    """Fit a curve of a sphere of 2 mm on a layer of 5 mm with the command, and return the content of fit.json."""
    rows = np.column_stack([depth, force])
    np.savetxt(tmp_path / "c.csv", rows, "%.9g", ",", header="depth_m,force_N", comments="")
    command = ["indentation", str(tmp_path / "c.csv"), "--radius", "0.002", "--thickness", "0.005"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    return json.loads((tmp_path / "fit.json").read_text())


def test_a_contact_point_far_before_the_first_depth_is_found_and_told(tmp_path):
    """The search ended half a range of depths before the first depth, without a message: E was 3.9 times too large."""
    layer, depth = Layer(Indenter("sphere", 5e-3, 0.5, 2e-3)), np.linspace(0, 3e-4, 60)
    noise = 0.003 * np.random.default_rng(0).standard_normal(60)
    force = 1000 * layer.force(depth + 6e-4)
    content = written(tmp_path, depth, force + force.max() * noise)
    assert content["contact_point"] == pytest.approx(-6e-4, rel=0.03)
    assert content["young_modulus"] == pytest.approx(1000, rel=0.03)
    assert any("m before the first depth, outside the measured curve" in w for w in content["warnings"])


def test_the_modulus_of_a_half_space_is_that_of_a_fit(tmp_path):
    """The contact point of the layer was used, so the modulus was that of no fit: 1404 Pa."""
    rig, depth = Indenter("sphere", 5e-3, 0.5, 2e-3), np.linspace(-3e-4, 1e-3, 130)
    force = 1000 * Layer(rig).force(depth)
    content = written(tmp_path, depth, force)
    alone = fit_with_offset(depth, force, lambda d: half_space(rig, d))
    assert content["half_space_young_modulus"] == pytest.approx(alone.modulus, rel=1e-4) and alone.modulus > 1500


@pytest.mark.ci
@pytest.mark.parametrize("seed", [0, 1])
def test_a_reading_of_one_step_below_zero_is_no_adhesion(tmp_path, seed):
    """The estimate of the noise is 0 if most forces are rounded to the same value."""
    depth = np.linspace(-7e-4, 3e-4, 400)
    force = 1000 * Layer(Indenter("sphere", 5e-3, 0.5, 2e-3)).force(depth)
    step = force.max() / 1000
    noise = 0.3 * np.random.default_rng(seed).standard_normal(400)
    content = written(tmp_path, depth, step * np.round(force / step + noise))
    assert not any("adhesion" in w for w in content["warnings"])
    assert any("adhesion" in w for w in written(tmp_path, depth, force - 20 * step * (depth > 0))["warnings"])


def test_without_an_approach_the_zero_is_taken_as_it_is():
    layer = Layer(Indenter("sphere", 1e3 * H, 0.5, R))
    depth = np.linspace(2e-5, 5e-4, 60)
    for seed in range(5):
        force = hertz(depth) * (1 + 0.01 * np.random.default_rng(seed).normal(size=60))
        assert fit_with_offset(depth, force, layer.force).offset_error == 0


@pytest.mark.parametrize("tilt", [0.0, 0.1, -0.1])
def test_a_base_line_that_tilts_is_told_and_taken_off(tmp_path, capsys, tilt):
    """Drift of a sensor shifts the contact point by 13 errors of independent noise. The errors of the plain fit include
    the structure of its residuals.
    """
    depth = np.linspace(-4e-4, 7e-4, 120)
    force = hertz(depth - START)
    force += 0.005 * force.max() * np.random.default_rng(3).standard_normal(len(depth))
    force += tilt * force.max() * np.linspace(0, 1, len(depth))
    np.savetxt(tmp_path / "c.csv", np.column_stack([depth, force]), "%.9g", ",", header="depth_m,force_N", comments="")
    command = ["indentation", str(tmp_path / "c.csv"), "--radius", str(R), "--thickness", "1", "--out", str(tmp_path)]
    assert main(command) == 0
    content, said = json.loads((tmp_path / "fit.json").read_text()), capsys.readouterr().err
    assert ("The sensor drifts" in said) == bool(tilt) == (content["without_tilt"] is not None)
    found = content["without_tilt"] or content
    for name, true in (("young_modulus", E), ("contact_point", START)):
        assert abs(found[name] - true) < 4 * found["standard_errors"][name]
    if tilt:
        off = abs(content["contact_point"] - START)
        assert 0.5 < off / content["standard_errors"]["contact_point"] < 4
        assert off > 8 * found["standard_errors"]["contact_point"]


def test_a_radius_in_millimetres_is_refused(tmp_path, capsys):
    (tmp_path / "c.csv").write_text("depth_um,force_mN\n0,0\n1,1\n")
    assert main(["indentation", str(tmp_path / "c.csv"), "--radius", "5", "--thickness", "0.01"]) == 2
    assert "--radius 5 must be in metres, and at most 0.2: give e.g. --radius 0.005" in capsys.readouterr().err
    depth = np.linspace(0, 1e-3, 12)
    np.savetxt(tmp_path / "c.csv", np.c_[depth, depth**2], delimiter=",", header="depth_m,force_N", comments="")
    of_cone = ["--shape", "cone", "--radius", "5", "--thickness", "0.01", "--out", str(tmp_path)]
    main(["indentation", str(tmp_path / "c.csv"), *of_cone])
    told = capsys.readouterr().err
    assert "and has no effect for a cone" in told and "in metres" not in told


def test_a_wrong_shape_is_told_behind_a_long_approach(tmp_path, capsys):
    """The noise of the approach hid the misfit. A punch fitted to data of a sphere had a third of the modulus, without
    a warning.
    """
    depth = np.linspace(-1e-3, 1e-3, 101)
    force = hertz(np.maximum(depth, 0.0))
    force = force + 0.003 * force.max() * np.random.default_rng(3).normal(size=len(force))
    np.savetxt(
        tmp_path / "c.csv", np.column_stack([depth, force]), delimiter=",", header="depth_m,force_N", comments=""
    )
    command = ["indentation", str(tmp_path / "c.csv"), "--radius", str(R), "--thickness", "10", "--out", str(tmp_path)]
    assert main(command) == 0 and "misfit" not in capsys.readouterr().err
    assert main([*command, "--shape", "punch"]) == 0
    assert "structured misfit: residuals in contact change sign" in capsys.readouterr().err
    assert main([*command, "--shape", "cone"]) == 0
    told = capsys.readouterr().err
    assert "a half-angle of 45 degrees is assumed" in told and "--radius is for a sphere or a punch" in told


def test_depths_near_the_end_of_the_table_are_fitted(tmp_path, capsys):
    """The search tried earlier contact points, for which the table has no forces, and refused the curve."""
    layer, file = Layer(Indenter("sphere", 2e-4, 0.5, 0.01)), tmp_path / "layer.csv"
    ask = ["indentation", str(file), "--shape", "sphere", "--radius", "0.01", "--thickness", "0.0002"]
    ask += ["--out", str(tmp_path / "out")]
    for part, code in ((0.95, 0), (1.3, 2)):
        depth = np.linspace(-1e-5, part * layer.deepest, 60)
        force = E * layer.force(np.minimum(depth, layer.deepest)) * np.maximum(1, depth / layer.deepest) ** 3
        rows = "\n".join(f"{d:.9g},{f:.9g}" for d, f in zip(depth, force, strict=True))
        file.write_text(f"depth_m,force_N\n{rows}\n")
        assert main(ask) == code
    assert json.loads((tmp_path / "out" / "fit.json").read_text())["young_modulus"] == pytest.approx(E, rel=1e-6)
    assert "m or more after contact, but for this layer and indenter only depths up to" in capsys.readouterr().err
    ask[ask.index("0.0002")] = "1e-9"  # all depths are beyond the table of so thin a layer
    assert main(ask) == 2 and "m or more after contact" in capsys.readouterr().err


def test_an_approach_as_long_as_the_layer_is_thick_is_fitted():
    """The search also tries contact points before the first reading. Only there are depths larger than the
    thickness.
    """
    depth = np.linspace(-8e-3, 1e-3, 181)
    for rig in (Indenter("sphere", H, 0.5, R), Indenter("punch", H, 0.5, R / 5), Indenter("cone", H, 0.5)):
        layer = Layer(rig)
        found = fit_contact(depth, E * layer.force(depth), layer.force)
        assert np.isclose(found.modulus, E, rtol=1e-4) and abs(found.contact_point) < 1e-7


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.2])
def test_only_a_real_hold_at_the_end_is_left_out(noise):
    """With 20 % of noise, points long before the end came near the largest force. Then the last points determined E."""
    rng, depth = np.random.default_rng(38), np.linspace(-2e-4, 6e-4, 200)
    force = 0.03 * (np.maximum(depth, 0) / 6e-4) ** 1.5
    shaken = force + noise * 0.03 * rng.standard_normal(200)
    assert _end_of_loading(depth, shaken) == (200, [])
    held = np.append(depth, np.full(60, 6e-4))
    relaxing = np.append(force, 0.03 * (1 - 0.3 * (1 - np.exp(-np.arange(60) / 20))))
    last, _ = _end_of_loading(held, relaxing + noise * 0.03 * rng.standard_normal(260))
    assert abs(last - 200) <= 2
    # The force is constant, and the depth creeps.
    creeping, constant = np.append(depth, 6e-4 + 2e-6 * np.arange(60)), np.append(force, np.full(60, 0.03))
    last, told = _end_of_loading(creeping, constant + noise * 0.03 * rng.standard_normal(260))
    assert (noise > 0.1 and not told) or 190 <= last <= 205


@pytest.mark.parametrize("second", [["[step]", "notes", "see page 12"], ["[step]", "Sheet2", ""]])
def test_other_sheets_of_a_workbook_are_not_read_as_rows(second, tmp_path):
    """A workbook is read as such a text. The second sheet made the file unreadable, even if it was empty."""
    rows = [f"{d}\t{f}" for d, f in zip(DEPTH, hertz(DEPTH), strict=True)]
    (tmp_path / "one.txt").write_text("\n".join(["[step]", "curve", "depth_m\tforce_N", *rows, ""]))
    (tmp_path / "two.txt").write_text("\n".join(["[step]", "curve", "depth_m\tforce_N", *rows, "", *second]))
    one, two = read_indentation(tmp_path / "one.txt"), read_indentation(tmp_path / "two.txt")
    assert np.array_equal(one.force, two.force)
    told = ("only the first table is read, not the sheets or steps below it: 'notes'",) if second[-1] else ()
    assert two.notes == (*told, *one.notes)
