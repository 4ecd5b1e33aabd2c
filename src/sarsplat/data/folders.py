"""Atomic output folders: whole or absent, replaced in one step, written by one process at a time.

Nothing is replaced that is of another kind: neither a folder nor the file of an export.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sarsplat.data.files import growing, locked, open_file, plain_os_errors, refuse_unwritable, sync
from sarsplat.errors import SarsplatError

_LAYOUTS = {
    "dataset.json": r"dataset\.json|truth\.ply|preview\.png|images/[^/]+\.tif|unplaced/\d+\.tif|masks/[^/]+\.png",
    "config.json": (
        r"config\.json|metrics\.jsonl?|about\.json|(gaussians|points|mesh)\.ply|checkpoints/\d+\.safetensors|"
        r"report/(index\.html|[^/]+\.png)|tensorboard/events\.out\.tfevents\.[^/]+|"
        r"tiles/\d+/(config\.json|metrics\.jsonl|checkpoints/\d+\.safetensors)"
    ),
    "comparison.html": r"comparison\.html",
    "contact-sheet.png": r"contact-sheet\.png|az[\d.]+_gr[\d.]+\.(tif|png)",
    "chips.json": r"chips\.json|labels\.csv|[\w+-]+/\d+\.(jpg|png|npy)|chips-\d+\.tar",
    "measured-chips.json": r"measured-chips\.json|labels\.csv|[\w+-]+/[\w+-]+/\d+\.(jpg|png|npy)",
}
"""The kinds of folder we make, by the file that marks them, and what may be in them."""

Recognises = Callable[[bytes, int], bool]
"""Whether a file that begins with these bytes, and has that many, is of some kind."""

_HEAD = 96  # bytes by which a kind of file is recognised
_BUILT, _RETIRED = "new", "old"
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of Linux's renameat2


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Lock a run, which need not exist yet, against other writers while the block runs (see `locked`).

    What a killed process left is removed: temporary files and locks in the run, and our temporary folder beside it.
    """
    with plain_os_errors("write", folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with locked(folder):
            for stray in (*folder.rglob(".*.tmp"), *folder.rglob(".*.lock")):
                if stray.is_file() and not stray.is_symlink() and _belongs(stray.relative_to(folder), "config.json"):
                    stray.unlink()
            path = Path(os.path.realpath(folder))
            if _temporary_name(path).exists():
                with suppress(SarsplatError), _workshop(path):  # it may not be ours
                    pass
            yield


@contextmanager
def new_folder(
    path: Path, overwrite: bool, *, marker: str, goes_on: Callable[[Path], bool] | None = None
) -> Iterator[Path]:
    """Build a whole output folder under a temporary sibling name; it takes its place when the block ends well.

    If the block raises, KeyboardInterrupt included, the temporary folder is removed and what stood at `path` stays.
    What a killed process left under the temporary name, `.NAME.tmpdir`, is cleared by the next one that writes there.

    Parameters
    ----------
    path : Path
        The folder to make; parent folders are made too. An empty folder there counts as absent.
    overwrite : bool
        Whether an existing folder of the same kind may be replaced, as a whole.
    marker : str
        Name of the file that marks this kind of folder: dataset.json, config.json (a run), comparison.html,
        contact-sheet.png or chips.json.
    goes_on : callable, optional
        Whether what a stopped process has built in a folder can be gone on with. If it is given, what has been built
        stays when the block raises, and the next call yields it again, unless this says no.

    Yields
    ------
    Path
        The temporary folder to write into.

    Raises
    ------
    SarsplatError
        If `path` exists and may not be replaced, another process is writing it, the temporary folder is not ours, or
        the disk is full, read-only or closed to us.

    Notes
    -----
    Old and new are exchanged in one step (renameat2 of Linux). Where the system or the file system cannot, the old
    folder is moved aside first; a process killed just then leaves it in `.NAME.tmpdir/old`, from where the next call
    for the same path puts it back.
    """
    path = Path(os.path.realpath(path))  # unlike resolve() it tolerates a link to itself
    with plain_os_errors("write", path):
        refuse_existing(path, overwrite, marker=marker)
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path), _workshop(path, goes_on) as (built, retired):
            _refuse_existing(path, overwrite, marker)  # it may have been put back
            built.mkdir(exist_ok=True)
            with growing(built):
                yield built
            _flush(built)
            _refuse_existing(path, overwrite, marker)  # it may have appeared meanwhile
            if not path.exists():
                built.replace(path)
            elif not _exchange(built, path):
                _replace_in_two_steps(built, path, retired)
            sync(path.parent)


def refuse_existing(path: Path, overwrite: bool, *, marker: str) -> None:
    """Refuse what `new_folder` would refuse, without making anything."""
    refuse_unwritable(path)
    path = Path(os.path.realpath(path))  # unlike resolve() it tolerates a link to itself
    with plain_os_errors("write", path):
        _refuse_existing(path, overwrite, marker)
        with suppress(FileNotFoundError):
            _refuse_foreign_workshop(_temporary_name(path))


def refuse_other_kinds(path: Path, run: Path, recognises: Recognises) -> None:
    """Refuse to write an export of a run inside its folder, or over a file of another kind."""
    if Path(os.path.realpath(path)) == run.resolve():
        raise SarsplatError(f"{path} is the file that is exported; choose another name")
    if Path(os.path.realpath(path)).is_relative_to(run.resolve()):
        raise SarsplatError(f"{path} is inside the run; choose a path outside {run}")
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
    return _temporary_name(path) / _BUILT


def _temporary_name(path: Path) -> Path:
    return path.with_name(f".{path.name}.tmpdir")


@contextmanager
def _workshop(path: Path, goes_on: Callable[[Path], bool] | None = None) -> Iterator[tuple[Path, Path]]:
    """Two names in a temporary folder beside `path`, removed at the end; the caller holds the lock of `path`.

    Both are free, unless the first one has what `goes_on` accepts; then it also stays after an error.
    """
    folder = _temporary_name(path)
    built, retired = folder / _BUILT, folder / _RETIRED
    with suppress(FileExistsError):
        folder.mkdir()
    _refuse_foreign_workshop(folder)
    if retired.exists() and not path.exists():
        retired.replace(path)
    if goes_on is None or not goes_on(built):
        _clear(folder)
    folder.mkdir(exist_ok=True)
    try:
        yield built, retired
    except BaseException:
        if goes_on is None or not goes_on(built):
            _clear(folder)
        raise
    _clear(folder)


def _clear(workshop: Path) -> None:
    for left in (_BUILT, _RETIRED):
        shutil.rmtree(workshop / left, ignore_errors=True)
    with suppress(OSError):
        workshop.rmdir()


def _refuse_foreign_workshop(folder: Path) -> None:
    """Refuse a temporary folder that we have not made; FileNotFoundError if there is none."""
    if not stat.S_ISDIR(folder.lstat().st_mode):
        raise SarsplatError(
            f"{folder} is in the way but is not a temporary folder of sarsplat's; move it or choose another name"
        )
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name not in (_BUILT, _RETIRED) or entry.is_symlink():
                raise SarsplatError(
                    f"{folder} holds {entry.name}, which sarsplat did not create; move it or choose another name"
                )


def _exchange(one: Path, other: Path) -> bool:
    """Let two names trade places in one step; False where the system or the file system cannot."""
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if sys.platform == "linux" else None
    if renameat2 is None:
        return False
    if renameat2(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
        return False
    raise OSError(number, os.strerror(number))


def _flush(folder: Path) -> None:
    """Flush a folder with all that is in it to the disk: in one call where the system has one, which is far quicker."""
    if _flush_whole_disk(folder):
        return
    for inner, _, names in os.walk(folder):
        for name in names:
            sync(Path(inner, name))
        sync(Path(inner))


def _flush_whole_disk(folder: Path) -> bool:
    """Flush the file system that holds a folder; False where the system cannot."""
    syncfs = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None) if sys.platform == "linux" else None
    if syncfs is None:
        return False
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        if syncfs(descriptor) == 0:
            return True
    finally:
        os.close(descriptor)
    number = ctypes.get_errno()
    if number == errno.ENOSYS:
        return False
    raise OSError(number, os.strerror(number))


def _replace_in_two_steps(built: Path, path: Path, retired: Path) -> None:
    path.replace(retired)
    try:
        built.replace(path)
    except BaseException:
        retired.replace(path)
        raise


def _refuse_existing(path: Path, overwrite: bool, marker: str) -> None:
    if not os.path.lexists(path):
        return
    if not path.is_dir():
        raise SarsplatError(f"{path} is a file, not a folder; choose another name")
    if not any(path.iterdir()):
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
    if (foreign := _foreign(path, marker)) is not None:
        raise SarsplatError(
            f"{path} also holds {foreign}, which sarsplat did not create; move it or choose another name"
        )


def _foreign(path: Path, marker: str) -> Path | None:
    """A file or link in the folder that this kind of folder does not contain, or None."""
    for folder, folders, files in os.walk(path):
        links = [name for name in folders if Path(folder, name).is_symlink()]
        for name in sorted(files + links):
            relative = Path(folder, name).relative_to(path)
            if not _belongs(relative, marker):
                return relative
    return None


def _belongs(relative: Path, marker: str) -> bool:
    """Whether a kind of folder contains such a file, perhaps under a temporary name that a killed process left."""
    finished = relative.with_name(re.sub(r"^\.(.+)\.(tmp|lock)$", r"\1", relative.name))
    return re.fullmatch(_LAYOUTS[marker], finished.as_posix()) is not None
