"""Sweeps at several temperatures: shift factors against those of the data, temperature laws, files, messages."""

import json

import numpy as np
import pytest
from conftest import SHARED

from fitting.__main__ import main
from fitting.fits.families import models
from fitting.master import master_curve, master_report, shifts, temperature_laws, temperature_sweeps
from fitting.readers import rheometer
from fitting.readers.frequency_sweep import Sweep
from fitting.reports import one_page
from liverjax.core.errors import InputError

pytestmark = pytest.mark.quick_to_compile

TEMPERATURES = 273.15 + np.linspace(-10.0, 90.0, 11)
C1, C2, REFERENCE = 8.0, 150.0, 4
OMEGA = np.geomspace(0.5, 80, 12)
TRUE = -C1 * (TEMPERATURES - TEMPERATURES[REFERENCE]) / (C2 + TEMPERATURES - TEMPERATURES[REFERENCE])
TRUE_B = -0.002 * (TEMPERATURES - TEMPERATURES[REFERENCE])


def moduli_of_polymer(omega: np.ndarray) -> np.ndarray:
    """Return moduli of a smooth wide spectrum: one mode per third of a decade, weights of a power law with a
    plateau.
    """
    times = np.geomspace(1e-9, 1e6, 46)
    x = 1j * omega[:, None] * times
    return 5e3 + (2e4 * (1 + (times / 1e-3) ** -0.45) / 3 * x / (1 + x)).sum(axis=1)


def sweeps(noise: float | tuple[float, float], seed: int = 0, vertical: bool = False) -> list[Sweep]:
    rng, out = np.random.default_rng(seed), []
    for a, b in zip(10**TRUE, 10 ** (TRUE_B * vertical), strict=True):
        G = moduli_of_polymer(a * OMEGA) / b
        factor = 1 + np.broadcast_to(noise, 2)[:, None] * rng.standard_normal((2, len(OMEGA)))
        out.append(Sweep(OMEGA, G.real * factor[0], G.imag * factor[1]))
    return out


def test_factors_of_exact_data_are_those_that_made_them():
    found = shifts.found(sweeps(0.0), TEMPERATURES, REFERENCE)
    # A cubic spline with knots 0.4 decades apart follows the curve to about 1e-4.
    assert np.abs(found.log_a - TRUE).max() < 3e-3 and found.apart < 1e-3
    assert found.log_a[REFERENCE] == 0 == found.log_a_errors[REFERENCE] and not found.log_b.any()


def test_sweeps_with_a_gap_between_them_are_refused():
    """The sweeps were joined because the curve was assumed smooth. The error was 1.7 decades, the stated error 0.08."""
    true = np.array([0.0, -4.0])
    far = [moduli_of_polymer(10**a * OMEGA) for a in true]
    parts = [Sweep(OMEGA, G.real, G.imag) for G in far]
    with pytest.raises(InputError, match="0 and 60 °C do not overlap after the best shifts"):
        shifts.found(parts, 273.15 + np.array([0.0, 60.0]), 0)


@pytest.mark.ci
def test_standard_errors_of_factors_are_right():
    z, of_law = [], []
    for seed in range(24):
        found = shifts.found(sweeps(0.02, seed), TEMPERATURES, REFERENCE)
        free = np.arange(11) != REFERENCE
        z.append((found.log_a - TRUE)[free] / found.log_a_errors[free])
        assert 0.015 < found.apart < 0.025
        wlf = temperature_laws.temperature_laws_of(found)[0].numbers
        of_law.append([(wlf[name][0] - true) / wlf[name][1] for name, true in (("C1", C1), ("C2_K", C2))])
    # errors of neighbours are correlated: 24 sets of about 3 independent ones
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4
    # C1 and C2 are correlated, so 24 values give 1 +- 0.3. With independent factors, their errors were half as large.
    assert 0.6 < np.sqrt(np.mean(np.square(of_law))) < 1.4


@pytest.mark.ci
@pytest.mark.parametrize("noise", [(0.004, 0.08), (0.08, 0.004)])
def test_standard_errors_of_factors_are_right_if_the_noise_of_the_moduli_differs(noise):
    """Both moduli had the same weight. The standard errors were up to two times too small, or five times too large."""
    z, of_the_better = [], []
    for seed in range(12):
        found = shifts.found(sweeps(noise, seed)[2:7], TEMPERATURES[2:7], 2)
        z.append(np.delete((found.log_a - TRUE[2:7]) / np.maximum(found.log_a_errors, 1e-12), 2))
        of_the_better.append(np.abs(np.delete(found.log_a - TRUE[2:7], 2)).max())
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.45
    assert np.median(of_the_better) < 0.02  # decades; 0.05 with equal weights


@pytest.mark.slow
def test_errors_of_factors_contain_the_noise_where_points_scatter():
    """A curve with knots 0.4 decades apart follows the noise. Then the errors were only a half to a fifth of the right
    size.
    """
    z, told = [], 0
    for seed in range(12):
        parts = sweeps(0.1, seed)[2:8]
        found = shifts.found(parts, TEMPERATURES[2:8], 2)
        assert found.knots > 0.6
        z.append(np.delete((found.log_a - TRUE[2:8]) / np.maximum(found.log_a_errors, 1e-12), 2))
        data = temperature_sweeps.AtTemperatures(parts, TEMPERATURES[2:8], None)
        told += any("does not hold" in n for n in master_curve.master_curve(data, None).sweep.notes)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.45 and not told  # 5.9 with knots 0.4 decades apart


def test_vertical_factors_are_found_where_the_curve_has_a_shape():
    found = shifts.found(sweeps(0.002, 1, vertical=True), TEMPERATURES, REFERENCE, vertical=True)
    z = np.delete((found.log_b - TRUE_B) / np.maximum(found.log_b_errors, 1e-12), REFERENCE)
    assert np.sqrt(np.mean(z**2)) < 2.5 and np.abs(found.log_b - TRUE_B).max() < 0.05
    without = shifts.found(sweeps(0.002, 1, vertical=True), TEMPERATURES, REFERENCE)
    assert without.apart > 2 * found.apart


@pytest.mark.parametrize("vertical", [True, False])
def test_factors_of_the_moduli_are_told_where_only_frequencies_are_shifted(vertical):
    """These factors changed log a by seven of its standard errors, although the curves deviated by 2.4 %."""
    data = temperature_sweeps.AtTemperatures(sweeps(0.01, 2, vertical), TEMPERATURES, None)
    notes = master_curve.master_curve(data, None).sweep.notes
    assert (
        any("the moduli also change with the temperature by factors" in n and "give --vertical" in n for n in notes)
        == vertical
    )
    assert not any("factors too" in n for n in master_curve.master_curve(data, None, vertical=True).sweep.notes)


def test_the_noise_of_one_modulus_does_not_hide_factors_of_the_moduli():
    """The sums of squares had equal weights. With 6 % of noise in G'', log a was wrong by 80 standard errors without
    a note."""
    rng, parts, T = np.random.default_rng(0), [], 273.15 + np.array([25.0, 37.0, 50.0])
    omega = np.geomspace(0.1, 100, 31)
    for a, b in ((0.8, 1.04), (0.0, 1.0), (-0.8, 0.96)):
        G, noise = moduli_of_polymer(10**a * omega) / b, rng.standard_normal((2, 31))
        parts.append(Sweep(omega, G.real * (1 + 0.001 * noise[0]), G.imag * (1 + 0.06 * noise[1])))
    (told,) = master_curve._factors_of_moduli(parts, shifts.found(parts, T, 1))
    assert "(G' and G'' weighted by their noise)" in told and "give --vertical" in told


@pytest.mark.ci
@pytest.mark.parametrize("noise", [pytest.param(0.02, marks=pytest.mark.slow), 0.05])
def test_no_factors_are_told_of_a_power_law(noise):
    """For a power law, any shift a can be replaced by a factor b. The note changed log a by more than a decade in 8 to
    12 of 40 data sets.
    """
    true, omega = np.array([1.2, 0.6, 0.0, -0.55, -1.1]), np.geomspace(0.1, 100.0, 16)
    T = 273.15 + np.linspace(10.0, 50.0, 5)
    for seed in range(12):
        spread = 1 + noise * np.random.default_rng(seed).standard_normal((2, 5, 16))
        G = 1e3 * (1j * omega * 10.0 ** true[:, None]) ** 0.15
        parts = [Sweep(omega, p, q) for p, q in zip(G.real * spread[0], G.imag * spread[1], strict=True)]
        assert not master_curve._factors_of_moduli(parts, shifts.found(parts, T, 2))


def test_factors_of_a_power_law_are_told_to_be_unknown():
    """With --vertical, shifts of a power law were wrong by up to 9 standard errors, without a warning."""
    true, T = np.array([0.0, -0.5, -0.9, -1.4, -1.8]), 273.15 + np.linspace(10.0, 50.0, 5)
    omega, rng = np.geomspace(0.6, 60, 15), np.random.default_rng(0)
    for part, told in (((1j * omega * 10 ** true[:, None]) ** 0.15, True), (None, False)):
        G = np.stack([moduli_of_polymer(omega * 10**a) for a in true]) if part is None else 1e3 * part
        spread = 1 + 0.02 * rng.standard_normal((2, 5, 15))
        parts = [Sweep(omega, p, q) for p, q in zip(G.real * spread[0], G.imag * spread[1], strict=True)]
        found = master_curve.master_curve(temperature_sweeps.AtTemperatures(parts, T, None), None, vertical=True)
        assert any("remove --vertical, or measure a wider band" in n for n in found.sweep.notes) == told


def test_the_shifts_of_a_power_law_are_a_minimum():
    """Without a line search, the iteration ended in a cycle, farther from one curve than the true shifts."""
    true, T = np.array([0.0, -0.5, -0.9, -1.4, -1.8]), 273.15 + np.linspace(10.0, 50.0, 5)
    omega = np.geomspace(0.6, 60, 15)
    spread = 1 + 0.02 * np.random.default_rng(1).standard_normal((2, 5, 15))
    G = 1e3 * (1j * omega * 10.0 ** true[:, None]) ** 0.15
    parts = [Sweep(omega, p, q) for p, q in zip(G.real * spread[0], G.imag * spread[1], strict=True)]
    found = shifts.found(parts, T, 0, True, (0.6,))
    at_true = shifts.distances_from_curve(parts, true, np.zeros(5), found.knots)
    assert found.apart < np.sqrt(np.mean(at_true**2))


def test_laws_have_their_numbers_and_errors():
    found = shifts.found(sweeps(0.01, 3), TEMPERATURES, REFERENCE)
    wlf, arrhenius = temperature_laws.temperature_laws_of(found)
    assert (wlf.name, arrhenius.name) == ("WLF", "Arrhenius") and wlf.apart < 0.02 < arrhenius.apart
    for name, true in (("C1", C1), ("C2_K", C2)):
        value, error = wlf.numbers[name]
        assert abs(value - true) < 4 * error < 0.2 * true
    energy = 8e4 / (8.314462618 * np.log(10))
    given = {"covariance": np.zeros((11, 11)), "given": True}
    exact = found._replace(log_a=energy * (1 / TEMPERATURES - 1 / TEMPERATURES[REFERENCE]), **given)
    (law,) = (law for law in temperature_laws.temperature_laws_of(exact) if law.name == "Arrhenius")
    value, error = law.numbers["activation_energy_J_per_mol"]
    assert value == pytest.approx(8e4, rel=1e-9) and error < 1 and law.apart < 1e-12


def write_rows(path, unit: str = "C", factors: bool = False, tables=None, order: int = 1) -> None:
    lines = [f"frequency_Hz,storage_modulus_kPa,loss_modulus_kPa,temperature_{unit}" + ",shift_factor" * factors]
    offset = {"C": 273.15, "K": 0.0}[unit]
    for k, s in enumerate(tables or sweeps(0.0)):
        for w, p, q in zip(s.angular_frequency, s.storage, s.loss, strict=True):
            row = [w / (2 * np.pi), p / 1e3, q / 1e3, TEMPERATURES[k] - offset + 0.03 * np.sin(w)]
            lines.append(",".join(f"{v:.12g}" for v in row + [10 ** TRUE[k]] * factors))
    path.write_text("\n".join([lines[0], *lines[1:][::order]]) + "\n")


@pytest.mark.parametrize(("unit", "order"), [("C", 1), ("K", -1)])
def test_a_file_with_a_column_of_temperature(tmp_path, unit, order):
    write_rows(tmp_path / "a.csv", unit, order=order)
    data = temperature_sweeps.read_temperatures([tmp_path / "a.csv"])
    assert np.allclose(data.temperatures, TEMPERATURES, atol=0.05) and data.shift_factors is None
    # A file of several temperatures repeats its frequencies, and begins again with the lowest.
    assert not any("repeated" in note or "sorted" in note for own in data.sweeps for note in own.notes)
    head, *rows = (tmp_path / "a.csv").read_text().splitlines()
    (tmp_path / "b.csv").write_text("\n".join([head, *(row for row in rows for _ in range(2))]) + "\n")
    again = temperature_sweeps.read_temperatures([tmp_path / "b.csv"])
    assert all(any("copies of other points" in note for note in own.notes) for own in again.sweeps)
    rows += [row.replace(",", ",1", 1) for row in rows]  # other moduli at the same frequencies
    (tmp_path / "c.csv").write_text("\n".join([head, *rows]) + "\n")
    again = temperature_sweeps.read_temperatures([tmp_path / "c.csv"])
    assert all(any("repeated" in note for note in own.notes) for own in again.sweeps)
    found = master_curve.master_curve(data, TEMPERATURES[REFERENCE] + 3)
    assert found.shifts.reference == REFERENCE and np.abs(found.shifts.log_a - TRUE).max() < 3e-3
    assert np.allclose(found.sweep.storage, moduli_of_polymer(found.sweep.angular_frequency).real, rtol=0.01)


def test_given_factors_are_taken_as_they_are(tmp_path):
    write_rows(tmp_path / "a.csv", factors=True)
    data = temperature_sweeps.read_temperatures([tmp_path / "a.csv"])
    found = master_curve.master_curve(data, None)
    assert found.shifts.given and found.shifts.reference == REFERENCE and np.allclose(found.shifts.log_a, TRUE)
    assert np.allclose(found.sweep.storage, moduli_of_polymer(found.sweep.angular_frequency).real, rtol=1e-9)


def test_given_factors_and_vertical_ones_do_not_go_together(tmp_path):
    write_rows(tmp_path / "a.csv", factors=True)
    data = temperature_sweeps.read_temperatures([tmp_path / "a.csv"])
    (note,) = (n for n in master_curve.master_curve(data, None, vertical=True).sweep.notes if "--vertical" in n)
    assert "the column shift_factor" in note
    wrong = master_curve._sentences(shifts.known_shifts(data.sweeps, data.temperatures, 0, 0 * TRUE), 0.0, True)
    assert "or check the column shift_factor" in wrong[1] and "--vertical" not in wrong[1]
    assert not any("--vertical finds" in n for n in master_curve.master_curve(data, None).sweep.notes)


@pytest.mark.parametrize(
    ("name", "celsius"),
    # The Unicode minus was ignored, and the first number with a C or K was used: 3 °C, and 5 K.
    [
        *(("Sweep-25C", 25), ("Sweep -25C", -25), ("-25 °C", -25), ("run_-25.5 C", -25.5), ("3-25C", 25)),
        *(("\u221225 °C", -25), ("step 3C at 37 °C", 37), ("5 K/min, 25 C", 25), ("run 1C 37 C", None)),
    ],
)
def test_a_hyphen_between_words_is_no_sign(tmp_path, name, celsius):
    tables = [(name, 1.0), ("other 40 C", 2.0)]
    text = "".join(
        f"[step]\n{title}\nFrequency\tStorage modulus\tLoss modulus\nHz\tPa\tPa\n"
        + "".join(f"{f}\t{m * (1 + f)}\t{m * f}\n" for f in (1, 2, 3))
        + "\n"
        for title, m in tables
    )
    (tmp_path / "t.txt").write_text(text)
    if celsius is None:
        with pytest.raises(InputError, match=r"states several temperatures \(1 °C, 37 °C\); add a column"):
            temperature_sweeps.read_temperatures([tmp_path / "t.txt"])
        return
    data = temperature_sweeps.read_temperatures([tmp_path / "t.txt"])
    assert np.allclose(data.temperatures - 273.15, [celsius, 40])


@pytest.mark.parametrize(
    ("others", "known"),
    [((25.0, 37.0, 45.0), False), ((25.2, 25.0, 24.8), True), ((23.8, 23.7, 23.8), True)],
)
def test_the_name_of_a_table_does_not_replace_its_temperatures(tmp_path, others, known):
    """One empty cell replaced the temperatures of all rows, 25 to 45 °C, by the 25 °C of the name. A sample may be
    more than 1 K colder than the set temperature in the name. Then the file was refused."""
    head = "Frequency\tStorage modulus\tLoss modulus\tTemperature\nHz\tPa\tPa\t°C\n"
    rows = [f"{f}\t{1000 + f}\t{100 + f}\t{T}\n" for T in others for f in (1, 2, 3)]
    rows[1] = "2\t1002\t102\t\n"
    last = "".join(f"{f}\t{900 + f}\t{90 + f}\t60\n" for f in (1, 2, 3))
    (tmp_path / "t.txt").write_text(f"[step]\nfrom 25 C\n{head}{''.join(rows)}\n[step]\nat 60 C\n{head}{last}")
    if known:
        data = temperature_sweeps.read_temperatures([tmp_path / "t.txt"])
        assert np.allclose(data.temperatures - 273.15, [25.0, 60.0])
    else:
        with pytest.raises(InputError, match="the temperature of 1 of 9 rows is missing"):
            temperature_sweeps.read_temperatures([tmp_path / "t.txt"])


def write_constant_rows(path, temperatures) -> None:
    rows = [f"{f},{1000 + f},{100 + f},{T}\n" for T in temperatures for f in (1, 2, 3)]
    path.write_text("frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C\n" + "".join(rows))


@pytest.mark.parametrize("files", [1, 5])
def test_close_temperatures_are_no_chain(tmp_path, files):
    """Sweeps at 20, 20.9, 21.8 and 22.7 °C were joined, because each differs from the next by less than 1 K."""
    temperatures, paths = (20.0, 20.9, 21.8, 22.7, 30.0), []
    for k, own in enumerate(np.array_split(temperatures, files)):
        paths.append(tmp_path / f"{k}.csv")
        write_constant_rows(paths[-1], own)
    data = temperature_sweeps.read_temperatures(paths)
    assert np.allclose(data.temperatures - 273.15, [20.45, 22.25, 30.0])


def test_scattered_temperatures_that_count_as_one_are_told(tmp_path):
    rows = [f"{f},{1000 + f},{100 + f},{T + 0.3 * f}\n" for T in (20, 30) for f in (1, 2, 3, 4, 5)]
    (tmp_path / "a.csv").write_text("frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C\n" + "".join(rows))
    data = temperature_sweeps.read_temperatures([tmp_path / "a.csv"])
    assert np.allclose(data.temperatures - 273.15, [20.9, 30.9])
    assert "rows from 20.3 to 21.5 °C count as one temperature, 20.9 °C" in data.sweeps[0].notes[-1]


def test_a_wrong_reading_of_the_temperature_is_ignored(tmp_path):
    """One wrong cell made a sweep of one point, and the message advised to remove half of the temperatures."""
    rows = [f"{f},{1000 + f},{100 + f},{T}" for T in (-10, 20) for f in (1, 2, 3, 4)]
    rows[-1] = rows[-1].replace(",20", ",31.4")
    head = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C\n"
    (tmp_path / "a.csv").write_text(head + "\n".join(rows).replace("-", "\u2212") + "\n")
    data = temperature_sweeps.read_temperatures([tmp_path / "a.csv"])
    assert np.allclose(data.temperatures - 273.15, [-10, 20])
    assert any("the points at 31.4 °C (frequencies: 4 Hz) are ignored" in note for note in data.sweeps[0].notes)


def test_the_instrument_is_found_in_each_sweep_before_the_shift(tmp_path):
    """All points were shifted, also those at which the inertia is 20 % of G'. The band limited shifted frequencies."""
    omega, rng = np.geomspace(0.5, 300, 16), np.random.default_rng(0)
    parts = parts_of({0: 0.003, 1: 0.003}, [omega, omega], np.array([0.5, 0.0]))
    heavy = [s._replace(storage=s.storage + 0.5 * omega**2, source="a.csv") for s in parts]
    data = temperature_sweeps.AtTemperatures(heavy, TEMPERATURES[:2], None)
    found = temperature_sweeps.with_usable_points(data, (None, None), None, None)
    assert all(len(s.storage) < 16 and len(s.storage) + len(s.grey) == 16 for s in found.sweeps)
    notes = [note for note in found.sweeps[0].notes if "which is the mark of the instrument" in note]
    assert notes and notes[0].startswith("at -10")
    limited = temperature_sweeps.with_usable_points(data, (None, 10.0), None, None).sweeps
    assert all(s.angular_frequency[-1] <= 20 * np.pi < 300 and s.source == "a.csv" for s in limited)
    # The raw columns, which show the inertia, are kept if tables at one temperature are joined.
    raw = {"torque": rng.random(16)}
    assert np.allclose(temperature_sweeps.joined([parts[0]._replace(raw=raw)]).raw["torque"], raw["torque"])


@pytest.mark.draws
def test_the_command_shifts_several_files_and_fits_the_curve(tmp_path, capsys):
    paths = []
    for k, s in enumerate(sweeps(0.0)[2:7]):
        paths.append(tmp_path / f"{k}.csv")
        T = TEMPERATURES[2 + k] - 273.15
        rows = [f"{w},{p},{q},{T}" for w, p, q in zip(s.angular_frequency, s.storage, s.loss, strict=True)]
        head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa,Temperature (°C)"
        paths[-1].write_text("\n".join([head, *rows]) + "\n")
    out = tmp_path / "out"
    assert (
        main([*map(str, paths), "--master", "30", "--model", "spectrum", "--optimizer", "bfgs", "--out", str(out)]) == 0
    )
    content = json.loads((out / "fit.json").read_text())
    shift = content["details"]["shift"]
    assert shift["reference_temperature_C"] == pytest.approx(30.0) and len(shift["log10_a"]) == 5
    assert content["method"] == "closed-form" and content["mean_relative_error"] < 0.02
    again = np.genfromtxt(out / "master_curve.csv", delimiter=",", names=True)
    assert len(again) == 60 and np.all(np.diff(again["frequency_Hz"]) >= 0)
    table = np.genfromtxt(out / "shift_factors.csv", delimiter=",", names=True)
    assert np.allclose(np.log10(table["shift_factor"]), TRUE[2:7], atol=5e-3)
    told = capsys.readouterr()
    assert "has no effect" not in told.err and content["data"] == ", ".join(map(str, paths))
    assert "reference" in told.out and "nearest" not in told.err and (out / "shift.png").exists()


def test_the_command_says_which_temperature_it_took_and_prints_the_factors_on_the_page(tmp_path, capsys, monkeypatch):
    write_rows(tmp_path / "a.csv")
    pages = []
    monkeypatch.setattr(one_page, "save", lambda figure, file: pages.append(figure))
    words = [str(tmp_path / "a.csv"), "--model", "spectrum", "--report", "--out", str(tmp_path / "out")]
    between = TEMPERATURES[REFERENCE] - 273.15 + 3
    assert main([*words, "--master", f"{between:g}"]) == 0
    assert f"nearest to {between:g} °C" in capsys.readouterr().err
    (text,) = (t.get_text() for t in pages[0].texts if t.get_family() == ["monospace"])
    assert "log10 a_T" in text and "  reference" in text and "WLF: C1" in text
    with pytest.raises(SystemExit):
        main([*words, "--master", "nan"])
    assert "'nan' is not a temperature" in capsys.readouterr().err


def test_a_sweep_at_several_temperatures_that_fits_nothing_gets_the_remedy(tmp_path, capsys):
    rows = [f"{f},{m * (1 + f)},{m * f},{T}\n" for T, m in ((20, 1e3), (30, 1e6)) for f in (1, 2, 3)]
    file = tmp_path / "a.csv"
    file.write_text("frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C\n" + "".join(rows))
    assert main([str(file), "--out", str(tmp_path / "out")]) == 2
    assert "give --master, or a file for each temperature" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("text", "options", "sentence"),
    [
        ("frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n1,2,1\n2,3,1\n3,4,1\n", [], "states no temperature"),
        (
            "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C\n1,2,1,20\n2,3,1,20\n3,4,1,20\n",
            [],
            "all sweeps are at 20 °C (rows less than 1 K apart count as one temperature)",
        ),
        (
            "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C\n"
            + "".join(f"{f},{m * (1 + f)},{m * f},{T}\n" for T, m in ((20, 1e-6), (30, 1e9)) for f in (1, 2, 3)),
            [],
            "do not match",
        ),
        ("frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_K\n1,2,1,-3\n2,3,1,20\n", [], "absolute zero"),
        (
            "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C\n"
            + "".join(f"{f},2,1,{T}\n" for T in (20, 30) for f in (1, 2, 3)).replace("2,2,1,20", "2,2,1,"),
            [],
            "the temperature of 1 of 6 rows is missing",
        ),
        ("", ["--with", "a.csv"], "remove --with"),
    ],
)
def test_what_cannot_be_shifted_gets_one_sentence(tmp_path, capsys, text, options, sentence):
    file = tmp_path / "a.csv"
    file.write_text(text)
    assert main([str(file), *options, "--master", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert sentence in error and "Traceback" not in error and error.count("\n") == 1


@pytest.mark.ci
def test_twenty_measured_tables_make_one_curve():
    file = SHARED / "data" / "rheology" / "rheojax" / "frequency_sweep_tts.txt"
    if not file.exists():
        pytest.skip("the tables of twenty temperatures are not here")
    data = temperature_sweeps.read_temperatures([file])
    found = master_curve.master_curve(data, 333.15)
    assert len(data.sweeps) == 20 and np.ptp(np.log10(found.sweep.angular_frequency)) > 14
    # All sweeps except the three coldest ones, which are glassy, agree with one curve within 1 %.
    assert np.all(found.shifts.misfit[3:] < 0.01)
    wlf = found.laws[0]
    assert wlf.name == "WLF" and wlf.apart < 0.05
    # The guide contains these numbers.
    assert wlf.numbers["C1"] == pytest.approx((6.93, 0.10), rel=0.05)
    assert wlf.numbers["C2_K"] == pytest.approx((168.7, 1.5), rel=0.05)
    # For another reference temperature the law is equal if C2 changes by the difference of temperatures (Ferry, 11-22).
    other = master_curve.master_curve(data, 293.15).laws[0]
    apart = found.shifts.temperatures[found.shifts.reference] - 293.15
    assert other.numbers["C2_K"][0] == pytest.approx(wlf.numbers["C2_K"][0] - apart, rel=0.03)
    # A smooth spectrum with 2 times per decade follows 14 decades. Half a decade at the cold end is noise.
    fit = models.spectrum_fit(found.sweep)
    assert np.mean(fit.relative_errors(found.sweep)) < 0.015 and fit.details["spectrum"]["decades_carried"] > 12


def parts_of(noise: dict[int, float], omegas: list[np.ndarray], log_a: np.ndarray, seed: int = 0) -> list[Sweep]:
    """Return sweeps with their own frequencies, shifts and relative noise (default 0)."""
    rng, out = np.random.default_rng(seed), []
    for k, (omega, a) in enumerate(zip(omegas, log_a, strict=True)):
        G, factor = moduli_of_polymer(10**a * omega), 1 + noise.get(k, 0.0) * rng.standard_normal((2, len(omega)))
        out.append(Sweep(omega, G.real * factor[0], G.imag * factor[1]))
    return out


def test_errors_of_factors_contain_the_noise_of_each_sweep():
    """All sweeps counted as equally noisy. The errors of the one with 4 % of noise were 4 to 5 times too small."""
    z, log_a = [], np.array([0.0, -0.8, -1.6])
    omegas = [np.geomspace(0.1, 100, n) for n in (61, 61, 10)]
    for seed in range(12):
        found = shifts.found(parts_of({0: 0.003, 1: 0.003, 2: 0.04}, omegas, log_a, seed), TEMPERATURES[:3], 0)
        z.append((found.log_a - log_a)[1:] / found.log_a_errors[1:])
    assert np.all(np.sqrt(np.mean(np.square(z), axis=0)) < 1.7)
    # The mean over the sweeps, not over the points, was given as the distance of all points.
    assert np.isclose(found.apart, np.sqrt(np.average(found.misfit**2, weights=[61, 61, 10])))


def test_a_long_sweep_is_shifted_onto_a_short_neighbour():
    """The overlap had to be a quarter of the long sweep, which is more than the whole short sweep."""
    omegas, log_a = [np.geomspace(0.1, 10, 15), np.geomspace(0.1, 1, 8), np.geomspace(1e-3, 100, 26)], [0, -0.5, -1.0]
    found = shifts.found(parts_of({}, omegas, np.array(log_a)), TEMPERATURES[:3], 0)
    assert np.allclose(found.log_a, log_a, atol=1e-3)


def test_missing_factors_and_missing_deviations_are_told(tmp_path):
    """One empty cell made all given factors unused, and one file without deviations those of all others, without a
    note."""
    write_rows(tmp_path / "a.csv", factors=True)
    head, *rows = (tmp_path / "a.csv").read_text().splitlines()
    empty = [row.rpartition(",")[0] + "," for row in rows]
    n = len(OMEGA)
    (tmp_path / "a.csv").write_text("\n".join([head, empty[0], *rows[1:]]))
    data = temperature_sweeps.read_temperatures([tmp_path / "a.csv"])
    assert np.allclose(data.shift_factors, 10**TRUE)
    (tmp_path / "a.csv").write_text("\n".join([head, *empty[:n], *rows[n:]]))
    data = temperature_sweeps.read_temperatures([tmp_path / "a.csv"])
    assert data.shift_factors is None and any("shift_factor are not used" in note for note in data.sweeps[0].notes)
    one, other, *_ = sweeps(0.0)
    both = temperature_sweeps.joined([one._replace(storage_sd=one.storage, loss_sd=one.loss), other])
    assert both.storage_sd is None and "the standard deviations are not used" in both.notes[0]


@pytest.mark.parametrize("estimated", [False, True])
def test_a_master_curve_keeps_the_measured_deviations(tmp_path, estimated):
    """The file had no deviations. A fit of the file then had other weights, and errors up to 4 times different."""
    own = [s._replace(storage_sd=0.03 * s.storage, loss_sd=0.01 * s.loss) for s in sweeps(0.0)[2:5]]
    own = [s._replace(sd_estimated=estimated) for s in own]
    found = master_curve.master_curve(temperature_sweeps.AtTemperatures(own, TEMPERATURES[2:5], None), None)
    master_report.write_master_curve(tmp_path, found)
    again = rheometer.read_sweep(tmp_path / "master_curve.csv")
    assert (again.storage_sd is None) == estimated
    if not estimated:
        assert np.allclose(again.storage_sd, 0.03 * again.storage) and np.allclose(again.loss_sd, 0.01 * again.loss)
