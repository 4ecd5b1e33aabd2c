"""Trainings for tests, and their comparison bit by bit."""

from __future__ import annotations

from typing import Any

import torch

from sarsplat import Config, Dataset
from sarsplat.learning import Trainer
from sarsplat.learning.snapshot import Snapshot


def trained(dataset: Dataset, config: Config, steps: int, snapshot: Snapshot | None = None, **options: Any) -> Trainer:
    """Trainer after these steps, from a snapshot if one is given."""
    trainer = Trainer(dataset, config, **options)
    if snapshot is not None:
        trainer.restore(snapshot)
    for _ in range(steps):
        trainer.step()
    return trainer


def assert_same(one: Snapshot, other: Snapshot) -> None:
    """Assert that all tensors are the same to the bit."""
    assert one.tensors.keys() == other.tensors.keys()
    assert [name for name, tensor in one.tensors.items() if not torch.equal(tensor, other.tensors[name])] == []
