"""What a shell offers after some words."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from sarsplat.cli import main
from sarsplat.cli.completion import script
from sarsplat.cli.parser import COMMANDS, options
from sarsplat.reconstruction.presets import PRESETS
from sarsplat.scenes import TARGETS

ASK = """
source {script}
COMP_WORDS=(sarsplat "$@")
COMP_CWORD=$#
_sarsplat
for offer in "${{COMPREPLY[@]}}"; do echo "$offer"; done
"""


@pytest.fixture(scope="module")
def completion(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "sarsplat.bash"
    path.write_text(script(options(), "bash"))
    return path


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("", set(COMMANDS)),
        ("rec", {"reconstruct"}),
        ("import ", set(COMMANDS["import"])),
        ("import mstar chips --tr", {"--train-views", "--train-depression"}),
        ("reconstruct ds --preset ", {"auto", *PRESETS}),
        ("reconstruct ds --preset pa", {"paper"}),
        ("reconstruct ds --points.v", {"--points.voxel"}),
        ("reconstruct ds --seed 3 --densification ", {"on", "off"}),
        ("simulate --target ", set(TARGETS)),
        ("simulate --out ds --protocol ms", {"mstar"}),
        # nothing: paths
        ("reconstruct ", set()),
        ("reconstruct ds --out ", set()),
        ("evaluate run", set()),
    ],
)
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_what_bash_offers(completion: Path, words: str, offered: set[str]) -> None:
    ask = ["bash", "--norc", "-c", ASK.format(script=completion), "bash", *words.split(" ")]
    done = subprocess.run(ask, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert set(done.stdout.split()) == offered


def test_paths_where_nothing_is_offered(completion: Path) -> None:
    assert "complete -o default -F _sarsplat sarsplat" in completion.read_text()


def test_the_command_prints_the_script(completion: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    assert capsys.readouterr().out == completion.read_text()
    assert main(["completion", "zsh"]) == 0
    assert "bashcompinit" in capsys.readouterr().out
