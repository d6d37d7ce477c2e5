"""Sweeps in the formats of eight manufacturers: each is read without changes; spoiled ones give a one-line message."""

import json
import re

import numpy as np
import pytest
from conftest import ROOT
from test_rheometer_tables import _workbook

from fitting.__main__ import main
from fitting.readers.rheometer import read_sweep
from fitting.readers.tables.sweep_tables import tables_of
from liverjax import InputError

pytestmark = pytest.mark.quick_to_compile

OMEGA = np.array([0.1, 0.5, 2.0, 10.0, 50.0, 200.0])
G = 1000 * (1 + 0.9 * (1j * OMEGA) ** 0.4)
HERTZ, SIZE, DEGREES, TAN = OMEGA / 2 / np.pi, np.abs(G), np.degrees(np.angle(G)), G.imag / G.real
COLUMNS = {"f": HERTZ, "w": OMEGA, "s": G.real, "l": G.imag, "c": SIZE, "p": DEGREES, "t": TAN, "n": np.arange(1.0, 7)}


def rows(keys: str, delimiter=",", write=lambda v: f"{v:.10g}") -> str:
    return "".join(delimiter.join(write(COLUMNS[k][i]) for k in keys) + "\n" for i in range(len(OMEGA)))


def comma(v: float) -> str:
    return f"{v:.10g}".replace(".", ",")


def english(v: float) -> str:
    return f"{v:,.7f}"


def german(v: float) -> str:
    return english(v).translate(str.maketrans(",.", ".,"))


def quoted(write):
    return lambda v: f'"{write(v)}"'


TRIOS = "Filename\tliver 3\nInstrument name\tDHR-3\n[Parameters]\nDiameter\t20 mm\n[step]\nFrequency sweep - 1\n"
PAAR = "Project:\tLiver\nTest:\tFrequency sweep 1\nResult:\tFrequency sweep 1\n\nInterval and data points:\t1\t6\n"
JSON = {
    "Results": {
        "ResultsSteps": [{"Id": "a", "Name": "Frequency sweep - 1"}],
        "ColumnHeaders": {
            "w": {"DisplayName": "Angular frequency", "Unit": {"Name": "rad/s"}},
            "c": {"DisplayName": "Complex modulus", "Unit": {"Name": "kPa"}},
            "p": {"DisplayName": "Phase angle", "Unit": {"Name": "°"}},
        },
        "Rows": [
            {"w": w, "c": c / 1e3, "p": p, "Results Step Id": "a"} for w, c, p in zip(OMEGA, SIZE, DEGREES, strict=True)
        ],
    }
}
#: Name -> text, or (text, encoding).
FILES = {
    "trios, complex and phase": TRIOS
    + "Step time\tAngular frequency\tComplex modulus\tPhase angle\ns\trad/s\tPa\t°\n"
    + rows("nwcp", "\t"),
    "trios, storage and tan(delta)": TRIOS
    + "Angular frequency\tStorage modulus\tTan(delta)\nrad/s\tPa\t\n"
    + rows("wst", "\t", comma),
    "trios csv, thousands": '"Angular frequency","Storage modulus","Loss modulus"\n"rad/s","Pa","Pa"\n'
    + rows("wsl", ",", quoted(english)),
    "trios, aborted last point": TRIOS
    + "Angular frequency\tStorage modulus\tLoss modulus\nrad/s\tPa\tPa\n"
    + rows("wsl", "\t")
    + "400\t\t\n",
    "trios json": json.dumps(JSON),
    "trios json, aborted point": json.dumps(JSON).replace(
        '"Rows": [', '"Rows": [{"w": 0.05, "c": null, "p": 9.0, "Results Step Id": "a"}, '
    ),
    "rheocompass, loss factor": (
        PAAR
        + "Interval data:\tPoint No.\tAngular Frequency\tStorage Modulus\tLoss Factor\n"
        + "\t\t\t\t\n\t\t[rad/s]\t[Pa]\t[1]\n"
        + "".join("\t" + line + "\n" for line in rows("nwst", "\t", comma).splitlines()),
        "utf-16",
    ),
    "rheocompass, phase shift": PAAR
    + "Interval data:\tPoint No.\tFrequency\tComplex Shear Modulus\tPhase Shift Angle\n\t\t[Hz]\t[Pa]\t[°]\n"
    + "".join("\t" + line + "\n" for line in rows("nfcp", "\t").splitlines()),
    "rheoplus": "Meas. Pts.;Angular Frequency;Storage Modulus;Loss Modulus;Damping Factor\n;[1/s];[Pa];[Pa];[1]\n"
    + rows("nwslt", ";"),
    "rheocompass in German": "Messpkt.;Kreisfrequenz [1/s];Speichermodul [Pa];Verlustmodul [Pa];Verlustfaktor [1]\n"
    + rows("nwslt", ";", german),
    "rheocompass in German, factor": (
        "Kreisfrequenz [rad/s];Speichermodul [Pa];Verlustfaktor [1]\n" + rows("wst", ";", german),
        "latin-1",
    ),
    "rheowin": "HAAKE RheoWin 4.87\nf in Hz;G' in Pa;G\" in Pa;|G*| in Pa;δ in °\n" + rows("fslcp", ";", comma),
    "rheowin, complex": "HAAKE RheoWin 4.87\n\nω in rad/s\t|G*| in Pa\t|η*| in Pas\tδ in °\n" + rows("wcnp", "\t"),
    "rheowin, bars and commas": "ω in rad/s,|G*| in Pa,|η*| in Pas,tan(δ) in -\n" + rows("wcnt"),
    "rheowin, latin-1": ("f in Hz;|G*| in Pa;Phase in °\n" + rows("fcp", ";", comma), "latin-1"),
    "kinexus, complex": "Action,Point,Frequency(Hz),Complex shear modulus(G*)(Pa),Phase angle(°)\n"
    + "".join("Sweep," + line + "\n" for line in rows("nfcp").splitlines()),
    "kinexus, components": "f (Hz),Shear modulus (elastic component)(Pa),Shear modulus (viscous component)(Pa)\n"
    + rows("fsl"),
    "kinexus, delta": "Angular frequency (rad/s);Complex modulus (G*) (kPa);Phase angle (δ) (°)\n"
    + rows("w", ";")
    .replace("\n", ";{}\n")
    .format(*(f"{c / 1e3:.10g};{p:.10g}" for c, p in zip(SIZE, DEGREES, strict=True))),
    "bohlin": "Bohlin CVO\n\nFrequency   Phase Angle   Complex Modulus   Elastic Modulus   Viscous Modulus\n"
    + "Hz          °             Pa                Pa                Pa\n"
    + rows("fpcsl", "      "),
    "bohlin, phase": "Frequency [Hz]\tPhase Angle [°]\tComplex Modulus [Pa]\n" + rows("fpc", "\t"),
    "orchestrator": "Freq [rad/s]\tG' [dyn/cm²]\tG'' [dyn/cm²]\n"
    + "".join(f"{w:.8g}\t{10 * g.real:.8g}\t{10 * g.imag:.8g}\n" for w, g in zip(OMEGA, G, strict=True)),
    "plain, tan_delta": "frequency_Hz,storage_modulus_Pa,tan_delta\n" + rows("fst"),
    "plain, loss and tan": "frequency_Hz,loss_modulus_Pa,tan_delta\n" + rows("flt"),
    "plain, radians": "frequency_Hz,complex_modulus_Pa,phase_rad\n"
    + "".join(f"{f:.9g},{c:.9g},{np.radians(p):.9g}\n" for f, c, p in zip(HERTZ, SIZE, DEGREES, strict=True)),
    "plain, holes": "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n0.001,,\n0.002,n/a,3\n" + rows("fsl"),
    "plain, quoted decimal commas": "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n"
    + rows("fsl", ",", quoted(comma)),
    "excel's own csv": "sep=;\nω [rad/s];G' [Pa];G'' [Pa]\n" + rows("wsl", ";", comma) + ";;\nMean of three;;\n",
    "french": (
        "Fréquence (Hz);Module de conservation (Pa);Facteur de perte\n"
        + rows("fst", ";", lambda v: english(v).translate({44: "\u00a0", 46: ","})),
        "latin-1",
    ),
    "swiss": "f / Hz\tG' / Pa\tG'' / Pa\n" + rows("fsl", "\t", lambda v: english(v).replace(",", "'")),
    "clipboard": "\tω\t|G*|\tδ\t\n\trad/s\tPa\t°\t\n"
    + "".join(f"\t{line}\t\n" for line in rows("wcp", "\t").splitlines()),
    "matlab": "% omega G' G''\n" + rows("wsl", " "),
    "markdown": "| f [Hz] | G' [Pa] | G'' [Pa] |\n|---|---|---|\n"
    + "".join(f"| {line} |\n" for line in rows("fsl", " | ").splitlines()),
    "tension": "Frequency (Hz),Storage modulus E' (Pa),Loss modulus (E'') (Pa)\n"
    + "".join(f"{f:.9g},{3 * s:.9g},{3 * v:.9g}\n" for f, s, v in zip(HERTZ, G.real, G.imag, strict=True)),
    "bending": "Winkelfrequenz [rad·s⁻¹];Flexural storage modulus [psi];Tan δ\n"
    + "".join(f"{w:.9g};{3 * s / 6894.757293168:.9g};{t:.9g}\n" for w, s, t in zip(OMEGA, G.real, TAN, strict=True)),
    "spanish": "Frecuencia (kHz);Módulo de almacenamiento (Pa);Módulo de pérdida (Pa)\n"
    + "".join(f"{f / 1e3:.9g};{s:.9g};{v:.9g}\n" for f, s, v in zip(HERTZ, G.real, G.imag, strict=True)),
    "dma": "Frequency\tE'\tTan δ\nHz\tMPa\t\n"
    + "".join(f"{f:.9g}\t{3e-6 * s:.9g}\t{t:.9g}\n" for f, s, t in zip(HERTZ, G.real, TAN, strict=True)),
}


def written(tmp_path, name: str):
    text, encoding = FILES[name] if isinstance(FILES[name], tuple) else (FILES[name], "utf-8")
    path = tmp_path / "sweep.csv"
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize("name", FILES)
def test_it_is_read_as_it_is(name, tmp_path):
    found = read_sweep(written(tmp_path, name))
    # The numbers have seven digits after the point, so the smallest one, 0.016 Hz, is exact to 3e-6.
    assert np.allclose(found.angular_frequency, OMEGA, rtol=1e-5)
    assert np.allclose(found.storage, G.real, rtol=1e-5) and np.allclose(found.loss, G.imag, rtol=1e-5)


def test_deviations_without_a_name_and_doubtful_thousands_are_told(tmp_path):
    (tmp_path / "a.csv").write_text(
        "f (Hz),G' (Pa),SD,G'' (Pa),±\n" + "".join(f"{k},900,9,80,1\n" for k in range(1, 5))
    )
    found = read_sweep(tmp_path / "a.csv")
    assert found.storage_sd is None and any("'SD', '±' are not used" in note for note in found.notes)
    (tmp_path / "a.csv").write_text("f (Hz),G' (Pa),Pa,G'' (Pa)\n" + "".join(f"{k},900,9,80\n" for k in range(1, 5)))
    assert not read_sweep(tmp_path / "a.csv").notes
    (tmp_path / "a.csv").write_text(
        "f (Hz);G' (Pa);G'' (Pa)\n" + "".join(f"{k};410,382;110,{k}00\n" for k in range(1, 5))
    )
    assert any("410,382 is read as 410.382" in note for note in read_sweep(tmp_path / "a.csv").notes)
    (tmp_path / "a.csv").write_text(
        "f (Hz);G' (Pa);G'' (Pa)\n" + "".join(f"0,{k};410,382;110,{k}00\n" for k in range(1, 5))
    )
    assert not read_sweep(tmp_path / "a.csv").notes


def test_all_columns_have_the_table_s_decimal_sign():
    """A strain of 1,100 % in a table with moduli of 1,234.5 is 11. In a table with 1.234,5 it is 0.011."""
    head = "strain_%,frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C"
    for modulus, strain in (("1,234.5", 11.0), ("1.234,5", 0.011)):
        lines = [f'"1,100","{k}","{modulus}","{modulus}","25"' for k in range(1, 5)]
        (table,) = tables_of("x", [head, *lines])
        assert np.allclose(table.raw["strain"], strain) and np.allclose(table.rows[0][1:], 1234.5)
        assert np.allclose(table.raw["temperature"], 298.15)


def test_a_workbook_with_texts_for_numbers(tmp_path):
    head = [["Frequency", "Complex modulus", "Phase angle"], ["Hz", "Pa", "°"]]
    table = [[float(HERTZ[k]), german(SIZE[k]), float(DEGREES[k])] for k in range(6)]
    found = read_sweep(_workbook(tmp_path / "a.xlsx", {"Details": [["Operator", "x"]], "Sweep": head + table}))
    assert np.allclose(found.storage, G.real, rtol=1e-5) and np.allclose(found.loss, G.imag, rtol=1e-5)


def test_deviations_of_modulus_and_phase_are_carried_over(tmp_path):
    """Compare with random draws: the spread of G' and G'' if |G*| and the phase scatter as stated in the file."""
    head = "frequency_Hz,complex_modulus_Pa,complex_modulus_sd_Pa,phase_deg,phase_sd_deg\n"
    lines = [f"{f:.12g},{c:.12g},{0.02 * c:.12g},{p:.12g},0.3\n" for f, c, p in zip(HERTZ, SIZE, DEGREES, strict=True)]
    (tmp_path / "a.csv").write_text(head + "".join(lines))
    found = read_sweep(tmp_path / "a.csv")
    rng = np.random.default_rng(0)
    drawn = SIZE * (1 + 0.02 * rng.standard_normal((100_000, 6)))
    drawn = drawn * np.exp(1j * np.radians(DEGREES + 0.3 * rng.standard_normal((100_000, 6))))
    assert np.allclose(found.storage_sd, drawn.real.std(axis=0), rtol=0.01)  # 100,000 draws: known to 0.2 %
    assert np.allclose(found.loss_sd, drawn.imag.std(axis=0), rtol=0.01)


def changed(name: str, *pairs: tuple[str, str]) -> str:
    text = FILES[name][0] if isinstance(FILES[name], tuple) else FILES[name]
    for old, new in pairs:
        assert re.search(old, text), old
        text = re.sub(old, new, text, count=1)
    return text


def column(name: str, place: int, value: str, head: int = 1, delimiter: str = ",") -> str:
    """Replace all numbers of a column."""
    lines = [line.split(delimiter) for line in changed(name).splitlines()]
    for row in lines[head:]:
        row[place] = value
    return "\n".join(delimiter.join(row) for row in lines) + "\n"


HEAD = "frequency_Hz,complex_modulus_Pa,phase_deg\n"
#: The change of a file, and a part of the message.
SPOILED = {
    "bar": (changed("bohlin, phase", (r"\[Pa\]", "[bar]")), r"unit 'bar' of column Complex Modulus \[bar\].*use Pa"),
    "milli": (changed("rheowin, complex", ("in Pa", "in mPa")), "unit 'mPa'.*use Pa"),
    "turns": (changed("bohlin, phase", ("°", "turn")), "unit 'turn' of column Phase Angle.*use deg or rad"),
    "rpm": (changed("bohlin, phase", ("Hz", "rpm")), "unit 'rpm'.*use Hz or rad_s"),
    "percent": (changed("rheowin, bars and commas", ("in -", "in %")), r"unit '%' of column tan\(δ\)"),
    "per second": (changed("swiss", ("f / Hz", "f / s-1")), "in s-1 may be in Hz or rad/s; name this column"),
    "per second, long": (changed("bohlin, phase", ("Hz", "1/s")), "in 1/s may be in Hz or rad/s; name this column"),
    "angular in Hz": (changed("rheowin, complex", ("rad/s", "Hz")), "is an angular frequency in Hz; name this column"),
    "phase without unit": (
        HEAD.replace("_deg", "") + "1,10,0.2\n2,11,0.3\n3,12,0.3\n",
        "column phase may be in degrees or radians; name this column",
    ),
    "deviation of the phase without unit": (
        HEAD.replace("\n", ",phase_sd\n") + "1,10,20,0.2\n2,11,30,0.3\n3,12,30,0.3\n",
        "column phase_sd may be in degrees or radians; name this column phase_sd_deg or phase_sd_rad",
    ),
    "no angle": ("frequency_Hz,complex_modulus_Pa\n1,2\n2,3\n", "no column for loss.*phase_angle_deg or tan_delta"),
    "no modulus": ("frequency_Hz,phase_deg\n1,2\n2,3\n", "no column for storage.*add storage_modulus_Pa"),
    "two angles": ("frequency_Hz,tan_delta,phase_deg\n1,2,3\n2,3,3\n", "no column for storage.*add"),
    "no frequency": ("time_s,complex_modulus_Pa,phase_deg\n1,2,3\n2,3,4\n", "no column for frequency.*add"),
    "only storage": ("frequency_Hz,G' [Pa]\n1,2\n2,3\n", "no column for loss"),
    "phase of 90": (
        HEAD + "1,10,90\n2,11,91\n3,12,95\n",
        "line 2: phase_deg = 90 is not a phase below 90 degrees.*check",
    ),
    "negative phase": (
        HEAD + "1,10,-5\n2,11,-6\n3,12,-7\n",
        "line 2: phase_deg = -5 is not positive.*correct the sign",
    ),
    "phase of 0": (HEAD + "1,10,0\n2,11,0\n3,12,0\n", "phase_deg = 0 is not positive"),
    "negative tangent": (column("plain, tan_delta", 2, "-0.2"), "tan_delta = -0.2 is not positive.*correct the sign"),
    "size of 0": (column("plain, radians", 1, "0"), "complex_modulus_Pa = 0 is not positive"),
    "all empty": (
        column("plain, tan_delta", 2, ""),
        r"line 2: tan_delta is empty.*5 more points.*fill this cell, or remove",
    ),
    "all dashes": (
        column("plain, tan_delta", 1, "---"),
        "line 2: storage_modulus_Pa is empty.*fill this cell, or remove",
    ),
    "all nan": (column("plain, tan_delta", 0, "NaN"), "line 2: frequency_Hz is empty"),
    "infinite": (column("plain, radians", 1, "inf"), "complex_modulus_Pa = inf is not finite.*remove the line"),
    "too large": (column("plain, radians", 1, "1e200"), "beyond any measurement.*check the unit"),
    "one frequency": (column("plain, radians", 0, "1"), "fewer|at least two different frequencies"),
    "word": (
        changed("plain, radians", (r"\n0.0795\S*?,", "\nfast,")),
        "line 3: frequency_Hz = 'fast' is not a number.*correct",
    ),
    "word in phase": (column("plain, radians", 2, "soft"), "line 2: phase_rad = 'soft' is not a number.*correct"),
    "two points": (column("plain, radians", 1, "1.2.3"), "complex_modulus_Pa = '1.2.3' is not a number"),
    "two commas": (column("rheowin", 1, "1,2,3", 2, ";"), "G' in Pa = '1,2,3' is not a number"),
    "unit in cell": (column("plain, radians", 1, "400 Pa"), "= '400 Pa' is not a number"),
    "bare decimal commas": (
        HEAD + "0,5,337,8,34,7\n1,5,337,8,34,7\n",
        "line 2: there are 6 cells under 3 headings; write decimals",
    ),
    "an extra cell": (
        changed("plain, radians", (r"\n0.0795", "\n9,0.0795")),
        "line 3: there are 4 cells under 3 headings",
    ),
    "cut after the header": (HEAD, "line 1: there are no numbers below the header; give two"),
    "cut in the first row": (HEAD + "0.1,30", "line 2: phase_deg is empty|at least two"),
    "cut in the header": (HEAD[:20], "no column for|no header names"),
    "header gone": (rows("fcp"), "no header names frequency_Hz.*add that header"),
    "header in words": ("speed,hardness,lag\n" + rows("fcp"), "no header names.*add that header"),
    "columns disagree": (
        "frequency_Hz,angular_frequency_rad_s,complex_modulus_Pa,phase_deg\n1,1,5,6\n2,2,5,6\n3,3,5,6\n",
        "columns angular_frequency_rad_s and frequency_Hz disagree; remove the wrong column",
    ),
    "sizes disagree": (
        "f [Hz],|G*| [Pa],|G*| [kPa],δ [°]\n1,5,5,6\n2,5,5,6\n3,5,5,6\n",
        r"disagree; remove the wrong column",
    ),
    "one deviation": (
        "frequency_Hz,storage_modulus_Pa,storage_sd_Pa,loss_modulus_Pa\n1,4,1,2\n2,4,1,2\n3,4,1,2\n",
        "only one of storage_modulus_sd_Pa and loss_modulus_sd_Pa.*give both or none",
    ),
    "json without results": (
        json.dumps({"Rows": JSON["Results"]["Rows"]}),
        "is JSON, but not an export of TRIOS.*give CSV",
    ),
    "json without angle": (json.dumps(JSON).replace("Phase angle", "Torque"), "no column for loss"),
    "json cut": (json.dumps(JSON)[:300], "is JSON, but not an export of TRIOS"),
    "empty": ("", "is empty: export"),
    "blank": ("\n \n\t\n", "is empty: export"),
    "prose": ("Dear colleague,\nthe data are attached.\n", "no header names.*add that header"),
    "picture": (b"\x89PNG\r\n\0\0\0\0", "not a text file: export"),
    "broken workbook": (b"PK\x03\x04xl/" + bytes(99), "cannot be read.*save the file again, or export"),
    "creep": ("time_s,strain,stress_Pa\n0,1,2\n1,1,3\n", "no header names frequency_Hz"),
    "most points bad": (
        HEAD + "".join(f"{k},10,{5 if k < 3 else -5}\n" for k in range(1, 9)),
        "line 4: phase_deg = -5 is not positive .and 5 more",
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_spoiled_file_gets_one_sentence(name, tmp_path):
    content, sentence = SPOILED[name]
    (tmp_path / "sweep.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as caught:
        read_sweep(tmp_path / "sweep.csv")
    told = str(caught.value)
    assert re.search(sentence, told), told
    assert "sweep.csv" in told and "\n" not in told and len(told) < 400 and re.search(r"[;:,] \w", told)


def test_there_are_as_many_as_said():
    assert len(FILES) >= 30 and len(SPOILED) >= 50


def test_holes_are_named(tmp_path):
    (note,) = read_sweep(written(tmp_path, "plain, holes")).notes
    assert "2 of 8 points are ignored as unusable: line 2: storage_modulus_Pa is empty; line 3: " in note
    assert any("from |G*| and the phase" in n for n in read_sweep(written(tmp_path, "clipboard")).notes)


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("time_s,relaxation_modulus_Pa\n0.1,900\n0.3,800\n1,700\n3,600\n10,500\n30,450\n", "relaxation"),
        ("time_s,strain,stress_Pa\n0,0,2\n1,0.1,2\n2,0.15,2\n3,0.17,2\n", "creep"),
        ("depth_um,force_mN\n" + "\n".join(f"{d},{0.01 * d**1.5:.4f}" for d in range(0, 200, 10)), "indentation"),
        ((ROOT / "data" / "rubber_curves.csv").read_text(), "curves"),
    ],
)
def test_a_file_of_another_test_names_its_command(tmp_path, capsys, text, command):
    file = tmp_path / "test.csv"
    file.write_text(text)
    assert main([str(file), "--method", "closed-form", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"contains no frequency sweep: give it to `python -m fitting {command}`" in said
