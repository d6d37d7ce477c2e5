"""Columns of relaxation and creep tests: headings of other programs, tension, several tables, the other kind of
test.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from test_time_tests import write

from fitting.__main__ import main
from fitting.commands.together import errors_of_sizes
from fitting.readers.indentation_curves import read_indentation
from fitting.readers.rheometer import read_sweep
from fitting.readers.tables.time_columns import read_columns
from fitting.readers.time_tests import Sample, read_time_test
from fitting.waves.dispersion import read_dispersion
from fitting.waves.files.formats import COLUMNS
from fitting.waves.wave_field import read_waves
from liverjax.core.errors import InputError

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.parametrize(
    "header",
    [
        "Zeit [s];Relaxationsmodul [Pa]",
        "Zeit / s;Relaxationsmodul / Pa",
        "Time, s;Relaxation modulus in Pa",
        "Elapsed time in s;Shear modulus in Pa",
        "t [s];G(t) [Pa]",
        "Temps (s);Module de relaxation (Pa)",
        "time (s);modulus (Pa);T (°C)",
    ],
)
def test_headings_of_other_programs_are_read(header, tmp_path):
    (tmp_path / "t.csv").write_text(header + "\n" + "".join(f"{k};{900 - k}\n" for k in range(1, 9)))
    columns, _ = read_columns(tmp_path / "t.csv")
    (tmp_path / "first.csv").write_text("T (°C);" + header + "\n" + "".join(f"25;{k};{900 - k}\n" for k in range(1, 9)))
    assert np.array_equal(read_columns(tmp_path / "first.csv")[0]["time"], columns["time"])
    assert np.allclose(columns["time"], np.arange(1, 9)) and np.allclose(columns["modulus"], 900 - np.arange(1, 9))


@pytest.mark.parametrize(
    ("header", "quantity", "factor"),
    [
        ("time [s],E(t) [kPa]", "modulus", 1e3 / 3),
        ("t (s),Relaxation modulus E(t) (kPa)", "modulus", 1e3 / 3),
        ("time_s,Young's modulus [Pa]", "modulus", 1 / 3),
        ("Step time [s],Relaxation modulus G(t) [kPa]", "modulus", 1e3),
        ("time_s,D(t) [1/Pa]", "compliance", 3.0),
        ("time_s,tensile creep compliance (1/kPa)", "compliance", 3e-3),
        ("time_s,tensile stress [kPa],tensile strain [%]", "stress", 1e3 / 3),
        ("time_s,compressive stress [kPa],compressive strain [%]", "stress", 1e3 / 3),
        ("time_s,nominal stress [kPa],engineering strain [%]", "stress", 1e3 / 3),
        ("time_s,E(t) [Pa],G(t) [kPa]", "modulus", None),
    ],
)
def test_quantities_of_tension_are_made_those_of_shear(header, quantity, factor, tmp_path):
    more = header.count(",") > 1
    rows = "".join(f"{k},{900 - k}{f',{5 + k}' * more}\n" for k in range(1, 9))
    (tmp_path / "t.csv").write_text(header + "\n" + rows)
    columns, notes = read_columns(tmp_path / "t.csv")
    expected = 1e3 * (5 + np.arange(1, 9)) if factor is None else factor * (900 - np.arange(1, 9))
    assert np.allclose(columns[quantity], expected) and not any("tensile" in name for name in columns)
    assert any("G = E / 3" in note for note in notes) == (factor != 1e3 and factor is not None)
    if quantity == "stress":
        assert np.allclose(columns["strain"], 0.01 * (5 + np.arange(1, 9)))


@pytest.mark.parametrize("name", ["E(t) [Pa]", "tensile strain,tensile stress [Pa]", "G(t) [Pa]"])
def test_only_quantities_of_shear_have_the_size_error_of_a_torque(name, tmp_path):
    """Moduli of tension had the error of torque over twist, with the fourth power of the radius."""
    rows = "".join(f"{k},{'0.1,' * (',' in name)}{900 - k}\n" for k in range(1, 9))
    (tmp_path / "t.csv").write_text(f"time_s,{name}\n{rows}")
    test = read_time_test(tmp_path / "t.csv", "relaxation", ramp=0)
    expected = np.hypot(50e-6 / 0.02, (4 if name[0] == "G" else 2) * 10e-6 / 0.001)
    assert errors_of_sizes(SimpleNamespace(radius=0.001, height=0.02), [test]) == pytest.approx([expected])


@pytest.mark.parametrize(
    ("header", "quantity", "factor"),
    [
        ("time_s,modulus_kPa,tensile strain [%]", "modulus", 1e3 / 3),
        ("Time (s),Creep compliance (1/kPa),Tensile stress (kPa)", "compliance", 3e-3),
        ("time_s,stress [kPa],tensile strain [%]", "stress", 1e3 / 3),
        ("time_s,strain [%],tensile stress [kPa]", "strain", 1e-2),
        ("time_s,Zugspannung [kPa],Dehnung [%]", "stress", 1e3 / 3),
        ("time_s,G(t) [kPa],tensile strain [%]", "modulus", 1e3),
        ("time_s,stress [kPa],strain [%],E(t) [Pa]", "stress", 1e3 / 3),
        ("time_s,stress [kPa],strain [%],e(t) [%]", "stress", 1e3),
        ("time_s,stress [kPa],strain [%],d(t) [mm]", "stress", 1e3),
    ],
)
def test_one_column_of_tension_makes_the_others_those_of_tension(header, quantity, factor, tmp_path):
    """A modulus in a table with tensile strain was three times too large, and a note claimed the opposite."""
    more = ",#DIV/0!" * (header.count(",") - 2)  # as workbooks write 0/0, here in an unused column
    rows = "".join(f"{k},{900 - k},{5 + k}{more}\n" for k in range(1, 9))
    (tmp_path / "t.csv").write_text(header + "\n" + rows)
    columns, _ = read_columns(tmp_path / "t.csv")
    assert np.allclose(columns[quantity], factor * (900 - np.arange(1, 9)))


def test_large_strain_in_tension_is_told(tmp_path):
    time = np.geomspace(0.1, 100, 40)
    for strain, told in ((0.3, True), (0.005, False)):
        stress = 3 * strain * (500 + 500 * np.exp(-time / 5))
        file = write(tmp_path / "t.csv", "time_s,tensile strain [1],stress [Pa]", time, np.full(40, strain), stress)
        notes = read_time_test(file, "relaxation", ramp=0.0).notes
        assert any("too small in tension" in note for note in notes) == told


@pytest.mark.parametrize("gap", ["", "\n"])
@pytest.mark.parametrize("first", [60.0, 0.5])
def test_a_second_table_is_not_appended_to_the_first(gap, first, tmp_path):
    """The other table has another unit, and continues or begins again. A modulus of 1000 Pa was read as 942 Pa."""

    def rows(times):
        return "".join(f"{t:g},{400 + 600 * np.exp(-t / 10):.6g}\n" for t in times)

    text = "time_s,relaxation modulus [Pa]\n" + rows(np.linspace(0.5, 50, 50)) + gap
    text += "time_s,relaxation modulus [kPa]\n" + rows(first + np.arange(30.0))
    (tmp_path / "two.csv").write_text(text)
    test = read_time_test(tmp_path / "two.csv", "relaxation")
    assert test.used.sum() == 50 and any("contains 2 tables" in note for note in test.notes)


@pytest.mark.parametrize("kind", ["relaxation", "creep"])
def test_a_file_of_the_other_kind_is_told(kind, tmp_path):
    time = np.geomspace(0.1, 100, 40)
    held, moves = np.full(40, 100.0), 0.1 * (2 - np.exp(-time / 5))
    creep = write(tmp_path / "c.csv", "time_s,stress [Pa],strain [1]", time, held, moves)
    relaxation = write(tmp_path / "r.csv", "time_s,stress [Pa],strain [1]", time, 10 / moves, held / 1e3)
    own, other = (relaxation, creep) if kind == "relaxation" else (creep, relaxation)
    steady = write(tmp_path / "s.csv", "time_s,stress [Pa],strain [1]", time, 9 * (1 - np.exp(-time)), time / 1e3)
    assert not any("python -m fitting" in note for note in read_time_test(steady, "relaxation").notes)
    assert any("python -m fitting" in note for note in read_time_test(other, kind).notes)
    assert not any("python -m fitting" in note for note in read_time_test(own, kind).notes)


@pytest.mark.parametrize("sizes", [(), ("--radius", "0.004", "--height", "0.002")])
def test_errors_of_a_test_in_time_contain_the_size_of_the_sample(sizes, tmp_path):
    """The errors are 50 um of 4 mm or 2 mm, and four times 10 um of the radius. Ratios and times are not affected."""
    t = np.geomspace(0.01, 100, 40)
    noisy = (500 + 300 * np.exp(-t)) * (1 + 0.002 * np.random.default_rng(0).standard_normal(40))
    file = write(tmp_path / "t.csv", "time_s,relaxation_modulus_Pa", t, noisy)
    assert main(["relaxation", str(file), *sizes, "--modes", "1", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "fit.json").read_text())
    total, noise = found["total_errors"], found["standard_errors"]
    size = np.hypot(50e-6 / 0.002, 40e-6 / 0.004) if sizes else np.hypot(50e-6 / 0.004, 40e-6 / 0.010)
    for name in ("shear_modulus", "equilibrium_modulus"):
        assert total[name] == pytest.approx(np.hypot(size * found[name], noise[name]), rel=1e-6)
    assert total["ratios"] == noise["ratios"] and total["relaxation_times"] == noise["relaxation_times"]


@pytest.mark.parametrize(("kind", "power"), [("angle_rad,torque_N.m", 4), ("displacement_m,force_N", 2)])
def test_a_wrong_radius_counts_twice_for_force_and_four_times_for_torque(kind, power, tmp_path):
    """Force counted four times too: the total error was 2 % of G0 for a radius of 2 mm, and not 1 %."""
    t = np.geomspace(0.01, 100, 40)
    noisy = (500 + 300 * np.exp(-t)) * (1 + 0.002 * np.random.default_rng(0).standard_normal(40))
    file = write(tmp_path / "t.csv", f"time_s,{kind}", t, np.full(40, 1e-4), 1e-6 * noisy)
    sizes = ["--radius", "0.002", "--height", "0.02", "--ramp", "0", "--modes", "1", "--out", str(tmp_path)]
    assert main(["relaxation", str(file), *sizes]) == 0
    found = json.loads((tmp_path / "fit.json").read_text())
    relative = found["error_shares"]["geometry"]["shear_modulus"] / found["shear_modulus"]
    assert relative == pytest.approx(np.hypot(50e-6 / 0.02, power * 10e-6 / 0.002))


def test_the_size_of_a_sample_with_a_modulus_is_used_for_the_total_errors(tmp_path):
    """The note said that the size is not used."""
    file = write(tmp_path / "t.csv", "time_s,relaxation_modulus_Pa", np.arange(1.0, 9), 500 - np.arange(8.0))
    (note,) = read_time_test(file, "relaxation", Sample(0.004, 0.002), ramp=0.0).notes
    assert "does not change the moduli" in note and "used only for the total errors" in note


def test_a_strain_in_percent_without_a_unit_is_told(tmp_path):
    """A strain of 5, meant as 5 %, gave moduli a hundred times too small."""
    rows = "".join(f"{k},5,{90 - k}\n" for k in range(9))
    (tmp_path / "t.csv").write_text("time_s,strain,stress_Pa\n" + rows)
    _, notes = read_columns(tmp_path / "t.csv")
    assert any(
        "the strain reaches 500 %: if the strain is in percent, name the column strain_%" in note for note in notes
    )
    (tmp_path / "t.csv").write_text("time_s,strain_%,stress_Pa\n" + rows)
    columns, notes = read_columns(tmp_path / "t.csv")
    assert columns["strain"][0] == 0.05 and not any("percent" in note for note in notes)


def test_a_balance_shows_forces_in_grams(tmp_path):
    rows = "".join(f"{k},{0.1 * k},{9 * k}\n" for k in range(9))
    (tmp_path / "t.csv").write_text("time_s,displacement_mm,force_g\n" + rows)
    force = read_columns(tmp_path / "t.csv")[0]["force"]
    assert np.allclose(force, 9 * np.arange(9) * 9.80665e-3)  # standard gravity, CGPM 1901


def test_a_tensile_test_without_a_whole_row_is_refused(tmp_path):
    """A file of shear got this sentence, and a file of tension a traceback."""
    rows = "".join(f"{k},,{k}\n" for k in range(6))
    (tmp_path / "t.csv").write_text("time_s,tensile strain [1],tensile stress [Pa]\n" + rows)
    with pytest.raises(InputError, match="every row has a cell that is empty or not finite; give numbers"):
        read_columns(tmp_path / "t.csv")


def test_rows_that_are_comments_are_not_read(tmp_path):
    """The value 9999 at 6 s was fitted. A line of units may also begin with `#`."""
    rows = [f"{'#' if k == 5 else ''}{k},{k + 1},{9999 if k == 5 else 900 - k}\n" for k in range(10)]
    (tmp_path / "t.csv").write_text("no,time_s,relaxation_modulus_Pa\n" + "".join(rows))
    columns, _ = read_columns(tmp_path / "t.csv")
    assert columns["time"].tolist() == [1, 2, 3, 4, 5, 7, 8, 9, 10] and columns["modulus"].max() == 900
    (tmp_path / "t.csv").write_text("# no,time,relaxation modulus\n# -,min,kPa\n" + "".join(rows))
    columns, _ = read_columns(tmp_path / "t.csv")
    assert columns["time"][0] == 60 and columns["modulus"].max() == 900e3


@pytest.mark.parametrize(
    ("read", "header", "row"),
    [
        (read_columns, "time_s,relaxation_modulus_kPa", "{k},1,856"),
        (read_columns, "time_s,relaxation_modulus_kPa,", "{k},1,856,"),
        (read_columns, "# time_s,relaxation_modulus_kPa", "{k},1,856"),
        (read_indentation, "depth_mm,force_mN", "{k},0,{k}"),
        (read_dispersion, "frequency_Hz,phase_velocity_m/s", "{k},1,5"),
        (read_waves, ",".join(COLUMNS), "{k},0,0,1,0,0,0,0,0,5"),
        (read_sweep, "frequency_Hz,storage_modulus_kPa,loss_modulus_kPa,", "{k},1,856,3,"),
    ],
)
def test_numbers_to_the_right_of_the_last_heading_are_refused(read, header, row, tmp_path):
    """A decimal comma cut the number: 1,856 kPa became 1 kPa. Remarks and empty cells may follow the numbers."""
    (tmp_path / "t.csv").write_text(header + "\n" + "".join(row.format(k=k) + "\n" for k in range(1, 9)))
    with pytest.raises(InputError, match=r"line 2: there are .* write decimals with a point"):
        read(tmp_path / "t.csv")


def test_cells_to_the_right_are_refused_only_if_the_columns_may_be_wrong(tmp_path):
    """A remark that began with a digit was refused as if decimal commas were the cause."""
    rows, file = [f"{k};{900 - k}" for k in range(1, 9)], tmp_path / "t.csv"

    def modulus(head: str, *ends: str) -> list[float]:
        file.write_text("\n".join([head, *(row + end for row, end in zip(rows, [*ends, *[""] * 8], strict=False))]))
        return read_columns(file)[0]["modulus"].tolist()

    remarks = ";2nd sample, 20 C", ";12:30:05", ";;room;37", ";", ";dropped;5"
    assert modulus("time_s;modulus_Pa", *remarks) == modulus("time_s;modulus_Pa;;", ";1;0") == list(range(899, 891, -1))
    with pytest.raises(InputError, match="line 2: there are 3 cells under 2 headings; remove the cells to the right"):
        modulus("time_s;modulus_Pa", ";0")
    file.write_text("frequency (Hz);G' (Pa);G'' (Pa);;\n" + "".join(f"{k};{900 + k};{k};1;0\n" for k in range(1, 9)))
    assert len(read_sweep(file).angular_frequency) == 8
    file.write_text("time_s,modulus_Pa\n" + "".join(f"{k},{9 - k},2nd sample,20 C\n" for k in range(1, 9)))
    assert len(read_columns(file)[0]["modulus"]) == 8


def test_remarks_and_empty_cells_may_follow_the_numbers(tmp_path):
    (tmp_path / "t.csv").write_text("time_s,modulus_Pa\n# 1,2,3\n1,900,,\n2,800,dropped,\n3,700\n4,600,\n")
    assert read_columns(tmp_path / "t.csv")[0]["modulus"].tolist() == [900, 800, 700, 600]


@pytest.mark.parametrize("header", ["time_s,modulus_Pa", "time_s,compliance_1/Pa", "time_s,force_nN,displacement_m"])
def test_a_number_beyond_any_measurement_is_refused(header, tmp_path):
    """9.91e37, which instruments write for a missing value, was fitted as a modulus."""
    more = ",1e-3" * (header.count(",") - 1)
    (tmp_path / "t.csv").write_text(
        header + "\n" + "".join(f"{k},{9.91e37 if k == 4 else k}{more}\n" for k in range(9))
    )
    with pytest.raises(InputError, match=r"9.91e.37 is beyond any measurement; correct the unit or the row"):
        read_columns(tmp_path / "t.csv")


@pytest.mark.parametrize("speed", ["1e300", "1e-300"])
def test_a_velocity_beyond_any_measurement_is_refused(speed, tmp_path):
    """Its modulus was infinite or 0."""
    rows = "".join(f"{hertz},{speed if hertz == 20 else 2}\n" for hertz in (10, 20, 40, 80))
    (tmp_path / "w.csv").write_text("frequency_Hz,phase_velocity_m/s\n" + rows)
    with pytest.raises(InputError, match=r"velocity 1e.?300 is beyond any measurement; correct the unit or this row"):
        read_dispersion(tmp_path / "w.csv")
