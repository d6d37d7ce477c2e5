"""The instrument's inertia from the raw torque: synthetic instruments, and measured files with known inertia."""

import re

import numpy as np
import pytest
from conftest import SHARED

from fitting.readers.frequency_sweep import Sweep
from fitting.readers.rheometer import read_sweep, without_inertia
from liverjax import InputError

RADIUS, HEIGHT, INERTIA = 0.005, 0.002, 25e-6
K = np.pi * RADIUS**4 / (2 * HEIGHT)
OMEGA = np.geomspace(1, 200, 20)
G = 5000 * (1j * OMEGA) ** 0.1


def export(path, inertia=INERTIA, sample=True, phase=True, theta=1e-3):
    """Write a synthetic export in the format of TRIOS. Its raw torque follows from the equation of motion of a
    plate.
    """
    M = (K * G - inertia * OMEGA**2) * theta
    columns = {
        ("Angular frequency", "rad/s"): OMEGA,
        ("Torque", "µN.m"): 0 * OMEGA - 80.0,  # another torque, of the whole step
        ("Raw phase", "°"): np.degrees(np.angle(M)),
        ("Oscillation torque", "µN.m"): 1e6 * np.abs(M),
        ("Oscillation displacement", "rad"): 0 * OMEGA + theta,
        ("Oscillation torque (sample)", "µN.m"): 1e6 * K * np.abs(G) * theta,
        ("Storage modulus", "Pa"): G.real,
        ("Loss modulus", "Pa"): G.imag,
    }
    left = [key for key in columns if (sample or "sample" not in key[0]) and (phase or "phase" not in key[0])]
    lines = ["[step]", "Frequency sweep - 1", "\t".join(k[0] for k in left), "\t".join(k[1] for k in left)]
    lines += ["\t".join(f"{v:.12g}" for v in row) for row in zip(*(columns[k] for k in left), strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return read_sweep(path)


@pytest.mark.parametrize("phase", [True, False])
@pytest.mark.parametrize("sample", [True, False])
def test_the_inertia_is_found_and_the_points_below_it_left_out(sample, phase, tmp_path):
    s = export(tmp_path / "e.txt", sample=sample, phase=phase)
    size = () if sample else (RADIUS, HEIGHT)
    kept = without_inertia(s, *size)
    found = float(re.search(r"inertia of ([\d.]+) uN", kept.notes[0])[1])
    assert found == pytest.approx(25.0, rel=1e-3)
    lost = np.abs(G) < 0.03 * INERTIA * OMEGA**2 / K
    assert 0 < lost.sum() < 10 and np.allclose(kept.angular_frequency, OMEGA[~lost])
    assert np.allclose(kept.grey[:, 0], OMEGA[lost]) and np.allclose(kept.grey[:, 1], G.real[lost])
    assert f"{lost.sum()} of 20 points" in kept.notes[1]
    # Points that were ignored before were lost.
    again = without_inertia(s._replace(grey=np.ones((1, 3))), *size)
    assert np.array_equal(again.grey, np.vstack([np.ones((1, 3)), kept.grey]))


@pytest.mark.parametrize("lines", [(4,), (6, 9, 22)])
def test_an_empty_cell_takes_one_point_away_and_not_the_column(lines, tmp_path):
    path = tmp_path / "gap.txt"
    export(path, sample=False)
    rows = path.read_text().splitlines()
    for place, line in enumerate(lines):  # the phase, the torque, the displacement
        cells = rows[line].split("\t")
        cells[2 + place] = ""
        rows[line] = "\t".join(cells)
    path.write_text("\n".join(rows) + "\n")
    whole, kept = (
        without_inertia(s, RADIUS, HEIGHT) for s in (export(tmp_path / "e.txt", sample=False), read_sweep(path))
    )
    assert f"{len(lines)} of 20 points have an empty cell in the raw columns" in kept.notes[0]
    assert "the raw torque shows" in kept.notes[0]  # not only the phase
    assert np.allclose(kept.inertia, whole.inertia, rtol=1e-6) and len(kept.grey) == len(whole.grey)


def test_a_displacement_of_zero_is_an_empty_cell(tmp_path):
    """A single 0 switched the search for the inertia off, without a message."""
    s = export(tmp_path / "z.txt", sample=False, phase=False)
    for name in ("angle", "torque"):
        column = s.raw[name].copy()
        column[3] = 0
        kept = without_inertia(s._replace(raw=s.raw | {name: column}), RADIUS, HEIGHT)
        assert "1 of 20 points have an empty cell in the raw columns, or a torque or displacement of 0" in kept.notes[0]
        assert np.allclose(kept.inertia, without_inertia(s, RADIUS, HEIGHT).inertia, rtol=1e-6)


@pytest.mark.parametrize("rows", [1, 2, 3, 5])
def test_raw_cells_in_a_few_rows_show_no_inertia_that_is_not_there(rows):
    """The inertia of one row agreed with itself. It was extrapolated to the end of the sweep, and points were lost."""
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal((3, len(OMEGA)))
    measured = G.real * noise[0] + 1j * G.imag * noise[1]
    M = np.where(np.arange(len(OMEGA)) < rows, K * measured * noise[2] * 1e-3, np.nan)
    raw = {"torque": np.abs(M), "angle": 1e-3 + 0 * np.abs(M), "phase": np.angle(M)}
    s = Sweep(OMEGA, measured.real, measured.imag, raw=raw)
    kept = without_inertia(s, RADIUS, HEIGHT)
    assert kept.inertia is None and kept.grey is None


@pytest.mark.parametrize("close", [False, True])
def test_repeats_of_one_frequency_do_not_agree_on_an_inertia(close):
    """The torque of the sample was mistaken for the inertia 2 K G' / omega^2 if the highest frequency was repeated. The
    same holds for frequencies that are nearly equal."""
    frequencies = np.geomspace(1, 200, 6)
    omega = np.repeat(np.append(frequencies, [199.8, 199.9, 200.1, 200.2]) if close else frequencies, 3)
    omega.sort()
    G = 5000 * (1j * omega) ** 0.1 * (1 + 0.005 * np.random.default_rng(0).standard_normal(len(omega)))
    raw = {"torque": np.abs(K * G) * 1e-3, "angle": 1e-3 + 0 * omega}
    assert without_inertia(Sweep(omega, G.real, G.imag, raw=raw), RADIUS, HEIGHT).inertia is None


def test_the_phase_alone_tells_the_share_of_the_instrument(tmp_path):
    """Torque and displacement are not needed: I omega^2 / K = G' - G'' / tan(phase)."""
    s = export(tmp_path / "p.txt", sample=False)
    only = s._replace(raw={"phase": s.raw["phase"]})
    for given in (s, only):
        kept = without_inertia(given)
        lost = np.abs(G) < 0.03 * INERTIA * OMEGA**2 / K
        assert np.allclose(kept.angular_frequency, OMEGA[~lost]) and "raw phase shows" in kept.notes[0]
        assert np.allclose(kept.inertia, INERTIA * OMEGA[~lost] ** 2 / K, rtol=1e-6)
    # If the phase is that of the sample, nothing was subtracted.
    plain = only._replace(raw={"phase": np.angle(G)})
    assert without_inertia(plain) is plain


def test_what_is_not_told_changes_nothing(tmp_path):
    s = export(tmp_path / "a.txt", sample=False, phase=False)
    told = without_inertia(s)  # neither the torque of the sample nor its size
    assert told.grey is None and told.inertia is None and "give --radius and --height" in told.notes[-1]
    light = export(tmp_path / "b.txt", inertia=1e-12)
    assert without_inertia(light).grey is None and len(without_inertia(light).storage) == 20


def test_phases_written_as_lags_are_turned(tmp_path):
    s = export(tmp_path / "l.txt", sample=False)
    turned = without_inertia(s._replace(raw={"phase": -s.raw["phase"]}))
    assert "after a change of sign" in turned.notes[0]
    assert np.allclose(turned.inertia, without_inertia(s).inertia, rtol=1e-9)


def test_raw_columns_without_a_unit_are_named_and_degrees_are_read(tmp_path):
    M, rows = (K * G - INERTIA * OMEGA**2) * 1e-3, []
    for w, g, m in zip(OMEGA, G, M, strict=True):
        rows.append([w, g.real, g.imag, 1e6 * abs(m), np.degrees(1e-3), np.angle(m)])
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa,torque_uN.m,angle_deg,raw_phase"
    np.savetxt(tmp_path / "d.csv", rows, delimiter=",", header=head, comments="")
    s = read_sweep(tmp_path / "d.csv")
    assert [n for n in s.notes if "column 'raw_phase' is not used" in n and "name this column e.g. raw_phase_deg" in n]
    assert without_inertia(s, RADIUS, HEIGHT).inertia[0] == pytest.approx(INERTIA * OMEGA[0] ** 2 / K, rel=1e-3)


def test_a_sweep_of_nothing_but_the_instrument_is_refused(tmp_path):
    with pytest.raises(InputError, match="the instrument dominates at nearly all points"):
        without_inertia(export(tmp_path / "e.txt", inertia=1.0))


def test_ten_measured_sweeps_have_one_inertia():
    files = sorted((SHARED / "data" / "lions_mane").glob("*.csv"))
    if not files:
        pytest.skip("the raw sweeps are not here")
    for file in files:
        gap = float(re.search(r"gap after preload ([\d.]+) um", file.read_text())[1]) * 1e-6
        s = without_inertia(read_sweep(file), 0.004, gap)
        # 22.47 uN m s^2 in all ten files, and 2 to 5 of 31 points are affected by the instrument
        assert float(re.search(r"inertia of ([\d.]+) uN", s.notes[0])[1]) == pytest.approx(22.47, abs=0.02)
        assert 2 <= len(s.grey) <= 5


def test_a_sweep_whose_raw_phase_nears_180_degrees_loses_those_points():
    file = SHARED / "data" / "rheology" / "rheojax" / "multi_technique.txt"
    if not file.is_file():
        pytest.skip("the measured export is not here")
    s = read_sweep(file)
    kept = without_inertia(s)
    assert "instrument inertia of 24" in " ".join(kept.notes)
    assert kept.grey is None or kept.grey[:, 0].min() > 100
