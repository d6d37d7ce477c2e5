"""Convert spreadsheets (.xls, .xlsx, .xlsb, .ods) to lines of text. Each sheet is a table with tabs between cells."""

import io
from pathlib import Path

from liverjax.core.errors import InputError

#: First bytes of a workbook in the old binary format (OLE), and of a zip archive (new formats).
OLD, ZIP = bytes.fromhex("d0cf11e0a1b11ae1"), b"PK\x03\x04"


def is_one(data: bytes) -> bool:
    """Return whether the bytes are the content of a workbook."""
    return data.startswith(OLD) or (data.startswith(ZIP) and (b"xl/" in data or b"opendocument.spreadsheet" in data))


def text(path: Path, data: bytes, wanted: str) -> str:
    """Return all sheets of a workbook in the form of an instrument's text export, in which each sheet is a test step.

    Args:
        path: path of the file, for error messages.
        data: content of the file.
        wanted: what to export as CSV if the workbook cannot be read, e.g. "the sheet of the sweep".

    Raises:
        InputError: python-calamine, which reads workbooks, is not installed, or the workbook is damaged.
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
    except Exception as error:  # the type of the exception depends on the file format
        raise InputError(
            f"{path} is a spreadsheet workbook that cannot be read ({_line(error)}): save the file again, or export "
            f"{wanted} as CSV"
        ) from None
    parts = [["[step]", name, *("\t".join(map(_line, row)) for row in rows), ""] for name, rows in sheets.items()]
    return "\n".join(line for part in parts for line in part)


def _line(cell: object) -> str:
    """Return a cell as text, without tabs and line ends. Numbers keep all their digits."""
    return " ".join(str(cell).split())
