"""Which files an export may replace: those of its own kind, outside the run that it is made from."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError

_HEAD = 64  # bytes by which a kind of file is recognised

Recognises = Callable[[bytes, int], bool]
"""Whether a file that begins with these bytes, and has that many, is of some kind."""


def refuse_other_kinds(path: Path, run: Path, recognises: Recognises) -> None:
    """A slip must not cost the run, nor a file that is not of the kind that is to be written.

    Raises
    ------
    SarsplatError
        If the path is inside the run's folder, or a file of another kind is there.
    """
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
