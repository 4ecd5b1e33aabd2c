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
_NITF = (
    "a NITF file, not phase history; import it with `sarsplat import sicd` if it is a SICD, and instead of a SIDD the "
    "SICD that it was made from"
)
_RELATIVES = {
    b"CRSD": "raw radar data (CRSD), whose pulses are not compensated; get it as CPHD or SICD from who made it",
    b"NITF": _NITF,
    b"NSIF": _NITF,
    b"<?xml": "XML, perhaps the metadata of phase history, without pulses; give the file that holds both",
    b"<CPHD": "the metadata of a CPHD (XML), without its pulses; give the file that holds both",
    b"<CRSD": "the metadata of raw radar data (CRSD, XML); get CPHD or SICD from who made it",
}
"""What other files begin with, and what they are."""


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
    several : bool
        Whether files may hold several channels: `read` is then also given the name of one, or None.
    describe : callable, optional
        What a file holds, for people to read: names and values, or a `SarsplatError` of one sentence.
    begins : bytes
        What every such file begins with, and no other; empty if nothing tells.
    container : bytes
        What it begins with as other files do: that tells only of what is given as phase history.
    """

    what: str
    endings: tuple[str, ...]
    read: Callable[..., PhaseHistory]
    begins: bytes = b""
    container: bytes = b""
    several: bool = False
    describe: Callable[[Path], dict[str, str]] | None = None


def format_of(path: Path) -> PhaseHistoryFormat | None:
    """The format of a file: the one that it begins like, or else the one whose ending it has; None if it has none."""
    formats = FORMATS.loaded().values()
    with open_file(path) as file:
        start = file.read(max(len(one.begins) for one in formats))
    begun = (one for one in formats if one.begins and start.startswith(one.begins))
    ending = (one for one in formats if path.suffix.lower() in one.endings)
    return next(begun, next(ending, None))


def read_phase_history(path: Path, channel: str | None = None) -> PhaseHistory:
    """The pulses of one file, of whichever format; of one channel, if it has several.

    Refused if it is of no format that is known here, cannot be used, or a channel is named where there are none.
    """
    known = format_of(path)
    with open_file(path) as file:
        start = file.read(_HEAD)
    if (what := what_else(start)) is not None:
        raise SarsplatError(f"{path} is {what}")
    if known is None:
        contained = (one for one in FORMATS.loaded().values() if one.container and start.startswith(one.container))
        known = next(contained, None)
    if known is None:
        kinds = " or ".join(one.what for one in FORMATS.loaded().values())
        raise SarsplatError(f"{path} is no phase history of a known format; give {kinds}")
    if known.several:
        return known.read(path, channel)
    if channel is not None:
        raise SarsplatError(f"{path} has no channels ({known.what}), so leave out --channel")
    return known.read(path)


def what_else(start: bytes) -> str | None:
    """What radar data other than phase history are that begin like this, and what to do with them; None if unknown."""
    return next((what for magic, what in _RELATIVES.items() if start.lstrip().startswith(magic)), None)
