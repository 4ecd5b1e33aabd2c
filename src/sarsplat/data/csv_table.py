"""Reader of CSV tables of any dialect: line ends, separators, quotes, byte-order mark, UTF-8 or UTF-16."""

from __future__ import annotations

import codecs
import csv
import io
import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from sarsplat.data.files import open_file, read_bytes
from sarsplat.errors import SarsplatError, counted, shown

_SEPARATORS = ",;\t"
_MAX_ROWS = 100_000
_LARGEST = 64 << 20  # bytes
_LONGEST_LINE = 10_000  # bytes

Row = tuple[int, dict[str, str]]
"""A row's line in the file and its cells by column, stripped; missing cells are empty."""


@dataclass(frozen=True)
class CsvTable:
    """A file of comma-separated values, with at least one row."""

    path: Path
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    decimal_comma: bool = False
    """True if `1,5` is a number, because commas do not separate the cells."""

    def number(self, row: Row, column: str) -> float:
        """Parse a cell as a finite number."""
        value = parsed(row[1][column], self.decimal_comma)
        if not math.isfinite(value):
            raise SarsplatError(
                f"{self.path}, line {row[0]}: {column} is {shown(row[1][column])}; give a number, with a decimal point "
                "unless semicolons separate the cells"
            )
        return value

    def direction(self, row: Row, column: str) -> float:
        """Parse a cell as an angle from -360 to 360 degrees."""
        value = self.number(row, column)
        if abs(value) > 360:
            raise SarsplatError(
                f"{self.path}, line {row[0]}: {column} is {shown(row[1][column])}; directions are degrees, -360 to 360"
            )
        return value


def read_table(path: Path, purpose: str, needed: Sequence[str] = ()) -> CsvTable:
    """Read a table in UTF-8 or UTF-16, whose first line names the columns; skip empty rows.

    `purpose` is the file that errors ask for, such as "the table of labels". Raise if a `needed` column is missing.
    """
    try:
        text = _decoded(read_bytes(path, _LARGEST))
        separator = _separator(text)
        reader = _reader(text, separator)
        columns = _names(reader)
        if missing := [name for name in needed if name not in columns]:
            lacks = f"column{'' if len(missing) == 1 else 's'} {', '.join(map(repr, missing))}"
            raise SarsplatError(f"{path} is missing the {lacks}; it needs {', '.join(needed)}")
        rows = []
        filled = (cells for cells in reader if any(cell.strip() for cell in cells))  # spreadsheets append empty rows
        for cells in itertools.islice(filled, _MAX_ROWS + 1):
            rows.append((reader.line_num, _row(path, reader.line_num, columns, cells)))
    except UnicodeDecodeError as error:
        raise SarsplatError(
            f"{path} is not a readable CSV table, for its byte {error.start} is not UTF-8; save {purpose} in UTF-8"
        ) from error
    except csv.Error as error:
        raise SarsplatError(f"{path} is not a readable CSV table ({error}); give {purpose}") from error
    if len(rows) > _MAX_ROWS:
        raise SarsplatError(f"{path} has more than {_MAX_ROWS} rows; split {purpose} into smaller ones")
    if twice := [name for name, times in Counter(columns).items() if name and times > 1]:
        raise SarsplatError(f"{path} has the column {shown(twice[0])} twice; rename or remove one of them")
    if not rows:
        raise SarsplatError(f"{path} has no rows; give {purpose}")
    return CsvTable(path, columns, tuple(rows), separator != ",")


def column_names(path: Path) -> tuple[str, ...]:
    """Return the column names in the first line of a file, which may be of any kind."""
    with open_file(path) as file:
        first = _decoded(file.read(_LONGEST_LINE), "replace").lstrip("\r\n").partition("\n")[0]
    try:
        return _names(_reader(first, _separator(first)))
    except csv.Error:
        return ()


def relative_path(path: Path, row: Row, column: str, of: str) -> str:
    """Return a cell with a relative path into the folder of, say, "chips"; raise if it leads out of it."""
    line, text = row[0], row[1][column]
    inside = PurePosixPath(text.replace("\\", "/"))
    if inside.is_absolute() or PureWindowsPath(text).drive or ".." in inside.parts or "\0" in text:
        raise SarsplatError(
            f"{path}, line {line}: the path {shown(text)} points outside the folder of {of}; use paths relative to it"
        )
    return text


def parsed(text: str, decimal_comma: bool = False) -> float:
    """Parse a number; NaN if it is not one."""
    try:
        return float(text.replace(",", ".") if decimal_comma else text)
    except ValueError:
        return math.nan


def _names(reader: Any) -> tuple[str, ...]:
    """Return the column names: the first line that is not empty, with spaces for what cannot be printed."""
    names: list[str] = next(filter(None, reader), [])
    return tuple("".join(letter if letter.isprintable() else " " for letter in name).strip() for name in names)


def _reader(text: str, separator: str) -> Any:
    return csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True)


def _decoded(data: bytes, errors: str = "strict") -> str:
    """Decode a table, without byte-order mark and without a first line such as `sep=;`."""
    if b"\0" in data[:1]:
        raise UnicodeDecodeError("utf-8", data, 0, 1, "it looks like UTF-16")
    encodings = {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
    text = data.decode(encodings.get(data[:2], "utf-16-le" if data[1:2] == b"\0" else "utf-8-sig"), errors)
    return text[text.find("\n") :] if text[:4].lower() == "sep=" else text


def _separator(text: str) -> str:
    """Return the candidate separator that occurs most often in the header line."""
    first = text.lstrip("\r\n").partition("\n")[0].partition("\r")[0]
    return max(_SEPARATORS, key=first.count)


def _row(path: Path, line: int, columns: tuple[str, ...], cells: list[str]) -> dict[str, str]:
    if any(cell.strip() for cell in cells[len(columns) :]):
        raise SarsplatError(
            f"{path}, line {line}: there are {counted(len(cells), 'cell')} for {counted(len(columns), 'column')}; "
            "put cells that contain the separator into quotes"
        )
    return dict(zip(columns, itertools.chain((cell.strip() for cell in cells), itertools.repeat(""))))
