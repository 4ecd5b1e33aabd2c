"""What a newcomer gets wrong first: one sentence on stderr, exit code 2, nothing written."""

import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from made import write_geotiff
from sarsplat import extras
from sarsplat.cli import main

SIMULATE, ONE_VIEW = "simulate --out new --target t72", "--azimuth 0 --grazing 45"

MISTAKES = {
    "simulate --out new": "neither --target nor --mesh",
    f"{SIMULATE} --mesh a.obj": "both --target and --mesh",
    "simulate --out new --mesh nowhere.obj": "nowhere.obj",
    f"{SIMULATE} --azimuth 0 --grazing 95": "95",
    f"{SIMULATE} --grazing 45": "--azimuth is missing",
    f"{SIMULATE} --azimuth 0,30,60": "--grazing is missing",
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
    f"{SIMULATE} --ground-reflectivity 0.5": "only second bounces",
    f"{SIMULATE} --bounces 2 --ground 0.1": "give |Γ|²",
    f"{SIMULATE} --bounces 2 --passes 2 --baseline 0.004": "but --bounces 2 was given",
    f"{SIMULATE} --bounces 2 --source splat": "second bounces need",
    f"{SIMULATE} --terrain full/dem.tif": "needs the γ⁰",
    f"{SIMULATE} --ground 0.1 --terrain full/dem.tif --masks": "but --terrain was given",
    f"{SIMULATE} --ground 0.1 --terrain missing.tif": "missing.tif",
    f"{SIMULATE} --isar 0 0": "--isar has 2 numbers; give three",
    f"{SIMULATE} --isar 0 0 1 --line-of-sight 1 0": "--line-of-sight has 2 numbers",
    f"{SIMULATE} --isar 0 0 1 --ground 0.1": "but --ground was given",
    f"{SIMULATE} --isar 1 0 0.5": "along the line of sight",
    "simulate --out new --target satellite": "give the axis",
    f"simulate --target t72 {ONE_VIEW} --out full": "--overwrite",
    "reconstruct nowhere --out new": "nowhere: it does not exist",
    "reconstruct empty --out new": "empty is not a dataset",
    "reconstruct full --out new": "not a dataset",
    "reconstruct full --out new --resume --overwrite": "one of them",
    "evaluate nowhere": "nowhere does not exist",
    "report full": "not a run",
    "export full new.ply": "not a run",
    "chips nowhere --out new": "does not exist",
    "chips --out new": "there are no runs",
    "chips full --out new --measured --count 3": "but --count was given",
    "view empty": "neither a run nor a dataset",
    "info nowhere": "does not exist",
    "info empty": "cannot be described",
    "info full --plot new.png": "draws the views of a dataset",
    "import mstar nowhere --out new --class T72 --train-views 8": "folder",
    "import mstar full --out new --split soc --train-views all --serial 1": "but --serial was given",
    "import sicd a.nitf --out new --size far": "--size 'far' is not a number; write it as 64",
}
STACKS = {
    "--baseline 0.004": "--baseline needs --passes or --polarimetric",
    "--polarimetric --baseline 0.004": "--baseline needs --passes",
    "--polarimetric --looks 4": "--polarimetric makes stacks, not single images, but --looks was given",
    "--passes 1 --baseline 0.004": "--passes is 1",
    "--passes 3 --baseline 0 0.1": "--baseline has 2 numbers",
    "--passes 2 --baseline 0.004 --source splat": "--passes makes stacks, not single images, but --source splat",
    "--passes 2 --baseline 0.004 --wavelength 0": "wavelength",
    "--passes 2 --baseline 0": "two passes are the same",
}
MISTAKES |= {f"{SIMULATE} {ONE_VIEW} --ground 0.5 {options}": told for options, told in STACKS.items()}


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


WORDS = {
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
    "reconstruct full --out new --iterations 0": "iterations is 0; it must be a whole number from 1",
    "reconstruct full --out new --rates.means x": "--rates.means 'x' is not a number; give one",
    "reconstruct full other --out new": "sarsplat reconstruct does one target at a time, and 'other' is another; see `",
    "evaluate full other": "'other' is one argument too many for sarsplat evaluate; remove it",
    "evaluate": "RUN|PLY is missing; see sarsplat evaluate --help",
    "completion tcsh": "shell 'tcsh' is unknown; choose one of bash, fish, zsh",
}


@pytest.mark.parametrize(
    ("words", "columns"), [*((words, "40") for words in MISTAKES | WORDS), *((words, "200") for words in [*WORDS][::5])]
)
def test_mistakes_are_reported_in_one_sentence(words: str, columns: str, place: Path, monkeypatch, refused) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    complaint = refused(words)
    assert complaint.startswith(f"error: {WORDS[words]}") if words in WORDS else MISTAKES[words] in complaint
    assert not set("│─╭╯") & set(complaint)
    assert {path.name for path in place.iterdir()} == {"empty", "full"}


def test_a_missing_extra_names_the_command_to_get_it(tmp_path: Path, monkeypatch, refused) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    simulate = f"simulate --target t72 --out {tmp_path / 'new'} {ONE_VIEW}"
    assert "pip install 'sarsplat[simulate]'" in refused(simulate)
    monkeypatch.setattr(extras, "installed_version", lambda _: None)  # from source: no index has our package
    assert "not installed; install it with: pip install trimesh" in refused(simulate)
    assert extras.extra_with("json") is None


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
