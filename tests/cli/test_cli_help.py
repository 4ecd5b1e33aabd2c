"""Help must be instant."""

import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest

from sarsplat.cli import main
from sarsplat.names import TargetName
from sarsplat.reconstruction.config import Config, Densification, FlatGround, Surroundings
from sarsplat.scenes import TARGETS

PROGRAM = """
import sys, time
from sarsplat.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    heavy = sorted({"torch", "numpy", "scipy", "matplotlib", "trimesh"} & set(sys.modules))
    print(f"code={end.code} heavy={heavy}")
print(time.process_time())
"""


def _shown(program: str, *arguments: str) -> str:
    call = [sys.executable, "-c", program, *arguments]
    return subprocess.run(call, capture_output=True, text=True, check=True).stdout


@pytest.fixture(scope="module")
def long_s() -> float:
    """What importing torch takes here and now, as every other command must before it begins: CPU time, seconds."""
    return float(_shown("import time, torch; print(time.process_time())"))


@pytest.mark.parametrize(
    "command",
    [
        ["--help"],
        ["simulate", "--help"],
        ["reconstruct", "--help"],
        ["import", "mstar", "--help"],
        ["render", "--help"],
    ],
)
def test_help_is_fast_and_imports_nothing_heavy(command: list[str], long_s: float) -> None:
    for _ in range(5):  # the least of five: beside other work, caches are shared
        *shown, ended, took_s = _shown(PROGRAM, *command).splitlines()
        if float(took_s) < 0.4 * long_s:
            break
    assert ended == "code=0 heavy=[]"
    assert float(took_s) < 0.4 * long_s
    assert shown[0].startswith(f"usage: {' '.join(['sarsplat', *command[:-1]])} [-h]")


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
    whole = Config(densification=Densification(), ground=FlatGround(), surroundings=Surroundings())
    for record, prefix in (
        (whole, ""),
        *(
            (getattr(whole, part), f"{part}.")
            for part in ("rates", "points", "densification", "ground", "surroundings")
        ),
    ):
        for field in fields(record):
            if isinstance(value := getattr(record, field.name), int | float):
                flag = f"--{prefix}{field.name}".replace("_", "-")
                assert re.search(rf"{re.escape(flag)} ((?!--).)*\(default: {value}\)", shown), flag
    for part in ("rates", "points", "densification", "ground", "surroundings"):
        assert f"{part} options" in shown


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
