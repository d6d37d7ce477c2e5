"""Tables in text files of any encoding: lines, their cells, and the numbers in them."""

import codecs
import csv
import re
from pathlib import Path

from fitting.readers import trios_json, workbook
from liverjax.core.errors import InputError


def text_of(path: Path, what: str = "a frequency sweep") -> str:
    """Content of a text file of any encoding, or of a workbook. `InputError` if it is neither; it names `what`."""
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder: give the CSV file of {what}")
        if not path.exists():
            raise InputError(f"{path}: no such file; give the CSV file of {what}")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the CSV file of {what}") from None
    if not data.strip():
        raise InputError(f"{path} is empty: export the sweep again")
    if workbook.is_one(data):
        return workbook.text(path, data, f"the sheet of {what.replace('a ', 'the ', 1)}")
    text = _decoded(path, data)
    if text.lstrip().startswith("{"):
        found = trios_json.tables(text)
        if found is None:
            raise InputError(f"{path} is JSON, but not the export of TRIOS (it has no Results): give CSV or text")
        return found
    return text


def _decoded(path: Path, data: bytes) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    start = data[:200]  # UTF-16 without its mark: every second byte of plain text is 0
    for name, zeros in (("utf-16-le", start[1::2]), ("utf-16-be", start[::2])):
        if len(start) > 20 and not any(zeros):
            return data.decode(name, errors="replace")
    if b"\0" in data:
        raise InputError(f"{path} is not a text file: export the sweep as CSV or text")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def find_delimiter(line: str) -> str:
    """Delimiter of the cells of a line: the most frequent of tab, semicolon, comma and bar, else spaces."""
    best = max("\t;,|", key=line.count)
    return best if best in line else ("  " if "  " in line.strip() else " ")


def split_line(line: str, delimiter: str | None = None) -> tuple[str, list[str]]:
    """The delimiter of a line and its cells; without a given delimiter it is found."""
    delimiter = delimiter or find_delimiter(line)
    return delimiter, split_cells(line, delimiter)


def split_cells(line: str, delimiter: str) -> list[str]:
    """The cells of a line."""
    if delimiter in (" ", "  "):
        return re.split(r"\s{2,}" if delimiter == "  " else r"\s+", line.strip())
    return [c.strip() for c in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


def to_number(text: str, delimiter: str) -> float | None:
    """A number, with a decimal comma where commas do not separate cells; None for any other text."""
    text = text.strip().strip('"')
    if delimiter != "," and "," in text and "." not in text:
        text = text.replace(",", ".")
    try:
        return float(text)
    except ValueError:
        return None
