"""Reading sweeps: units, instruments' exports, and one sentence for everything that cannot be read."""

import json

import numpy as np
import pytest
from conftest import ROOT

from fitting.readers.curves import read_curves
from fitting.readers.rheometer import read_all_sweeps, read_sweep
from liverjax import InputError

HEADER = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n"
ROWS = "0.1,300,30\n1,400,60\n10,500,90\n"


def _write(tmp_path, text, name="sweep.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding) if isinstance(text, str) else text)
    return path


def test_plain_csv(tmp_path):
    s = read_sweep(_write(tmp_path, "# a comment\n" + HEADER + ROWS + "# the end\n"))
    assert np.allclose(s.angular_frequency, 2 * np.pi * np.array([0.1, 1, 10]))
    assert s.storage.tolist() == [300, 400, 500] and s.loss.tolist() == [30, 60, 90]
    assert s.storage_sd is None and s.notes == ()
    assert all(np.array_equal(a, b) for a, b in zip(s.deviations, (s.storage, s.loss), strict=True))


@pytest.mark.parametrize(
    "header",
    [
        "angular_frequency_rad_s,storage_modulus_kPa,loss_modulus_kPa",
        "angular_frequency_rad_s;storage_modulus_kPa;loss_modulus_kPa",
        "Angular frequency [rad/s]\tStorage modulus [kPa]\tLoss modulus [kPa]",
        "omega (rad/s), G' (kPa), G'' (kPa)",
        "ANGULAR_FREQUENCY_RAD_S,STORAGE_MODULUS_KPA,LOSS_MODULUS_KPA",
        '"Angular Frequency (rad/s)","Storage Modulus (kPa)","Loss Modulus (kPa)"',
    ],
)
def test_units_and_delimiters(tmp_path, header):
    delimiter = max("\t;,", key=header.count)
    text = header + "\n" + ROWS.replace(",", delimiter)
    s = read_sweep(_write(tmp_path, text))
    assert np.allclose(s.angular_frequency, [0.1, 1, 10]) and np.allclose(s.storage, [3e5, 4e5, 5e5])


def test_deviations(tmp_path):
    header = "frequency_Hz,storage_modulus_Pa,storage_modulus_sd_Pa,loss_modulus_Pa,loss_modulus_sd_Pa\n"
    text = header + "1,400,4,60,6\n2,500,5,70,7\n"
    s = read_sweep(_write(tmp_path, text))
    assert s.storage_sd.tolist() == [4, 5] and s.loss_sd.tolist() == [6, 7]
    one = "frequency_Hz,storage_modulus_Pa,storage_sd_Pa,loss_modulus_Pa\n1,400,4,60\n2,500,5,70\n"
    with pytest.raises(InputError, match="give both"):
        read_sweep(_write(tmp_path, one))


def test_sorting_and_repeats_are_said(tmp_path):
    s = read_sweep(_write(tmp_path, HEADER + "10,500,90\n0.1,300,30\n0.1,310,31\n"))
    assert s.storage.tolist() == [300, 310, 500]
    assert any("sorted" in n for n in s.notes) and any("1 frequencies are repeated" in n for n in s.notes)


def test_moduli_beside_columns_of_a_dma_may_be_those_of_tension(tmp_path):
    """E taken for G is three times too large: the headings of the moduli alone do not tell."""
    head, rows = "Frequency (Hz),{}Storage Modulus (kPa),{}Loss Modulus (kPa),{}\n", "0.1,9,1,2\n1,10,2,2\n"
    told = {}
    for own, beside in (
        ("", "Static Force (N)"),
        ("", "Length (mm)"),
        ("", "Axial force (N)"),
        ("Shear ", "Length (mm)"),
    ):
        s = read_sweep(_write(tmp_path, head.format(own, own, beside) + rows))
        assert np.allclose(s.storage, [9000, 10000])
        told[own + beside] = [n for n in s.notes if "if these are moduli E, three times as large" in n]
    assert [len(said) for said in told.values()] == [1, 1, 0, 0]


def test_viscosities_are_named_as_not_read(tmp_path):
    with pytest.raises(InputError, match=r"viscosities are not read: \|G\*\| is omega \|eta\*\|"):
        read_sweep(_write(tmp_path, "frequency_Hz,complex viscosity (Pa.s),tan(delta)\n1,9,0.1\n2,8,0.1\n"))


TRIOS = """\
Filename\tliver 3
Instrument name\tDHR-3
rundate\t3/6/2020
[Parameters]
Geometry\tParallel plate
Diameter\t20 mm
[step]
Amplitude sweep - 1
Angular frequency\tStorage modulus\tLoss modulus\tOscillation strain\tStep time
rad/s\tPa\tPa\t%\ts
6.28319\t401\t61\t0.01\t10
6.28319\t400\t60\t0.1\t20
[step]
Frequency sweep - 2
Step time\tAngular frequency\tStorage modulus\tLoss modulus\tTan(delta)
s\trad/s\tMPa\tMPa\t
10\t0.628319\t3e-4\t3e-5\t0.1
20\t6.28319\t4e-4\t6e-5\t0.15
30\t62.8319\t5e-4\t9e-5\t0.18
[step]
Conditioning end
Step time\tTemperature
s\t°C
"""

RHEOCOMPASS = """\
Project:\tLiver\t\t\t
Test:\tFrequency sweep 1\t\t\t
Result:\tFrequency sweep 1\t\t\t

Interval and data points:\t1\t3\t\t
Interval data:\tPoint No.\tAngular Frequency\tStorage Modulus\tLoss Modulus
\t\t\t\t
\t\t[rad/s]\t[Pa]\t[Pa]
\t1\t0,628319\t300\t30
\t2\t6,28319\t400\t60
\t3\t62,8319\t5,0E+2\t90
"""


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("text", [TRIOS, RHEOCOMPASS], ids=["trios", "rheocompass"])
def test_instrument_exports(tmp_path, text, encoding):
    s = read_sweep(_write(tmp_path, text, "export.txt", encoding))
    assert np.allclose(s.angular_frequency, 2 * np.pi * np.array([0.1, 1, 10]), rtol=1e-5)
    assert np.allclose(s.storage, [300, 400, 500]) and np.allclose(s.loss, [30, 60, 90])
    if text is TRIOS:
        assert "2 tables" in s.notes[0]


VARIANTS = {
    "sd first": (
        "frequency_Hz,sd_storage_modulus_Pa,storage_modulus_Pa,SD_G''_Pa,loss_modulus_Pa\n1,4,400,6,60\n2,5,500,7,70\n",
        True,
    ),
    "errors": (
        "Frequency (Hz),Storage modulus error (Pa),Storage modulus (Pa),Loss modulus error (Pa),Loss modulus (Pa)\n1,4,400,6,60\n2,5,500,7,70\n",
        True,
    ),
    "other columns first": (
        "Frequency point (1),frequency_index,Frequency (Hz),Storage compliance (1/Pa),storage_temperature_C,Storage modulus (Pa),Loss modulus (Pa)\n1,1,1,9,9,400,60\n2,2,2,9,9,500,70\n",
        False,
    ),
    "numpy": ("# frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n1,400,60\n2,500,70\n", False),
    "spaces": ("frequency_Hz storage_modulus_Pa  loss_modulus_Pa\n1 400  60\n2 500  70\n".replace("  ", " "), False),
    "primes": ("Frequency [Hz]|G′ [Pa]|G″ [Pa]\n1|400|60\n2|500|70\n", False),
    "quoted": ('"Frequency (Hz)","Storage modulus (Pa)","Loss modulus (Pa)"\n"1","400","60"\n"2","500","70"\n', False),
    "title": (
        "Frequency sweep; Storage modulus; Loss modulus\nfrequency_Hz;storage_modulus_Pa;loss_modulus_Pa\n1;400;60\n2;500;70\n",
        False,
    ),
    "both frequencies": (
        "frequency_Hz,angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa\n1,6.2832,400,60\n2,12.566,500,70\n",
        False,
    ),
    "aborted step": (
        "[step]\nFrequency\tStorage modulus\tLoss modulus\nHz\tPa\tPa\n[step]\nFrequency\tStorage modulus\tLoss modulus\nHz\tPa\tPa\n1\t400\t60\n2\t500\t70\n",
        False,
    ),
    "per second": (
        "Frequency [rad s-1]\tStorage modulus [Pa]\tLoss modulus [Pa]\n6.283185307\t400\t60\n12.566370614\t500\t70\n",
        False,
    ),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_headers_that_laboratories_write(tmp_path, name):
    text, deviations = VARIANTS[name]
    s = read_sweep(_write(tmp_path, text))
    assert np.allclose(s.angular_frequency, 2 * np.pi * np.array([1, 2]), rtol=1e-4)
    assert s.storage.tolist() == [400, 500] and s.loss.tolist() == [60, 70]
    assert (s.storage_sd is not None) == deviations
    if deviations:
        assert s.storage_sd.tolist() == [4, 5] and s.loss_sd.tolist() == [6, 7]


BAD = {
    "empty": ("", "is empty"),
    "blank": ("  \n\n", "is empty"),
    "prose": ("Dear colleague,\nplease find the data attached.\n", "no header names frequency_Hz"),
    "binary": (b"\x89PNG\r\n\0\0\0\0", "not a text file"),
    "no numbers": (HEADER, "no numbers below the header"),
    "no frequency": ("time_s,storage_modulus_Pa,loss_modulus_Pa\n1,2,3\n", "no column for frequency"),
    "no loss": ("frequency_Hz,storage_modulus_Pa\n1,2\n", "no column for loss"),
    "unit": (HEADER.replace("loss_modulus_Pa", "loss_modulus_bar") + ROWS, "unit 'bar' of column loss_modulus_bar"),
    "frequency unit": (HEADER.replace("_Hz", "_rpm") + ROWS, "unit 'rpm'"),
    "negative": (HEADER + ROWS.replace("60", "-60"), "line 3: loss_modulus_Pa = -60 is not positive"),
    "zero": (HEADER + ROWS.replace("60", "0"), "loss_modulus_Pa = 0 is not positive"),
    "nan": (HEADER + ROWS.replace("400", "nan"), "line 3: storage_modulus_Pa is empty"),
    "inf": (HEADER + ROWS.replace("400", "inf"), "is not finite"),
    "negative frequency": (HEADER + ROWS.replace("0.1", "-0.1"), "frequency_Hz = -0.1 is not positive"),
    "text": (HEADER + ROWS.replace("400", "soft"), "line 3: storage_modulus_Pa = 'soft' is not a number"),
    "short row": (HEADER + "0.1,300,30\n1,400\n", "line 3: loss_modulus_Pa is empty; fill it in"),
    "milli": (HEADER.replace("storage_modulus_Pa", "storage_modulus_mPa") + ROWS, "unit 'mPa'"),
    "angular in Hz": (HEADER.replace("frequency_Hz", "angular_frequency_Hz") + ROWS, "angular frequency in Hz"),
    "disagree": ("angular_frequency_rad_s," + HEADER + "1,1,300,30\n2,2,400,60\n", "disagree"),
    "decimal comma": (HEADER + '"1,5","337,8","34,7"\n', "it has 1 frequency"),
    "decimal comma bare": (HEADER + "1,5,337,8,34,7\n", "6 cells under 3 headings"),
    "one frequency": (HEADER + "1,300,30\n1,310,31\n1,320,33\n", "at least two different"),
    "huge": (HEADER + ROWS.replace("400", "1e200"), "beyond any measurement"),
    "one point": (HEADER + "1,400,60\n", "give at least two"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_get_one_sentence(tmp_path, name):
    content, sentence = BAD[name]
    with pytest.raises(InputError) as caught:
        read_sweep(_write(tmp_path, content))
    message = str(caught.value)
    assert sentence in message and "sweep.csv" in message and "\n" not in message


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_sweep(tmp_path / "none.csv")
    with pytest.raises(InputError, match="is a folder"):
        read_sweep(tmp_path)
    with pytest.raises(InputError, match="name too long"):
        read_sweep(tmp_path / ("x" * 300))


def test_random_damage_is_refused_or_read_but_never_a_traceback(tmp_path):
    rng = np.random.default_rng(0)
    original = (ROOT / "data" / "lions_mane_frequency_sweep.csv").read_bytes()
    for _ in range(200):
        data = bytearray(original)
        for _ in range(rng.integers(1, 30)):
            k = int(rng.integers(len(data)))
            action = rng.integers(3)
            if action == 0:
                data[k] = int(rng.integers(256))
            elif action == 1:
                del data[k : k + int(rng.integers(1, 200))]
            else:
                data[k:k] = bytes(rng.integers(0, 256, 5, dtype=np.uint8))
        path = _write(tmp_path, bytes(data))
        try:
            sweep = read_sweep(path)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert np.all(np.isfinite(sweep.storage)) and np.all(sweep.loss > 0)


def test_shipped_tables_name_their_source():
    for path in sorted((ROOT / "data").glob("*.csv")):
        head = [line for line in path.read_text().splitlines() if line.startswith("#")]
        assert "Source" in " ".join(head) and "Units" in " ".join(head)
    for path in sorted((ROOT / "data").glob("*_frequency_sweep.csv")):
        assert len(read_sweep(path).angular_frequency) >= 16


def test_lions_mane_table_is_the_mean_of_the_raw_sweeps():
    from conftest import SHARED

    folder = SHARED / "data" / "lions_mane"
    if not folder.is_dir():
        pytest.skip("the raw sweeps are not here")
    raw = np.stack([np.loadtxt(f, delimiter=",", skiprows=2) for f in sorted(folder.glob("*.csv"))])
    s = read_sweep(ROOT / "data" / "lions_mane_frequency_sweep.csv")
    assert np.allclose(s.storage, raw[:, :, 1].mean(axis=0), rtol=1e-5)
    assert np.allclose(s.loss_sd, raw[:, :, 2].std(axis=0, ddof=1), rtol=1e-5)


def _trios(temperatures, rows=ROWS):
    """An export with one step a temperature, G' higher by the step's number."""
    steps = ["[Parameters]\nTemperature limit\t620.000 [°C]"]
    for k, t in enumerate(temperatures):
        numbers = "\n".join(f"{f}\t{float(s) + k}\t{l}" for f, s, l in (r.split(",") for r in rows.split()))
        title = f"[Step]\nStep name\tFrequency sweep ({t:.1f} °C)\nNumber of points\t3"
        steps.append(f"{title}\nAngular frequency\tStorage modulus\tLoss modulus\nrad/s\tPa\tPa\n{numbers}")
    return "\n".join(steps) + "\n"


def test_a_file_of_many_tables_names_them_and_one_is_chosen(tmp_path):
    path = _write(tmp_path, _trios((150, 20, -20)), "export.txt")
    s = read_sweep(path)
    (note,) = s.notes
    assert s.storage[0] == 300 and "3 tables: 1 'Frequency sweep (150.0 °C)', 2 'Frequency sweep (20.0 °C)'" in note
    assert "table 1 'Frequency sweep (150.0 °C)' is used, the first with most frequencies, 3" in note
    assert "--table" in note
    for wanted, place in (("2", 1), ("(20.0 °C)", 1), ("-20", 2), ("frequency sweep (-20.0 °c)", 2), ("150", 0)):
        chosen = read_sweep(path, table=wanted)
        assert chosen.storage[0] == 300 + place and f"table {place + 1} '" in chosen.notes[0]
    for wanted, sentence in (("20.0", "in the names of 2 tables"), ("37 °C", "is no table"), ("4", "is no table")):
        with pytest.raises(InputError, match=f"--table .*{sentence}.*2 'Frequency sweep"):
            read_sweep(path, table=wanted)
    assert read_sweep(_write(tmp_path, HEADER + ROWS), table="1").notes == ()


def test_tables_are_named_as_every_instrument_does(tmp_path):
    assert "1 'Amplitude sweep - 1', 2 'Frequency sweep - 2'" in read_sweep(_write(tmp_path, TRIOS)).notes[0]
    two = RHEOCOMPASS + RHEOCOMPASS.replace("sweep 1", "sweep 2")
    assert "1 'Frequency sweep 1', 2 'Frequency sweep 2'" in read_sweep(_write(tmp_path, two)).notes[0]
    plain = "# liver\n" + HEADER + ROWS + "\n# kidney\n" + HEADER + ROWS
    assert "1 'liver', 2 'kidney'" in read_sweep(_write(tmp_path, plain)).notes[0]


@pytest.mark.parametrize("bad", ["-90", "0", "nan", "1e200"])
def test_unusable_points_are_left_out_and_named(tmp_path, bad):
    rows = "0.01,200,20\n" + ROWS.replace("90", bad)
    s = read_sweep(_write(tmp_path, HEADER + rows))
    assert s.storage.tolist() == [200, 300, 400] and s.loss.tolist() == [20, 30, 60]
    (note,) = s.notes
    told = "loss_modulus_Pa is empty" if bad == "nan" else f"loss_modulus_Pa = {float(bad):g} is "
    assert "1 of 4 points is left out" in note and f"line 5: {told}" in note


def test_too_few_usable_points_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"line 4: loss_modulus_Pa = -90 is not positive; correct"):
        read_sweep(_write(tmp_path, HEADER + ROWS.replace("90", "-90")))
    two = "storage_modulus_Pa,loss_modulus_Pa,frequency_Hz\n300,30,1\n301,30,1\n302,30,2\n303,-30,3\n"
    with pytest.raises(InputError, match="line 5"):  # three points remain, but at two frequencies
        read_sweep(_write(tmp_path, two))
    falling = "".join(f"{k},{300 + k},{30 if k < 4 else -30}\n" for k in range(1, 9))
    with pytest.raises(InputError, match=r"line 5: .* is not positive \(and 4 more points are unusable\)"):
        read_sweep(_write(tmp_path, HEADER + falling))
    spread = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,storage_sd_Pa,loss_sd_Pa\n"
    s = read_sweep(_write(tmp_path, spread + "".join(f"{k},300,30,{k - 1},3\n" for k in range(1, 6))))
    assert len(s.storage) == 4 and "storage_sd_Pa = 0 is not positive" in s.notes[0]


TRIOS_JSON = {
    "Schema": {"Url": "https://software.tainstruments.com/schemas/TRIOSJSONExportSchema"},
    "Results": {
        "Processed": {
            "ResultsSteps": [{"Id": "a", "Name": "Amplitude - 1"}, {"Id": "b", "Name": "Frequency sweep - 2"}],
            "ColumnHeaders": {
                "Angular frequency_rad/s": {
                    "DisplayName": "Angular frequency",
                    "ValueType": "Number",
                    "Unit": {"Name": "rad/s"},
                },
                "Status bits": {"DisplayName": "Status bits", "ValueType": "Text"},
                "Storage modulus_MPa": {"DisplayName": "Storage modulus", "Unit": {"Name": "MPa"}},
                "Loss modulus_MPa": {"DisplayName": "Loss modulus", "Unit": {"Name": "MPa"}},
                "Results Step Id": {"DisplayName": "Results Step Id", "ValueType": "Uuid"},
            },
            "Rows": [
                {
                    "Angular frequency_rad/s": omega,
                    "Status bits": "0x12",
                    "Storage modulus_MPa": storage,
                    "Loss modulus_MPa": 1e-5,
                    "Results Step Id": step,
                }
                for step, omega, storage in (("a", 6.28, 4e-4), ("b", 1, 3e-4), ("b", 10, 4e-4), ("b", 100, 5e-4))
            ],
        }
    },
}


def test_trios_json(tmp_path):
    s = read_sweep(_write(tmp_path, json.dumps(TRIOS_JSON), "export.json"))
    assert s.angular_frequency.tolist() == [1, 10, 100] and np.allclose(s.storage, [300, 400, 500])
    assert "1 'Amplitude - 1', 2 'Frequency sweep - 2'" in s.notes[0]
    older = TRIOS_JSON | {"Results": TRIOS_JSON["Results"]["Processed"]}
    assert len(read_sweep(_write(tmp_path, json.dumps(older), "older.json")).storage) == 3
    for text in ('{"Results": []}', '{"a": 1}', "{", '{"Results": {"ColumnHeaders": {}, "Rows": [1]}}'):
        with pytest.raises(InputError, match="is JSON, but not the export of TRIOS"):
            read_sweep(_write(tmp_path, text, "other.json"))


def test_moduli_of_tension_are_thirds_and_said(tmp_path):
    text = "Frequency,E_stor,E_loss\nHz,MPa,MPa\n1,0.3,0.03\n2,0.6,0.06\n4,0.9,0.09\n"
    s = read_sweep(_write(tmp_path, text))
    assert np.allclose(s.storage, [1e5, 2e5, 3e5]) and np.allclose(s.loss, [1e4, 2e4, 3e4])
    assert any("G = E / 3 is taken" in n for n in s.notes)
    primes = read_sweep(_write(tmp_path, "f [Hz],E' [MPa],E'' [MPa]\n1,0.3,0.03\n2,0.6,0.06\n4,0.9,0.09\n"))
    assert np.allclose(primes.storage, s.storage)
    both = "frequency_Hz,E' (Pa),storage_modulus_Pa,loss_modulus_Pa\n1,900,400,60\n2,999,500,70\n"
    assert read_sweep(_write(tmp_path, both)).storage.tolist() == [400, 500]
    short = "omega_rad_s,Gp_Pa,Gpp_Pa\n1,400,60\n2,500,70\n"
    assert read_sweep(_write(tmp_path, short)).loss.tolist() == [60, 70]


def _workbook(path, sheets):
    """A minimal .xlsx: the parts that ECMA-376 asks for, texts inline."""
    import zipfile
    from xml.sax.saxutils import escape

    main, package = "http://schemas.openxmlformats.org/spreadsheetml/2006/main", "http://schemas.openxmlformats.org"
    links = f"{package}/officeDocument/2006/relationships"

    def cell(value):
        if isinstance(value, str):
            return f'<c t="inlineStr"><is><t>{escape(value)}</t></is></c>'
        return f"<c><v>{value!r}</v></c>"

    def listed(numbers, kind, target):
        each = (f'<Relationship Id="r{k}" Type="{links}/{kind}" Target="{target.format(k)}"/>' for k in numbers)
        return f'<Relationships xmlns="{package}/package/2006/relationships">{"".join(each)}</Relationships>'

    with zipfile.ZipFile(path, "w") as file:
        file.writestr("_rels/.rels", listed([1], "officeDocument", "xl/workbook.xml"))
        names = "".join(f'<sheet name="{n}" sheetId="{k}" r:id="r{k}"/>' for k, n in enumerate(sheets, 1))
        book = f'<workbook xmlns="{main}" xmlns:r="{links}"><sheets>{names}</sheets></workbook>'
        file.writestr("xl/workbook.xml", book)
        file.writestr("xl/_rels/workbook.xml.rels", listed(range(1, len(sheets) + 1), "worksheet", "sheet{}.xml"))
        for k, rows in enumerate(sheets.values(), 1):
            data = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
            file.writestr(f"xl/sheet{k}.xml", f'<worksheet xmlns="{main}"><sheetData>{data}</sheetData></worksheet>')
    return path


def test_a_workbook_is_read_sheet_by_sheet(tmp_path):
    rows = [[0.1 * 10**k, 300.5 * (k + 1), 30.25 * (k + 1)] for k in range(4)]
    head = [["Angular frequency", "Storage modulus", "Loss modulus"], ["rad/s", "kPa", "kPa"]]
    details = [["Filename", "sample"], ["Operator", "a\tb"]]
    path = _workbook(tmp_path / "t.xlsx", {"Details": details, "Sweep - 1": head + rows[:3], "Sweep - 2": head + rows})
    found = read_sweep(path)
    np.testing.assert_array_equal(found.storage, 1e3 * np.array(rows)[:, 1])
    assert any("table 2 'Sweep - 2' is used" in note for note in found.notes)
    assert read_sweep(path, table="Sweep - 1").loss.tolist() == [30250, 60500, 90750]


def test_workbooks_that_cannot_be_read_are_one_sentence(tmp_path, monkeypatch):
    import sys
    import zipfile

    with zipfile.ZipFile(tmp_path / "new.xlsx", "w") as file:
        file.writestr("xl/workbook.xml", "<workbook/>")
    old = _write(tmp_path, bytes.fromhex("d0cf11e0a1b11ae1") + bytes(504), "old.xls")
    for path in (tmp_path / "new.xlsx", old):
        with pytest.raises(InputError, match=r"cannot be read .*export the sheet of the frequency sweep as CSV"):
            read_sweep(path)
        with pytest.raises(InputError, match=r"is a spreadsheet workbook.*export the sheet of curves as CSV"):
            read_curves([path])
    monkeypatch.setitem(sys.modules, "python_calamine", None)  # as where it is not installed
    with pytest.raises(InputError, match=r"pip install '\.\[excel\]'"):
        read_sweep(old)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"])
def test_any_encoding_is_read(tmp_path, encoding):
    text = "Frequency [Hz];G' [kPa];G'' [kPa];T [°C]\n0,5;1,25;0,5;20\n1;1,5;0,6;20\n2;1,75;0,7;20\n"
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    s = read_sweep(tmp_path / "a.csv")
    assert s.storage.tolist() == [1250, 1500, 1750] and s.loss.tolist() == [500, 600, 700]
    assert s.raw is not None and np.allclose(s.raw["temperature"], 293.15)


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
    told = [n for n in read_sweep(tmp_path / "s.csv").notes if "taken for an effect of the frequency" in n]
    assert len(told) == (words is not None) and all(words in n for n in told)


def test_one_modulus_of_tension_makes_the_other_one_too(tmp_path):
    """Only the one that said so was divided by 3: the loss was three times too large, without a word."""
    rows = "".join(f"{f},{3000 + f},300\n" for f in (0.1, 1.0, 10.0))
    (tmp_path / "s.csv").write_text("frequency_Hz,tensile_storage_modulus_Pa,loss_modulus_Pa\n" + rows)
    found = read_sweep(tmp_path / "s.csv")
    assert np.allclose(found.loss, 100) and any("loss_modulus_Pa are of tension" in n for n in found.notes)
    (tmp_path / "s.csv").write_text("frequency_Hz,tensile_storage_modulus_Pa,shear_loss_modulus_Pa\n" + rows)
    with pytest.raises(InputError, match="name both alike"):
        read_sweep(tmp_path / "s.csv")


def test_degrees_that_look_like_radians_are_told(tmp_path):
    rows = "".join(f"{f},1000,{a}\n" for f, a in ((0.1, 0.2), (1.0, 0.3), (10.0, 0.4)))
    (tmp_path / "s.csv").write_text("frequency_Hz,complex_modulus_Pa,phase_angle_deg\n" + rows)
    assert any("if these are radians, name it phase_rad" in n for n in read_sweep(tmp_path / "s.csv").notes)


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
    notes("temperature_C", (20, 37))  # who shifts sweeps by temperature reads them apart, without this advice
    ((_, apart),) = read_all_sweeps(tmp_path / "s.csv")
    assert not any("--master" in note for note in apart.notes)
    assert notes("temperature_C", (20, 21)).endswith("a measurement of its own") == notes(
        "strain_%", (1, 1.2)
    ).endswith("own")


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
    """Rounded to two digits a column contradicts nothing; one that is a tenth off does."""
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
    """|E*|/omega was three times G*/omega: a note of 200 %."""
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
