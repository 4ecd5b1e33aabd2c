"""What reaches the terminal: on any encoding, without control characters; and of a newcomer's mistakes one sentence."""

import io
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from made import write_geotiff
from sarsplat import extras
from sarsplat.cli import console, main

RUN = "import sys, sarsplat.cli; sys.exit(sarsplat.cli.main())"
QUICKLY = ("simulate", "--target", "t72", "--azimuth", "0", "180", "--grazing", "45", "--pixels", "16")


def test_letters_are_those_of_the_terminal_and_escape_sequences_are_not_sent(tmp_path, monkeypatch, said) -> None:
    with monkeypatch.context() as patch:
        for command in ([*QUICKLY, "--out", f"{tmp_path}/out"], ["info", f"{tmp_path}/out"]):
            shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
            patch.setattr(sys, "stdout", shown)
            assert main(command) == 0
            shown.flush()
    assert b"mean ?" in shown.buffer.getvalue()
    header = tmp_path / "out" / "dataset.json"
    data = json.loads(header.read_text())
    data["source"]["target"] = "\x1b]0;gone\x07[red]t72"
    header.write_text(json.dumps(data))
    told = said(f"info {tmp_path}/out")
    assert "\x1b" not in told
    assert "\x07" not in told
    assert r"\x1b]0;gone\x07[red]t72" in told


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


@pytest.mark.skipif(sys.platform != "linux", reason="the size of a process is read from /proc")
def test_when_memory_runs_out(tmp_path: Path, refused) -> None:
    import resource

    usual = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (900 << 20), usual[1]))
    try:
        told = refused([*QUICKLY[:-1], "20000", "--out", f"{tmp_path}/out"])
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
    (hint,) = re.findall(r"^next: (.*)$", said([*QUICKLY, "--out", "two words"]), re.MULTILINE)
    assert hint.startswith("tools/sarsplat reconstruct 'two words'")
    asked = subprocess.run(f"{hint} --help", shell=True, capture_output=True, text=True, check=False)
    assert asked.returncode == 0, asked.stderr


@pytest.mark.parametrize(
    ("called", "where", "path", "typed"),
    [
        ("tools/sarsplat", ".", "", "tools/sarsplat"),
        ("{here}/tools/sarsplat", ".", "", "tools/sarsplat"),
        ("sarsplat", "tools", "", "./sarsplat"),
        ("{here}/tools/sarsplat", "elsewhere", "", "{here}/tools/sarsplat"),
        ("{here}/tools/sarsplat", "elsewhere", "tools", "sarsplat"),  # on the path the name is enough
        ("pytest", ".", "", "sarsplat"),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="paths are written differently there")
def test_how_the_program_was_called(script, tmp_path, monkeypatch, called, where, path, typed):
    monkeypatch.chdir(tmp_path / where)
    monkeypatch.setenv("PATH", str(tmp_path / path), prepend=os.pathsep)
    monkeypatch.setattr(sys, "argv", [called.format(here=tmp_path)])
    assert console.program() == typed.format(here=tmp_path)


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
    [(15, ["the shape is uncertain; add views", "is uncertain: the weakest direction of its views is 77°"]), (60, [])],
)
def test_an_uncertain_shape_is_called_so_before_and_after(box: Path, grazing, told, tmp_path: Path, ended) -> None:
    ring = f"simulate --mesh {box}/box.obj --azimuth 0:360:45 --grazing {grazing} --pixels 16 --out {tmp_path}/ring"
    few = "--iterations 20 --gaussians 200 --points.voxel 0.3 --points.rays-per-pixel 2"
    assert main(ring.split()) == 0
    _, complaints = ended(f"reconstruct {tmp_path}/ring {few} --out {tmp_path}/run", 0)
    lines = [line for line in complaints.splitlines() if line.startswith("warning: ")]
    assert len(lines) == len(told)
    assert all(part in line for part, line in zip(told, lines, strict=True))


# ---- what a newcomer gets wrong first: one sentence, exit code 2, nothing written ------------------------------------
@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with an empty folder and one full of other things."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "picture.png").write_bytes(b"\x89PNG")
    (tmp_path / "full" / "broken.tif").write_bytes(b"II*\0nonsense")
    write_geotiff(tmp_path / "full" / "dem.tif", np.zeros((4, 4), np.float32))
    monkeypatch.chdir(tmp_path)
    return tmp_path


SIMULATE, ONE_VIEW = "simulate --out new --target t72", "--azimuth 0 --grazing 45"

MISTAKES = {
    "simulate --out new": "neither --target nor --mesh",
    f"{SIMULATE} --mesh a.obj": "both --target and --mesh",
    f"{SIMULATE} --azimuth 0 --grazing 95": "95",
    f"{SIMULATE} --grazing 45": "--azimuth is missing",
    f"{SIMULATE} {ONE_VIEW} --incidence 45": "leave out one of them",
    f"{SIMULATE} --random-views 3 --azimuth 0": "--random-views draws the azimuths",
    f"{SIMULATE} --random-views 0": "--random-views is 0",
    f"{SIMULATE} --random-views 3 --test-azimuth 5": "--test-grazing is missing",
    f"{SIMULATE} --random-views 3 --test-azimuth 5 --test-protocol": "--test-protocol sets the test views",
    f"{SIMULATE} {ONE_VIEW} --test-azimuth 0": "are training views",
    f"{SIMULATE} --test-azimuth 5": "--test-azimuth needs --azimuth",
    f"{SIMULATE} {ONE_VIEW} --pixels 0": "0 × 0",
    f"{SIMULATE} {ONE_VIEW} --looks -1": "--looks is -1.0",
    f"{SIMULATE} --clean-tests": "--clean-tests needs --looks",
    f"{SIMULATE} {ONE_VIEW} --looks 1 --clean-tests": "--clean-tests needs test views",
    f"{SIMULATE} --response hann": "'hann'",
    f"{SIMULATE} --bounces 2 --ground 0.1": "give |Γ|²",
    f"{SIMULATE} --bounces 2 --passes 2 --baseline 0.004": "--passes makes stacks, not single images, but --bounces 2",
    f"{SIMULATE} --polarimetric --looks 4": "--polarimetric makes stacks, not single images, but --looks was given",
    f"{SIMULATE} --baseline 0.004": "--baseline needs --passes or --polarimetric",
    f"{SIMULATE} --polarimetric --baseline 0.004": "--baseline needs --passes",
    f"{SIMULATE} --passes 1 --baseline 0.004": "--passes is 1",
    f"{SIMULATE} --passes 3 --baseline 0 0.1": "--baseline has 2 numbers",
    f"{SIMULATE} --bounces 2 --source splat": "second bounces need",
    f"{SIMULATE} --ground 0.1 --terrain full/dem.tif --masks": "but --terrain was given",
    f"{SIMULATE} --isar 0 0": "--isar has 2 numbers; give three",
    f"{SIMULATE} --isar 0 0 1 --line-of-sight 1 0": "--line-of-sight has 2 numbers",
    f"{SIMULATE} --isar 0 0 1 --ground 0.1": "but --ground was given",
    "simulate --out new --target satellite": "give the axis",
    f"simulate --target t72 {ONE_VIEW} --out full": "--overwrite",
    "reconstruct nowhere --out new": "nowhere: it does not exist",
    "reconstruct empty --out new": "empty is not a dataset",
    "reconstruct full --out new": "not a dataset",
    "reconstruct full --out new --resume --overwrite": "one of them",
    "evaluate nowhere": "nowhere does not exist",
    "report full": "not a run",
    "chips nowhere --out new": "does not exist",
    "info full --plot new.png": "draws the views of a dataset",
    "import mstar nowhere --out new --class T72 --train-views 8": "folder",
    "import sicd a.nitf --out new --size far": "--size 'far' is not a number; write it as 64",
    "recontruct": "'recontruct' is not a command of sarsplat; did you mean reconstruct?",
    "bogus": "'bogus' is not a command of sarsplat; choose one of ",
    "import": "sarsplat import needs a command; choose one of folder, mstar, phase-history, ",
    "import mstr": "'mstr' is not a command of sarsplat import; did you mean mstar?",
    "simulate --target t72 --oout x": "--oout is not an option of sarsplat simulate; did you mean --out?",
    "simulate --target T-72 --out new": "--target 'T-72' is unknown; did you mean t72?",
    "simulate --target=zeppelin --out new": "--target 'zeppelin' is unknown; choose one of 2s1, aircraft, btr70, ",
    f"{SIMULATE} --azimuth 0:360:-10": "--azimuth '0:360:-10' is 0 angles; give 1 to 10000 in steps",
    f"{SIMULATE} --law 1": "--law takes 2 or 3 numbers, not 1; see sarsplat simulate --help",
    f"{SIMULATE} --law 1 a": "--law 'a' is not a number; see sarsplat simulate --help",
    f"{SIMULATE} --target-box 0 0 0 1 1": "--target-box takes 6 numbers, not 5; see",
    f"{SIMULATE} --target-box 0 0 0 1 1 0": "--target-box 0 0 0 1 1 0 is no box",
    "simulate --target t72": "--out is missing; see sarsplat simulate --help",
    "simulate --out": "--out needs a value; give 1",
    "simulate --out new --pixels many": "--pixels does not accept 'many'; see sarsplat simulate --help",
    f"{SIMULATE} --spacing 1 2 3": "--spacing has 3 numbers; give one, or two: azimuth and range",
    "reconstruct full --out new --xyz": "--xyz is not an option of sarsplat reconstruct; sarsplat reconstruct --help",
    "reconstruct full --out new --rates.mean-m 5": "--rates.mean-m is not an option of sarsplat reconstruct; did you",
    "reconstruct full --out new --iterations five": "--iterations 'five' is not a whole number; give one",
    "reconstruct full --out new --rates.means x": "--rates.means 'x' is not a number; give one",
    "reconstruct full other --out new": "sarsplat reconstruct does one target at a time, and 'other' is another; see `",
    "evaluate full other": "'other' is one argument too many for sarsplat evaluate; remove it",
    "evaluate": "RUN|PLY is missing; see sarsplat evaluate --help",
    "completion tcsh": "shell 'tcsh' is unknown; choose one of bash, fish, zsh",
}


@pytest.mark.parametrize(
    ("words", "columns"), [*((words, "40") for words in MISTAKES), *((words, "200") for words in [*MISTAKES][::12])]
)
def test_mistakes_are_reported_in_one_sentence(words: str, columns: str, place: Path, monkeypatch, refused) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    complaint = refused(words)
    assert MISTAKES[words] in complaint
    assert not set("│─╭╯") & set(complaint)
    assert {path.name for path in place.iterdir()} == {"empty", "full"}


def test_from_source_a_missing_extra_is_named_by_its_packages(tmp_path: Path, monkeypatch, refused) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    monkeypatch.setattr(extras, "installed_version", lambda _: None)  # no index has our package
    told = refused(f"simulate --target t72 --out {tmp_path / 'new'} {ONE_VIEW}")
    assert "not installed; install it with: pip install trimesh" in told


def test_ctrl_c_while_the_program_is_loading(monkeypatch, capsys) -> None:
    class Interrupted:
        def find_spec(self, name: str, *_: object) -> None:
            if name == "sarsplat.cli.app":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "sarsplat.cli.app", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    assert main(["doctor"]) == 130
    assert capsys.readouterr().err == "error: stopped by Ctrl-C; nothing half-written was left behind\n"


def test_ctrl_c_after_the_work_is_done_changes_nothing(monkeypatch) -> None:
    usual = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("sys.argv", ["sarsplat", "--version"])
    try:
        assert main() == 0
        signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, usual)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(28, "No space left on device"), "the disk is full; free some space"),
        (OSError("odd"), "odd; check the path and the disk"),
    ],
)
def test_what_no_command_foresaw_is_one_sentence(error: OSError, reason: str, monkeypatch, refused) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("sarsplat.cli.app.parse", fail)
    assert refused("doctor") == f"error: cannot use a file: {reason}\n"
