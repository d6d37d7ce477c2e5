"""Read tables from text files of any encoding: lines, cells, and the numbers in cells."""

import codecs
import csv
import math
import re
from collections.abc import Iterable
from pathlib import Path

from fitting.readers import trios_json, workbook
from liverjax.core.errors import InputError

#: Maximum length of a line: Python's CSV reader refuses longer cells.
LONGEST_LINE = 131072


def text_of(path: Path, what: str = "a frequency sweep") -> str:
    """Return the content of a text file of any encoding, or of a workbook, as text. `what` names the expected content
    in messages.

    Raises:
        InputError: the file does not exist, is empty, or is neither text nor a workbook.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder: give the CSV file of {what}")
        if not path.exists():
            raise InputError(f"{path}: no such file; give the CSV file of {what}")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the CSV file of {what}") from None
    if not data.strip():
        raise InputError(f"{path} is empty: export it again")
    if workbook.is_one(data):
        return workbook.text(path, data, f"the sheet of {what.replace('a ', 'the ', 1)}")
    text = _decoded(path, data)
    long = next((k for k, line in enumerate(text.splitlines(), 1) if len(line) > LONGEST_LINE), None)
    if long is not None and not text.lstrip().startswith("{"):
        raise InputError(
            f"{path}: line {long} has more than {LONGEST_LINE} characters, which no table has: export it again"
        )
    if text.lstrip().startswith("{"):
        found = trios_json.tables(text)
        if found is None:
            raise InputError(f"{path} is JSON, but not the export of TRIOS (it has no Results): give CSV or text")
        return found
    return _with_whole_headings(text)


#: A quoted cell that the line does not close.
_OPEN = re.compile(r'(?:^|[,;\t])\s*"[^"]*$')


def _with_whole_headings(text: str) -> str:
    """The text in which quoted headings with line breaks stand on one line. Line numbers below stay the same."""
    lines = text.splitlines()
    for k in range(min(len(lines), _HEAD) - 1):
        if _OPEN.search(lines[k]) and re.match(r'[^",;\t]*"\s*(?:[,;\t]|$)', lines[k + 1]):
            lines[k], lines[k + 1] = "", f"{lines[k]} {lines[k + 1]}"
    return "\n".join(lines)


#: Headings stand in the first lines of a file.
_HEAD = 200


def _decoded(path: Path, data: bytes) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    start = data[:200]  # UTF-16 without a byte order mark: every second byte of plain text is 0
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
    """Return the delimiter of a line: the most frequent of tab, semicolon, comma and bar; or else spaces.

    In "Frequency, Hz;Modulus, Pa" the commas are within the cells. So a comma with a space counts only if there is no
    tab and no semicolon.
    """
    plain = re.sub(r"\|\s*\w+\s*\*?\s*\|", "", line) if "*|" in line else line  # the bars of |G*| are not delimiters
    plain = re.sub(r", +", "", plain) if re.search(r"[\t;]", plain) else plain
    best = max("\t;,|", key=plain.count)
    return best if best in plain else ("  " if "  " in line.strip() else " ")


def split_line(line: str, delimiter: str | None = None) -> tuple[str, list[str]]:
    """Return the delimiter and the cells of a line. If no delimiter is given, it is found from the line."""
    delimiter = delimiter or find_delimiter(line)
    return delimiter, split_cells(line, delimiter)


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line."""
    if delimiter in (" ", "  "):
        return re.split(r"\s{2,}" if delimiter == "  " else r"\s+", line.strip())
    return [c.strip() for c in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


#: Texts in cells without a measurement.
EMPTY = {"", "-", "--", "---", "–", "—", "*", "n/a", "#n/a", "na", "n.a.", "none", "null", "nan", "?"}
#: _GROUPED: spaces and apostrophes that separate thousands. _THOUSANDS: patterns of numbers in which commas or points
#: separate thousands.
_GROUPED = re.compile(r"(?<=\d)['’ \u00a0\u2009\u202f](?=\d{3}(\D|$))")
_THOUSANDS = {sign: re.compile(rf"[-+]?[1-9]\d{{0,2}}(\{sign}\d{{3}})+(\{other}\d*)?") for sign, other in (",.", ".,")}


def decimal_sign(cells: Iterable[str]) -> str | None:
    """Return the decimal sign of a table, "." or ",", or None if the cells do not show it. The other sign separates
    thousands."""
    found = set()
    for cell in cells:
        text = _GROUPED.sub("", cell.strip().strip('"').lower())
        for sign, other in (",.", ".,"):
            whole, *rest = re.split(r"e[-+]?\d", text)[:1][0].split(sign)
            if len(rest) != 1 or not re.fullmatch(r"\d*", rest[0]) or not re.fullmatch(r"[-+]?[\d,.]*", whole):
                continue
            if "e" in text or other in whole or len(rest[0]) != 3 or not re.fullmatch(r"[-+]?[1-9]\d{0,2}", whole):
                found.add(sign)
    return found.pop() if len(found) == 1 else None


def to_number(text: str, delimiter: str, sign: str | None = None) -> float | None:
    """Return the number in a cell: NaN for an empty cell, None for any other text. A decimal comma and separated
    thousands are allowed.

    Args:
        text: a cell.
        delimiter: delimiter of the cells.
        sign: `decimal_sign` of the table. If it is None, a single comma or point is the decimal sign.
    """
    text = text.strip().strip('"').strip()
    if text.lower() in EMPTY:
        return math.nan
    text = _GROUPED.sub("", text)
    for thousands, decimals in (",.", ".,"):
        certain = decimals in text or text.count(thousands) > 1
        if sign != thousands and (sign == decimals or certain) and _THOUSANDS[thousands].fullmatch(text):
            text = text.replace(thousands, "").replace(decimals, ".")
    if "," in text and "." not in text and text.count(",") == 1:
        text = text.replace(",", ".")
    try:
        return float(text)
    except ValueError:
        return None


def means_nothing(cells: Iterable[str]) -> bool:
    """Return whether no cell begins like a number. The line then has only words."""
    return not any(re.match(r"[-+]?[.,]?\d|nan|[-+]?inf", cell.strip('" ').lower()) for cell in cells)


#: Words that mark a row as a summary of other rows.
_SUMMARY = re.compile(
    r"(mean|average|avg|median|sd|std|st\.? ?dev|std\.? ?dev|standard deviation|sem|standard error|min|max|minimum"
    r"|maximum|range|cv|mittelwert|mittel|standardabweichung|moyenne|.cart[- ]type|media|promedio)\.?( ?\(?%?\)?)?:?",
    re.I,
)


def summary_rows(rows: list[list[str]]) -> dict[int, str]:
    """Rows such as "Mean" and "SD" below a table, and the word that each one has in one of its cells.

    If most rows have such a word, it does not mark a summary.
    """
    found: dict[int, str] = {}
    for k, row in enumerate(rows):
        word = next((cell.strip('" ') for cell in row if _SUMMARY.fullmatch(cell.strip('" '))), None)
        if word is not None:
            found[k] = word
    return found if 2 * len(found) < len(rows) else {}
