"""The next command that a command names can be typed as it stands, however the program was called."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from sarsplat.cli import console, main

SIMULATE = ("simulate", "--target", "t72", "--azimuth", "0", "180", "--grazing", "45", "--pixels", "16")


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """The console script, in a folder that no PATH has."""
    made = tmp_path / "tools" / "sarsplat"
    made.parent.mkdir()
    (tmp_path / "elsewhere").mkdir()
    made.write_text(f"#!{sys.executable}\nimport sys\nfrom sarsplat.cli import main\nsys.exit(main())\n")
    made.chmod(0o755)
    return made


@pytest.mark.skipif(sys.platform == "win32", reason="scripts are .exe files there")
def test_the_hint_of_a_script_that_is_not_on_the_path_works(script, tmp_path, monkeypatch, said):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["tools/sarsplat"])  # as a shell calls it
    (hint,) = re.findall(r"^next: (.*)$", said([*SIMULATE, "--out", "two words"]), re.MULTILINE)
    assert hint.startswith("tools/sarsplat reconstruct 'two words'")
    asked = subprocess.run(f"{hint} --help", shell=True, capture_output=True, text=True, check=False)
    assert asked.returncode == 0, asked.stderr


@pytest.mark.parametrize(
    ("called", "where", "typed"),
    [
        ("tools/sarsplat", ".", "tools/sarsplat"),
        ("{here}/tools/sarsplat", ".", "tools/sarsplat"),
        ("sarsplat", "tools", "./sarsplat"),
        ("{here}/tools/sarsplat", "elsewhere", "{here}/tools/sarsplat"),
        ("pytest", ".", "sarsplat"),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="paths are written differently there")
def test_how_the_program_was_called(script, tmp_path, monkeypatch, called, where, typed):
    monkeypatch.chdir(tmp_path / where)
    monkeypatch.setattr(sys, "argv", [called.format(here=tmp_path)])
    assert console.program() == typed.format(here=tmp_path)


def test_on_the_path_the_name_is_enough(script, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(script.parent), prepend=os.pathsep)
    monkeypatch.setattr(sys, "argv", [str(script)])
    assert console.program() == "sarsplat"


def test_commands_are_shown_alike_wherever_they_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(console, "program", lambda: "bin/sarsplat")
    (tmp_path / "empty").mkdir()
    assert main(["reconstruct", "empty", "--out", "new"]) == 2
    assert "`bin/sarsplat simulate` or `bin/sarsplat import`" in capsys.readouterr().err
    console.warn("x/sarsplat view and what sarsplat did; see sarsplat view --help")
    told = capsys.readouterr().err
    assert told == "warning: x/sarsplat view and what sarsplat did; see bin/sarsplat view --help\n"


def test_what_is_no_command_stays_as_it_is(capsys):
    assert main(["info", "nowhere"]) == 2
    console.finish("a.png", "look at a.png")
    assert "next: look at a.png" in capsys.readouterr().out
