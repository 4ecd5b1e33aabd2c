"""The same bits for any number of threads."""

from __future__ import annotations

from typing import Any

import torch
from recipes import training_view

THREADS = (1, 2, 3)


def measure(quick: bool) -> dict[str, Any]:
    """Compare images and gradients bit by bit; stops where they differ."""
    scene, before = training_view(1000) if quick else training_view(), torch.get_num_threads()
    outcomes = []
    try:
        for threads in THREADS:
            torch.set_num_threads(threads)
            outcomes.append(scene.step())
    finally:
        torch.set_num_threads(before)
    for threads, tensors in zip(THREADS[1:], outcomes[1:], strict=True):
        if not all(torch.equal(a, b) for a, b in zip(tensors, outcomes[0], strict=True)):
            raise SystemExit(f"images or gradients of {threads} threads differ from those of one")
    return {"ratios": {f"images and gradients, the same bits for {', '.join(map(str, THREADS))} threads": "yes"}}
