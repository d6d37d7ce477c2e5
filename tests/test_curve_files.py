"""Files of stress and stretch: headings, components, several samples, columns with another quantity."""

import json
import re

import numpy as np
import pytest
from test_curves import KNOWN

from fitting.__main__ import main
from fitting.fits import stress_stretch
from fitting.readers import curves
from fitting.readers.tables import text_tables
from liverjax.core.errors import InputError
from liverjax.laws import homogeneous

pytestmark = pytest.mark.quick_to_compile


def test_a_measured_stretch_of_sheared_samples_is_one_curve(tmp_path):
    """The stretches 1, 1.0 and 1.0004 were read as three curves."""
    shear = np.linspace(0, 0.5, 12)
    rows = [f"simple_shear,{('1', '1.0', '1.0004')[k % 3]},{x:.4f},{x:.5f}" for k, x in enumerate(shear)]
    rows += [f"simple_shear,0.9,{x:.4f},{x:.5f}" for x in shear]
    file = tmp_path / "s.csv"
    file.write_text("\n".join(["test,stretch,shear,nominal_stress_kPa", *rows]) + "\n")
    found, _ = curves.read_curves([file])
    assert [(c.label, len(c.stress)) for c in found] == [("s, simple shear", 12), ("s, simple shear at 0.9", 12)]
    file.write_text("\n".join(["test,shear,nominal_stress_kPa", *(f"simple_shear,{x:.4f},{x:.5f}" for x in shear)]))
    ((curve,), _) = curves.read_curves([file])
    assert np.allclose(curve.F[:, 0, 0], 1) and len(curve.stress) == 12


@pytest.mark.parametrize("at", [0.995, 1.005, 0.9])
def test_a_stretch_that_scatters_about_a_rounded_one_is_one_sample(tmp_path, at):
    """A stretch of 0.995 +- 0.0005 was read as two curves of six rows each."""
    shear = np.linspace(0, 0.5, 12)
    own = at + 5e-4 * np.random.default_rng(1).uniform(-1, 1, 12)
    rows = [f"simple_shear,{s:.5f},{x:.4f},{x:.5f}" for s, x in zip(own, shear, strict=True)]
    (tmp_path / "s.csv").write_text("\n".join(["test,stretch,shear,nominal_stress_kPa", *rows]) + "\n")
    ((curve,), _) = curves.read_curves([tmp_path / "s.csv"])
    assert len(curve.stress) == 12


def test_a_component_of_single_precision_roundoff_is_no_curve(tmp_path):
    """A component P22 of 1e-7 of the stress was scaled by its own size and spoiled the fit."""
    rows = ["F11,F12,F13,F21,F22,F23,F31,F32,F33,P11_Pa,P22_Pa,P33_Pa"]
    r = np.random.default_rng(0).normal(size=(12, 2))
    for k, a in enumerate(np.linspace(1.03, 1.4, 12)):
        b, P = a**-0.5, 770 * (a - a**-2)
        rows.append(f"{a:.9f},0,0,0,{b:.9f},0,0,0,{b:.9f},{P:.9g},{1e-4 * r[k, 0]:.9g},{1e-4 * r[k, 1]:.9g}")
    (tmp_path / "a.csv").write_text("\n".join(rows))
    ((curve,), _) = curves.read_curves([tmp_path / "a.csv"])
    assert curve.component == (0, 0)


def test_one_wrong_stretch_is_not_taken_for_several_samples(tmp_path):
    """A mistyped stretch in a rising curve was taken for a reversal in a third of such files."""
    stretch = np.linspace(1.02, 1.5, 20)
    for k, wrong in ((6, 1.45), (12, 1.04), (10, 1.02)):
        moved = stretch.copy()
        moved[k] = wrong
        lines = [f"uniaxial,{s:.4f},{1e3 * (x - x**-2.0):.6g}" for s, x in zip(moved, stretch, strict=True)]
        (tmp_path / "c.csv").write_text("\n".join(["test,stretch,nominal_stress_Pa", *lines]) + "\n")
        assert not any("reverses" in note for note in curves.read_curves([tmp_path / "c.csv"])[1])


def test_several_ratios_of_the_stretches_are_no_return(tmp_path):
    """For biaxial tests with three ratios in one file, the message advised keeping only one of them."""

    def notes_of(ratios) -> list[str]:
        lines = ["F11,F22,F33,P11_Pa,P22_Pa"]
        for k, ratio in enumerate(ratios):
            for e in np.linspace(0.02, 0.25, 8):
                a, b = 1 + e, 1 + ratio * e
                P, Q = ((200 + k) * (own - 1 / (a * b) ** 2 / own) for own in (a, b))
                lines.append(f"{a:.9f},{b:.9f},{1 / (a * b):.9f},{P:.9g},{Q:.9g}")
        (tmp_path / "b.csv").write_text("\n".join(lines) + "\n")
        return [note for note in curves.read_curves([tmp_path / "b.csv"])[1] if "reverses" in note]

    assert not notes_of((1.0, 0.5, 0.0)) and not notes_of((0.2, 0.0))
    assert "reverses once" in notes_of((0.5, 0.5))[0]


@pytest.mark.ci
def test_unloading_preload_and_decimal_commas_are_seen(tmp_path, capsys):
    up = np.linspace(1.0, 1.4, 41)
    stress = 1e3 * (up - up**-2)
    rows = [(s, p) for s, p in zip(up, stress, strict=True)]
    back = [(s, 0.7 * p) for s, p in rows[-2::-1]]

    def read(rows, between=",", point="."):
        lines = [between.join(["test", "stretch", "nominal_stress_Pa"])]
        lines += [between.join(["uniaxial", *(f"{v:.6f}".replace(".", point) for v in row)]) for row in rows]
        (tmp_path / "c.csv").write_text("\n".join(lines) + "\n")
        return curves.read_curves([tmp_path / "c.csv"])

    (plain,), notes = read(rows)
    assert not notes and not stress_stretch.loaded_at_rest([plain])
    second = [(s, 0.99 * p) for s, p in rows + back]  # equal rows would be copies
    assert "reverses once" in read(rows + back)[1][0] and "reverses 3 times" in read(rows + back + second)[1][0]
    assert "reverses 2 times" in read([(s, f * p) for f in (0.7, 1.0, 1.3) for s, p in rows])[1][0]  # three samples
    with pytest.raises(InputError, match=r"stretches of 0\.5 and 30 do not have opposite stresses"):  # strains in %
        read([(s, 10 * s) for s in np.linspace(0.5, 30, 20)])
    assert not read(rows + [(2 - s, 1e3 * (2 - s - (2 - s) ** -2.0)) for s, _ in rows])[1]  # tension, then compression
    (german,), notes = read(rows, ";", ",")
    assert not notes and np.array_equal(german.stress, plain.stress)
    (loaded,), _ = read([(s, p + 0.15 * stress.max()) for s, p in rows])
    (words,) = stress_stretch.loaded_at_rest([loaded])
    assert "where the sample is not deformed" in words and "subtract the preload" in words
    read([(s, p + 0.15 * stress.max()) for s, p in rows])
    assert main(["curves", "neo_hookean", str(tmp_path / "c.csv"), "--out", str(tmp_path)]) == 0
    assert "subtract the preload" in capsys.readouterr().err


def test_the_stress_of_a_stretched_sample_without_shear_is_no_preload():
    """A sample was stretched by 20 % and then sheared. Its tensile stress without shear was taken for a preload."""
    shear = np.linspace(0.0, 0.5, 11)
    for stretch, told in ((1.2, 0), (1.0, 1)):
        F = np.tile(np.diag([stretch, stretch**-0.5, stretch**-0.5]), (11, 1, 1))
        F[:, 0, 1] = shear
        words = stress_stretch.loaded_at_rest([curves.Curve("a", "simple_shear", F, (0, 0), 506 + 1000 * shear**2)])
        assert len(words) == told and all("where the sample is not deformed" in own for own in words)


MEANINGS = {
    "none": (lambda a, P: (a, P), ""),
    "true stress": (lambda a, P: (a, P * a), "if the stress were true stress"),
    "logarithm": (lambda a, P: (1 + np.log(a), P), r"if the stretch were 1 \+ logarithmic strain"),
    "zero": (lambda a, P: (a + 0.05, P), "if the zero of the stretch were off by 0.05"),
    "offset": (lambda a, P: (a, P + 150.0), "if an offset of 1[45].* Pa were in the stress"),
}


@pytest.mark.parametrize("meaning", MEANINGS)
def test_columns_that_hold_something_else_are_named(meaning, tmp_path, capsys):
    """The sample is neo-Hookean with 1 kPa and 1 % of noise. The law fitted wrong columns with 40 % misfit, without a
    message.
    """
    change, words = MEANINGS[meaning]
    stretch = np.linspace(1.0, 1.6, 25)
    noise = np.random.default_rng(7).standard_normal(25)
    a, P = change(stretch, 1000.0 * (stretch - stretch**-2) + 10.0 * noise)
    rows = "".join(f"uniaxial,{x:.6g},{p:.6g}\n" for x, p in zip(a, P, strict=True))
    (tmp_path / "c.csv").write_text("test,stretch,nominal_stress_Pa\n" + rows)
    assert main(["curves", "neo_hookean", str(tmp_path / "c.csv"), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert ("structured misfit" in said) == bool(words) and re.search(words, said)
    told = json.loads((tmp_path / "curves.json").read_text())["structured_misfit"]
    if words:
        assert 980 < float(told[0].split("G0 ")[1].split(" Pa")[0]) < 1020


@pytest.mark.ci
def test_two_meanings_that_explain_the_data_alike_are_both_named(tmp_path, capsys):
    """The zero of the stretch is wrong. An offset of the stress explains the data as well, and only it was named."""
    stretch = np.linspace(1.0, 1.4, 30)
    P = 1000 * np.exp(1.5 * (stretch**2 + 2 / stretch - 3)) * (stretch - stretch**-2)
    P += 5 * np.random.default_rng(0).standard_normal(30)
    rows = "".join(f"uniaxial,{x:.6g},{p:.6g}\n" for x, p in zip(stretch + 0.01, P, strict=True))
    (tmp_path / "c.csv").write_text("test,stretch,nominal_stress_Pa\n" + rows)
    assert main(["curves", "fung_demiray", str(tmp_path / "c.csv"), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert "if the zero of the stretch were off by 0.0" in said and "an offset of -" in said


def test_components_and_named_tests_are_the_same_data(tmp_path):
    l, g = np.linspace(0.8, 1.2, 5), np.linspace(0, 0.3, 4)
    names = [f"{a}{i}{j}" for a in "FP" for i in (1, 2, 3) for j in (1, 2, 3)]
    rows = [",".join(names).replace("P11", "P11_kPa")]
    for v in l:
        F = np.asarray(homogeneous.deformation_gradient("uniaxial", v)).ravel()
        rows.append(",".join(f"{x:.12g}" for x in [*F, v - 1, *np.zeros(8)]))
    (tmp_path / "components.csv").write_text("\n".join(rows))
    simple = ["# tension, and shear at a stretch of 1.1", "test,stretch,shear,nominal_stress_kPa"]
    simple += [f"uniaxial,{v},,{v - 1}" for v in l] + [f"simple_shear,1.1,{v},{v}" for v in g]
    (tmp_path / "named.csv").write_text("\n".join(simple))
    found, notes = curves.read_curves([tmp_path / "components.csv", tmp_path / "named.csv"])
    assert not notes
    assert [c.test for c in found] == ["uniaxial", "uniaxial", "simple_shear"]
    assert np.allclose(found[0].F, found[1].F) and np.allclose(found[0].stress, found[1].stress)
    assert np.isclose(found[1].stress[0], -200.0)
    assert np.allclose(found[2].F[:, 0, 0], 1.1) and found[2].component == (0, 1)


def test_the_same_file_twice_is_refused(tmp_path, capsys):
    rows = "".join(f"uniaxial,{1 + 0.1 * k},{k}\n" for k in range(6))
    files = [tmp_path / name for name in ("a.csv", "b.csv")]
    for file in files:
        file.write_text("test,stretch,nominal_stress_Pa\n" + rows)
    assert main(["curves", "neo_hookean", *map(str, files), "--out", str(tmp_path)]) == 2
    assert "is the same measurement as" in capsys.readouterr().err
    files[1].write_text("# a comment\n" + files[0].read_text())
    assert main(["curves", "neo_hookean", *map(str, files), "--out", str(tmp_path)]) == 2
    assert "b, uniaxial has the same numbers as a, uniaxial" in capsys.readouterr().err


def test_remarks_after_the_numbers_and_a_second_heading_are_no_matter(tmp_path):
    rows = "".join(f"uniaxial,{1 + 0.1 * k},{k},{k},slipped\n" for k in range(6))
    (tmp_path / "c.csv").write_text(f"test,stretch,Stretch,nominal_stress_kPa\n{rows}")
    (found,), _ = curves.read_curves([tmp_path / "c.csv"])
    assert np.allclose(found.stress, 1e3 * np.arange(6)) and np.isclose(found.F[-1, 0, 0], 1.5)


def test_components_of_one_test_are_of_one_sample(tmp_path):
    """Components of one test have no individual factors."""
    a, b = np.linspace(1.02, 1.4, 9), np.linspace(1.01, 1.2, 9)
    F = np.stack([np.diag(each) for each in np.stack([a, b, 1 / (a * b)], axis=1)])
    head = ",".join([*(f"F{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "P11_Pa", "P22_Pa"])
    P = np.stack([np.linspace(10, 100, 9), np.linspace(5, 60, 9)], axis=1)
    np.savetxt(tmp_path / "c.csv", np.column_stack([F.reshape(9, 9), P]), "%.12g", ",", header=head, comments="")
    found, _ = curves.read_curves([tmp_path / "c.csv"])
    assert len(found) == 2 and {c.sample for c in found} == {str(tmp_path / "c.csv")}


def test_rows_without_a_stress_are_left_out_and_counted(tmp_path):
    rows = "".join(f"uniaxial,{1 + 0.1 * k},{'' if k == 3 else k}\n" for k in range(6))
    (tmp_path / "c.csv").write_text(f"test,stretch,nominal_stress_kPa\n{rows}")
    (found,), notes = curves.read_curves([tmp_path / "c.csv"])
    assert np.allclose(found.stress, 1e3 * np.array([0, 1, 2, 4, 5]))
    assert notes == ["c.csv: 1 rows without a stress are ignored"]


@pytest.mark.parametrize("last", ["uniaxial,1.2,570,Mean", "Mean,1.2,570,", "Mean,,570,"])
def test_a_summary_below_a_curve_is_no_point(last, tmp_path):
    """The mean of the stresses was fitted as a point of the curve."""
    rows = [f"uniaxial,{a:.2f},{1000 * (a - a**-2):.4f}," for a in np.linspace(1.05, 1.4, 8)]
    (tmp_path / "a.csv").write_text("\n".join(["test,stretch,nominal_stress_Pa,remark", *rows, last]))
    (curve,), notes = curves.read_curves([tmp_path / "a.csv"])
    assert len(curve.stress) == 8
    assert notes == ["a.csv: data row 9 is a summary of other rows (Mean) and is ignored"]


def test_headings_with_capitals_and_without_a_unit_are_read(tmp_path):
    rows = "".join(f"uniaxial,{1 + 0.1 * k},{k}\n" for k in range(6))
    (tmp_path / "c.csv").write_text(f"Test,Stretch [-],Nominal stress [kPa]\n{rows}")
    (found,), notes = curves.read_curves([tmp_path / "c.csv"])
    assert np.allclose(found.stress, 1e3 * np.arange(6)) and not notes


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "latin-1", "utf-8-sig"])
def test_curves_of_any_encoding_are_read_below_their_title(encoding, tmp_path):
    rows = "".join(f"uniaxial,{1 + 0.1 * k},{k}\n" for k in range(6))
    text = f"Versuch an Gewebe für Müller\n\ntest,stretch,nominal_stress_kPa\n{rows}"
    (tmp_path / "c.csv").write_bytes(text.encode(encoding))
    (found,), notes = curves.read_curves([tmp_path / "c.csv"])
    assert np.allclose(found.stress, 1e3 * np.arange(6)) and not notes


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "has columns a, b"),
        ("test,strain,nominal_stress_kPa\nuniaxial,0.1,2\n", "for the column strain: stretch = 1 + strain"),
        (
            "test,Strain (%),shear,nominal_stress_kPa\nuniaxial,1,,2\n",
            "for the column Strain (%): stretch = 1 + strain",
        ),
        ("test,stretch,nominal_stress_kPa\nbending,1,2\n", "'bending' is not known"),
        ("test,stretch,nominal_stress_kPa\nuniaxial,1,x\nuniaxial,2,3\nuniaxial,3,3\n", "'x' is not a number"),
        ("test,stretch,nominal_stress_kPa\nuniaxial,1,inf\nuniaxial,2,3\nuniaxial,3,3\n", "not finite"),
        ("test,stretch,nominal_stress_kPa\nuniaxial,-1,1\nuniaxial,2,3\nuniaxial,3,3\n", "not possible"),
        ("test,stretch,nominal_stress_kPa\nuniaxial,1,1\nuniaxial,2,3\n", "at least 3"),
        ("test,stretch,nominal_stress_kPa\nuniaxial,2,1\nuniaxial,6,3\nuniaxial,9,4\n", "do not begin near 1"),
        ("test,shear,nominal_stress_Pa\n" + "".join(f"simple_shear,{k},{k}\n" for k in (0, 10, 30)), "2 % as 0.02"),
        ("test,stretch,nominal_stress_kPa\nuniaxial,1,05,0,143\nuniaxial,1,1,0,3\n", "5 cells under 3 headings"),
        ("test,stretch,force_N\nuniaxial,1,1\n", "no column nominal_stress_Pa"),
        ("test,stretch,stretch,nominal_stress_Pa\nuniaxial,1,2,1\n", "has two columns stretch: remove one"),
        ("test,stretch,nominal_stress_Pa,nominal_stress_Pa\nuniaxial,1,2,1\n", "two columns nominal_stress_Pa"),
        (
            "test,stretch,nominal_stress_Pa,nominal_stress_kPa\nuniaxial,1,2,1\n",
            "two columns of one stress, nominal_stress_Pa and nominal_stress_kPa: remove one",
        ),
        ("test,stretch,nominal_stress_kPa\nuniaxial,0.9,1\nuniaxial,1.1,-1\nuniaxial,1.2,-2\n", "point against"),
    ],
)
def test_bad_files_get_one_sentence(text, sentence, tmp_path, capsys):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    assert main(["curves", "neo_hookean", str(file), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1


def test_components_that_cannot_be_used_are_refused(tmp_path, capsys):
    names = ",".join(f"{a}{i}{j}" for a in "FP" for i in (1, 2, 3) for j in (1, 2, 3))

    def run(*rows):
        file = tmp_path / "bad.csv"
        file.write_text("\n".join([names, *rows]))
        assert main(["curves", "yeoh", str(file), "--out", str(tmp_path / "out")]) == 2
        return capsys.readouterr().err

    swollen = "1.2,0,0,0,1,0,0,0,1," + "5,0,0,0,0,0,0,0,0"
    assert "det F = 1.2" in run(swollen, swollen, swollen)
    loaded = "1,0,0,0,1,0,0,0,1," + "0,0,0,0,0,0,0,0,5"
    assert "P13 … P33 are not 0" in run(loaded, loaded, loaded)
    silent = "1,0,0,0,1,0,0,0,1," + "0,0,0,0,0,0,0,0,0"
    assert "zero or missing" in run(silent, silent, silent)


def test_tension_along_another_axis(tmp_path):
    l = np.linspace(0.8, 1.4, 13)
    names = ",".join(f"{a}{i}{j}" for a in "FP" for i in (1, 2, 3) for j in (1, 2, 3))
    rows = [f"{v**-0.5},0,0,0,{v},0,0,0,{v**-0.5},0,0,0,0,{2000 * (v - v**-2)},0,0,0,0" for v in l]
    (tmp_path / "axis2.csv").write_text("\n".join([names, *rows]))
    found, _ = curves.read_curves([tmp_path / "axis2.csv", tmp_path / "axis2.csv"])
    assert len({c.label for c in found}) == 2
    (candidate,) = stress_stretch.candidates("neo_hookean")
    assert np.isclose(stress_stretch.fit(candidate, found).values[0], 2000.0)


def test_components_without_a_column_of_shear(tmp_path):
    F = np.asarray(homogeneous.deformation_gradient("uniaxial", np.linspace(0.8, 1.4, 13)))
    P = np.asarray(homogeneous.response(KNOWN["neo_hookean"], "uniaxial", np.linspace(0.8, 1.4, 13)))
    rows = np.column_stack([F[:, 0, 0], F[:, 1, 1], F[:, 2, 2], P])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="F11,F22,F33,P11_Pa", comments="")
    ((curve,), _) = curves.read_curves([tmp_path / "a.csv"])
    assert curve.test == "uniaxial" and np.allclose(curve.F, F)
    np.savetxt(tmp_path / "b.csv", rows[:, [0, 1, 3]], delimiter=",", header="F11,F22,P11_Pa", comments="")
    with pytest.raises(InputError, match="has no column F33: give F11, F22 and F33"):
        curves.read_curves([tmp_path / "b.csv"])


@pytest.mark.parametrize(
    ("heading", "used"),
    [("nominal_stress_sd_kPa", False), ("stress sd [kPa]", False), ("SD", False), ("sample", True), ("side_mm", True)],
)
def test_deviations_are_named_as_not_used(heading, used, tmp_path):
    """The fit estimates the noise from the residuals. A file with deviations gave the same results, without a
    message.
    """
    rows = "".join(f"uniaxial,{l:g},{l - l**-2:g},0.02\n" for l in np.linspace(1.05, 1.5, 10))
    (tmp_path / "c.csv").write_text(f"test,stretch,nominal_stress_kPa,{heading}\n{rows}")
    found, notes = curves.read_curves([tmp_path / "c.csv"])
    assert len(found) == 1 and [f"{heading} is not used" in note for note in notes] == [True] * (not used)


def test_a_wrong_row_is_named(tmp_path):
    """A stress that was a tenth of the true one made the modulus 5 % too low, without a message."""
    stretch = np.linspace(1.02, 1.4, 30)
    stress = 1000 * (stretch - stretch**-2)
    stress[20] /= 10
    rows = "".join(f"uniaxial,{l:.6g},{p:.6g}\n" for l, p in zip(stretch, stress, strict=True))
    (tmp_path / "a.csv").write_text(f"test,stretch,nominal_stress_Pa\n{rows}")
    notes = curves.read_curves([tmp_path / "a.csv"])[1]
    assert sum(f"the stress {stress[20]:.4g} Pa at 1.282 is far from its neighbours" in note for note in notes) == 1


def test_a_column_of_deviations_is_not_the_column_of_the_stress(tmp_path):
    """Rows without a standard deviation were ignored as rows without a stress."""
    rows = "".join(f"uniaxial,{1 + 0.05 * k},{'' if k % 2 else 0.1},{k}\n" for k in range(1, 9))
    (tmp_path / "c.csv").write_text(f"test,stretch,nominal_stress_sd_kPa,nominal_stress_kPa\n{rows}")
    (found,), notes = curves.read_curves([tmp_path / "c.csv"])
    assert np.allclose(found.stress, 1e3 * np.arange(1, 9)) and not any("without a stress" in note for note in notes)


def test_copies_of_all_rows_count_once(tmp_path):
    """Each copy counted as a measurement, so the errors were too small, and the law was called inadequate."""
    rows = [f"uniaxial,{1 + 0.01 * k:.2f},,{0.03 * k:.2f}\n" for k in range(12)]
    held = rows[:6] + rows[5:6] * 4 + rows[6:]  # rows of a held load are no copies
    shear = [f"simple_shear,,{0.1 * k:.1f},{0.1 * k:.1f}\n" for k in range(5)]
    file, found = tmp_path / "c.csv", []
    for written in (held, [row for row in held for _ in (0, 1)], held + held, held + shear + shear):
        file.write_text("test,stretch,shear,nominal_stress_kPa\n" + "".join(written))
        found.append(curves.read_curves([file]))
    assert found[0][1] == []
    for read, notes in found[1:]:
        assert np.array_equal(read[0].stress, found[0][0][0].stress)
        assert len(notes) == 1 and "rows are ignored, because they are copies of other rows" in notes[0]
    assert len(found[3][0][1].stress) == 5 and "c.csv: 5 rows are" in found[3][1][0]


def test_a_comment_may_follow_the_numbers_of_a_row(tmp_path):
    """A row with "0.21 # slipped" was refused. Commas and numbers in the comment do not matter."""
    rows = [f"3 #2,uniaxial,{1 + 0.05 * k:.2f},{0.2 * k:.1f}" for k in range(1, 9)]
    rows[0] += " # slipped, 3 times, 4"
    rows[1] += ",# slipped, 3 times"
    rows[2] += ",a remark"
    (tmp_path / "c.csv").write_text("\n".join(["sample,test,stretch,nominal_stress_kPa", *rows]) + "\n")
    ((found,), _) = curves.read_curves([tmp_path / "c.csv"])
    assert np.allclose(found.stress, 200 * np.arange(1, 9)) and np.allclose(found.driven, 1 + 0.05 * np.arange(1, 9))
    cells = text_tables.without_comments(["3 #2", "1e-3# x", "5 # y", "7"], [False, True, True])
    assert cells == ["3 #2", "1e-3", "5"]
