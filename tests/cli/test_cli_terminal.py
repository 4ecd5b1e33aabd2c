"""What reaches the terminal: on any encoding, without control characters, and commands as they can be typed here."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from sarsplat.cli import console, main

RUN = "import sys, sarsplat.cli; sys.exit(sarsplat.cli.main())"
SIMULATE = ("simulate", "--target", "t72", "--azimuth", "0", "180", "--grazing", "45", "--pixels", "16")


def test_terminals_that_know_few_letters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for command in ([*SIMULATE, "--out", f"{tmp_path}/out"], ["info", f"{tmp_path}/out"]):
        shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
        monkeypatch.setattr(sys, "stdout", shown)
        assert main(command) == 0
        shown.flush()
    assert b"mean ?" in shown.buffer.getvalue()


@pytest.mark.skipif(sys.platform != "linux", reason="pseudo-terminals are tested on Linux")
def test_mistakes_are_one_sentence_on_a_terminal_too(tmp_path: Path) -> None:
    import pty

    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", RUN, "simulate", "128", "--out", str(tmp_path / "out")]
    environment = os.environ | {"TERM": "xterm-256color"}
    done = subprocess.run(command, stdout=theirs, stderr=theirs, env=environment, check=False)
    shown = os.read(ours, 10_000).decode()
    assert done.returncode == 2
    assert "'128' is one argument too many for sarsplat simulate; remove it" in shown
    assert "\\x1b" not in shown


def test_escape_sequences_of_strangers_are_not_sent(tmp_path: Path, said) -> None:
    said([*SIMULATE, "--out", str(tmp_path / "out")])
    header = tmp_path / "out" / "dataset.json"
    data = json.loads(header.read_text())
    data["source"]["target"] = "\x1b]0;gone\x07[red]t72"
    header.write_text(json.dumps(data))
    shown = said(f"info {tmp_path}/out")
    assert "\x1b" not in shown
    assert "\x07" not in shown
    assert r"\x1b]0;gone\x07[red]t72" in shown


@pytest.mark.skipif(sys.platform != "linux", reason="the size of a process is read from /proc")
def test_when_memory_runs_out(tmp_path: Path, refused) -> None:
    import resource

    usual = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (900 << 20), usual[1]))
    try:
        told = refused([*SIMULATE[:-1], "20000", "--out", f"{tmp_path}/out"])
    finally:
        resource.setrlimit(resource.RLIMIT_AS, usual)
    assert "memory" in told
    assert not list(tmp_path.iterdir())


# ---- the next command -----------------------------------------------------------------------------------------------
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
    assert "make one with `bin/sarsplat simulate`" in capsys.readouterr().err
    console.warn("x/sarsplat view and what sarsplat did; see sarsplat view --help")
    told = capsys.readouterr().err
    assert told == "warning: x/sarsplat view and what sarsplat did; see bin/sarsplat view --help\n"


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("give ground=False or `ground=False`", "give --no-ground or --no-ground"),
        ("pass overwrite=True", "pass --overwrite"),
        ("with preset='scene'", "with --preset scene"),
        ("a smaller `size_m`, as `size_m=30`", "a smaller --size, as --size 30"),
        ("the `columns={'heading': 'NAME', 'class': 'TYPE'}`", "the --columns heading=NAME class=TYPE"),
        ("`resolution_m=(0.5, 0.3)`", "--resolution 0.5 0.3"),
        ("`around=(-47.1, 8.5)`", "--around=-47.1,8.5"),
        ("give `target_class`, `calibration='absolute'` or looks=None", "give --class, --calibrated or --looks 0"),
        ("set `points.rays_per_pixel`, or texture=None", "set --points.rays-per-pixel, or --texture off"),
        ("seed=0/x=True exists; engine='cpu'", "seed=0/x=True exists; engine='cpu'"),
        (
            "object missing required field 'views'; `sarsplat check x`",
            "object missing required field 'views'; `sarsplat check x`",
        ),
        ("say `columns={'incidence': 'Angle (deg)'}`", "say --columns 'incidence=Angle (deg)'"),
        ("ground=True/run and a,looks=None.png do not exist", "ground=True/run and a,looks=None.png do not exist"),
    ],
)
def test_parameters_are_options(message: str, shown: str) -> None:
    assert console.as_options(message) == shown


# ---- warnings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("grazing", "told"),
    [
        (15, ["the shape is uncertain; add views", "is uncertain: the weakest direction of its views is 77°"]),
        (60, []),
    ],
)
def test_an_uncertain_shape_is_called_so_before_and_after(box: Path, grazing, told, tmp_path: Path, capsys) -> None:
    ring = f"simulate --mesh {box}/box.obj --azimuth 0:360:45 --grazing {grazing} --pixels 16 --out {tmp_path}/ring"
    few = "--iterations 20 --gaussians 200 --points.voxel 0.3 --points.rays-per-pixel 2"
    assert main(ring.split()) == 0
    capsys.readouterr()
    assert main(f"reconstruct {tmp_path}/ring {few} --out {tmp_path}/run".split()) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert len(lines) == len(told)
    assert all(part in line for part, line in zip(told, lines, strict=True))
