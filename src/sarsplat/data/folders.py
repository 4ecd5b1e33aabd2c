"""Output folders that are whole or absent, replaced in one step, and written by one process at a time."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from sarsplat.data.files import locked, plain_os_errors, sync
from sarsplat.errors import SarsplatError

_LAYOUTS = {
    "dataset.json": r"dataset\.json|truth\.ply|images/[^/]+\.tif",
    "config.json": (
        r"config\.json|metrics\.jsonl?|gaussians\.ply|points\.ply|\.lock|checkpoints/\d+\.safetensors|"
        r"report/(index\.html|[^/]+\.png)"
    ),
    "contact-sheet.png": r"contact-sheet\.png|az[\d.]+_gr[\d.]+\.(tif|png)",
}
"""The kinds of folder we make, by the file that marks them, and what may be in them."""

_LOCK = ".lock"
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of Linux's renameat2


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Be the only process that writes into a folder while the block runs, under whatever name it gets meanwhile.

    What a killed process left is removed: temporary files in it, and a temporary folder beside it.

    Raises
    ------
    SarsplatError
        If another process is writing into it, or it cannot be written.
    """
    with plain_os_errors("write", folder), locked(folder / _LOCK, folder):
        for stray in folder.rglob(".*.tmp"):
            stray.unlink()
        if _temporary_name(folder.resolve()).exists():
            with suppress(SarsplatError), _workshop(folder.resolve()):  # it may be in use
                pass
        yield


@contextmanager
def new_folder(path: Path, overwrite: bool, *, marker: str) -> Iterator[Path]:
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
        Name of the file that marks this kind of folder: dataset.json, config.json (a run) or contact-sheet.png.

    Yields
    ------
    Path
        The temporary folder to write into.

    Raises
    ------
    SarsplatError
        If `path` exists and may not be replaced or another process is writing it, or the disk is full, read-only or
        closed to us.

    Notes
    -----
    Old and new are exchanged in one step (renameat2 of Linux). Where the system or the file system cannot, the old
    folder is moved aside first; a process killed just then leaves it in `.NAME.tmpdir/old`, from where the next call
    for the same path puts it back.
    """
    path = Path(path).resolve()
    with plain_os_errors("write", path), ExitStack() as held:
        _refuse_existing(path, overwrite, marker)
        path.parent.mkdir(parents=True, exist_ok=True)
        built, retired = held.enter_context(_workshop(path))
        _refuse_existing(path, overwrite, marker)  # it may have been put back
        if (path / _LOCK).exists():
            held.enter_context(only_writer(path))
        built.mkdir()
        yield built
        for folder, _, names in os.walk(built):
            for name in names:
                sync(Path(folder, name))
            sync(Path(folder))
        _refuse_existing(path, overwrite, marker)  # it may have appeared meanwhile
        if not path.exists():
            built.replace(path)
        elif not _exchange(built, path):
            _replace_in_two_steps(built, path, retired)
        sync(path.parent)


def _temporary_name(path: Path) -> Path:
    return path.with_name(f".{path.name}.tmpdir")


@contextmanager
def _workshop(path: Path) -> Iterator[tuple[Path, Path]]:
    """Two free names in a temporary folder beside `path`, which is ours alone and removed at the end."""
    folder = _temporary_name(path)
    built, retired = folder / "new", folder / "old"
    with ExitStack() as held:
        while True:
            folder.mkdir(exist_ok=True)
            try:
                held.enter_context(locked(folder / _LOCK, path))
                break
            except FileNotFoundError:
                continue  # its last owner has just removed it
        if retired.exists() and not path.exists():
            retired.replace(path)
        try:
            for left in (built, retired):
                shutil.rmtree(left, ignore_errors=True)
            yield built, retired
        finally:
            for left in (built, retired):
                shutil.rmtree(left, ignore_errors=True)
            (folder / _LOCK).unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Let two names trade places in one step; False where the system or the file system cannot."""
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    if renameat2(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
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
        raise SarsplatError(f"{path} is a file, not a folder; give another name")
    if not any(path.iterdir()):
        return
    if not overwrite:
        raise SarsplatError(f"{path} exists; give another name or --overwrite")
    # Replacing a folder deletes everything in it, so a slip such as `--out . --overwrite` must not cost a day's work.
    if Path.cwd().is_relative_to(path) or Path.home().resolve().is_relative_to(path):
        raise SarsplatError(f"{path} holds the current or the home folder and is never replaced; give another name")
    if not (path / marker).is_file():
        raise SarsplatError(f"{path} holds no {marker}, so it is not ours to replace; give another name")
    if (foreign := _foreign(path, marker)) is not None:
        raise SarsplatError(f"{path} also holds {foreign}, which is not ours to delete; move it or give another name")


def _foreign(path: Path, marker: str) -> Path | None:
    """A file or link in the folder that is no part of its kind, if there is one."""
    for folder, folders, files in os.walk(path):
        links = [name for name in folders if Path(folder, name).is_symlink()]
        for name in sorted(files + links):
            relative = Path(folder, name).relative_to(path)
            finished = relative.with_name(re.sub(r"^\.(.+)\.tmp$", r"\1", name))  # what a killed process left
            if not re.fullmatch(_LAYOUTS[marker], finished.as_posix()):
                return relative
    return None
