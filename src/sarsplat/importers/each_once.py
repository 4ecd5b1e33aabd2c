"""Files that a user lists: at least one, and none twice, for an image that counts twice outweighs the others."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from sarsplat.errors import SarsplatError


def each_once(files: Sequence[str | Path]) -> list[Path]:
    """The files as paths, in their order.

    Raises
    ------
    SarsplatError
        If there are none, or one is there twice, be it by another name.
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
