"""Where a training is quicker: some of its steps on the GPU and on the CPU, where that is left to us."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import torch

from sarsplat.errors import SarsplatError
from sarsplat.learning.method import Trainable
from sarsplat.renderer.engines import cpu

_UNTIMED = 3
"""First steps of a training on a GPU, which compile, send and record."""

_TIMED = 10

_FEW = 10 * (_UNTIMED + _TIMED)
"""So many are made while others are tried."""

_CPU = torch.device("cpu")


def quicker(make: Callable[[torch.device], Trainable], gpu: torch.device, iterations: int) -> tuple[torch.device, str]:
    """The CPU, and a sentence that says why, if a step takes longer on the GPU or fails there; else the GPU, and "".

    `make` makes a training at its beginning, on a device. One of few iterations is on the GPU untried.
    """
    if iterations < _FEW:
        return gpu, ""
    try:
        cpu.library()  # which warns once, and that must not be while nothing is said
    except SarsplatError:
        return gpu, ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they come again with the training itself
        try:
            there = _trial(make(gpu))
        except (SarsplatError, torch.OutOfMemoryError) as error:  # the memory of a GPU is soon full
            return _CPU, f"training on the CPU: on the GPU, {str(error).partition(chr(10))[0]}"
        try:
            on_cpu = make(_CPU)
            _seconds(on_cpu, 1)
            here = 0.0
            for _ in range(_TIMED):
                if (here := here + _seconds(on_cpu, 1)) >= there:
                    return gpu, ""
        except SarsplatError:
            return gpu, ""
    said = f"a step takes {here / _TIMED * 1e3:.3g} ms there, and {there / _TIMED * 1e3:.3g} ms on the GPU"
    return _CPU, f"training on the CPU: {said}; device cuda takes the GPU nevertheless"


def _trial(on_gpu: Trainable) -> float:
    """What its steps take, s, once all is made that is made once; then its memory is free again."""
    _seconds(on_gpu, _UNTIMED)
    return _seconds(on_gpu, _TIMED)


def _seconds(trainer: Trainable, steps: int) -> float:
    """Of so many steps, until the device is done, s."""
    begun = time.perf_counter()
    for _ in range(steps):
        trainer.step()
    trainer.check()
    return time.perf_counter() - begun
