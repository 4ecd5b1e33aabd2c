"""Files to import: listed by a user, found in a folder, or named by the rows of a table; checks of their fields."""

from __future__ import annotations

import itertools
import os
import posixpath
import re
import unicodedata
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from jaxtyping import Shaped

from sarsplat.data.csv_table import CsvTable, Row, relative_path
from sarsplat.data.files import open_file, plain_reason
from sarsplat.errors import SarsplatError, SarsplatWarning, counted, shown
from sarsplat.extras import needed

if TYPE_CHECKING:
    import h5py

_LARGEST_CHUNK = 64 << 20  # maximum size of a chunk of HDF5, bytes, which is unpacked at a time
_MOST_FILES = 100_000  # maximum number of files in a folder; with more, it is probably a home folder


def raise_damaged(path: str | Path, problem: str) -> NoReturn:
    """Raise a `SarsplatError` on a damaged file; `problem` is its predicate."""
    raise SarsplatError(f"{path} {problem}; get it again")


def number_in(path: Path, value: object, name: str, least: float, most: float) -> float:
    """Return a field of a file as a number; raise if it is of another type, or out of range."""
    if not isinstance(value, int | float) or not least <= value <= most:  # also catches NaN
        raise_damaged(path, f"has {shown(value)} as {name}, not a number from {least:g} to {most:g}")
    return float(value)


def whole_in(path: Path, text: str, name: str, least: int, most: int) -> int:
    """Return the text of a field as a whole number; raise if it is not one, or out of range."""
    number = int(text) if re.fullmatch(r"[0-9]{1,15}", text) else text[:40]
    return int(number_in(path, number, name, least, most))


def printable(text: str | None) -> str:
    """Return the text of a field without unprintable letters, cut to 80."""
    return "".join(letter if letter.isprintable() else "?" for letter in (text or "").strip())[:80]


def check_pixel(path: Path, pixel: tuple[float, float], shape: tuple[int, int]) -> None:
    """Raise if a pixel is outside the rows and columns of a file's image."""
    if not all(0 <= value <= size - 1 for value, size in zip(pixel, shape, strict=True)):
        raise SarsplatError(
            f"the pixel {pixel[0]:g}, {pixel[1]:g} is outside {path}, which has {shape[0]} rows and {shape[1]} "
            f"columns, counted from 0; its middle is `pixel=({shape[0] // 2}, {shape[1] // 2})`"
        )


@contextmanager
def opened_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open a file so that any exception inside h5py, as of a garbled file, becomes one sentence."""
    with needed("rslc", "an HDF5 file"):
        import h5py
    with open_file(path):  # a regular file that can be read
        try:
            with h5py.File(path, "r", locking=False) as file:
                yield file
        except (SarsplatError, MemoryError):
            raise
        except Exception as error:
            raise_damaged(path, f"is not a readable HDF5 file ({shown(str(error))})")


def hdf5_array(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """Return an array of a file; raise if it is missing or lies in another file."""
    import h5py

    at: Any = file
    for part in name.split("/"):
        if not isinstance(at, h5py.Group) or part not in at:
            raise_damaged(path, f"has no {name}")
        if not isinstance(at.get(part, getlink=True), h5py.HardLink):
            raise_damaged(path, f"has {name} elsewhere, by a link, not in the file itself")
        at = at[part]
    if not isinstance(at, h5py.Dataset) or at.shape is None:
        raise_damaged(path, f"has no array {name}")
    if at.external or at.is_virtual:
        raise_damaged(path, f"has {name} in another file")
    if at.chunks is not None and np.prod(at.chunks, dtype=float) * at.dtype.itemsize > _LARGEST_CHUNK:
        raise SarsplatError(f"{path} has {name} in chunks {shown(at.chunks)}; write it again in smaller ones")
    return at


def complex_of(stored: Shaped[np.ndarray, "*shape"]) -> Shaped[np.ndarray, "*shape"]:
    """Join records of real and imaginary part to complex numbers; return other arrays unchanged."""
    if stored.dtype.names not in (("r", "i"), ("real", "imag")):
        return stored
    real, imaginary = (stored[name] for name in stored.dtype.names)
    joined = np.empty(stored.shape, np.result_type(real, np.complex64))
    joined.real, joined.imag = real, imaginary
    return joined


def each_once(files: Sequence[str | Path]) -> list[Path]:
    """Return the files as paths, in their order; raise if the list is empty, or one is given twice or by two names."""
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
    """Find all files in the folder of `what` and in its subfolders, sorted, but for hidden ones; raise if too many.

    macOS keeps hidden notes beside each file (`._name.csv`).
    """

    def shown_file(path: Path) -> bool:
        parts = path.relative_to(folder).parts
        return path.is_file() and not any(part.startswith((".", "__MACOSX")) for part in parts)

    try:
        if not folder.is_dir():
            raise SarsplatError(f"{folder} is not a folder; give the folder of {what}")
        files = sorted(itertools.islice(filter(shown_file, folder.rglob("*")), _MOST_FILES + 1))
    except OSError as error:  # which names what it was about, perhaps deep in the folder
        raise SarsplatError(f"cannot read {error.filename or folder}: {plain_reason(error)}") from error
    if len(files) > _MOST_FILES:
        raise SarsplatError(f"{folder} has more than {_MOST_FILES:,} files; give a folder that holds only {what}")
    return files


def listed_files(
    folder: Path, table: CsvTable, rows: Sequence[Row], column: str, *, of: str, endings: Sequence[str] = ()
) -> list[tuple[Row, Path]]:
    """Find the files that rows name, relative to the folder of `of`, such as "chip"; endings may be left out.

    Differences in capital letters, or in the encoding of accents, are accepted with a warning; another one counts rows
    without a file. Raises if no row has a file, several files match, or one leads out of the folder, even by a link.
    """

    @cache  # only if a name is not that of a file
    def by_plain_name() -> dict[str, list[Path]]:
        found: dict[str, list[Path]] = defaultdict(list)
        for path in files_in(folder, f"the {of}s"):
            found[_plain(path.relative_to(folder).as_posix())].append(path)
        return found

    listed: list[tuple[Row, Path]] = []
    otherwise: list[str] = []
    missing: list[str] = []
    for row in rows:
        text = relative_path(table.path, row, column, of=f"{of}s").replace("\\", "/")
        names = [f"{text}{ending}" for ending in ("", *endings)] if text else []
        # os.path's: pathlib's raises if a name is too long for the system, as if the folder were wrong
        path = next((folder / name for name in names if os.path.isfile(folder / name)), None)  # noqa: PTH113
        if path is None:
            similar = next(filter(None, (by_plain_name().get(_plain(name)) for name in names)), [])
            if len(similar) > 1:
                either = " and ".join(str(path.relative_to(folder)) for path in similar[:2])
                raise SarsplatError(
                    f"{table.path}, line {row[0]}: {shown(text)} may be {either}; write the name as the file's"
                )
            if not similar:
                missing.append(shown(row[1][column]))
                continue
            path = similar[0]
            otherwise.append(f"{shown(row[1][column])} for {path.relative_to(folder)}")
        if not path.resolve().is_relative_to(folder.resolve()):
            raise SarsplatError(
                f"{table.path}, line {row[0]}: {shown(text)} is a link out of the folder of {of}s; copy the file"
            )
        listed.append((row, path))
    if not listed:
        raise SarsplatError(
            f"{folder} has none of {counted(len(rows), of)} in {table.path} (the first is {missing[0]}); give the "
            "folder that they are relative to"
        )
    if otherwise:
        warn_caller(
            f"{table.path} spells {counted(len(otherwise), 'file')} otherwise than they are called, the first of "
            f"them {otherwise[0]}; they are taken for these"
        )
    if missing:
        warn_caller(
            f"{folder} lacks {len(missing)} of {counted(len(rows), of)} in {table.path}, the first of them "
            f"{missing[0]}; the others are used"
        )
    return listed


def _plain(name: str) -> str:
    """Return a name in small letters, its accents in one encoding, without leading `./`."""
    return unicodedata.normalize("NFC", posixpath.normpath(name)).casefold()


def warn_caller(text: str) -> None:
    """Issue a warning about files that points at the user's code."""
    warnings.warn(text, SarsplatWarning, stacklevel=6)
