"""Tests described by a TOML file: simulated samples, other integrals, cycles; invalid input; the commands."""

import json
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from fitting.__main__ import main
from fitting.commands.together import errors_of_sizes
from fitting.fits import time_tests as fits
from fitting.methods.generalised_maxwell import Maxwell, moduli
from fitting.readers.time_tests import Sample, TimeTest, read_time_test
from fitting.rigs import compression, described, glued, thin_layer
from fitting.rigs.described import curve_of, read_described

pytestmark = pytest.mark.quick_to_compile

TRUTH = Maxwell(np.float64(800.0), np.array([0.3, 0.4]), np.array([20.0, 1.0]))
PRONY = lj.Prony(ratios=TRUTH.ratios, relaxation_times=TRUTH.relaxation_times, part="isochoric")


def shear(time):
    g, tau = TRUTH.ratios, TRUTH.relaxation_times
    return TRUTH.shear_modulus * (1 - (g * (1 - np.exp(-np.asarray(time)[..., None] / tau))).sum(axis=-1))


def written(folder, table, columns, name="test"):
    rows = "\n".join(",".join(f"{v:.10g}" for v in row) for row in zip(*columns, strict=True))
    (folder / f"{name}.csv").write_text(f"time_s,displacement_m,force_N\n{rows}\n")
    lines = [f"{key} = {value!r}" for key, value in ({"data": f"{name}.csv"} | table).items()]
    (folder / f"{name}.toml").write_text("\n".join(lines) + "\n")
    return folder / f"{name}.toml"


SLOW = pytest.mark.slow


@SLOW
@pytest.mark.parametrize("test", ["tension", "compression", "glued_punch"])
def test_a_simulated_sample_gives_its_numbers_back(tmp_path, test, verified):
    """The sample is simulated over time on another mesh, with a ramp and a constant displacement."""
    r, h, punch, dt = 0.01, 0.008, 0.004, 0.25
    time = dt * np.arange(1, 81)
    d = 2e-5 * np.minimum(time / 1.0, 1.0)
    cells = glued.Cells(rim=0.03, edge=0.015, corners=32)
    if test == "glued_punch":
        rig, sizes = glued.indentation(r, h, punch, dt, d, cells), {"radius": r, "height": h, "punch": punch}
    else:
        rig = glued.tension(r, h, dt, (1 if test == "tension" else -1) * d / h, cells)
        sizes = {"radius": r, "height": h}
    force, codes = glued.read(rig, lj.laws.NeoHookean(mu=800.0, bulk=8e5), PRONY)
    assert not np.any(np.asarray(codes))
    file = written(tmp_path, {"test": test} | sizes, (time, d, np.abs(np.asarray(force))))
    found = fits.fit(read_described(file), 2).model
    error = abs(float(found.shear_modulus) / 800 - 1)
    verified(f"{test} described by a file, against a simulation of another mesh: G0", "run in time", error, 0.01)
    assert error < 0.01
    np.testing.assert_allclose(found.relaxation_times, TRUTH.relaxation_times, rtol=0.03)
    np.testing.assert_allclose(found.ratios, TRUTH.ratios, rtol=0.02)


@pytest.mark.parametrize("shape", ["sphere", "cone", "punch"])
def test_an_indenter_pressed_at_constant_speed(tmp_path, shape):
    """The force is the integral of G(t - s) df/ds, here computed by quadrature."""
    sizes = {"half_angle": 70.0} if shape == "cone" else {"radius": 2e-3}
    rig = thin_layer.Indenter(shape=shape, thickness=8e-3, poisson=0.5, **sizes)
    layer, speed = thin_layer.Layer(rig), 1e-5

    def elastic(d):
        return 3 * float(layer.force(np.array([d]))[0])

    time = np.linspace(0.25, 30, 120)
    grid = np.linspace(0, 30, 6001)
    f = np.array([elastic(speed * s) for s in grid])
    force = []
    for t in time:
        middle = 0.5 * (grid[1:] + grid[:-1])
        past = middle < t
        force.append(np.sum((shear(t - middle) * np.diff(f))[past]))
    file = written(tmp_path, {"test": shape, "thickness": 8e-3} | sizes, (time, speed * time, force))
    test = read_described(file)
    assert test.kind == "relaxation" and test.time[0] == 0 and test.driven[0] == 0
    rows = np.flatnonzero(test.used)
    answer = fits.response_in_time("relaxation", TRUTH, jnp.asarray(test.time), jnp.asarray(test.driven), rows)
    np.testing.assert_allclose(answer, test.answer[rows], rtol=2e-3, atol=2e-4 * np.nanmax(test.answer))
    assert len(rows) == len(time)


def test_an_indenter_under_a_held_force_creeps(tmp_path):
    """In creep, the strain f(d)/S is the force over S times the compliance. Here it has one mode, in closed form."""
    layer = thin_layer.Layer(thin_layer.Indenter(shape="sphere", thickness=8e-3, poisson=0.5, radius=2e-3))
    depths = np.linspace(0, 1e-3, 4001)
    table, time, held = 3 * layer.force(depths), np.geomspace(0.1, 60, 40), 1e-3
    # G = 800 (0.4 + 0.6 exp(-t/2)): J = (1 - 0.6 exp(-0.4 t/2)) / 320.
    d = np.interp(held * (1 - 0.6 * np.exp(-0.2 * time)) / 320, table, depths)
    sizes = {"test": "sphere", "thickness": 8e-3, "radius": 2e-3, "drive": "force"}
    test = read_described(written(tmp_path, sizes, (np.append(0.0, time), np.append(0.0, d), np.full(41, held))))
    assert test.kind == "creep" and np.all(np.isfinite(test.driven))
    found = fits.fit(test, 1).model
    assert float(found.shear_modulus) == pytest.approx(800, rel=0.02)
    np.testing.assert_allclose([found.ratios[0], found.relaxation_times[0]], [0.6, 2.0], rtol=0.02)


@pytest.mark.slow
def test_a_glued_sample_s_stiffness_is_that_of_another_program(tmp_path):
    """Tension of a sample with R = H = 10 mm, mu 800, K 16000, by 1 um: 1.07390e-4 N (axisymmetric, 64 x 64 graded,
    DOLFINx).
    """
    time, poisson = np.arange(1.0, 7.0), (3 * 20 - 2) / (2 * (3 * 20 + 1))
    table = {"test": "tension", "radius": 0.01, "height": 0.01, "poisson": poisson}
    test = read_described(written(tmp_path, table, (time, 0 * time + 1e-6, 0 * time + 1.07390e-4)))
    np.testing.assert_allclose(test.answer[test.used] / test.driven[test.used], 800, rtol=0.005)


@SLOW
def test_a_negative_displacement_in_tension_is_told(tmp_path):
    time = np.arange(1.0, 7.0)
    table = {"test": "tension", "radius": 0.01, "height": 0.01}
    up, down = (
        read_described(written(tmp_path, table, (time, sign * 1e-6 + 0 * time, sign * 1e-4 * (1 + 1 / time))))
        for sign in (1, -1)
    )
    assert "write test = 'compression'" in " ".join(down.notes) and "compression" not in " ".join(up.notes)
    np.testing.assert_allclose(down.answer[down.used], up.answer[up.used])


@pytest.mark.parametrize("drive", ["displacement", "force"])
def test_a_load_that_was_there_at_once(tmp_path, drive):
    """Without a row at 0 s, a constant load is read as a ramp, with a note. With ramp = 0 it is read as a step."""
    layer = thin_layer.Layer(thin_layer.Indenter(shape="sphere", thickness=8e-3, poisson=0.5, radius=2e-3))
    time, force = np.geomspace(0.1, 60, 40), 3 * 800 * float(layer.force(np.array([5e-4]))[0])
    held = (time, 0 * time + 5e-4, force * (0.4 + 0.6 * np.exp(-time / 2)))
    if drive == "force":
        depths = np.linspace(0, 1e-3, 4001)
        deep = np.interp(1e-3 * (1 - 0.6 * np.exp(-0.2 * time)) / 320, 3 * layer.force(depths), depths)
        held = (time, deep, 0 * time + 1e-3)
    table = {"test": "sphere", "thickness": 8e-3, "radius": 2e-3, "drive": drive}
    ramp = read_described(written(tmp_path, table, held))
    step = read_described(written(tmp_path, table | {"ramp": 0}, held))
    assert ramp.driven[0] == 0 and any("under load" in n for n in ramp.notes)
    assert step.driven[0] > 0 and not any("under load" in n for n in step.notes)
    found = fits.fit(step, 1).model
    assert float(found.shear_modulus) == pytest.approx(800, rel=0.001)
    assert abs(float(fits.fit(ramp, 1).model.shear_modulus) / 800 - 1) > 0.01


@pytest.mark.parametrize(("shape", "back"), [("sphere", True), ("cone", True), ("punch", False)])
def test_rows_of_a_contact_that_shrinks_are_left_out(tmp_path, shape, back):
    """When the formula of a growing contact was used for a retracted sphere, G0 was 350 times too large."""
    sizes = {"thickness": 0.02} | ({"half_angle": 60.0} if shape == "cone" else {"radius": 0.005})
    time = np.arange(1, 61) / 10
    d = 1e-3 * np.minimum(time, 1.0) + 2e-6 * np.random.default_rng(0).normal(size=60)
    d[30] += 5e-5  # one reading is not a reversal
    d[45:] -= 1.5e-5 * np.arange(15)
    file = written(tmp_path, {"test": shape} | sizes, (time, d, np.maximum(d, 0) * 100 * (1 + np.exp(-time))))
    test = read_described(file)
    said = [note for note in test.notes if "shrinks" in note]
    assert bool(said) == back
    if back:
        backwards = written(tmp_path, {"test": shape} | sizes, (time, np.r_[1e-3, 1e-3 - 1e-5 * np.arange(59)], d))
        with pytest.raises(lj.InputError, match="goes back from"):
            read_described(backwards)
        # 2 % of the depth is not yet a reversal.
        assert said[0].startswith("13 rows from 4.8 s on are ignored")
        assert test.time[-1] == pytest.approx(4.7)


@pytest.mark.parametrize("shape", ["sphere", "punch"])
def test_an_approach_that_is_longer_than_the_indentation_is_left_out(tmp_path, shape):
    """The approach was taken as the load. So the sphere was refused, and the modulus of the punch was 1 Pa. After a
    short approach, a note told that the first row was under load."""
    layer = thin_layer.Layer(thin_layer.Indenter(shape, 2e-3, 0.5, 1e-3))
    time, rng = np.arange(0, 60, 0.2), np.random.default_rng(1)
    for approach in (1e-3, 1.5e-4):
        d = np.interp(time, [0, 10, 12, 60], [-approach, 0, 2e-4, 2e-4])
        elastic = 800 * 3 * layer.force(np.maximum(d, 0))
        force = elastic + 0.002 * elastic.max() * rng.standard_normal(len(time))
        for sign in (1, -1):
            columns = (time, sign * d, sign * force)
            test = read_described(written(tmp_path, {"test": shape, "thickness": 2e-3, "radius": 1e-3}, columns))
            assert test.begun == pytest.approx(10.0) and not any("under load already" in n for n in test.notes)
            held = test.used & (test.time > 13)
            assert np.mean(test.answer[held] / test.driven[held]) == pytest.approx(800, rel=0.002)


@pytest.mark.parametrize("offset", [0.0, 2e-4])
def test_rows_after_a_punch_is_lifted_are_left_out(tmp_path, offset):
    """The force of a punch that no longer touched the sample was fitted, and G0 was four times too large."""
    time = np.arange(0, 40, 0.1)
    d = np.interp(time, [0, 1, 2, 31, 31.5, 40], [0, 0, 1e-4, 1e-4, 0, 0])
    force = 80 * d * (0.4 + 0.6 * np.exp(-time / 10))
    force[time > 31.15] = 0.0
    force += offset + 1e-5 * np.random.default_rng(0).standard_normal(len(time))
    table = {"test": "punch", "thickness": 2e-3, "radius": 1e-3}
    test = read_described(written(tmp_path, table, (time, d, force)))
    assert test.time[-1] == pytest.approx(31.1) and any("88 rows from 31.2 s on are ignored" in n for n in test.notes)


@pytest.mark.parametrize("shape", ["sphere", "punch"])
@pytest.mark.parametrize("sign", [1, -1])
def test_an_offset_above_the_force_does_not_hide_the_direction_of_the_load(tmp_path, shape, sign):
    """The displacement before the contact was taken for the load, and the test was refused."""
    time, rng = 0.05 * np.arange(500), np.random.default_rng(0)
    d = np.where(time < 15, -2e-6, 3e-4) + 1e-7 * rng.standard_normal(500)
    force = 0.01 * (time >= 15) * (1 + np.exp((15 - time) / 2)) + 1e-5 * rng.standard_normal(500)
    table = {"test": shape, "thickness": 0.01, "radius": 0.002}
    driven = [
        read_described(written(tmp_path, table, (time, sign * d, sign * (force + offset)))).driven
        for offset in (0.0, 0.05, 0.02, -0.02, -0.05)
    ]
    assert all(np.array_equal(driven[0], other) for other in driven[1:]) and driven[0][-1] > 0.01
    # Without a row at rest, the force of the unloaded sample at the end is no offset.
    late = time >= 15
    back = np.where(time < 20, d, -1e-6)[late], np.where(time < 20, force, 0)[late]
    found = read_described(written(tmp_path, table, (time[late] - 14.95, sign * back[0], sign * back[1])))
    assert found.driven[found.used][0] > 0.01


@pytest.mark.parametrize("rows", [30, 50, 500])
def test_a_punch_that_goes_back_to_the_surface_in_cycles_keeps_its_contact(tmp_path, rows):
    """With 50 rows in a cycle, all cycles after the first were ignored."""
    time = np.arange(5 * rows) / rows
    d = 1.5e-4 * (1 - np.cos(2 * np.pi * time))
    table, rng = {"test": "punch", "thickness": 0.01, "radius": 0.002}, np.random.default_rng(0)
    for noise in (0.0, 1e-4):
        force = 70 * d + noise * rng.standard_normal(len(time))
        test = read_described(written(tmp_path, table, (time, d, force)))
        assert len(test.time) == len(time) and not any("ignored" in note for note in test.notes)
    # The punch is lifted between two rows.
    lifted = (time > 3.35) & (time < 3.7)
    test = read_described(written(tmp_path, table, (time, np.where(lifted, 0, d), np.where(lifted, 0, force))))
    assert len(test.time) == int(np.argmax(lifted))


@pytest.mark.parametrize(("rows", "noise"), [(301, 0.005), (1501, 0.01)])
@pytest.mark.parametrize("back", [0.0, 0.05])
def test_the_scatter_of_a_held_sphere_is_no_retraction(tmp_path, rows, noise, back):
    """1447 of 1501 rows were ignored. With 301 rows, the strain kept its scatter, because rows were added before."""
    time, rng = np.linspace(0, 30, rows), np.random.default_rng(0)
    d = 3e-4 * (np.minimum(time / 0.5, 1) - back * np.clip((time - 25) / 0.5, 0, 1))
    scattered = d + noise * 3e-4 * rng.standard_normal(rows) * (time > 0)
    columns = (time, scattered, np.maximum(d, 0) * 100 * (1 + np.exp(-time)))
    test = read_described(written(tmp_path, {"test": "sphere", "thickness": 5e-3, "radius": 3e-3}, columns))
    assert sum("the displacement scatters by" in note for note in test.notes) == 1
    assert not any("scatter" in note and "the displacement" not in note for note in test.notes)
    assert any("shrinks" in note for note in test.notes) == bool(back)
    assert 25 < test.time[-1] < 26 if back else test.time[-1] == 30
    assert np.ptp(test.driven[(test.time > 1) & (test.time < 25)]) < 1e-9 * test.driven.max()


def test_a_sphere_with_four_rows_has_too_few_responses(tmp_path):
    """The message was an IndexError."""
    held = np.arange(4.0), np.array([0.0, 1e-4, 1e-4, 1e-4]), np.array([0.0, 1, 0.9, 0.8])
    with pytest.raises(lj.InputError, match="3 usable responses remain"):
        read_described(written(tmp_path, {"test": "sphere", "thickness": 5e-3, "radius": 3e-3}, held))


@SLOW
def test_a_compression_by_a_fifth_is_computed(tmp_path):
    """At a compression of 15 %, the finest cells at the rims of this disc invert. The computation continues with
    coarser ones.
    """
    time = np.arange(1, 31) / 10
    d = 0.2 * 0.008 * np.minimum(time, 1.0)
    secants = []
    for part in (0.5, 1.0):
        file = written(
            tmp_path, {"test": "compression", "radius": 0.01, "height": 0.008}, (time, part * d, 300 * part * d)
        )
        test = read_described(file)
        secants.append(np.max(test.driven) / part)
    assert 1.02 < secants[1] / secants[0] < 1.2  # a glued disc stiffens in compression


def test_the_elastic_curve_is_followed_on_both_sides_of_rest():
    values = curve_of(lambda d: 2 * d + d**2, np.array([-0.1, 0.0, 0.5, 1.0]))
    np.testing.assert_allclose(values, [-0.19, 0.0, 1.25, 3.0], atol=1e-3)


@pytest.mark.parametrize("poisson", [0.4995, 0.4])
def test_a_slender_sample_is_stretched_uniformly_on_both_sides_of_rest(tmp_path, poisson):
    """Such a sample was refused. The tensile stress in its place gave 0.84 of the modulus at a strain of 20 %. The half
    of a cycle against the load was linear."""
    r, h = 0.002, 0.05
    time = np.arange(1, 41) / 4
    d = 0.2 * h * np.sin(np.pi * time / 5)
    stretch = 1 + d / h
    force = 1000 * np.pi * r**2 * (stretch - stretch**-2)
    file = written(tmp_path, {"test": "tension", "radius": r, "height": h, "poisson": poisson}, (time, d, force))
    test = read_described(file)
    assert any("25 radii, so its stretch is taken as uniform" in note for note in test.notes)
    far = np.abs(d) > 0.05 * h
    ratio = np.interp(time, test.time, test.answer)[far] / np.interp(time, test.time, test.driven)[far]
    # The glued ends make the sample stiffer by 1.3 %. A compressible sample is softer by (1 + poisson) / 1.5.
    np.testing.assert_allclose(ratio, 1000 * 1.5 / (1 + poisson), rtol=0.02 if poisson > 0.49 else 0.04)


@pytest.mark.parametrize("test", ["tension", "compression"])
def test_a_glued_sample_is_also_simulated_against_the_load(tmp_path, monkeypatch, test):
    """The half of a cycle against the load was linear, with forces that were wrong by up to 18 %. A closed form of the
    force takes the place of the simulation."""

    def force(strains):
        return 1e3 * (1 + strains - (1 + strains) ** -2)

    monkeypatch.setattr(described.glued, "tension", lambda radius, height, dt, strains, cells: strains)
    monkeypatch.setattr(described.glued, "read", lambda strains, law, prony: (force(strains), 0 * strains))
    monkeypatch.setattr(described.glued, "mesh_error", lambda strains, law, prony: 0 * strains)
    time = np.arange(1, 41) / 4
    d = 0.0015 * np.sin(np.pi * time / 5) * (1 - 1e-6 * time)  # the load is the first half of the cycle
    found = read_described(written(tmp_path, {"test": test, "radius": 0.01, "height": 0.01}, (time, d, 100 * d)))
    assert any("against the direction of the load: the stiffness" in note for note in found.notes)
    exact = force(d / 0.01 if test == "tension" else -d / 0.01)
    strain = np.interp(time, found.time, found.driven)
    np.testing.assert_allclose(strain / strain[9], exact / exact[9], atol=5e-3)


def test_a_simulation_against_the_load_that_fails_is_told(monkeypatch):
    """Such a test was refused, although the test in the direction of the load was computed."""

    def secants(test, end, path):
        if end < 0:
            raise lj.InputError("a.toml: the simulation of an elastic sample fails; give smaller displacements")
        return end * np.array([0.05, 1.0]), np.array([2.0, 3.0]), []

    monkeypatch.setattr(described, "_secants", secants)
    own = described.Described("tension", Path("a.csv"), {"radius": 0.01, "height": 0.01}, 0.4995, "force", 0.0, False)
    curve, _, notes = described._glued_curve(own, (1e-3, 5e-4), "a.toml")
    assert curve(1e-3) == pytest.approx(3e-3) and curve(-5e-4) == pytest.approx(-1e-3)
    assert any(note.endswith("linear there, because the simulation of an elastic sample fails") for note in notes)


def test_a_wide_glued_punch_has_an_error_of_its_size():
    """A punch wider than 8 heights was refused because of this approximate error."""
    of = []
    for punch in (0.0159, 0.0161, 0.019):
        sizes = {"radius": 0.02, "height": 0.002, "punch": punch}
        own = described.Described("glued_punch", Path("a.csv"), sizes, 0.4995, "displacement", 0.0, False)
        by_height, by_radius = described._change_per_size(own, 1e-4)
        of.append((by_height * 0.002, by_radius * punch))
    np.testing.assert_allclose(of[1:], [of[0], of[0]], rtol=0.02)
    assert 2 < of[0][0] < 3 < of[0][1] < 4


@pytest.mark.parametrize("poisson", [0.0, 0.1])
def test_a_slender_sample_of_low_poisson_s_ratio_is_compressed(poisson):
    """A compression by 40 % ended in a ValueError of SciPy."""
    law = described._neo_hookean(poisson)
    for strain in (0.1, 0.4, 0.5):
        a = compression.side_stretch(law, strain)
        assert abs(compression._cauchy(law, a, 1 - strain)[0]) < 1e-6
    with pytest.raises(lj.InputError, match=r"not found at a compression by 0[.]7: give a smaller"):
        compression.side_stretch(law, 0.7)


def test_cycles_between_plates_give_the_numbers_back(tmp_path):
    """A cylinder between slippery plates is compressed cyclically: G = E / 3, and the response passes through 0."""
    time = np.arange(0.05, 40, 0.05)
    r, h, fine = 0.01, 0.01, np.arange(0, 40.001, 0.005)
    d = 1e-4 * np.sin(np.pi * fine / 8) ** 2
    middle, steps = 0.5 * (fine[1:] + fine[:-1]), np.diff(d)
    force = np.array([np.sum((shear(t - middle) * steps)[middle < t]) for t in time]) * 3 * np.pi * r**2 / h
    force += 0.01 * force.max() * np.random.default_rng(0).standard_normal(len(force))
    rows = "\n".join(f"{a},{b},{c}" for a, b, c in zip(time, np.interp(time, fine, d), force, strict=True))
    (tmp_path / "cycles.csv").write_text(f"time_s,displacement_m,force_N\n{rows}\n")
    test = read_time_test(tmp_path / "cycles.csv", "relaxation", Sample(r, h))
    assert test.cyclic
    found = fits.fit(test, 2)
    assert float(found.model.shear_modulus) == pytest.approx(800, rel=0.02)
    # The slow decay of the cycles determines the longest time, with its error.
    errors = found.uncertainty.standard_errors
    exact = np.array([800, *TRUTH.ratios, *TRUTH.relaxation_times])
    assert np.all(np.abs(found.uncertainty.values - exact) < 4 * errors)


def test_a_step_that_is_taken_back_is_no_cycle():
    held = np.array([0.0, 1, 1, 1, 0, 0, 0])
    test = TimeTest("creep", np.arange(7.0), held, held, np.arange(7) > 0)
    assert not test.cyclic and test._replace(driven=np.array([0.0, 1, 0, 1, 0, 1, 0])).cyclic


@pytest.mark.ci
def test_the_commands_take_a_description(tmp_path):
    layer = thin_layer.Layer(thin_layer.Indenter(shape="sphere", thickness=8e-3, poisson=0.5, radius=2e-3))
    time = np.geomspace(0.1, 100, 40)
    force = 3 * layer.force(np.array([1e-4]))[0] * shear(time)
    ramp = np.concatenate([[1e-6], time]), np.concatenate([[1e-4], np.full(40, 1e-4)]), np.append(force[0], force)
    file = written(tmp_path, {"test": "sphere", "thickness": 8e-3, "radius": 2e-3}, ramp)
    assert main(["relaxation", str(file), "--out", str(tmp_path / "one")]) == 0
    found = (tmp_path / "one" / "fit.json").read_text()
    assert "contact is assumed to begin at displacement 0" in found
    omega = np.geomspace(0.05, 50, 20)
    G = moduli(TRUTH, omega)
    rows = "\n".join(f"{w},{a},{b}" for w, a, b in zip(omega, *G, strict=True))
    (tmp_path / "sweep.csv").write_text(f"angular_frequency_rad/s,storage_modulus_Pa,loss_modulus_Pa\n{rows}\n")
    out = tmp_path / "both"
    assert main([str(tmp_path / "sweep.csv"), "--with", str(file), "--modes", "2", "--out", str(out)]) == 0
    tests = json.loads((out / "fit.json").read_text())["tests"]
    assert [t["test"] for t in tests] == ["sweep", "relaxation"]
    assert main(["creep", str(file), "--out", str(tmp_path / "no")]) == 2
    assert main(["relaxation", str(file), "--radius", "0.01", "--out", str(tmp_path / "no")]) == 2


@pytest.mark.parametrize(
    "change, words",
    [
        ({"test": "bending"}, "test = 'bending' is not known"),
        ({"test": "sphere"}, "sphere has no key 'height'"),
        ({"height": None}, "tension needs height; give this key in metres"),
        ({"radius": "wide"}, "radius = 'wide' is not a number"),
        ({"radius": 10**400}, "is not a number; give a number"),
        ({"test": ["sphere"]}, r"test = \['sphere'\] is not known"),
        ({"drive": ["force"]}, r"drive = \['force'\] is not known; use displacement or force"),
        ({"radius": 10.0}, "radius = 10 cannot be the size of a sample"),
        (
            {"test": "glued_punch", "punch": 5e-4, "radius": 0.001, "height": 0.02},
            "height = 0.02 m is 20 radii, but samples under a punch are computed only up to 10",
        ),
        ({"radus": 0.01}, "did you mean radius"),
        ({"poisson": 0.5}, "must be from 0 to 0.4995"),
        ({"drive": "torque"}, "use displacement or force"),
        ({"height": 1e-4}, "more than half of the height"),
        ({"data": 3}, "must name a file"),
        ({"ramp": 0.5}, "ramp = 0.5 cannot be used; remove ramp"),
        ({"min_time": -3.0}, "min_time = -3 is negative; give a time of the data file"),
        ({"data": "none.csv"}, "none.csv"),
        ({"data": "shear.csv"}, "needs columns of time, displacement and force"),
        ({"data": "still.csv"}, "displacement is zero throughout"),
    ],
)
def test_descriptions_that_cannot_be_used_get_one_sentence(tmp_path, change, words):
    table = {"test": "tension", "radius": 0.01, "height": 0.01} | change
    (tmp_path / "shear.csv").write_text("time_s,strain,stress_Pa\n" + "\n".join(f"{k},1,{9 - k}" for k in range(1, 8)))
    still = "\n".join(f"{k},0,{9 - k}" for k in range(1, 8))
    (tmp_path / "still.csv").write_text(f"time_s,displacement_m,force_N\n{still}\n")
    time = np.arange(1.0, 9.0)
    file = written(tmp_path, {k: v for k, v in table.items() if v is not None}, (time, 0 * time + 1e-4, 1 / time))
    with pytest.raises(lj.InputError, match=words) as told:
        read_described(file)
    assert "\n" not in str(told.value)


def test_a_file_that_is_no_toml_gets_one_sentence(tmp_path):
    (tmp_path / "bad.toml").write_text("test = tension\n")
    with pytest.raises(lj.InputError, match="is not valid TOML"):
        read_described(tmp_path / "bad.toml")
    with pytest.raises(lj.InputError, match="cannot be read"):
        read_described(tmp_path / "none.toml")


def test_the_size_error_is_that_of_the_sizes_in_the_file(tmp_path):
    """The error was 1.3 %, that of a rheometer's sample. For a punch on a thick layer, the force is proportional to the
    radius, with no effect of the thickness."""
    time = np.geomspace(0.1, 60, 20)
    columns = (np.append(0.0, time), np.append(0.0, 0 * time + 1e-5), np.append(0.0, 1e-3 * (1 + np.exp(-time))))
    command = SimpleNamespace(radius=None, height=None)
    for sizes, expected in (
        ({"radius": 1e-3, "thickness": 0.9}, 10e-6 / 1e-3),
        ({"radius": 1e-3, "thickness": 2e-3}, np.hypot(0.338 * 0.05, 1.675 * 0.01)),
    ):
        test = read_described(written(tmp_path, {"test": "punch"} | sizes, columns))
        (found,) = errors_of_sizes(command, [test])
        assert found == pytest.approx(expected, rel=0.02)


def test_columns_of_strain_and_stress_do_not_hide_those_of_the_test(tmp_path):
    """A file of a testing machine was refused, because it also has columns of strain and stress."""
    time = np.arange(1.0, 13.0)
    force = 1e-3 * shear(time)
    file = written(tmp_path, {"test": "punch", "radius": 0.002, "thickness": 0.004}, (time, 1e-4 + 0 * time, force))
    expected = read_described(file)
    rows = "".join(f"{t},0.1,{1e3 * f:.10g},1,{f:.10g}\n" for t, f in zip(time, force, strict=True))
    head = "Time (s),Extension (mm),Load (mN),Tensile strain (%),Tensile stress (kPa)\n"
    (tmp_path / "test.csv").write_text(head + rows)
    found = read_described(file)
    np.testing.assert_allclose(found.answer, expected.answer, rtol=1e-8)
    assert not any("tensile" in note for note in found.notes)
