"""What a sweep costs beside its runs: with local processes, and on a Ray cluster of two nodes on this machine.

`python benchmarks/fleets.py` writes benchmarks/results/fleets.json. It needs the extra `ray` and an idle machine.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from results import RESULTS, machine, save

from sarsplat import read_dataset, sweep, write_dataset
from sarsplat.cli.simulate import simulate
from sarsplat.sweeps import Means

PROCESSES = 2
TINY = {"iterations": 5, "gaussians": 50, "points.voxel": 0.5, "points.rays_per_pixel": 2}
FEW = {"azimuth": ("0:360:60",), "grazing": ("45",), "test_azimuth": ("45",), "test_grazing": ("45",)}
KINDS: dict[str, tuple[dict[str, Any], dict[str, Any], tuple[int, int]]] = {
    "tiny": ({"pixels": (32,), "spacing": (0.6,), **FEW}, TINY, (4, 24)),
    "t72": ({}, {}, (2, 6)),
}
"""Options of a simulation, settings, and how many runs: two counts tell what each costs and what beginning does."""


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


def measured(kind: str, executor: str, means: Means, folder: Path) -> dict[str, Any]:
    """Seconds to begin, and for each run: what it computes, and what the sweep adds."""
    _, settings, counts = KINDS[kind]
    seconds, took = [], []
    for count in counts:
        plan = {"datasets": [str(folder / kind)], "preset": "quick", "settings": settings, "reports": False}
        begun = time.monotonic()
        out = folder / f"{kind}-{executor}-{count}"
        found = sweep(plan | {"seeds": list(range(count))}, out, executor=executor, means=means, quiet=True)
        seconds.append(time.monotonic() - begun)
        took += [one.row.took_s for one in found.results if one.row is not None and one.finished]
    a_run = (seconds[1] - seconds[0]) / (counts[1] - counts[0])
    computed = sum(took) / len(took)
    assert len(took) == sum(counts), [one.reason for one in found.failed]
    return {
        "kind": kind,
        "executor": executor,
        "runs": list(counts),
        "seconds": seconds,
        "run_s": computed,
        "overhead_s": a_run * PROCESSES - computed,
        "begin_s": seconds[0] - a_run * counts[0],
    }


def main() -> None:
    """Measure all and write it."""
    made: dict[str, Any] = {"machine": machine(), "processes": PROCESSES, "rows": []}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for kind, (options, *_) in KINDS.items():
            simulate(target="t72", out=folder / "made" / kind, **options)
            made_of = read_dataset(folder / "made" / kind)  # scoring a surface would take longer than all else
            write_dataset(folder / kind, made_of if kind == "t72" else replace(made_of, truth_mesh=None))
        made["rows"] += [measured(kind, "local", Means(PROCESSES), folder) for kind in KINDS]
        with cluster() as nodes:
            made["rows"] += [measured(kind, "ray", Means(address=nodes.address), folder) for kind in KINDS]
    save(RESULTS / "fleets.json", made)


if __name__ == "__main__":
    main()
