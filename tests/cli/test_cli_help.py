"""What help says; how soon a command begins; and what it imports."""

import inspect
import json
import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest

from made import SMALL, small_dataset, upright
from programs import python
from sarsplat import Config, Run, View, importers, write_dataset
from sarsplat.cli import main
from sarsplat.cli.commands import COMMANDS
from sarsplat.cli.importers import IMPORTERS
from sarsplat.names import TargetName
from sarsplat.scenes import TARGETS
from sarsplat.settings.sections import Densification, FlatGround, Surroundings


def test_the_overview_has_the_help_of_every_command(capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for words, names in (([], COMMANDS), (["import"], IMPORTERS)):
        with pytest.raises(SystemExit) as end:
            main([*words, "--help"] if words else [])
        assert end.value.code in (0, None)
        told = capsys.readouterr().out
        assert told.startswith(" ".join(["usage: sarsplat", *words, "[-h]"]))
        assert ("`sarsplat --version`" in told) == (not words)
        shown = re.findall(r"^│ ([\w-]+)  +(\S.*?) *│$", told, re.MULTILINE)
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


def test_the_package_is_a_program_of_the_same_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


# ---- imports by commands ---------------------------------------------------------------------------------------------
BEGUN = """
import contextlib, io, json, sys
from sarsplat.cli import main
for words in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        try:
            code = main(words.split())
        except SystemExit as end:
            code = end.code
    heavy = {"tyro", "numpy", "torch", "scipy", "matplotlib", "torchmetrics", "trimesh"} & set(sys.modules)
    print(json.dumps([code, sorted(heavy), shown.getvalue()]))
"""

WITHOUT_TORCH = """
import os, sys
class Torch:
    def find_spec(self, name, *_):
        if name == "torch":
            os._exit(7)  # nothing is flushed here
sys.meta_path.insert(0, Torch())
from sarsplat.cli import main
main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset, a finished run, an image, and a file of no known kind."""
    folder = tmp_path_factory.mktemp("places")
    write_dataset(folder / "dataset", small_dataset())
    Run.from_gaussians(upright([1.0, 1.0, 1.0]), SMALL, [View(0, 30)]).save(folder / "run")
    (folder / "file.unknown").write_text("?")
    return folder


OF_COMMANDS = {words: f"usage: sarsplat {words} [-h]" for words in ("info", "simulate", "import mstar", "reconstruct")}
LIGHT = {
    "--help": (0, [], "usage: sarsplat [-h]"),
    **{f"{words} --help": (0, ["tyro"], told) for words, told in OF_COMMANDS.items()},
    "info dataset": (0, ["numpy", "tyro"], "a dataset of 3 images"),
    "info run": (0, ["numpy", "tyro"], "learned     1 Gaussian"),
    "info run/points.ply": (0, ["numpy", "tyro"], "other columns  nx, ny, nz"),
    "info file.unknown": (2, ["numpy", "tyro"], ""),
}
"""Commands, one after the other in one process: exit code, what is imported by then, and what is said."""


def test_help_and_info_import_nothing_heavy(places: Path) -> None:
    lines = python("-c", BEGUN, *LIGHT, cwd=places).stdout.splitlines()
    for (words, (code, imported, told)), line in zip(LIGHT.items(), lines, strict=True):
        *ended, shown = json.loads(line)
        assert ended == [code, imported], words
        assert told in shown


def test_a_reconstruction_says_what_it_reads_before_torch_is_imported(places: Path) -> None:
    done = python("-c", WITHOUT_TORCH, "reconstruct", "dataset", "--out", "run", cwd=places)
    assert done.returncode == 7, done.stderr
    assert done.stdout == "reading dataset: 3 images of unnamed, 1 of them to train on, 16 × 12 pixels\n"
