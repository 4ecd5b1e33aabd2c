"""Types that are new to msgspec are learned by one thread at a time; Ctrl-C harms no search of many threads."""

import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import pytest

import sarsplat
from programs import python
from sarsplat.threads import convert, decode


def test_one_thread_at_a_time_learns_a_type(monkeypatch: pytest.MonkeyPatch) -> None:
    inside, most, learn = threading.Semaphore(1), [], msgspec.json.Decoder

    def learning(kind: Any) -> Any:
        most.append(inside.acquire(blocking=False))  # false if another thread is at it
        time.sleep(0.02)
        if most[-1]:
            inside.release()
        return learn(kind)

    monkeypatch.setattr(msgspec.json, "Decoder", learning)
    kinds = [msgspec.defstruct(f"Kind{k}", [("number", int)]) for k in range(3)]
    with ThreadPoolExecutor(6) as pool:
        read = [pool.submit(decode, b'{"number": 1}', kind) for kind in kinds]
        made = [pool.submit(convert, {"number": 1}, kind) for kind in kinds]
        assert [one.result() for one in read] == [one.result() for one in made]
    assert len(most) >= len(kinds)
    assert all(most)


def test_nothing_else_lets_msgspec_learn_types() -> None:
    package = Path(sarsplat.__file__).parent
    pattern = re.compile(r"msgspec\.convert\(|msgspec\.\w+\.decode\(.*type=|\.Decoder\(")
    own = [path.name for path in package.rglob("*.py") if pattern.search(path.read_text())]
    assert own == ["threads.py"]


PROGRAM = """
import os, signal, threading
import numpy as np
from scipy.spatial import cKDTree
from sarsplat.threads import uninterruptible

points = np.random.default_rng(0).normal(size=(60_000, 3))
tree = cKDTree(points)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background process starts without
threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    uninterruptible(tree.query, points, k=64, workers=-1)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def test_a_search_that_is_interrupted_harms_nothing() -> None:
    done = python("-c", PROGRAM)
    assert (done.returncode, done.stdout) == (0, "interrupted\n"), done.stderr
