"""A run as one file for other programs: each format is a module `format_NAME.py` of this folder."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from sarsplat.data.viewer_colours import Colour
from sarsplat.errors import SarsplatError
from sarsplat.exports.format import Content, Format
from sarsplat.reconstruction import Run

__all__ = ["FORMATS", "Content", "Format", "Written", "export", "format_of"]

_FOUND = [
    import_module(f"{__name__}.{info.name}").FORMAT for info in iter_modules(__path__) if info.name[:7] == "format_"
]
FORMATS: dict[str, Format] = {known.ending: known for known in _FOUND}
"""Every format by the ending of its files."""


@dataclass(frozen=True)
class Written:
    """What an export wrote, and which programs open it."""

    summary: str
    opened_with: str


def format_of(path: Path, content: Content | None = None) -> tuple[Format, Content]:
    """The format of files of this name, and what they hold unless asked otherwise.

    Raises
    ------
    SarsplatError
        If the ending is unknown, or such files cannot hold that.
    """
    known = FORMATS.get(path.suffix.lower())
    fit = [ending for ending, other in FORMATS.items() if content is None or content in other.writers]
    if known is None or path.suffix.lower() not in fit:
        what = {None: "an export", "mesh": "a mesh"}.get(content, content)
        endings = " or ".join(", ".join(fit).rsplit(", ", 1))
        raise SarsplatError(f"{path} is no name for {what}; choose one that ends in {endings}")
    return known, next(iter(known.writers)) if content is None else content


def export(run: Run, path: str | Path, content: Content | None = None, *, colour: Colour | None = None) -> Written:
    """Write a run to one file, whole or not at all.

    Parameters
    ----------
    run : Run
        What was reconstructed.
    path : str or Path
        File to write; its ending decides the format (`FORMATS`). An existing file is replaced.
    content : "gaussians", "points", "mesh" or "everything", optional
        What it holds, where a format can hold several.
    colour : "db" or "height", optional
        What viewers show of Gaussians: γ⁰ in decibels (the default) or the height.

    Raises
    ------
    SarsplatError
        If the ending is unknown, the format cannot hold that, the run has none of it, a package is missing, a colour
        is given for something else than Gaussians, or the file cannot be written.
    """
    path = Path(path)
    known, holds = format_of(path, content)
    if colour is not None and holds != "gaussians":
        raise SarsplatError(f"{path} will hold {holds}, whose colours are not chosen; leave out the colour")
    return Written(known.writers[holds](run, path, colour or "db"), known.opened_with[holds])
