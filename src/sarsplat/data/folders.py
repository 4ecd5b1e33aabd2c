"""Output folders that are whole or absent, and written by one process at a time.

Folders and exported files of another kind are never replaced.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from sarsplat.data.files import BUILT, beside, locked, open_file, plain_os_errors, refuse_unwritable
from sarsplat.errors import SarsplatError

Recognises = Callable[[bytes, int], bool]
"""Predicate of a kind of file, by its first bytes and its size."""

_OLD = "old"  # kind of a folder that is being replaced (see `beside`)
_HEAD = 96  # number of bytes by which a kind of file is recognised


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Lock a run, which need not exist yet, while the block runs (see `locked`); remove leftovers of a killed one."""
    with plain_os_errors("write", folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with locked(folder):
            if folder.exists():
                _clear(Path(os.path.realpath(folder)))
            yield


@contextmanager
def new_folder(
    path: Path, overwrite: bool, *, marker: str, goes_on: Callable[[Path], bool] | None = None
) -> Iterator[Path]:
    """Build an output folder under a temporary sibling name, and rename it to `path` when the block ends well.

    If the block raises, KeyboardInterrupt included, the temporary folder is removed and an existing `path` stays. A
    killed process leaves `.NAME.sarsplat-new`, which the next writer of this path clears, or `.NAME.sarsplat-old`, the
    folder that was being replaced, which it restores. Parent folders are made, and an empty folder counts as absent.

    With `overwrite`, an existing folder of the same kind is replaced as a whole; `marker` names the file that marks its
    kind, such as dataset.json. If `goes_on` says of an unfinished folder that it can be continued, that stays when the
    block raises, and the next call yields it again. Raise SarsplatError if `path` may not be replaced, another process
    is writing it, the disk is full or read-only, or permission is missing.
    """
    path = Path(os.path.realpath(path))  # unlike resolve() it tolerates a link to itself
    built, old = temporary_folder(path), beside(path, _OLD)
    with plain_os_errors("write", path):
        refuse_existing(path, overwrite, marker=marker)
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path):
            if old.exists() and not path.exists():
                old.replace(path)
            _refuse_existing(path, overwrite, marker)  # it may have been restored
            if goes_on is None or not goes_on(built):
                _clear(path)
            built.mkdir(exist_ok=True)
            try:
                yield built
                _refuse_existing(path, overwrite, marker)  # it may have appeared meanwhile
            except BaseException:
                if goes_on is None or not goes_on(built):
                    _clear(path)
                raise
            if path.exists():
                path.replace(old)
            built.replace(path)
            _clear(path)


def refuse_existing(path: Path, overwrite: bool, *, marker: str) -> None:
    """Raise if `new_folder` would, without making anything."""
    refuse_unwritable(path)
    path = Path(os.path.realpath(path))  # unlike resolve() it tolerates a link to itself
    with plain_os_errors("write", path):
        _refuse_existing(path, overwrite, marker)


def refuse_other_kinds(path: Path, run: Path, recognises: Recognises) -> None:
    """Raise if an export of a run would be written inside its folder, or over a file of another kind."""
    if Path(os.path.realpath(path)).is_relative_to(run.resolve()):
        raise SarsplatError(f"{path} is the file that is exported or is inside the run; choose a path outside {run}")
    if path.exists():
        with open_file(path) as content:
            head, size = content.read(_HEAD), content.seek(0, os.SEEK_END)
        if not recognises(head, size):
            raise SarsplatError(
                f"{path} exists and is not a {path.suffix.lower()} file as exported, so it will not be replaced; "
                "choose another name"
            )


def temporary_folder(path: Path) -> Path:
    """Temporary path at which `new_folder` builds a folder."""
    return beside(path, BUILT)


def _clear(path: Path) -> None:
    for left in (temporary_folder(path), beside(path, _OLD)):
        shutil.rmtree(left, ignore_errors=True)


def _refuse_existing(path: Path, overwrite: bool, marker: str) -> None:
    if not os.path.lexists(path) or not any(path.iterdir()):
        return
    if not overwrite:
        raise SarsplatError(f"{path} already exists; choose another name or pass overwrite=True")
    # Replacing a folder deletes everything in it, so a slip such as `--out . --overwrite` must not cost a day's work.
    if Path.cwd().is_relative_to(path) or Path.home().resolve().is_relative_to(path):
        raise SarsplatError(
            f"{path} contains the current folder or your home folder, so it is never replaced; choose another name"
        )
    if not (path / marker).is_file():
        raise SarsplatError(f"{path} contains no {marker}, so it will not be replaced; choose another name")
