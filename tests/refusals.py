"""What is refused: a room has one table of things to do in an empty folder and of words of the sentence they end in."""

from collections.abc import Callable
from pathlib import Path

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
