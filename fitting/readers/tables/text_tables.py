"""Read tables from text files of any encoding: lines, cells, and the numbers in cells."""

import codecs
import csv
import itertools
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from fitting.readers import workbook
from fitting.readers.tables import trios_json
from liverjax.core.errors import InputError

#: Maximum length of a line: Python's CSV reader cannot read longer cells.
LONGEST_LINE = 131072
#: The minus sign of Unicode. It is replaced by a hyphen, the usual minus sign in files.
MINUS = "\u2212"


def text_of(path: Path, what: str = "a frequency sweep") -> str:
    """Return the content of a text file of any encoding, or of a workbook, as text with hyphens as minus signs. `what`
    names the expected content in messages.

    Raises:
        InputError: the file does not exist, is empty, or is neither text nor a workbook.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder: give the CSV file of {what}")
        if not path.exists():
            raise InputError(f"{path} does not exist; give the CSV file of {what}")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the CSV file of {what}") from None
    if not data.strip():
        raise InputError(f"{path} is empty: export the file again")
    if workbook.is_one(data):
        return workbook.text(path, data, f"the sheet of {what.replace('a ', 'the ', 1)}").replace(MINUS, "-")
    text = _decoded(path, data).replace(MINUS, "-")
    long = next((k for k, line in enumerate(text.splitlines(), 1) if len(line) > LONGEST_LINE), None)
    if long is not None and not text.lstrip().startswith("{"):
        raise InputError(
            f"{path}: line {long} has more than {LONGEST_LINE} characters, which no table has; export the file again"
        )
    if text.lstrip().startswith("{"):
        found = trios_json.tables(text)
        if found is None:
            raise InputError(
                f"{path} is JSON, but not an export of TRIOS (a whole file with the entry Results): give CSV or text"
            )
        return found
    return _with_whole_headings(text)


#: A quoted cell without a closing quote in the same line.
_OPEN = re.compile(r'(?:^|[,;\t])\s*"[^"]*$')


def _with_whole_headings(text: str) -> str:
    """Join the two lines of each quoted heading that contains a line break. The line numbers of later lines stay the
    same."""
    lines = text.splitlines()
    for k in range(min(len(lines), _HEAD) - 1):
        if _OPEN.search(lines[k]) and re.match(r'[^"]*("\s*([,;\t]|$)|$)', lines[k + 1]):
            closed = next((j for j in range(k + 1, min(k + 5, len(lines))) if '"' in lines[j]), None)
            if closed is not None:
                lines[k], lines[k + 1] = "", f"{lines[k]} {lines[k + 1]}"
    return "\n".join(lines)


#: Number of lines at the beginning of a file that may contain headings.
_HEAD = 200


def _decoded(path: Path, data: bytes) -> str:
    if data.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)):
        return data.decode("utf-32", errors="replace")
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


def without_later_sheets(lines: list[str], head: int) -> tuple[list[str], list[str]]:
    """Return all lines above the first sheet (or step of an instrument) that begins below the table header, line
    `head`. Also return a note with the names of the sheets that are not read; empty sheets are not named."""
    starts = [k for k in range(head + 1, len(lines)) if lines[k].strip().lower() == "[step]"]
    parts = [lines[start + 1 : end] for start, end in itertools.pairwise([*starts, len(lines)])]
    names = [part[0].strip() for part in parts if any(map(str.strip, part[1:]))]
    listed = ", ".join(map(repr, names))
    notes = [f"only the first table is read, not the sheets or steps below it: {listed}"] if names else []
    return lines[: starts[0]] if starts else lines, notes


def find_delimiter(line: str) -> str:
    """Return the delimiter of a line: the most frequent of tab, semicolon, comma and bar; or else spaces."""
    return _delimiters(line)[0]


def _delimiters(line: str) -> list[str]:
    """Return the possible delimiters of a line, the most frequent first."""
    plain = re.sub(r"\|\s*\w+\s*\*?\s*\|", "", line) if "*|" in line else line  # the bars of |G*| are not delimiters
    found = sorted((sign for sign in "\t;,|" if sign in plain), key=plain.count, reverse=True)
    return found or ["  " if "  " in line.strip() else " "]


def delimiter_of_header(line: str, complete: Callable[[list[str]], bool]) -> str:
    """Return the most frequent delimiter for which the cells name all needed quantities (`complete` is true). If there
    is no such delimiter, return the most frequent one.

    In "Frequency, Hz;Modulus, Pa" the commas are more frequent, but only the semicolon gives two complete headings.
    """
    every = _delimiters(line)
    return next((sign for sign in every if complete(split_cells(line, sign))), every[0])


def split_line(line: str, delimiter: str | None = None) -> tuple[str, list[str]]:
    """Return the delimiter and the cells of a line. If `delimiter` is None, the delimiter is found from the line."""
    delimiter = delimiter or find_delimiter(line)
    return delimiter, split_cells(line, delimiter)


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line."""
    if delimiter in (" ", "  "):
        return re.split(r"\s{2,}" if delimiter == "  " else r"\s+", line.strip())
    return [c.strip() for c in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


#: A number with a comment behind it.
_COMMENTED = re.compile(r"([-+]?[.,]?\d[\d.,]*(?:[eE][-+]?\d+)?)\s*#.*")


def without_comments(cells: list[str], read: list[bool]) -> list[str]:
    """Return the cells of a row without comments. A comment begins with `#`, either after a number in a column that is
    read, or in a cell after the last column. Names such as "3 #2" in other columns stay whole.

    Args:
        cells: cells of the row.
        read: for each column, whether its numbers are read.
    """
    out, last = [], len(read) - 1
    for k, cell in enumerate(cells):
        found = _COMMENTED.fullmatch(cell) if k <= last and read[k] else None
        if k > last and cell.startswith("#"):
            break
        out.append(found[1] if found else cell)
        if found and k == last:
            break
    return out


def refuse_unnamed_numbers(
    path: str | os.PathLike, number: int, cells: list[str], headings: list[str], delimiter: str
) -> None:
    """Raise `InputError` if numbers to the right of the headings show that line `number` may be read wrongly. Remarks
    and empty cells may follow the numbers.

    Decimal commas in a table with commas between its cells give such numbers. With other delimiters, only a number next
    to the last column is refused, because the headings may then stand above the wrong columns.
    """
    width = len(headings)
    while delimiter == "," and width and not headings[width - 1].strip('" '):
        width -= 1
    beyond = cells[width:] if delimiter == "," else cells[width : width + 1]
    values = [to_number(cell, delimiter) for cell in beyond]
    if any(value is not None and math.isfinite(value) for value in values):
        remedy = "write decimals with a point, and give every column a heading"
        if delimiter != ",":
            remedy = "remove the cells to the right, or give them headings"
        raise InputError(f"{path}: line {number}: there are {len(cells)} cells under {width} headings; {remedy}")


#: Strings in cells without a measurement.
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
    """Return the number in a cell: NaN for an empty cell, None for any other string. A decimal comma and separated
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


#: Patterns of the labels of summary rows. _MEAN: means of other rows, for example "Mean (n = 3)". _DEVIATION: standard
#: deviations or errors of other rows. _OTHER: other summaries.
_MEAN = r"mean|average|avg|mw|mittelwert|mittel|moyenne|media|promedio|gemiddelde"
_DEVIATION = (
    r"s\.?d|std|st\.? ?dev|std\.? ?dev|stdev\.?[sp]?|stdabw\.?|std\.?[- ]?abw\.?|standardabweichung"
    r"|standard[ -]deviation|s\.?e\.?m|s\.?e|std\.? ?error|standard[ -]error|cv|rsd|variance|varianz|.cart[- ]type"
    r"|(95 ?%? ?)?c\.?i\.?( ?95 ?%?)?|confidence( interval)?"
)
_OTHER = r"median|mediane?|min|max|minimum|maximum|range|n|count"
_AROUND = r"±? ?({})( value)?\.?( ?± ?\w+)?( ?%)?( ?[(\[][^)\]]*[)\]])?:?"
_OF_MEANS = re.compile(_AROUND.format(_MEAN), re.I)
_BEFORE_NUMBERS = re.compile(_AROUND.format(f"{_MEAN}|{_DEVIATION}|{_OTHER}"), re.I)
_AFTER_NUMBERS = re.compile(_AROUND.format(f"{_MEAN}|{_DEVIATION}"), re.I)


def is_summary(label: str) -> bool:
    """Return whether a cell is the label of a summary of rows, such as "Mean" or "SD"."""
    return bool(_BEFORE_NUMBERS.fullmatch(label))


def summary_rows(rows: list[list[str]]) -> dict[int, str]:
    """Return the indices of rows such as "Mean" and "SD" at the end of a table, and the label of each row.

    The label is a cell before the first number. Only the label of a mean or deviation may also stand in a later cell,
    because words such as "max" in later cells may be remarks on a measured row. If no row above has a label, all
    labelled rows below a mean are summaries. If a label is repeated, no row is a summary: such labels may be names of
    samples.
    """
    labels = [_label(row) for row in rows]
    end = len(rows)
    while end and is_summary(labels[end - 1]):
        end -= 1
    means = [k for k, own in enumerate(labels) if _OF_MEANS.fullmatch(own) and all(labels[k:]) and not any(labels[:k])]
    end = min([end, *means])
    own = labels[end:]
    distinct = len(set(own)) == len(own) and not set(own) & set(labels[:end])
    return dict(enumerate(own, end)) if end and distinct else {}


def without_multiples(rows: list[tuple]) -> list[int]:
    """Return the indices of the rows that remain after all copies are removed. Rows are copies only if every row was
    written k times: the number of equal rows is then always a multiple of k. Other equal rows may be measurements with
    the same result, for example while a load is held, so they remain."""
    counts = Counter(rows)
    copies = math.gcd(*counts.values())
    seen: Counter[tuple] = Counter()
    kept = []
    for k, row in enumerate(rows):
        seen[row] += 1
        if seen[row] <= counts[row] // copies:
            kept.append(k)
    return kept


def _label(row: list[str]) -> str:
    """Return the label of a row (see `summary_rows`), or an empty string."""
    cells = [cell.strip('" ') for cell in row]
    words = [bool(cell) and cell.lower() not in EMPTY and to_number(cell, ";") is None for cell in cells]
    first = next((k for k, cell in enumerate(cells) if cell and not words[k]), len(cells))
    before = next((cells[k] for k in range(first) if words[k]), "")
    after = (cells[k] for k in range(first, len(cells)) if words[k] and _AFTER_NUMBERS.fullmatch(cells[k]))
    return before or next(after, "")
