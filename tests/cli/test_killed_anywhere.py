"""`kill -9` at random moments: the output is the old one, the new one or absent, and the next command works."""

import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from killable import use_small_presets
from PIL import Image

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


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob(".*.sarsplat-*")]


class Workshop:
    """A folder with a dataset, chips, two finished runs and what every command makes of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        box = trimesh.creation.box(extents=(2.4, 1.2, 1.0))
        box.apply_translation((0, 0, 0.5))
        box.export("box.obj")
        (folder / "chips").mkdir()
        labels = ["path,class,serial,desired_depression_deg,measured_depression_deg,target_az_deg"]
        noise = np.random.default_rng(0)
        for azimuth in range(0, 360, 30):
            amplitude = noise.rayleigh(20 + azimuth / 10, (32, 32))  # as single-look speckle has it
            picture = Image.fromarray(amplitude.clip(0, 255).astype(np.uint8))
            picture.save(folder / "chips" / f"{azimuth}.png")
            picture.save(folder / "chips" / f"{azimuth}.jpeg", quality=100)
            labels.append(f"{azimuth}.jpeg,T72,132,17,17.1,{azimuth}")
        (folder / "chips" / "labels.csv").write_text("\n".join(labels) + "\n")

    def done(self, command: str) -> None:
        assert main(command.split()) == 0, command

    def killed(self, command: str, limit: str, value: float) -> None:
        """Run a command that kills itself at some moment, or ends before."""
        process = self.process(command, {limit: str(value)})
        assert process.returncode in (0, -signal.SIGKILL), process.stderr

    def process(self, command: str, extra: dict[str, str]) -> subprocess.CompletedProcess[str]:
        script = str(Path(__file__).with_name("killable.py"))
        variables = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **extra}
        words = [sys.executable, script, *command.split()]
        return subprocess.run(words, env=variables, capture_output=True, text=True, check=False)

    def moments(self, command: str) -> list[tuple[str, float]]:
        """Random moments at which to kill a command: between two changes on the disk, and by the clock."""
        said = self.process(command, {}).stderr.split()
        count, seconds = int(said[said.index("moments") + 1]), float(said[said.index("seconds") + 1])
        chance = random.Random(command)
        by_clock = KILLS // 2
        steps = [("KILL_BEFORE", chance.randint(1, count)) for _ in range(KILLS - by_clock)]
        return [*steps, *(("KILL_AFTER", chance.uniform(0, seconds)) for _ in range(by_clock))]


@pytest.fixture(scope="module", autouse=True)
def few_samples() -> None:
    """As many as usual: the processes that are killed know nothing of few."""


SIMULATE = "simulate --mesh box.obj --azimuth 0:360:90 --grazing 30 --test-azimuth 45 --pixels 32 --looks 1"


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workshop]:
    usual, folder = dict(PRESETS), tmp_path_factory.mktemp("workshop")
    before = Path.cwd()
    os.chdir(folder)
    use_small_presets()
    made = Workshop(folder)
    made.done(f"{SIMULATE} --out dataset")
    for seed in SEEDS:
        made.done(f"reconstruct dataset --out run{seed} --seed {seed}")
    yield made
    os.chdir(before)
    PRESETS.update(usual)


OVERWRITING = {  # what is made with 5 in place of what was made with 6, and the other way round
    "simulate": f"{SIMULATE} --seed {{}} --overwrite --out dataset2",
    "import": "import mstar chips --labels chips/labels.csv --class T72 --train-views {} --overwrite --out chips2",
    "render": "render run{} --azimuth 0:360:120 --grazing 30 --overwrite --out images",
    "export": "export run{} --overwrite gaussians.ply",
}


@pytest.mark.parametrize("name", OVERWRITING)
def test_overwriting(workshop: Workshop, name: str) -> None:
    commands = [OVERWRITING[name].format(seed) for seed in SEEDS]
    out = workshop.folder / commands[0].split()[-1]
    made = []
    for command in commands:
        workshop.done(command)
        made.append(tree(out))
    assert made[0] != made[1]
    # an import draws its preview once the dataset is there
    bare = [{name: content for name, content in whole.items() if name != "preview.png"} for whole in made]
    for turn, (limit, value) in enumerate(workshop.moments(commands[1])):
        workshop.killed(commands[turn % 2], limit, value)
        found = tree(out if out.exists() else out.with_name(f".{out.name}.sarsplat-old"))
        assert found in [*made, *bare], (limit, value)
        if out.exists() and name != "render":  # whose folders `info` does not describe
            workshop.done(f"info {out}")
        if turn % 3 == 2:  # else the next killed one meets what this one left
            workshop.done(commands[turn % 2])
            assert tree(out) == made[turn % 2]
            assert leftovers(workshop.folder) == []
    workshop.done(commands[0])
    assert leftovers(workshop.folder) == []


def test_a_new_run(workshop: Workshop) -> None:
    command, out = "reconstruct dataset --out new --seed 5", workshop.folder / "new"
    wanted = results(workshop.folder / "run5")
    moments = workshop.moments(command)
    for limit, value in moments:
        shutil.rmtree(out, ignore_errors=True)
        workshop.killed(command, limit, value)
        workshop.done(f"{command} --resume" if out.exists() else command)
        assert results(out) == wanted, (limit, value)
        assert leftovers(workshop.folder) == []


def test_resuming(workshop: Workshop) -> None:
    """Again and again, until nothing is left to do."""
    command, out = "reconstruct dataset --out again --resume", workshop.folder / "again"
    begun, moment = workshop.folder / "begun", 50
    while not begun.exists() or leftovers(begun):  # until one is killed after its first checkpoint, and not in the next
        shutil.rmtree(begun, ignore_errors=True)
        moment += 10
        workshop.killed("reconstruct dataset --out begun --seed 5", "KILL_BEFORE", moment)
    assert not (begun / "points.ply").exists()
    (workshop.folder / ".begun.sarsplat-lock").unlink(missing_ok=True)
    shutil.copytree(begun, out)
    moments = workshop.moments(command)
    for turn, (limit, value) in enumerate(moments):
        if turn % 3 == 0:
            shutil.rmtree(out)
            shutil.copytree(begun, out)
        workshop.killed(command, limit, value)
        workshop.done("info again")
        if turn % 3 == 2:
            workshop.done(command)
            assert results(out) == results(workshop.folder / "run5"), (limit, value)
            assert leftovers(workshop.folder) == []
    workshop.done(command)
    assert leftovers(workshop.folder) == []


def test_overwriting_a_run(workshop: Workshop) -> None:
    """The old run is whole until the new one has a checkpoint to go on from."""
    command, out = "reconstruct dataset --out over --overwrite --seed 5", workshop.folder / "over"
    old = tree(Path("run6"))
    shutil.copytree("run6", out)
    wanted = results(workshop.folder / "run5")
    for limit, value in workshop.moments(command):
        shutil.rmtree(out)
        shutil.copytree("run6", out)
        workshop.killed(command, limit, value)
        if not out.exists() or b'"seed": 6' in (out / "config.json").read_bytes():
            assert tree(out if out.exists() else out.with_name(".over.sarsplat-old")) == old, (limit, value)
            workshop.done(command)
        else:
            workshop.done("reconstruct dataset --out over --resume")
        assert results(out) == wanted, (limit, value)
        assert leftovers(workshop.folder) == []


@pytest.mark.parametrize("name", ["evaluate", "report"])
def test_scores_and_report(workshop: Workshop, name: str) -> None:
    run = workshop.folder / "scored"
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree("run5", run)
    before = tree(run)
    workshop.done(f"{name} scored")
    after = tree(run)
    assert before is not None and after is not None
    for turn, (limit, value) in enumerate(workshop.moments(f"{name} scored")):
        if turn % 2 == 0:
            shutil.rmtree(run)
            shutil.copytree("run5", run)
        workshop.killed(f"{name} scored", limit, value)
        found = tree(run) or {}
        unfinished = {key for key in found if ".sarsplat-" in Path(key).name}
        assert before.keys() <= found.keys()
        assert {key: found[key] for key in found.keys() - unfinished}.items() <= after.items(), (limit, value)
        workshop.done("info scored")
    workshop.done(f"{name} scored")
    assert tree(run) == after
    assert leftovers(run) == []
