"""Which importers there are, and which of them reads a file or folder: each says so in its function `recognise`.

`recognise(contents)`, beside the function that is the command, returns a `Recognised`, or None for what is not its own.
"""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from sarsplat.errors import SarsplatError, counted
from sarsplat.plugins import discover

T = TypeVar("T")

IMPORTERS = discover("sarsplat.cli", "import_", "command", "sarsplat.importers")
"""`import NAME` by name: `command` in the file `import_NAME.py` of this folder, or an entry point."""

USUAL_TRAIN_VIEWS = 36
_NAMED = 3
"""Files of many that cannot be read."""


@dataclass(frozen=True)
class Contents:
    """A folder with the files in it and in its subfolders, sorted; or a single file."""

    path: Path
    files: list[Path]

    def ending_in(self, *endings: str) -> list[Path]:
        """The files with one of these endings, which are in small letters."""
        return [path for path in self.files if path.suffix.lower() in endings]


@dataclass(frozen=True)
class Recognised:
    """What a file or folder of images seems to be."""

    kind: str
    """In a few words."""
    facts: dict[str, str] = field(default_factory=dict)
    """Names and values."""
    command: str | None = None
    """What to type to import it; words in capitals (`to_replace`) are to be replaced. None if there is no such."""
    certainty: float = 1.0
    """Between 0 and 1: of several importers, the most certain one is believed."""
    also: dict[str, str] = field(default_factory=dict)
    """Other commands that fit, each after what it is for."""


def recognised(path: Path) -> Recognised | None:
    """What a file, or a folder that is neither a dataset nor a run, can be imported as; None if it holds no images.

    Of a table (CSV), what it is the table of. Refused if it cannot be read, or a file that decides is damaged.
    """
    from sarsplat.importers.files import files_in

    is_table = path.suffix.lower() == ".csv" and path.is_file()
    folder = path.absolute().parent if is_table else path
    contents = Contents(folder, files_in(folder, "images to import") if folder.is_dir() else [path])
    asked: list[Callable[[Contents], Recognised | None] | None]
    asked = [getattr(inspect.getmodule(command), "recognise", None) for command in IMPORTERS.loaded().values()]
    answers = [answer for recognise in asked if recognise is not None and (answer := recognise(contents)) is not None]
    best = max(answers, key=lambda answer: answer.certainty, default=None)
    if best is None or not is_table:
        return best
    its_own = best.certainty == 1 and any(path.name in fact for fact in best.facts.values())
    return best if its_own else None  # of what else lies in the folder


def by_ending(contents: Contents, endings: tuple[str, ...], command: str, what: str) -> Recognised | None:
    """Files that may be of some kind, as their endings are all that is known of them."""
    if not (files := contents.ending_in(*endings)):
        return None
    first = files[0]
    pattern = f"{shlex.quote(str(first.parent))}/*{first.suffix}" if len(files) > 1 else shlex.quote(str(first))
    typed = f"sarsplat import {command} {pattern} --size METRES --out {shlex.quote(dataset_name(first.parent))}"
    kind = f"{len(files)} {first.suffix} files" if len(files) > 1 else f"a {first.suffix} file"
    return Recognised(f"{kind}, which may be {what}", {}, typed, certainty=0.5)


_MOST_TRIED = 8
"""Files of a folder that are opened to find one that can be read: an ending may be that of many other things."""


def first_readable(
    files: Sequence[Path], read: Callable[[Path], T]
) -> tuple[tuple[Path | None, T | None], dict[str, str]]:
    """The first of a folder's files that can be read and what `read` makes of it, and a fact of those before it.

    None of both if none of the first few can be read.
    """
    refused: list[str] = []
    for path in files[:_MOST_TRIED]:
        try:
            return (path, read(path)), unusable(refused)
        except SarsplatError as error:
            refused.append(str(error))
    return (None, None), unusable(refused)


def unusable(refused: Sequence[str]) -> dict[str, str]:
    """A fact of files that cannot be read, by what is wrong with each; nothing if there are none."""
    more = [f"and {counted(len(refused) - _NAMED, 'other')}"] if len(refused) > _NAMED else []
    return {"unusable": "\n".join([*refused[:_NAMED], *more])} if refused else {}


def typed_import(*words: str, out: str) -> str:
    """The command, as a shell takes it."""
    return shlex.join(["sarsplat", "import", *words, "--out", out])


def dataset_name(folder: Path) -> str:
    """What to call the dataset that is made of a folder."""
    return f"{folder.resolve().name}-dataset"


_MEANT = {
    ("--spacing", "METRES"): "distance of pixels in the slant plane, m; two numbers if it differs, azimuth and range",
    ("--resolution", "METRES"): "3 dB width of a point, m; two numbers if it differs, azimuth and range",
    ("--size", "METRES"): "side of the images, m, in azimuth and slant range",
    ("--wavelength", "METRES"): "that of the radar, m",
    ("--grazing", "DEGREES"): "of the line of sight above the horizon: 90 minus the incidence angle",
    ("--quantity", "QUANTITY"): "what the numbers are: amplitude, power or db",
    (
        "--geocoded",
        "GROUND",
    ): "what their producer took for the ground: level; or terrain, and its heights with --terrain",
    ("--look", "SIDE"): "to which side of its flight the radar looks: right or left",
    ("--table", "TABLE.csv"): "a row for each picture; columns file, azimuth and grazing, in degrees",
    ("--columns", "NAME"): "what the table calls that column",
    ("--azimuth", "DEGREES"): "direction of the radar, clockwise from the map's right",
}


def to_replace(command: str) -> list[str]:
    """A sentence for each word in capitals of a command that is to be replaced: what to put there."""
    words = shlex.split(command)
    return [
        f"{option} {placeholder}: {meaning}"
        for (option, placeholder), meaning in _MEANT.items()
        if option in words and placeholder in re.split("[=,]", words[words.index(option) + 1])
    ]


def training_half(images: int) -> str:
    """How many of them to train on, as an option takes it."""
    return str(min(USUAL_TRAIN_VIEWS, max(1, images // 2)))
