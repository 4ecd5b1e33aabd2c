"""Files to import: those that a user lists, those in a folder, and those that the rows of a table name."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path

from sarsplat.data.csv_table import CsvTable, Row, relative_path
from sarsplat.data.files import plain_reason
from sarsplat.errors import SarsplatError, SarsplatWarning, counted, shown

_MOST_FILES = 100_000
"""Of more, somebody gave a home folder."""


def each_once(files: Sequence[str | Path]) -> list[Path]:
    """The files as paths, in their order; none, or one that is there twice, be it by another name, is refused.

    An image that counts twice would outweigh the others.
    """
    if not files:
        raise SarsplatError("no files were given; give at least one")
    seen: dict[str, Path] = {}
    for path in map(Path, files):
        first = seen.setdefault(os.path.realpath(path), path)
        if first is not path:
            also = "twice" if first == path else f"twice, also as {first}"
            raise SarsplatError(f"{path} is given {also}; give each file once")
    return [*seen.values()]


def files_in(folder: Path, what: str) -> list[Path]:
    """Every file in the folder of `what` and in its subfolders, sorted; far too many are refused, not cut."""
    try:
        if not folder.is_dir():
            raise SarsplatError(f"{folder} is not a folder; give the folder of {what}")
        files = sorted(itertools.islice(filter(Path.is_file, folder.rglob("*")), _MOST_FILES + 1))
    except OSError as error:  # which names what it was about, perhaps deep in the folder
        raise SarsplatError(f"cannot read {error.filename or folder}: {plain_reason(error)}") from error
    if len(files) > _MOST_FILES:
        raise SarsplatError(f"{folder} has more than {_MOST_FILES:,} files; give a folder that holds only {what}")
    return files


def listed_files(
    folder: Path, table: CsvTable, rows: Sequence[Row], column: str, *, of: str, endings: Sequence[str] = ()
) -> list[tuple[Row, Path]]:
    """Rows with the files that they name, relative to the folder of `of`, such as "chip"; endings may be left out.

    Rows without a file are counted in a warning. Refused if no row has a file, or one leads out of the folder, be it by
    a link.
    """
    listed = [(row, path) for row in rows if (path := _listed_file(folder, table, row, column, of, endings))]
    if not listed:
        first = shown(rows[0][1][column])
        raise SarsplatError(
            f"{folder} has none of {counted(len(rows), of)} in {table.path} (the first is {first}); give the folder "
            "that they are relative to"
        )
    used = {id(row) for row, _ in listed}
    if missing := [shown(row[1][column]) for row in rows if id(row) not in used]:
        warn_caller(
            f"{folder} lacks {len(missing)} of {counted(len(rows), of)} in {table.path}, the first of them "
            f"{missing[0]}; the others are used"
        )
    return listed


def _listed_file(
    folder: Path, table: CsvTable, row: Row, column: str, of: str, endings: Collection[str]
) -> Path | None:
    text = relative_path(table.path, row, column, of=f"{of}s").replace("\\", "/")
    for ending in ("", *endings):
        path = folder / f"{text}{ending}"
        # os.path's: pathlib's raises if a name is too long for the system, as if something were wrong with the folder
        if text and os.path.isfile(path):  # noqa: PTH113
            if not path.resolve().is_relative_to(folder.resolve()):
                raise SarsplatError(
                    f"{table.path}, line {row[0]}: {shown(text)} is a link out of the folder of {of}s; copy the file"
                )
            return path
    return None


def warn_caller(text: str) -> None:
    """Issue a warning about files that points at the caller's code, not at ours."""
    warnings.warn(text, SarsplatWarning, stacklevel=6)
