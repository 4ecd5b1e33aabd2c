"""What help says; how soon it does is in test_cli_startup.py."""

import inspect
import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest

from sarsplat import importers
from sarsplat.cli import main
from sarsplat.cli.commands import COMMANDS
from sarsplat.cli.importers import IMPORTERS
from sarsplat.names import TargetName
from sarsplat.scenes import TARGETS
from sarsplat.settings.config import Config
from sarsplat.settings.sections import Densification, FlatGround, Surroundings


def test_the_overview_says_of_every_command_what_its_own_help_says_first(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for words, names in (([], COMMANDS), (["import"], IMPORTERS)):
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        shown = re.findall(r"^│ ([\w-]+)  +(\S.*?) *│$", capsys.readouterr().out, re.MULTILINE)
        assert [name for name, _ in shown] == list(names)
        for name, text in shown:
            with pytest.raises(SystemExit):
                main([*words, name, "--help"])
            assert text in capsys.readouterr().out.splitlines(), name


@pytest.mark.parametrize("name", [name for name in importers.__all__ if name.startswith("import_")])
def test_an_import_has_an_option_for_everything_that_its_function_takes(name: str) -> None:
    taken = inspect.signature(getattr(importers, name)).parameters
    about = getattr(importers, taken["about"].annotation[len("Unpack[") : -1])
    options = inspect.signature(IMPORTERS[name.removeprefix("import_").replace("_", "-")]).parameters
    assert options.keys() == taken.keys() - {"about", "quiet"} | about.__annotations__.keys()
    assert all(one.annotation.__metadata__[-1].help for one in options.values())


def test_help_without_a_command_names_the_version_option_too(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([])
    assert end.value.code in (0, None)
    told = capsys.readouterr().out
    assert "usage: sarsplat [-h]" in told
    assert "`sarsplat --version`" in told
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("sarsplat ")


def test_the_package_is_a_program_that_is_called_by_the_same_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    command = [sys.executable, "-m", "sarsplat", "import", "mstar"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f"error: CHIPS is missing; see {sys.executable} -m sarsplat import mstar --help\n"


def test_help_shows_every_setting(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        main(["reconstruct", "--help"])
    shown = re.sub(r"[│\s]+", " ", capsys.readouterr().out)
    assert "on the ground (docs/concepts/measured-chips.md); any of its options below switches it on." in shown
    whole = Config(densification=Densification(), ground=FlatGround(), surroundings=Surroundings())
    parts = ("rates", "points", "densification", "ground", "surroundings")
    for record, prefix in ((whole, ""), *((getattr(whole, part), f"{part}.") for part in parts)):
        for field in fields(record):
            if isinstance(value := getattr(record, field.name), int | float):
                flag = f"--{prefix}{field.name}".replace("_", "-")
                assert re.search(rf"{re.escape(flag)} ((?!--).)*\(default: {value}\)", shown), flag
    assert all(f"{part} options" in shown for part in parts)


def test_help_is_whole_wherever_it_is_asked_for(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for words in ("evaluate --help", "evaluate run --align rigid -h"):
        with pytest.raises(SystemExit):
            main(words.split())
        told = capsys.readouterr().out
        assert told.startswith("usage: sarsplat evaluate [-h] [OPTIONS] RUN|PLY\n")
        assert "(x towards the nose, z up, ground at z = 0); without it" in told  # no line ends early


def test_names_that_are_repeated_for_the_sake_of_speed() -> None:
    assert get_args(TargetName) == tuple(TARGETS)


def test_a_reader_that_leaves_is_no_mistake() -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "sarsplat", "reconstruct", "--help"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize(
    ("command", "shown"),
    [("import folder", "{amplitude,power,db,complex}"), ("export", "{db,height}"), ("render", "{azimuth,grazing}")],
)
def test_choices_are_names_only(command: str, shown: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    told = capsys.readouterr().out
    assert shown in told
    assert not re.search(r"\bNone\b", told)
