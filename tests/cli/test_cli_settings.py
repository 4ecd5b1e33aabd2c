"""Settings on the command line: a preset or a file gives them, flags override them, and a shell completes them."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from programs import ROOT
from sarsplat import PRESETS, Config, Run
from sarsplat.cli import console, main
from sarsplat.cli.commands import COMMANDS
from sarsplat.cli.importers import IMPORTERS
from sarsplat.scenes import TARGETS
from sarsplat.settings.sections import Densification, FlatGround, Surroundings


@pytest.fixture(scope="module")
def place(box: Path) -> Path:
    """A folder with datasets of a box on nothing and on the ground, and both in speckle."""
    for name, more in (
        ("plain", ""),
        ("speckled", "--looks 4"),
        ("ground", "--ground 0.1"),
        ("both", "--ground 0.1 --looks 1"),
    ):
        simulate = f"simulate --mesh {box}/box.obj --azimuth 0:360:120 --grazing 45 --pixels 16 {more}"
        assert main(f"{simulate} --out {box}/{name}".split()) == 0
    return box


@pytest.fixture(autouse=True)
def there(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)


@pytest.fixture
def printed(said):
    """The settings that `--print-config` shows with these options."""

    def run(words: str, dataset: str = "plain") -> dict[str, Any]:
        data: dict[str, Any] = json.loads(said(f"reconstruct {dataset} --out nowhere {words} --print-config"))
        assert not Path("nowhere").exists()
        assert data["method"] == "sar-gs"
        return data["config"]

    return run


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_alone(name: str, printed) -> None:
    assert Config.from_dict(printed(f"--preset {name}")) == PRESETS[name]


@pytest.mark.parametrize(("dataset", "name"), [("plain", "default"), ("speckled", "speckled"), ("both", "scene")])
def test_the_preset_that_fits_the_images(dataset: str, name: str, printed) -> None:
    assert printed("", dataset)["preset"] == name
    chosen = Config.from_dict(printed("--seed 4", dataset))
    assert replace(chosen, evidence="") == replace(PRESETS[name], seed=4)
    assert bool(chosen.evidence) == (dataset == "both")


def test_flags_override_the_preset_even_with_the_values_that_help_shows(printed) -> None:
    flags = "--preset paper --views-per-step 8 --rates.means .02 --scale-bounds 0.02 0.2 --points.method rays"
    changed = printed(f"{flags} --points.cluster-radius 0.5 --densification.every=7")
    paper = PRESETS["paper"]
    assert Config.from_dict(changed) == replace(
        paper,
        views_per_step=8,
        scale_bounds=(0.02, 0.2),
        rates=replace(paper.rates, means=0.02),
        points=replace(paper.points, method="rays", cluster_radius=0.5),
        densification=replace(paper.densification, every=7),
    )


@pytest.mark.parametrize(
    ("words", "densification"),
    [
        ("", None),
        ("--densification on", Densification()),
        ("--densification.max-gaussians 60000", Densification()),
        ("--densification.start 5", Densification(start=5)),
        ("--preset paper", Densification()),
        ("--preset paper --densification off", None),
    ],
)
def test_density_control(words: str, densification: Densification | None, printed) -> None:
    assert Config.from_dict(printed(words)).densification == densification


def test_surroundings(printed, refused) -> None:
    on = Config.from_dict(printed("--surroundings.noise-floor 0.5")).surroundings
    assert on == Surroundings(noise_floor=0.5)
    assert printed("--surroundings off", "ground")["surroundings"] is None
    complaint = refused("reconstruct plain --out new --surroundings off --surroundings.noise-floor 1")
    assert "--surroundings off leaves it out, but --surroundings.noise-floor was given" in complaint


def test_ground_is_modelled_where_images_show_it(printed) -> None:
    assert printed("", "plain")["ground"] is None
    for words in ("--preset default", "--preset quick", "--preset speckled"):
        assert printed(words, "ground")["ground"] == FlatGround().as_dict()
    assert printed("--preset measured", "ground")["ground"] == PRESETS["measured"].ground.as_dict()
    assert printed("--preset paper", "ground")["ground"] is None
    assert printed("--ground off", "ground")["ground"] is None
    assert printed("--ground.pitch 7", "plain")["ground"] == FlatGround(pitch=7).as_dict()


def test_a_printed_configuration_is_read_back(printed, refused, tmp_path: Path) -> None:
    first = printed("--preset measured --gaussians 30 --densification.start 3")
    (tmp_path / "mine.json").write_text(json.dumps(first), encoding="utf-8-sig")  # as Windows' editors may save it
    assert printed(f"--config {tmp_path / 'mine.json'}") == first
    assert printed(f"--config {tmp_path / 'mine.json'} --gaussians 31") == {**first, "gaussians": 31}
    both = f"reconstruct plain --out new --config {tmp_path}/mine.json --preset paper"
    assert "but --preset was given" in refused(both)


def test_a_run_is_resumed_and_extended_with_its_own_settings(tmp_path: Path, refused) -> None:
    run = tmp_path / "run"
    few = "--gaussians 40 --points.voxel 0.3 --points.rays-per-pixel 2"
    assert main(f"reconstruct plain --out {run} --iterations 2 --seed 7 --common-law True {few}".split()) == 0
    resume = f"reconstruct plain --out {run} --resume"
    assert main(resume.split()) == 0
    # what is true or false is said alike before and after
    assert main(f"{resume} --iterations 4 --seed 7 --preset default --common-law True".split()) == 0
    extended = Run.load(run)
    assert (extended.iteration, extended.config.iterations, extended.config.gaussians) == (4, 4, 40)
    assert extended.config.common_law
    assert "started with seed 7, not 8" in refused(f"{resume} --iterations 5 --seed 8")
    assert "started with preset 'default', not 'paper'" in refused(f"{resume} --preset paper")
    assert "has already done 4 iterations, more than 3" in refused(f"{resume} --iterations 3")
    assert Run.load(run).config == extended.config


# ---- what a shell offers after some words ----------------------------------------------------------------------------
ASK = """
source "$1"
shift
for line in "$@"; do
    IFS=' ' read -ra COMP_WORDS <<< "sarsplat $line"
    [[ $line == *" " || -z $line ]] && COMP_WORDS+=("")
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    COMPREPLY=()
    _tyro_sarsplat
    echo "${COMPREPLY[@]}"
done
"""


@pytest.fixture(scope="module")
def completion(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "sarsplat.bash"
    with path.open("w") as file, redirect_stdout(file):
        assert main(["completion", "bash"]) == 0
    return path


OFFERED = {
    "": set(COMMANDS),
    "import ": set(IMPORTERS),
    "import mstar chips --tr": {"--train-views", "--train-depression"},
    "reconstruct ds --preset pa": {"paper"},
    "reconstruct ds --points.v": {"--points.voxel"},
    "reconstruct ds --seed 3 --densification ": {"on", "off"},
    "simulate --target ": set(TARGETS),
    "reconstruct ds --out pyproj": {"pyproject.toml"},
    "evaluate run": set(),  # nothing: paths
}


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_what_bash_offers(completion: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # what it offers it asks of the first python3; a version manager's takes ten times as long to begin
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    ask = ["bash", "--norc", "-c", ASK, "bash", str(completion), *OFFERED]
    done = subprocess.run(ask, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stderr == ""
    offers = [set(line.split()) - {"-h", "--help", "None"} for line in done.stdout.split("\n")[:-1]]
    assert dict(zip(OFFERED, offers, strict=True)) == OFFERED
    assert "complete -o default -F _tyro_sarsplat sarsplat" in completion.read_text()  # paths where it offers nothing


def test_parameters_that_messages_name_are_options(completion: Path) -> None:
    """Of backquoted words and switches in all texts of the library: what `as_options` makes of them exists."""
    options = set(re.findall(r"--[a-z][\w.-]*", completion.read_text()))
    named = set()
    for path in (path for path in (ROOT / "src" / "sarsplat").rglob("*.py") if path.parent.name != "cli"):
        nodes = [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
        docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        texts = [node.value for node in nodes if isinstance(node, ast.Constant) and id(node) not in docstrings]
        for text in (text for text in texts if isinstance(text, str)):
            found = re.findall(r"`[a-z][a-z0-9_.]+[`=]|\b[a-z_]+=(?:True|False)\b", text)
            named |= {(path.name, one, console.as_options(one[:-1] + "`" if one[0] == "`" else one)) for one in found}
    assert not {one for one in named if one[2].startswith("--") and one[2] not in options}


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    assert "--train-depression" in capsys.readouterr().out
