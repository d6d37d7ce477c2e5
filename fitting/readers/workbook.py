"""Spreadsheets are not read: the sentence that says so, and what to export."""

from pathlib import Path

from liverjax.core.errors import InputError

#: First bytes of the old binary format (OLE) and of the zip archive of the new one.
OLD, ZIP = bytes.fromhex("d0cf11e0a1b11ae1"), b"PK\x03\x04"


def refuse(path: Path, data: bytes, wanted: str) -> None:
    """`InputError` where the bytes are a workbook (.xls, .xlsx, .ods), saying to export `wanted` as text."""
    if data.startswith(OLD) or (data.startswith(ZIP) and (b"xl/" in data or b"opendocument.spreadsheet" in data)):
        raise InputError(f"{path} is a spreadsheet workbook, not text: open it, export {wanted} as CSV, and give that")
