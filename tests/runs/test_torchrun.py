"""Processes that torchrun starts share a training: the bits of one, one writer, and nothing lost when one is killed."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from sarsplat import Dataset, Run
from sarsplat.settings import Config

SCRIPT = """
import json, sys
from pathlib import Path
from sarsplat import reconstruct
from sarsplat.settings import Config

dataset, out, config = sys.argv[1:]
run = reconstruct(dataset, Config.from_dict(json.loads(Path(config).read_text())), out)
print("RUN", run.iteration, run.path is None, flush=True)
"""


def torchrun(count: int, *words: str) -> subprocess.Popen[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    begin = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(count), "--master-port", str(port)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    pipe = subprocess.PIPE
    return subprocess.Popen([*begin, *words], env=environment, stdout=pipe, stderr=pipe, text=True)


def command(dataset: Dataset, config: Config, out: Path, *options: str) -> list[str]:
    settings = out.with_suffix(".json")
    settings.write_text(json.dumps(config.as_dict()))
    return ["-m", "sarsplat", "reconstruct", str(dataset.path), "--out", str(out), "--config", str(settings), *options]


def finish(process: subprocess.Popen[str]) -> str:
    with process:
        said, complained = process.communicate(timeout=180)
    assert process.returncode == 0, complained
    return said


def files(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in ("gaussians.ply", "points.ply")}


@pytest.mark.slow
def test_three_processes_give_the_bits_of_one(dataset: Dataset, config: Config, finished: Run, tmp_path: Path) -> None:
    script, settings, out = tmp_path / "script.py", tmp_path / "config.json", tmp_path / "run"
    script.write_text(SCRIPT)
    settings.write_text(json.dumps(config.as_dict()))
    said = finish(torchrun(3, str(script), str(dataset.path), str(out), str(settings)))
    assert files(out) == files(finished.folder)
    assert said.count(f"RUN {config.iterations} False") == 1
    assert said.count(f"RUN {config.iterations} True") == 2  # in memory: one writes
    assert said.count(f"{config.iterations}/{config.iterations}  loss") == 1  # and one shows progress


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_the_command_too(dataset: Dataset, config: Config, finished: Run, tmp_path: Path, count: int) -> None:
    said = finish(torchrun(count, *command(dataset, config, tmp_path / "run")))
    assert files(tmp_path / "run") == files(finished.folder)
    assert said.count("wrote ") == 1


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds processes in /proc")
@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_process_ends_the_others_and_the_run_resumes(
    dataset: Dataset, config: Config, tmp_path: Path, rank: int
) -> None:
    long, out = replace(config, iterations=4000, checkpoint_every=20), tmp_path / "run"
    with torchrun(2, *command(dataset, long, out)) as process:
        while not list((out / "checkpoints").glob("*")):
            assert process.poll() is None
            time.sleep(0.02)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        (chosen,) = [
            pid for pid in children if f"\0RANK={rank}\0".encode() in Path(f"/proc/{pid}/environ").read_bytes()
        ]
        os.kill(int(chosen), signal.SIGKILL)
        begun = time.monotonic()
        _, complained = process.communicate(timeout=60)
    assert time.monotonic() - begun < 20
    assert process.returncode != 0
    assert complained.count("error: another process of this training has ended") == 1
    reached = Run.load(out).iteration
    assert reached and reached % 20 == 0
    more = replace(long, iterations=reached + 20)
    finish(torchrun(2, *command(dataset, more, out, "--resume")))
    assert Run.load(out).iteration == more.iterations


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--iterations", "0"], "error: iterations is 0; it must be a whole number from 1"),
        (["--iteration", "5"], "error: --iteration is not an option"),
        (["--device", "cpu", "--resume"], "run does not exist; make one with"),
    ],
)
def test_a_mistake_is_said_once(dataset: Dataset, tmp_path: Path, words: list[str], complaint: str) -> None:
    run = ["-m", "sarsplat", "reconstruct", str(dataset.path), "--out", str(tmp_path / "run"), *words]
    with torchrun(3, *run) as process:
        _, complained = process.communicate(timeout=60)
    assert process.returncode != 0
    assert complained.count(complaint) == 1, complained
    assert "exitcode  : 2" in complained
