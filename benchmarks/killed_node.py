"""Fill docs/how-to/sweep-ray.md with what a sweep says on a cluster of two nodes of which one is killed.

It needs the extra `ray`. The results must be those of local processes, bit for bit.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fleets import cluster
from results import REPOSITORY

from sarsplat import sweep
from sarsplat.cli.simulate import simulate
from sarsplat.cli.simulation_options import Options, Sensor, Target

sys.path.insert(0, str(REPOSITORY / "docs"))
from fill_block import fill_block

PAGE = REPOSITORY / "docs" / "how-to" / "sweep-ray.md"
_ABOUT = """Four T-72s of 64 × 64 pixels on two nodes, of which one is killed on the way; the results are those of local
processes, bit for bit (Ray's own lines are left out):"""
PLAN = """
datasets = ["t72"]
preset = "default"
seeds = [0, 1, 2, 3]
reports = false
[settings]
checkpoint_every = 50
"""


def scores(folder: Path) -> list[dict[str, float]]:
    """Of every run, but for the time."""
    results = sweep(folder.parent / "plan.toml", folder, run=False, quiet=True).results
    return [{} if one.row is None else {**one.row.scores, "time_s": 0.0} for one in results]


def main() -> None:
    """Run it twice and fill the page."""
    with tempfile.TemporaryDirectory() as place, cluster() as made:
        folder = Path(place)
        said: list[str] = []
        simulate(Options(folder / "t72", target=Target("t72"), sensor=Sensor((64,), (0.6,))))
        (folder / "plan.toml").write_text(PLAN)
        words = ["sweep", "plan.toml", "--out", "fleet", "--executor", "ray", "--address", made.address]
        begun = time.monotonic()
        command = [sys.executable, "-u", "-m", "sarsplat", *words]
        with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                ended = any("sweep: 4/4" in before for before in said)
                if ended or line.startswith("sweep: "):
                    said.append(f"{time.monotonic() - begun:5.0f} s  {line.rstrip()}")
                if made.worker_nodes and " at " in line:
                    made.remove_node(*made.worker_nodes, allow_graceful=False)
                    said.append(f"{time.monotonic() - begun:5.0f} s  *** one of the two nodes is killed ***")
        sweep(folder / "plan.toml", folder / "local", quiet=True)
        assert scores(folder / "fleet") == scores(folder / "local")
        text = "\n".join(line.replace(str(folder), "").rstrip() for line in said)
        fill_block(PAGE, "killed node", f"{_ABOUT}\n\n```\n{text}\n```\n")


if __name__ == "__main__":
    main()
