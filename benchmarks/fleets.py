"""What a sweep costs beside its runs: with local processes, and on a Ray cluster of two nodes on this machine.

`python benchmarks/fleets.py [local] [ray]` writes benchmarks/results/fleets.json. It needs the extra `ray` and an idle
machine.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from results import RESULTS, machine, save

from sarsplat import read_dataset, sweep, write_dataset
from sarsplat.cli.simulate import simulate
from sarsplat.cli.simulation_options import Options, Sensor, Target, TestViews, Views
from sarsplat.executors import Means

PROCESSES = 2
TINY = {"iterations": 5, "gaussians": 50, "points.voxel": 0.5, "points.rays_per_pixel": 2}
FEW = Views(azimuth=("0:360:60",), grazing=("45",)), TestViews(test_azimuth=("45",), test_grazing=("45",))
KINDS: dict[str, tuple[dict[str, Any], dict[str, Any], tuple[int, ...]]] = {
    "tiny": ({"sensor": Sensor((32,), (0.6,)), "views": FEW[0], "test_views": FEW[1]}, TINY, (2, 20, 120)),
    "t72": ({}, {}, (2,)),
}
"""Options of a simulation, settings, and how many runs. Tiny ones: the first sweep is not counted, for it reads the
programs from the disk; the others tell what a run that computes nearly nothing costs, and what beginning does."""


@contextmanager
def cluster() -> Iterator[Any]:
    """Two nodes of a processor each."""
    from ray.cluster_utils import Cluster

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    node = {"num_cpus": 1, "object_store_memory": 80 << 20}
    made = Cluster(initialize_head=True, head_node_args=node)
    made.add_node(**node)
    made.wait_for_nodes()
    try:
        yield made
    finally:
        made.shutdown()


def timed(kind: str, count: int, executor: str, means: Means, folder: Path) -> tuple[float, float]:
    """Seconds of a sweep, and those that one of its runs computes: the first of a process also imports."""
    plan = {"datasets": [str(folder / kind)], "preset": "quick", "settings": KINDS[kind][1], "reports": False}
    begun, out = time.monotonic(), folder / f"{kind}-{executor}-{count}"
    found = sweep(plan | {"seeds": list(range(count))}, out, executor=executor, means=means, quiet=True)
    assert not found.failed, [one.reason for one in found.failed]
    seconds = time.monotonic() - begun
    return seconds, statistics.median(one.row.took_s for one in found.results if one.row is not None)


def measured(executor: str, means: Means, folder: Path) -> dict[str, Any]:
    """Seconds that beginning takes, that a run costs which computes nearly nothing, and that one of the T-72 takes."""
    _, few, many = KINDS["tiny"][2]
    _, some, more = (timed("tiny", count, executor, means, folder)[0] for count in KINDS["tiny"][2])
    each = (more - some) / (many - few)
    _, run_s = timed("t72", KINDS["t72"][2][0], executor, means, folder)
    return {"executor": executor, "begin_s": some - each * few, "tiny_s": each * PROCESSES, "t72_s": run_s}


def main(executors: Sequence[str]) -> None:
    """Measure by these executors, and add it to what is known of others."""
    path = RESULTS / "fleets.json"
    made: dict[str, Any] = {"machine": machine(), "processes": PROCESSES, "rows": []}
    if path.exists():
        made["rows"] = [row for row in json.loads(path.read_text())["rows"] if row["executor"] not in executors]
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        folder = Path(place)
        for kind, (options, *_) in KINDS.items():
            simulate(Options(folder / "made" / kind, target=Target("t72"), **options))
            made_of = read_dataset(folder / "made" / kind)  # scoring a surface would take longer than all else
            write_dataset(folder / kind, made_of if kind == "t72" else replace(made_of, truth_mesh=None))
        for executor in executors:
            address = stack.enter_context(cluster()).address if executor == "ray" else "auto"
            made["rows"].append(measured(executor, Means(PROCESSES, address), folder))
    save(path, made)


if __name__ == "__main__":
    main(sys.argv[1:] or ("local", "ray"))
