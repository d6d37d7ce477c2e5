"""Exports of rheometers with several tables, workbooks and JSON."""

import json

import numpy as np
import pytest
from test_rheometer import HEADER, RHEOCOMPASS, ROWS, TRIOS, _write

from fitting.readers.curves import read_curves
from fitting.readers.rheometer import read_sweep
from liverjax import InputError


def _trios(temperatures, rows=ROWS):
    """Return an export with one step per temperature; G' increases with the number of the step."""
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
        with pytest.raises(InputError, match="is JSON, but not an export of TRIOS"):
            read_sweep(_write(tmp_path, text, "other.json"))


def _workbook(path, sheets):
    """Write a minimal .xlsx file: the parts that ECMA-376 requires, with inline texts."""
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
    monkeypatch.setitem(sys.modules, "python_calamine", None)  # as if it were not installed
    with pytest.raises(InputError, match=r"pip install '\.\[excel\]'"):
        read_sweep(old)


BELOW = "Point,Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa)\n1,0.1,1000,100\n2,0.5,1100,120\n3,1,1200,150\n"


@pytest.mark.parametrize(
    "word",
    ["Mean", "±SD", "Average:", "Std. Dev.", "Mean (n=3)", "CV [%]", "n", "Stdabw.", "CI95", "95% CI", "STDEV.S"],
)
def test_a_summary_below_a_table_is_no_point(tmp_path, word):
    """A row "Mean" was fitted as a sixth point, at the mean of the frequencies."""
    s = read_sweep(_write(tmp_path, f"{BELOW}4,5,1400,200\n{word},1.65,1175,142\n"))
    assert list(s.storage) == [1000, 1100, 1200, 1400] and f"line 6 is a summary of other rows ({word})" in s.notes[0]


def test_a_summary_may_stand_in_the_column_of_the_frequency(tmp_path):
    text = "Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa)\n0.1,1000,100\n1,1200,150\n10,1500,260\n"
    s = read_sweep(_write(tmp_path, text + "Mean,1233,170\nSD,200,60\n"))
    assert list(s.storage) == [1000, 1200, 1500] and len(s.notes) == 2


def test_all_labelled_rows_below_a_mean_are_summaries(tmp_path):
    """Below "Mean", a label that is not known made both rows points of the sweep."""
    s = read_sweep(_write(tmp_path, f"{BELOW}4,5,1400,200\nMean,1.65,1175,142\nHalf width,1,100,20\n"))
    assert list(s.storage) == [1000, 1100, 1200, 1400] and len(s.notes) == 2


@pytest.mark.parametrize("remark", ["max", "n", "range", "valid"])
def test_a_remark_on_the_last_row_marks_no_summary(tmp_path, remark):
    """The last measured row of a table with remarks was ignored."""
    text = "Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa),remark\n0.1,1000,100,\n1,1200,150,\n"
    s = read_sweep(_write(tmp_path, f"{text}10,1500,260,{remark}\n"))
    assert list(s.storage) == [1000, 1200, 1500] and s.notes == ()


def test_the_label_of_a_summary_may_be_in_the_last_column(tmp_path):
    text = "Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa),remark\n0.1,1000,100,\n1,1200,150,\n10,1500,260,\n"
    s = read_sweep(_write(tmp_path, text + "5,1233,170,Mean\n4,200,60,SD\n"))
    assert list(s.storage) == [1000, 1200, 1500] and len(s.notes) == 2


@pytest.mark.parametrize(
    "rows",
    [
        "mean,0.1,1000,100\nmean,1,1200,150\nmean,10,1500,260\n",
        "A,0.1,1000,100\nMax,1,1200,150\nMax,10,1500,260\n",
        "Auto,0.1,1000,100\nMean,1,1200,150\nAuto,10,1500,260\n",
        "Adventitia,0.1,1000,100\nMedia,1,1200,150\nIntima,10,1500,260\n",
        "a,0.1,1000,100\nmean,1,1200,150\nb,10,1500,260\n",
    ],
)
def test_a_word_of_a_label_marks_no_summary(tmp_path, rows):
    """A sample or a torque range may have such a name. The four highest frequencies of a sweep were ignored."""
    s = read_sweep(_write(tmp_path, f"Range,Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa)\n{rows}"))
    assert list(s.storage) == [1000, 1200, 1500] and s.notes == ()


@pytest.mark.parametrize(
    "header",
    [
        "Frequency (Hz), Storage modulus (Pa), Loss modulus (Pa)\t",
        "Frequency\t(Hz), Storage modulus\t(Pa), Loss modulus\t(Pa)",
    ],
)
def test_other_signs_in_a_header_of_commas_are_no_delimiters(tmp_path, header):
    s = read_sweep(_write(tmp_path, f"{header}\n0.1, 1000, 100\n1, 1200, 150\t\n10, 1500, 260\n"))
    assert list(s.storage) == [1000, 1200, 1500] and np.isclose(s.angular_frequency[0], 0.2 * np.pi)


@pytest.mark.parametrize("space", ["", " "])
@pytest.mark.parametrize("between", "\t;")
def test_commas_before_units_are_no_delimiters(tmp_path, between, space):
    rows = (
        (f"Frequency,{space}Hz", f"G',{space}Pa", f"G'',{space}Pa"),
        ("0,1", "1000", "100"),
        ("1", "1200", "150"),
        ("10", "1500", "260"),
    )
    s = read_sweep(_write(tmp_path, "\n".join(between.join(row) for row in rows)))
    assert list(s.storage) == [1000, 1200, 1500] and np.isclose(s.angular_frequency[0], 0.2 * np.pi)


def test_a_row_of_units_that_are_not_known_is_refused_by_name(tmp_path):
    """The rows below were not read, with the message "there are no numbers below the header"."""
    text = "Frequency\tStorage modulus\tLoss modulus\nrad/s\tmPa\tmPa\n0.1\t1000\t100\n1\t1200\t150\n10\t1500\t260\n"
    with pytest.raises(InputError, match="unit 'mPa' of column Storage modulus is not known"):
        read_sweep(_write(tmp_path, text))


def test_quoted_headings_may_have_line_breaks(tmp_path):
    text = '"Frequency,\n(Hz)","G\'\n\n(Pa)","G\'\' (Pa)"\n0.1,1000,100\n1,1200,150\n10,x,260\n'
    path = _write(tmp_path, text)
    with pytest.raises(InputError, match=r"line 7: G' +.Pa. = 'x' is not a number"):
        read_sweep(path)
    assert list(read_sweep(_write(tmp_path, text.replace("x", "1500"))).storage) == [1000, 1200, 1500]


@pytest.mark.parametrize("remark", [["gap readjusted here"], ["n/a", "n/a", "n/a"]])
@pytest.mark.parametrize("ending", ["tsv", "xlsx"])
def test_rows_below_a_remark_are_read(ending, remark, tmp_path):
    """With tabs between the cells, all rows below the remark were lost without a note."""
    rows = [[0.1 * 2**k, 300.5 + k, 30.25 + k] for k in range(10)]
    every = [["frequency_Hz", "storage_modulus_Pa", "loss_modulus_Pa"], *rows[:5], remark, *rows[5:]]
    path = tmp_path / f"t.{ending}"
    if ending == "xlsx":
        _workbook(path, {"Sweep": every, "Notes": [["see page 12"], ["Strain", "Force"], [1.0, 2.0, 3.0]]})
    else:
        path.write_text("\n".join("\t".join(map(str, row)) for row in every) + "\n")
    found = read_sweep(path)
    assert found.storage.tolist() == [row[1] for row in rows]
    assert any(f"{' '.join(remark)!r}, has no numbers and is ignored" in note for note in found.notes)


@pytest.mark.parametrize("title", ["", "Temperature sweep\n"])
def test_another_table_below_is_not_appended(title, tmp_path):
    """Numbers of a temperature ramp are not frequencies."""
    head, rows = "Frequency [Hz]\tG' [Pa]\tG'' [Pa]\n", "".join(f"{k}\t{300 + k}\t30\n" for k in range(1, 7))
    path = _write(tmp_path, head + rows + title + head.replace("Frequency [Hz]", "Temperature [K]") + rows, "t.txt")
    found = read_sweep(path)
    assert len(found.storage) == 6
    told = any("Temperature [K]" in note and "the rows below it are not read" in note for note in found.notes)
    assert told == (not title)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("title", ["Parameters of the fit", "Sample B\nmeasured again"])
def test_another_block_of_numbers_below_a_title_is_not_appended(title, order, tmp_path):
    """The numbers of this block became points of the sweep. Its frequencies do not continue those above."""
    rows = [f"{10 ** (k / 2 - 2):.3g}\t{300 + k}\t{30 + k}\n" for k in range(9)][::order]
    for block in (["1\t100\t0.1\n", "2\t200\t1\n"], rows):
        text = "Frequency [Hz]\tG' [Pa]\tG'' [Pa]\n" + "".join(rows) + title + "\n" + "".join(block)
        found = read_sweep(_write(tmp_path, text, "t.txt"))
        assert len(found.storage) == 9
        assert any(title.split("\n")[0] in n and "the rows below it are not read" in n for n in found.notes)
