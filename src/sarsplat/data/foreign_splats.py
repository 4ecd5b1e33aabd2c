"""Files of Gaussians in formats that are not read: known by their endings, to say how they are converted."""

from __future__ import annotations

from pathlib import Path

from sarsplat.errors import SarsplatError

_CONVERTED = (".spz", ".ksplat", ".sog", ".lcc", ".lcc2")
"""What splat-transform reads."""
_OTHERS = (".sogs", ".rad")


def refuse_foreign(path: Path) -> None:
    """Say how to convert Gaussians in a format that is not read."""
    ending = path.suffix.lower()
    if ending in _CONVERTED:
        raise SarsplatError(
            f"{path} holds Gaussians as {ending}, which is not read; open it in SuperSplat (superspl.at/editor) and "
            "export it as PLY, or convert it with splat-transform"
        )
    if ending in _OTHERS:
        raise SarsplatError(
            f"{path} holds Gaussians as {ending}, which is not read; give the PLY that it was made from"
        )
