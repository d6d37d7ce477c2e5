"""Other quantities in a sweep's columns: tension, radians, other temperatures, unusable points."""

import numpy as np
import pytest
from test_rheometer import HEADER, ROWS, _write

from fitting.readers.rheometer import read_all_sweeps, read_sweep
from liverjax import InputError


def test_moduli_beside_columns_of_a_dma_may_be_those_of_tension(tmp_path):
    """E taken for G is three times too large. The headings of the moduli alone do not show this."""
    head, rows = "Frequency (Hz),{}Storage Modulus (kPa),{}Loss Modulus (kPa),{},remark\n", "0.1,9,1,2,2\n1,10,2,2,2\n"
    told = {}
    for own, beside in (
        ("", "Static Force (N)"),
        ("", "Length (mm)"),
        ("", "Axial force (N)"),
        ("Shear ", "Length (mm)"),
        ("", "Dynamic strain (%),Torque (uN.m)"),
    ):
        s = read_sweep(_write(tmp_path, head.format(own, own, beside) + rows))
        assert np.allclose(s.storage, [9000, 10000])
        told[own + beside] = [n for n in s.notes if "if the numbers are moduli E, three times as large" in n]
    assert [len(said) for said in told.values()] == [1, 1, 0, 0, 0]


def test_viscosities_are_named_as_not_read(tmp_path):
    with pytest.raises(InputError, match=r"viscosities are not read \(convert them to \|G\*\| = omega \|eta\*\|"):
        read_sweep(_write(tmp_path, "frequency_Hz,complex viscosity (Pa.s),tan(delta)\n1,9,0.1\n2,8,0.1\n"))


def test_two_units_that_tear_the_moduli_apart_are_told(tmp_path):
    rows = "0.1,900,100\n1,1000,200\n10,1200,300\n"
    told = {}
    for storage, loss in (("kPa", "Pa"), ("Pa", "kPa"), ("kPa", "kPa")):
        notes = read_sweep(_write(tmp_path, f"Frequency (Hz),G' ({storage}),G'' ({loss})\n{rows}")).notes
        told[storage, loss] = [n for n in notes if "if both are in one unit" in n]
    assert "is in kPa" in told["kPa", "Pa"][0] and "5e+03 times" in told["kPa", "Pa"][0] and told["Pa", "kPa"]
    elastic = "".join(f"{row.rpartition(',')[0]},1\n" for row in rows.splitlines())  # a spring: one unit or two
    assert not told["kPa", "kPa"]
    assert not read_sweep(_write(tmp_path, f"Frequency (Hz),G' (kPa),G'' (kPa)\n{elastic}")).notes


@pytest.mark.parametrize("bad", ["-90", "0", "nan", "1e200"])
def test_unusable_points_are_left_out_and_named(tmp_path, bad):
    rows = "0.01,200,20\n" + ROWS.replace("90", bad)
    s = read_sweep(_write(tmp_path, HEADER + rows))
    assert s.storage.tolist() == [200, 300, 400] and s.loss.tolist() == [20, 30, 60]
    (note,) = s.notes
    told = "loss_modulus_Pa is empty" if bad == "nan" else f"loss_modulus_Pa = {float(bad):g} is "
    assert "1 of 4 points is ignored" in note and f"line 5: {told}" in note


def test_too_few_usable_points_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"line 4: loss_modulus_Pa = -90 is not positive; correct"):
        read_sweep(_write(tmp_path, HEADER + ROWS.replace("90", "-90")))
    two = "storage_modulus_Pa,loss_modulus_Pa,frequency_Hz\n300,30,1\n301,30,1\n302,30,2\n303,-30,3\n"
    with pytest.raises(InputError, match="line 5"):  # three points remain, but at two frequencies only
        read_sweep(_write(tmp_path, two))
    falling = "".join(f"{k},{300 + k},{30 if k < 4 else -30}\n" for k in range(1, 9))
    with pytest.raises(InputError, match=r"line 5: .* is not positive \(and 4 more points are unusable\)"):
        read_sweep(_write(tmp_path, HEADER + falling))
    spread = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,storage_sd_Pa,loss_sd_Pa\n"
    s = read_sweep(_write(tmp_path, spread + "".join(f"{k},300,30,{k - 1},3\n" for k in range(1, 6))))
    assert len(s.storage) == 4 and "storage_sd_Pa = 0 is not positive" in s.notes[0]


def test_moduli_of_tension_are_thirds_and_said(tmp_path):
    text = "Frequency,E_stor,E_loss\nHz,MPa,MPa\n1,0.3,0.03\n2,0.6,0.06\n4,0.9,0.09\n"
    s = read_sweep(_write(tmp_path, text))
    assert np.allclose(s.storage, [1e5, 2e5, 3e5]) and np.allclose(s.loss, [1e4, 2e4, 3e4])
    assert any("G = E / 3 is used" in n for n in s.notes)
    primes = read_sweep(_write(tmp_path, "f [Hz],E' [MPa],E'' [MPa]\n1,0.3,0.03\n2,0.6,0.06\n4,0.9,0.09\n"))
    assert np.allclose(primes.storage, s.storage)
    both = "frequency_Hz,E' (Pa),storage_modulus_Pa,loss_modulus_Pa\n1,900,400,60\n2,999,500,70\n"
    assert read_sweep(_write(tmp_path, both)).storage.tolist() == [400, 500]
    short = "omega_rad_s,Gp_Pa,Gpp_Pa\n1,400,60\n2,500,70\n"
    assert read_sweep(_write(tmp_path, short)).loss.tolist() == [60, 70]


@pytest.mark.parametrize(
    ("column", "first", "last", "words"),
    [
        ("temperature_C", 20, 37, "the temperature changes by 17 K"),
        ("temperature_C", 20, 21, None),
        ("strain_%", 1, 20, "the strain goes from 0.01 to 0.2"),
        ("strain_%", 1, 1.2, None),
    ],
)
def test_what_changes_along_the_frequencies_is_told(tmp_path, column, first, last, words):
    rows = [f"{f},{1000 + f},100,{t}" for f, t in zip((0.1, 1.0, 10.0), np.linspace(first, last, 3), strict=True)]
    head = f"frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,{column}\n"
    (tmp_path / "s.csv").write_text(head + "\n".join(rows) + "\n")
    told = [n for n in read_sweep(tmp_path / "s.csv").notes if "an effect of the frequency" in n]
    assert len(told) == (words is not None) and all(words in n for n in told)


def test_one_modulus_of_tension_makes_the_other_one_too(tmp_path):
    """Only the column with this heading was divided by 3. The loss was three times too large, without a message."""
    rows = "".join(f"{f},{3000 + f},300\n" for f in (0.1, 1.0, 10.0))
    (tmp_path / "s.csv").write_text("frequency_Hz,tensile_storage_modulus_Pa,loss_modulus_Pa\n" + rows)
    found = read_sweep(tmp_path / "s.csv")
    assert np.allclose(found.loss, 100) and any("loss_modulus_Pa are of tension" in n for n in found.notes)
    (tmp_path / "s.csv").write_text("frequency_Hz,tensile_storage_modulus_Pa,shear_loss_modulus_Pa\n" + rows)
    with pytest.raises(InputError, match="name both in the same way"):
        read_sweep(tmp_path / "s.csv")


def test_degrees_that_look_like_radians_are_told(tmp_path):
    rows = "".join(f"{f},1000,{a}\n" for f, a in ((0.1, 0.2), (1.0, 0.3), (10.0, 0.4)))
    (tmp_path / "s.csv").write_text("frequency_Hz,complex_modulus_Pa,phase_angle_deg\n" + rows)
    assert any(
        "if the numbers are radians, name the column phase_rad" in n for n in read_sweep(tmp_path / "s.csv").notes
    )


def test_lines_at_other_temperatures_or_strains_are_told(tmp_path):
    head = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,"
    rows = [(f, 100.0 + f, 10.0) for f in (0.1, 1.0, 10.0)]

    def notes(column, values):
        lines = [f"{f},{a},{b},{v}" for v in values for f, a, b in rows]
        (tmp_path / "s.csv").write_text("\n".join([head + column, *lines]) + "\n")
        return read_sweep(tmp_path / "s.csv").notes[-1]

    assert "the temperatures are 20 to 37 °C" in notes("temperature_C", (20, 37)) and "--master" in notes(
        "temperature_C", (20, 37)
    )
    assert "the strains are 0.01 to 0.5" in notes("strain_%", (1, 50))
    notes("temperature_C", (20, 37))  # users who shift sweeps by temperature read them separately, without this advice
    ((_, apart),) = read_all_sweeps(tmp_path / "s.csv")
    assert not any("--master" in note for note in apart.notes)
    for column, values in (("temperature_C", (20, 21)), ("strain_%", (1, 1.2))):  # nearly the same conditions
        assert "Each line counts as a separate measurement" in notes(column, values)


@pytest.mark.parametrize("wrong", [1.0, 1.1])
@pytest.mark.parametrize(
    ("heading", "values"),
    [
        ("tan_delta", lambda w, S, L: L / S),
        ("phase_deg", lambda w, S, L: np.degrees(np.arctan(L / S))),
        ("complex_modulus_kPa", lambda w, S, L: 1e-3 * np.hypot(S, L)),
        ("Complex viscosity [mPa·s]", lambda w, S, L: 1e3 * np.hypot(S, L) / w),
        ("|η*| (Pa s)", lambda w, S, L: np.hypot(S, L) / w),
    ],
    ids=["tangent", "phase", "complex", "viscosity", "eta"],
)
def test_a_column_that_contradicts_the_moduli_is_told(tmp_path, heading, values, wrong):
    """A column rounded to two digits does not contradict the moduli; a column with an error of a tenth does."""
    omega = np.geomspace(0.1, 100.0, 13)
    S, L = 1000 * omega**0.1, 200 * omega**0.15
    lines = [
        f"{w:.6g},{s:.6g},{k:.6g},{x:.2g}" for w, s, k, x in zip(omega, S, L, wrong * values(omega, S, L), strict=True)
    ]
    file = tmp_path / "sweep.csv"
    file.write_text("\n".join([f"angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa,{heading}", *lines]))
    told = [note for note in read_sweep(file).notes if "contradicts G' and G''" in note]
    assert len(told) == (wrong != 1.0) and all(heading in note for note in told)


def test_a_viscosity_beside_moduli_of_tension_contradicts_nothing(tmp_path):
    """|E*|/omega was three times G*/omega, which gave a note of 200 %."""
    omega = np.geomspace(0.1, 100.0, 13)
    S, L = 3000 * omega**0.1, 600 * omega**0.15
    lines = [f"{w:.6g},{s:.6g},{k:.6g},{np.hypot(s, k) / w:.4g}" for w, s, k in zip(omega, S, L, strict=True)]
    file = tmp_path / "dma.csv"
    file.write_text("\n".join(["omega [rad/s],E' [Pa],E'' [Pa],Complex viscosity [Pa·s]", *lines]))
    found = read_sweep(file)
    assert found.storage[0] == pytest.approx(S[0] / 3, rel=1e-5) and not any("contradict" in n for n in found.notes)
    for heading, factor in (("Complex modulus E* [Pa]", 1.0), ("Complex modulus [Pa]", 1 / 3), ("|eta*| [Pa·s]", 10.0)):
        size = factor * np.hypot(S, L) / (omega if "eta" in heading else 1.0)
        lines = [f"{w:.6g},{s:.6g},{k:.6g},{c:.6g}" for w, s, k, c in zip(omega, S, L, size, strict=True)]
        file.write_text("\n".join([f"omega [rad/s],E' [Pa],E'' [Pa],{heading}", *lines]))
        assert any("contradict" in n for n in read_sweep(file).notes) == (factor == 10.0)


@pytest.mark.parametrize(("cell", "bad"), [("0", 5), ("0", 12), ("", 7), ("", 12)])
def test_poor_deviations_cost_no_points(tmp_path, cell, bad):
    """Before, each point without a usable standard deviation was ignored, or the sweep was refused."""
    lines = [f"{k},{300 + k},{30 + k},{cell if k <= bad else 6},3\n" for k in range(1, 13)]
    s = read_sweep(_write(tmp_path, HEADER.strip() + ",storage_sd_Pa,loss_sd_Pa\n" + "".join(lines)))
    assert len(s.storage) == 12 and s.storage_sd is None and s.loss_sd is None
    assert len(s.notes) == 1 and "(storage_sd_Pa, loss_sd_Pa) are not used" in s.notes[0]
    assert f"{bad} of 12 points" in s.notes[0]


def test_one_repeated_frequency_is_no_series_of_temperatures(tmp_path):
    """Before, --master was advised, which refuses such a sweep."""
    lines = [f"{k},{300 + k},{30 + k},{36 + k / 4}\n" for k in range(1, 13)]
    for more, told in (([], "changes by 2.8 K"), (["3,304,34,36.5\n"], "changes by 2.8 K"), (lines, "--master")):
        more = [row.replace(",3", ",4", 1) for row in more] if more is lines else more
        s = read_sweep(_write(tmp_path, HEADER.strip() + ",temperature_C\n" + "".join(lines + more)))
        assert len(s.storage) == 12 + len(more) and any(told in note for note in s.notes)
