"""Files and folders that are whole or absent (a temporary name, synced, then renamed), and JSON read with care."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sarsplat.errors import SarsplatError

_REASONS = {
    errno.ENOSPC: "the disk is full; free some space",
    errno.EDQUOT: "the disk quota is used up; free some space",
    errno.EROFS: "the file system is read-only; give a path that can be written",
    errno.EACCES: "permission is denied; give another path or change its permissions",
    errno.EPERM: "permission is denied; give another path or change its permissions",
    errno.ENOTDIR: "part of its path is a file, not a folder; give another path",
    errno.EEXIST: "part of its path is a file, not a folder; give another path",
    errno.EISDIR: "it is a folder, not a file; give another path",
    errno.ENOENT: "it does not exist; check the path",
    errno.ENAMETOOLONG: "its name is too long; give a shorter one",
}


@contextmanager
def plain_os_errors(verb: str, path: Path) -> Iterator[None]:
    """Turn an OSError inside the block into one sentence: "cannot {verb} {path}: reason; remedy".

    Raises
    ------
    SarsplatError
        In place of any OSError.
    """
    try:
        yield
    except OSError as error:
        reason = _REASONS.get(error.errno or 0) or f"{error.strerror or error}; check the path and the disk"
        raise SarsplatError(f"cannot {verb} {path}: {reason}") from error


def _sync(path: Path) -> None:
    """Flush one file or folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file, whole or not at all; an existing one is replaced only once the new one is on the disk.

    Parameters
    ----------
    path : Path
        File to write; its folder must exist.
    data : bytes
        Its whole content.

    Raises
    ------
    SarsplatError
        If the disk is full or read-only, permission is missing, or the folder is not there.
    """
    path = Path(path)
    if not path.name:
        raise SarsplatError(f"cannot write {path}: it is a folder, not a file; give another path")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with plain_os_errors("write", path):
        try:
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            _sync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)  # still there only if something above failed


def write_json(path: Path, obj: Any) -> None:
    """Write an object as indented JSON, whole or not at all (see `write_bytes`).

    Raises
    ------
    SarsplatError
        If the object holds NaN, an infinity or something JSON has no word for, or the file cannot be written.
    """
    write_bytes(path, encode_json(obj, Path(path)))


def encode_json(obj: Any, path: Path) -> bytes:
    """The object as indented UTF-8 JSON ending in a newline; `path` is what an error names."""
    try:
        return (json.dumps(obj, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise SarsplatError(
            f"{path} cannot be written as JSON: {error}; use finite numbers, text, lists, dicts"
        ) from error


def read_json(path: Path) -> Any:
    """Read a JSON file that may be missing, garbled or hostile.

    Returns
    -------
    dict, list, str, int, float, bool or None
        The value; every number in it is finite.

    Raises
    ------
    SarsplatError
        If the file is missing, is not UTF-8 JSON, holds NaN or an infinity, or is nested too deeply.
    """
    path = Path(path)
    with plain_os_errors("read", path):
        data = path.read_bytes()
    try:
        return json.loads(data.decode(), parse_constant=_refuse_constant, parse_float=_finite)
    except RecursionError as error:
        raise SarsplatError(f"{path} is nested too deeply to be a file of ours; make it again") from error
    except ValueError as error:  # JSONDecodeError and UnicodeDecodeError among them
        raise SarsplatError(f"{path} is not valid JSON ({error}); make it again") from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number JSON allows")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is too large")
    return value


@contextmanager
def new_folder(path: Path, overwrite: bool, *, marker: str | None = None) -> Iterator[Path]:
    """Build a whole output folder under a temporary sibling name; it takes its place when the block ends well.

    If the block raises, KeyboardInterrupt included, the temporary folder is removed and what stood at `path` stays.

    Parameters
    ----------
    path : Path
        The folder to make; parent folders are made too. An empty folder there counts as absent.
    overwrite : bool
        Whether an existing folder may be replaced, as a whole.
    marker : str, optional
        Name of the file by which an earlier output of this kind is known: a folder without it is never replaced.

    Yields
    ------
    Path
        The temporary folder to write into.

    Raises
    ------
    SarsplatError
        If `path` exists and may not be replaced, or the disk is full, read-only or closed to us.
    """
    path = Path(path).resolve()
    with plain_os_errors("write", path):
        _refuse_existing(path, overwrite, marker)
        path.parent.mkdir(parents=True, exist_ok=True)
        # mkdtemp makes a private folder; the one inside it gets the user's usual permissions.
        workshop = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent))
        try:
            built, retired = workshop / "new", workshop / "old"
            built.mkdir()
            yield built
            for folder, _, names in os.walk(built):
                for name in names:
                    _sync(Path(folder, name))
                _sync(Path(folder))
            _refuse_existing(path, overwrite, marker)  # it may have appeared meanwhile
            try:
                if path.exists():
                    path.replace(retired)
                built.replace(path)
            except BaseException:
                if retired.exists() and not path.exists():
                    retired.replace(path)
                raise
            _sync(path.parent)
        finally:
            shutil.rmtree(workshop, ignore_errors=True)


def _refuse_existing(path: Path, overwrite: bool, marker: str | None) -> None:
    if not os.path.lexists(path):
        return
    if not path.is_dir():
        raise SarsplatError(f"{path} is a file, not a folder; give another name")
    empty = not any(path.iterdir())
    if not empty and not overwrite:
        raise SarsplatError(f"{path} exists; give another name or --overwrite")
    # Replacing a folder deletes everything in it, so a slip such as `--out . --overwrite` must not cost a day's work.
    if Path.cwd().is_relative_to(path) or Path.home().resolve().is_relative_to(path):
        raise SarsplatError(f"{path} holds the current or the home folder and is never replaced; give another name")
    if not empty and marker is not None and not (path / marker).is_file():
        raise SarsplatError(f"{path} holds no {marker}, so it is not ours to replace; give another name")
