"""What a shell offers after some words."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from programs import ROOT
from sarsplat.cli import console, main
from sarsplat.cli.commands import COMMANDS
from sarsplat.cli.importers import IMPORTERS
from sarsplat.scenes import TARGETS
from sarsplat.settings.presets import PRESETS

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
    "rec": {"reconstruct"},
    "import ": set(IMPORTERS),
    "import mstar chips --tr": {"--train-views", "--train-depression"},
    "reconstruct ds --preset ": {"auto", *PRESETS},
    "reconstruct ds --preset pa": {"paper"},
    "reconstruct ds --points.v": {"--points.voxel"},
    "reconstruct ds --seed 3 --densification ": {"on", "off"},
    "simulate --target ": set(TARGETS),
    "simulate --out ds --protocol ms": {"mstar"},
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


def test_paths_where_nothing_is_offered(completion: Path) -> None:
    assert "complete -o default -F _tyro_sarsplat sarsplat" in completion.read_text()


def test_parameters_that_messages_name_are_options(completion: Path) -> None:
    """Of backquoted words and switches in all texts of the library: what `as_options` makes of them exists."""
    options = set(re.findall(r"--[a-z][\w.-]*", completion.read_text()))
    named = set()
    for path in (ROOT / "src" / "sarsplat").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in docstrings]
        for text in (text for text in texts if isinstance(text, str) and path.parent.name != "cli"):
            found = re.findall(r"`[a-z][a-z0-9_.]+[`=]|\b[a-z_]+=(?:True|False)\b", text)
            named |= {(path.name, one, console.as_options(one[:-1] + "`" if one[0] == "`" else one)) for one in found}
    assert not {one for one in named if one[2].startswith("--") and one[2] not in options}


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    assert "--train-depression" in capsys.readouterr().out
