"""Where a training is quicker: some of its steps on the GPU and on the CPU, where that is left to us."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import torch

from sarsplat.learning.method import Trainable

_UNTIMED = 3
"""First steps of a training on a GPU, which compile, send and record."""

_TIMED = 10

_CPU = torch.device("cpu")


def quicker(make: Callable[[torch.device], Trainable], gpu: torch.device) -> tuple[torch.device, str]:
    """The CPU, and a sentence that says why, if a step takes longer on the GPU; else the GPU, and nothing to say.

    `make` makes a training at its beginning, on a device.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they come again with the training itself
        on_gpu = make(gpu)
        _seconds(on_gpu, _UNTIMED)
        there = _seconds(on_gpu, _TIMED)
        del on_gpu
        on_cpu = make(_CPU)
        _seconds(on_cpu, 1)
        here = 0.0
        for _ in range(_TIMED):
            if (here := here + _seconds(on_cpu, 1)) >= there:
                return gpu, ""
    said = f"a step takes {here / _TIMED * 1e3:.3g} ms there, and {there / _TIMED * 1e3:.3g} ms on the GPU"
    return _CPU, f"training on the CPU: {said}; device cuda takes the GPU nevertheless"


def _seconds(trainer: Trainable, steps: int) -> float:
    """Of so many steps, until the device is done, s."""
    begun = time.perf_counter()
    for _ in range(steps):
        trainer.step()
    trainer.check()
    return time.perf_counter() - begun
