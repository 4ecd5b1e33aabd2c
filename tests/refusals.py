"""What is refused: a room has one table of things to do in an empty folder and of words of the sentence they end in."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sarsplat.errors import SarsplatError

Do = Callable[[Path], object]
Refusals = list[tuple[Do, str]]


def check_refused(at: Path, do: Do, words: str) -> None:
    """It ends in that sentence, and nothing is begun that is called out."""
    with pytest.raises(SarsplatError, match=words):
        do(at)
    assert not [*at.glob("*out*")]


def stored(data: bytes, read: Do, name: str = "a") -> Do:
    """To read a file of these bytes."""

    def do(at: Path) -> object:
        (at / name).write_bytes(data)
        return read(at / name)

    return do


def edit_json(path: Path, place: str, value: object) -> dict[str, Any]:
    """Put another value at a dotted place of a file, or remove what is there for KeyError; returns the whole."""
    *parents, last = [int(key) if key.isdigit() else key for key in place.split(".")]
    inner = whole = json.loads(path.read_text())
    for key in parents:
        inner = inner[key]
    if value is KeyError:
        del inner[last]
    else:
        inner[last] = value
    path.write_text(json.dumps(whole))
    return whole
