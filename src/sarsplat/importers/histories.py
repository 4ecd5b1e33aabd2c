"""Formats of phase history: a module `history_NAME` each, or an entry point of another package."""

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
}
"""First bytes of other radar data → description and remedy."""


@dataclass(frozen=True)
class PhaseHistoryFormat:
    """Format of phase history; its functions raise a `SarsplatError` of one sentence, since files are untrusted."""

    what: str
    """Name of such files, in a few words."""
    endings: tuple[str, ...]
    """Endings of their names, in small letters, such as ".mat"."""
    read: Callable[..., PhaseHistory]
    """Function that reads one file."""
    begins: bytes = b""
    """First bytes of every such file and of no other; empty if they vary."""
    container: bytes = b""
    """First bytes that such files share with others: decisive only for files given as phase history."""
    several: bool = False
    """True if files may hold several channels: `read` is then also given the name of one, or None."""
    describe: Callable[[Path], dict[str, str]] | None = None
    """Function that returns facts of a file, names and values."""


def format_of(path: Path) -> PhaseHistoryFormat | None:
    """Return the format of a file by its first bytes, or else by its ending; None if unknown."""
    formats = FORMATS.loaded().values()
    with open_file(path) as file:
        start = file.read(max(len(one.begins) for one in formats))
    begun = (one for one in formats if one.begins and start.startswith(one.begins))
    ending = (one for one in formats if path.suffix.lower() in one.endings)
    return next(begun, next(ending, None))


def read_phase_history(path: Path, channel: str | None = None) -> PhaseHistory:
    """Read the pulses of one file; of several channels, of the named one.

    Raises if its format is unknown, it cannot be used, or a channel is named of a format without channels.
    """
    known = format_of(path)
    with open_file(path) as file:
        start = file.read(_HEAD)
    if what := next((what for magic, what in _RELATIVES.items() if start.startswith(magic)), None):
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
        raise SarsplatError(f"{path} has no channels ({known.what}); leave out `channel`")
    return known.read(path)
