"""Importers by name, and recognition of a file or folder by their functions `recognise`.

`recognise(contents)`, beside the function that is the command, returns a `Recognised`, or None for other contents.
"""

import inspect
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from sarsplat.errors import SarsplatError
from sarsplat.plugins import discover

IMPORTERS = discover("sarsplat.cli", "import_", "command", "sarsplat.importers")
"""`import NAME` by name: `command` in the file `import_NAME.py` of this folder, or an entry point."""

_MOST_TRIED = 8  # maximum number of files of a folder that are opened to find one that can be read


@dataclass(frozen=True)
class Contents:
    """A folder with the files in it and in its subfolders, sorted; or a single file."""

    path: Path
    files: list[Path]

    def ending_in(self, *endings: str) -> list[Path]:
        """Return the files with one of these endings, which are in small letters."""
        return [path for path in self.files if path.suffix.lower() in endings]


@dataclass(frozen=True)
class Recognised:
    """Description of a file or folder that an importer reads."""

    kind: str
    """Short name."""
    facts: dict[str, str] = field(default_factory=dict)
    """Names and values."""
    certainty: float = 1.0
    """Certainty between 0 and 1: the most certain importer is chosen."""


def recognised(path: Path) -> tuple[str, Recognised] | None:
    """Return the name and description of the importer that reads a file or folder; None if none does.

    Raises if the folder, or a file that decides, cannot be read.
    """
    from sarsplat.importers.files import files_in

    contents = Contents(path, files_in(path, "images to import") if path.is_dir() else [path])
    answers = []
    for name, command in IMPORTERS.loaded().items():
        recognise = getattr(inspect.getmodule(command), "recognise", None)
        if recognise is not None and (answer := recognise(contents)) is not None:
            answers.append((name, answer))
    return max(answers, key=lambda answer: answer[1].certainty, default=None)


def first_described(files: Sequence[Path], describe: Callable[[Path], Recognised]) -> Recognised | None:
    """Return the description of the first of several files that can be read; None if the first few cannot."""
    for path in files[:_MOST_TRIED]:
        with suppress(SarsplatError):
            found = describe(path)
            return found if len(files) == 1 else replace(found, facts={"the first": str(path), **found.facts})
    return None
