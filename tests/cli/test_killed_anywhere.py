"""`kill -9` at random moments: the output is the old one, the new one or absent, and the next command works."""

import os
import random
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from killable import use_small_presets
from PIL import Image

from programs import python
from sarsplat.cli import main
from sarsplat.settings import PRESETS

KILLS = int(os.environ.get("SARSPLAT_TEST_KILLS", "2"))
"""Of each command."""

pytestmark = pytest.mark.slow
Tree = dict[str, bytes] | None
SEEDS = (5, 6)


def tree(path: Path) -> Tree:
    """Everything in a file or folder; None if there is nothing. Times of training differ from run to run."""
    if path.is_file():
        return {"": path.read_bytes()}
    if not path.exists():
        return None
    files = sorted(file for file in path.rglob("*") if file.is_file())
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def results(run: Path) -> Tree:
    """What training must reproduce bit for bit."""
    return {name: (run / name).read_bytes() for name in ("config.json", "gaussians.ply", "points.ply")}


def leftovers(folder: Path = Path()) -> list[str]:
    return [path.name for path in folder.rglob(".*.sarsplat-*")]


def done(command: str) -> None:
    assert main(command.split()) == 0, command


def process(command: str, **limit: object) -> subprocess.CompletedProcess[str]:
    """Run a command that kills itself at this moment, or ends before."""
    variables = {name: str(value) for name, value in limit.items()}
    script = Path(__file__).with_name("killable.py")
    ended = python(script, *command.split(), env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **variables})
    assert ended.returncode in (0, -signal.SIGKILL), ended.stderr
    return ended


def moments(command: str) -> list[dict[str, float]]:
    """Random moments at which to kill a command: between two changes on the disk, and by the clock."""
    said = process(command).stderr.split()
    count, seconds = int(said[said.index("moments") + 1]), float(said[said.index("seconds") + 1])
    chance = random.Random(command)
    by_clock = KILLS // 2
    steps = [{"KILL_BEFORE": chance.randint(1, count)} for _ in range(KILLS - by_clock)]
    return [*steps, *({"KILL_AFTER": chance.uniform(0, seconds)} for _ in range(by_clock))]


@pytest.fixture(scope="module", autouse=True)
def few_samples() -> None:
    """As many as usual: the processes that are killed know nothing of few."""


SIMULATE = "simulate --mesh box.obj --azimuth 0:360:90 --grazing 30 --test-azimuth 45 --pixels 32 --looks 1"


@pytest.fixture(scope="module", autouse=True)
def place(box: Path) -> Iterator[None]:
    """The current folder holds a mesh, a dataset, chips, and two finished runs."""
    usual, before = dict(PRESETS), Path.cwd()
    os.chdir(box)
    Path("chips").mkdir()
    labels = ["path,class,serial,desired_depression_deg,measured_depression_deg,target_az_deg"]
    noise = np.random.default_rng(0)
    for azimuth in range(0, 360, 30):
        amplitude = noise.rayleigh(20 + azimuth / 10, (32, 32))  # as single-look speckle has it
        picture = Image.fromarray(amplitude.clip(0, 255).astype(np.uint8))
        picture.save(f"chips/{azimuth}.jpeg", quality=100)
        labels.append(f"{azimuth}.jpeg,T72,132,17,17.1,{azimuth}")
    Path("chips/labels.csv").write_text("\n".join(labels) + "\n")
    use_small_presets()
    done(f"{SIMULATE} --out dataset")
    for seed in SEEDS:
        done(f"reconstruct dataset --out run{seed} --seed {seed}")
    yield
    os.chdir(before)
    PRESETS.update(usual)


OVERWRITING = {  # what is made with 5 in place of what was made with 6, and the other way round
    "simulate": f"{SIMULATE} --seed {{}} --overwrite --out dataset2",
    "import": "import mstar chips --labels chips/labels.csv --class T72 --train-views {} --overwrite --out chips2",
    "render": "render run{} --azimuth 0:360:120 --grazing 30 --overwrite --out images",
    "export": "export run{} --overwrite gaussians.ply",
}


@pytest.mark.parametrize("name", OVERWRITING)
def test_overwriting(name: str) -> None:
    commands = [OVERWRITING[name].format(seed) for seed in SEEDS]
    out = Path(commands[0].split()[-1])
    made = []
    for command in commands:
        done(command)
        made.append(tree(out))
    assert made[0] != made[1]
    # an import draws its preview once the dataset is there
    bare = [{name: content for name, content in whole.items() if name != "preview.png"} for whole in made]
    for turn, moment in enumerate(moments(commands[1])):
        process(commands[turn % 2], **moment)
        found = tree(out if out.exists() else out.with_name(f".{out.name}.sarsplat-old"))
        assert found in [*made, *bare], moment
        if out.exists() and name != "render":  # whose folders `info` does not describe
            done(f"info {out}")
        if turn % 3 == 2:  # else the next killed one meets what this one left
            done(commands[turn % 2])
            assert tree(out) == made[turn % 2]
            assert leftovers() == []
    done(commands[0])
    assert leftovers() == []


@pytest.mark.parametrize("old", [None, "run6"], ids=["new", "overwriting"])
def test_a_run(old: str | None) -> None:
    """An old one is whole until the new one has a checkpoint to go on from."""
    out = Path("made")
    command = f"reconstruct dataset --out {out} --seed 5{' --overwrite' if old else ''}"
    for moment in moments(command):
        shutil.rmtree(out, ignore_errors=True)
        if old:
            shutil.copytree(old, out)
        process(command, **moment)
        if out.exists() and b'"seed": 5' in (out / "config.json").read_bytes():
            done(f"reconstruct dataset --out {out} --resume")
        else:
            left = tree(out if out.exists() else out.with_name(f".{out}.sarsplat-old"))
            assert left == (tree(Path(old)) if old else None), moment
            done(command)
        assert results(out) == results(Path("run5")), moment
        assert leftovers() == []


def test_resuming() -> None:
    """Again and again, until nothing is left to do."""
    command, out = "reconstruct dataset --out again --resume", Path("again")
    begun, count = Path("begun"), 50
    while not begun.exists() or leftovers(begun):  # until one is killed after its first checkpoint, and not in the next
        shutil.rmtree(begun, ignore_errors=True)
        count += 10
        process("reconstruct dataset --out begun --seed 5", KILL_BEFORE=count)
    assert not (begun / "points.ply").exists()
    Path(".begun.sarsplat-lock").unlink(missing_ok=True)
    shutil.copytree(begun, out)
    for turn, moment in enumerate(moments(command)):
        if turn % 3 == 0:
            shutil.rmtree(out)
            shutil.copytree(begun, out)
        process(command, **moment)
        done("info again")
        if turn % 3 == 2:
            done(command)
            assert results(out) == results(Path("run5")), moment
            assert leftovers() == []
    done(command)
    assert leftovers() == []


@pytest.mark.parametrize("name", ["evaluate", "report"])
def test_scores_and_report(name: str) -> None:
    run = Path("scored")
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree("run5", run)
    before = tree(run)
    done(f"{name} scored")
    after = tree(run)
    assert before is not None and after is not None
    for turn, moment in enumerate(moments(f"{name} scored")):
        if turn % 2 == 0:
            shutil.rmtree(run)
            shutil.copytree("run5", run)
        process(f"{name} scored", **moment)
        found = tree(run) or {}
        unfinished = {key for key in found if ".sarsplat-" in Path(key).name}
        assert before.keys() <= found.keys()
        assert {key: found[key] for key in found.keys() - unfinished}.items() <= after.items(), moment
        done("info scored")
    done(f"{name} scored")
    assert tree(run) == after
    assert leftovers(run) == []
