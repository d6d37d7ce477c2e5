"""Spreadsheets (.xls, .xlsx, .xlsb, .ods) as lines of text. Every sheet is a table with tabs between the cells."""

import io
from pathlib import Path

from liverjax.core.errors import InputError

#: First bytes of the old binary format (OLE) and of the zip archive of the new one.
OLD, ZIP = bytes.fromhex("d0cf11e0a1b11ae1"), b"PK\x03\x04"


def is_one(data: bytes) -> bool:
    """Whether the bytes are a workbook."""
    return data.startswith(OLD) or (data.startswith(ZIP) and (b"xl/" in data or b"opendocument.spreadsheet" in data))


def text(path: Path, data: bytes, wanted: str) -> str:
    """The sheets of a workbook, one after the other, in the form of an instrument's text export: each sheet is a step.

    Args:
        path: path of the file, for error messages.
        data: content of the file.
        wanted: what to export as CSV if the workbook cannot be read, e.g. "the sheet of the sweep".

    Raises:
        InputError: the reader of workbooks is not installed, or the workbook is damaged.
    """
    try:
        import python_calamine
    except ImportError:
        raise InputError(
            f"{path} is a spreadsheet workbook, which needs python-calamine: pip install '.[excel]', or export "
            f"{wanted} as CSV"
        ) from None
    try:
        book = python_calamine.CalamineWorkbook.from_filelike(io.BytesIO(data))
        sheets = {name: book.get_sheet_by_name(name).to_python() for name in book.sheet_names}
    except Exception as error:  # the library has an exception for each format, and raises other ones for damaged bytes
        raise InputError(
            f"{path} is a spreadsheet workbook that cannot be read ({_line(error)}): save it again, or export {wanted} "
            "as CSV"
        ) from None
    parts = [["[step]", name, *("\t".join(map(_line, row)) for row in rows), ""] for name, rows in sheets.items()]
    return "\n".join(line for part in parts for line in part)


def _line(cell: object) -> str:
    """A cell as text, without tabs and line ends. Numbers keep all their digits."""
    return " ".join(str(cell).split())
