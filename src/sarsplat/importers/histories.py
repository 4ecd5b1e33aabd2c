"""Formats of phase history: each is a file `history_NAME.py` of this folder, or an entry point of another package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError
from sarsplat.importers.phase_history import PhaseHistory
from sarsplat.plugins import discover

FORMATS = discover("sarsplat.importers", "history_", "FORMAT", "sarsplat.phase_histories")
"""Formats by their names."""


_HEAD = 128  # bytes by which a container is known


@dataclass(frozen=True)
class PhaseHistoryFormat:
    """A format of phase history.

    Parameters
    ----------
    what : str
        What such files are, in a few words.
    endings : tuple of str
        Of their names, in small letters, such as ".mat".
    read : callable
        Reads one file, or raises a `SarsplatError` of one sentence: files come from strangers.
    begins : bytes
        What every such file begins with, and no other; empty if nothing tells.
    container : bytes
        What it begins with as other files do: that tells only of what is given as phase history.
    """

    what: str
    endings: tuple[str, ...]
    read: Callable[[Path], PhaseHistory]
    begins: bytes = b""
    container: bytes = b""


def format_of(path: Path) -> PhaseHistoryFormat | None:
    """The format of a file: the one that it begins like, or else the one whose ending it has; None if it has none."""
    formats = FORMATS.loaded().values()
    with open_file(path) as file:
        start = file.read(max(len(one.begins) for one in formats))
    begun = (one for one in formats if one.begins and start.startswith(one.begins))
    ending = (one for one in formats if path.suffix.lower() in one.endings)
    return next(begun, next(ending, None))


def read_phase_history(path: Path) -> PhaseHistory:
    """The pulses of one file, of whichever format.

    Refused if it is of no format that is known here, or cannot be used.
    """
    known = format_of(path)
    if known is None:
        with open_file(path) as file:
            start = file.read(_HEAD)
        contained = (one for one in FORMATS.loaded().values() if one.container and start.startswith(one.container))
        known = next(contained, None)
    if known is None:
        kinds = " or ".join(one.what for one in FORMATS.loaded().values())
        raise SarsplatError(f"{path} is no phase history of a known format; give {kinds}")
    return known.read(path)
