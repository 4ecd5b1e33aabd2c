"""Files of Gaussians in formats that are not read: known by their endings, to say how they are converted."""

from __future__ import annotations

from pathlib import Path

from sarsplat.errors import SarsplatError

FOREIGN = (".spz", ".ksplat", ".sog", ".sogs", ".lcc", ".rad")
"""Endings of Gaussians in formats that are not read."""


def refuse_foreign(path: Path) -> None:
    """Say how to convert Gaussians in a format that is not read."""
    if path.suffix.lower() in FOREIGN:
        raise SarsplatError(
            f"{path} holds Gaussians as {path.suffix.lower()}, which is not read; open it in SuperSplat "
            "(superspl.at/editor) and export it as PLY, or convert it with splat-transform"
        )
