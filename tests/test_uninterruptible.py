"""Ctrl-C while a library works."""

from programs import python

PROGRAM = """
import os, signal, threading
import numpy as np
from scipy.spatial import cKDTree
from sarsplat.uninterruptible import uninterruptible

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
