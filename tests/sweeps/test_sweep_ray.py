"""A Ray cluster of two nodes: the same bits as in this process, also when a node dies."""

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from sarsplat import SarsplatError, sweep
from sarsplat.executors import Means

ray = pytest.importorskip("ray", reason="the extra `ray` is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two nodes with a processor each."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    node = {"num_cpus": 1, "object_store_memory": 80 << 20}
    made = Cluster(initialize_head=True, head_node_args=node)
    made.add_node(**node)
    made.wait_for_nodes()
    yield made
    made.shutdown()


def test_a_node_that_dies_costs_no_run(place, plan, cluster, results):
    plan |= {"seeds": [0, 1, 2, 3], "settings": {**plan["settings"], "iterations": 400, "checkpoint_every": 50}}
    (second,) = cluster.worker_nodes
    killed = threading.Event()

    def kill() -> None:
        rows, end = place / "out" / "rows", time.monotonic() + 120
        while len(list(rows.glob(".*.sarsplat-lock"))) < 2 and time.monotonic() < end:
            time.sleep(0.02)  # until each node is at a run
        cluster.remove_node(second, allow_graceful=False)
        killed.set()

    killer = threading.Thread(target=kill)
    killer.start()
    found = sweep(plan, place / "out", executor="ray", means=Means(address=cluster.address), quiet=True)
    killer.join()
    assert killed.is_set()
    assert [one.state for one in found.results] == ["finished"] * 4
    sweep(plan, place / "alone", executor="here", quiet=True)
    assert results(place / "out") == results(place / "alone")


def test_no_cluster_is_one_sentence(place, plan):
    with pytest.raises(SarsplatError, match="there is no Ray cluster at 'auto'"):
        sweep(plan, place / "out", executor="ray", quiet=True)
