"""Commands that must succeed or be refused, and a small target for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import trimesh

from sarsplat.cli import main

Command = Callable[[str | Sequence[str]], str]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Command:
    """What a command that succeeds says on stdout."""

    def run(words: str | Sequence[str]) -> str:
        capsys.readouterr()
        assert main(words.split() if isinstance(words, str) else words) == 0
        return capsys.readouterr().out

    return run


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Command:
    """What is said to a command that is refused: one sentence."""

    def run(words: str | Sequence[str]) -> str:
        capsys.readouterr()
        assert main(words.split() if isinstance(words, str) else words) == 2
        complaint = capsys.readouterr().err
        assert complaint.startswith("error: ")
        assert complaint.count("\n") == 1
        return complaint

    return run


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `box.obj`, 2.4 m long."""
    folder = tmp_path_factory.mktemp("box")
    trimesh.creation.box(extents=(2.4, 1.2, 1.0)).apply_translation((0, 0, 0.5)).export(folder / "box.obj")
    return folder
