"""Atomic files (written under a temporary name, then renamed), locks, and validated JSON."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import stat
from codecs import BOM_UTF8
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO, TypeVar

import msgspec
from filelock import FileLock, Timeout

from sarsplat.errors import SarsplatError, shown
from sarsplat.threads import decode

T = TypeVar("T")

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
    errno.EFBIG: "it grows larger than the system allows; free some space or raise the limit",
}

_LARGEST_JSON = 1 << 26  # maximum size of a JSON file, bytes
_OURS = ".sarsplat-"  # mark of temporary names, which no file of a user has
BUILT = "new"
"""Kind of a folder that is being built (see `beside`)."""


def beside(path: Path, kind: str) -> Path:
    """Return the temporary name `.NAME.sarsplat-KIND` beside a file or folder."""
    return path.with_name(f".{path.name}{_OURS}{kind}")


@contextmanager
def plain_os_errors(verb: str, path: Path) -> Iterator[None]:
    """Turn an OSError inside the block into a SarsplatError: "cannot {verb} {path}: reason; remedy"."""
    try:
        yield
    except OSError as error:
        raise SarsplatError(f"cannot {verb} {path}: {plain_reason(error)}") from error


def plain_reason(error: OSError) -> str:
    """Return the cause of an OSError in plain words, and a remedy."""
    return _REASONS.get(error.errno or 0) or f"{error.strerror or error}; check the path and the disk"


def refuse_unwritable(path: Path) -> None:
    """Raise if nothing can be written at a path, so that work does not start in vain."""
    with plain_os_errors("write", path):
        whole = Path(os.path.realpath(path))
        folder = next((parent for parent in whole.parents if os.path.lexists(parent)), whole)
        if not folder.is_dir():
            raise OSError(errno.ENOTDIR, "")
        with TemporaryFile(dir=folder):  # the surest way to know
            pass


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a file or folder for writing while the block runs, by a file `.NAME.sarsplat-lock` in the same folder.

    Raise if another process or thread holds the lock. It is reentrant. The system releases it when the process ends in
    any way; the next process removes the empty file.
    """
    path = Path(os.path.realpath(path))  # unlike resolve() it tolerates a link to itself
    lock_file = beside(path, "lock")
    lock_file.parent.stat()  # FileLock would make missing folders
    lock = FileLock(lock_file, is_singleton=True)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise SarsplatError(f"{path} is in use by another process; wait until it has finished") from error
    try:
        yield
    finally:
        if lock.lock_counter == 1:
            with suppress(OSError):  # Windows removes it on release
                lock_file.unlink()
        lock.release()


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Write a file in parts, whole or not at all; an existing one is replaced once the new one is on the disk.

    A killed process leaves `.NAME.sarsplat-tmp`, which the next one overwrites. In a folder that is being built, files
    are neither locked nor flushed to the disk. Raise SarsplatError if the disk is full or read-only, permission or the
    folder is missing, another process is writing this file, or the path exists and is not a regular file.
    """
    path = Path(path)
    with plain_os_errors("write", path):
        if not path.name or (os.path.lexists(path) and not path.is_file()):
            raise SarsplatError(
                f"cannot write {path}: it is a folder, a device, a pipe or a broken link; give another path"
            )
        temporary = beside(path, "tmp")
        final = all(folder.suffix != f"{_OURS}{BUILT}" for folder in path.parents)
        with locked(path) if final else nullcontext():
            temporary.unlink(missing_ok=True)
            try:
                with temporary.open("xb") as file:  # a new file: it follows no link
                    yield file
                    file.flush()
                    if final:
                        os.fsync(file.fileno())
                temporary.replace(path)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Write the whole content of a file, whole or not at all; parameters and errors as for `new_file`."""
    with new_file(path) as file:
        file.write(data)


def write_json(path: Path, obj: Any) -> None:
    """Write an object as indented JSON, whole or not at all; raise for NaN and infinities, and as `new_file` does."""
    write_bytes(path, encode_json(obj, Path(path)))


def encode_json(obj: Any, path: Path) -> bytes:
    """Encode an object as indented UTF-8 JSON ending in a newline; errors name `path`."""
    try:
        # not by msgspec, which silently turns NaN into null
        text = json.dumps(obj, indent=2, ensure_ascii=False, allow_nan=False, default=_struct_as_dict)
        return (text + "\n").encode()
    except (TypeError, ValueError, RecursionError) as error:  # UnicodeEncodeError of a file's name among them
        raise SarsplatError(
            f"{path} cannot be written as JSON: {error}; use finite numbers, UTF-8 text, lists, dicts"
        ) from error


def _struct_as_dict(value: object) -> dict[str, Any]:
    if isinstance(value, msgspec.Struct):
        fields = msgspec.structs.asdict(value)
        return {name: field for name, field in fields.items() if field is not msgspec.UNSET}
    raise TypeError(f"{shown(value)} is not a JSON value")


@contextmanager
def open_file(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file for reading; reject pipes, sockets and devices, which may never end.

    Any OSError or MemoryError in the block becomes a SarsplatError.
    """
    path = Path(path)
    with plain_os_errors("read", path):
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise SarsplatError(f"cannot read {path}: it is a pipe, socket or device; give a regular file")
        try:
            with path.open("rb") as file:
                yield file
        except MemoryError as error:
            raise SarsplatError(f"cannot read {path}: it does not fit into memory; give a smaller file") from error


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, hexadecimal."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


def read_json(path: Path, type: type[T]) -> T:
    """Read a JSON file, which may be missing, garbled or hostile, as a type that msgspec knows.

    Every number in the result is finite, and text can be written as UTF-8. Raise SarsplatError if the file is missing,
    is not UTF-8 JSON, holds NaN or an infinity, is nested too deeply, or a field is missing, unknown or of another
    type.
    """
    return decode_json(_read_text(path), Path(path), type)


def read_versioned_json(path: Path, type: type[T], *, schema: str, version: int, remedy: str) -> T:
    """Read a JSON file like `read_json`; raise also if its `schema` or `schema_version` differ, with this `remedy`."""
    data = _read_text(path)
    kind = decode_json(data, Path(path), _Kind)
    for field, expected in (("schema", schema), ("schema_version", version)):
        if (stated := getattr(kind, field)) != expected:
            raise SarsplatError(f"{path}: its {field} is {shown(stated)} but this program reads {expected!r}; {remedy}")
    return decode_json(data, Path(path), type)


class _Kind(msgspec.Struct):
    schema: Any = None
    schema_version: Any = None


def _read_text(path: Path) -> bytes:
    return read_bytes(path, _LARGEST_JSON).removeprefix(BOM_UTF8)  # some editors put that mark first


def read_bytes(path: Path, largest: int | None = None) -> bytes:
    """Read a whole file, of at most `largest` bytes if given; errors as for `open_file`."""
    with open_file(path) as file:
        if largest is not None and file.seek(0, os.SEEK_END) > largest:
            raise SarsplatError(f"{path} is larger than {largest >> 20} MiB; give a smaller file")
        file.seek(0)
        return file.read()


def decode_json(data: bytes, path: Path, type: type[T]) -> T:
    """Decode JSON text like `read_json`; errors name `path`."""
    try:
        return decode(data, type)
    except msgspec.ValidationError as error:
        raise SarsplatError(f"{path}: {_named_field(data, str(error))}; correct it or create it again") from error
    except (ValueError, RecursionError) as error:  # msgspec.DecodeError and UnicodeDecodeError among them
        raise SarsplatError(f"{path} is not valid JSON ({shown(str(error))}); create it again") from error


def _named_field(data: bytes, complaint: str) -> str:
    """Turn "Expected `float`, got `str` - at `$.views[1].azimuth_deg`" into "views[1].azimuth_deg is 'north': …"."""
    reason, _, field = complaint.partition(" - at `$")
    field = field.removesuffix("`").removeprefix(".")
    reason = "".join(letter if letter.isprintable() else "?" for letter in reason[:1].lower() + reason[1:])[:200]
    reason = reason.replace("`", "'")  # names in backquotes are our parameters
    if not field:
        return reason
    try:
        value = msgspec.json.decode(data)
        for key in re.findall(r"\w+", field):
            value = value[int(key) if isinstance(value, list) else key]
    except (ValueError, LookupError, TypeError, RecursionError):  # such as 1e999, or a key of any letters
        return f"{field}: {reason}"
    return f"{field}: {reason}" if isinstance(value, dict) else f"{field} is {shown(value)}: {reason}"


def inside(folder: Path, name: str) -> Path:
    """Return `folder / name`; raise if that leads out of the folder, also by a link."""
    path = folder / name
    try:
        inside = name.isprintable() and path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a name the system cannot hold, or a loop of links
        inside = False
    if not name or not inside:
        raise SarsplatError(f"the file {shown(name)} is not inside the dataset's folder; use a plain relative path")
    return path
