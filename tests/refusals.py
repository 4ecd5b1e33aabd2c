"""What is refused: a room has one table of things to do in an empty folder and of words of the sentence they end in."""

import itertools
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from fuzz import sentence_faults, watched
from sarsplat.cli import main
from sarsplat.errors import SarsplatError

Do = Callable[[Path], object]
Refusals = list[tuple[Do, str]]


BOMB = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in itertools.pairwise("abcdefghij")
)
"""XML whose entities grow tenfold nine times."""


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


def xml_changes(xml_of: Callable, with_xml: Callable) -> Callable[[str, str], Callable[[bytes], bytes]]:
    """Make changes of a file's metadata: every match of a pattern."""

    def change(old: str, new: str, data: bytes) -> bytes:
        text, times = re.subn(old, new, xml_of(data).decode(), flags=re.DOTALL)
        assert times
        return with_xml(data, text.encode())

    return lambda old, new: partial(change, old, new)


def check_spoilt(words: list[str], out: Path, told: str, capfd: pytest.CaptureFixture[str]) -> None:
    """An import of a spoilt file ends in one sentence, in little time and memory, and writes nothing."""
    with watched() as cost:
        assert main(["import", *words, "--out", str(out)]) == 2
    [line] = capfd.readouterr().err.splitlines()
    assert re.search(told, line), line
    assert sentence_faults(line) == []
    assert not out.exists()
    assert cost.seconds < 1 and cost.bytes < 64 << 20
