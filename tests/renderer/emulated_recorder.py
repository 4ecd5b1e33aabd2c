"""What `CudaRecorder` does, for the emulated GPU: operations of torch and launches, recorded and run again."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import pytest
import torch
from emulated_cuda import Emulator
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sarsplat.renderer.engines import on_device

T = TypeVar("T")

_FROM_THE_CPU = ("_local_scalar_dense", "lift_fresh", "nonzero", "is_nonzero", "equal", "masked_select", "pin_memory")
"""What would make a CPU wait for a GPU, or the other way round: while a graph is recorded, CUDA refuses it."""

_UNSEEN = [(Tensor, "tolist"), (Tensor, "numpy"), (Tensor, "cpu"), (torch, "from_numpy"), (torch, "as_tensor")]
"""The same, of which there are no operations where everything is on the CPU."""


_RECORDING = threading.Lock()
"""One thread records at a time, while others launch."""


class EmulatedRecorder(TorchDispatchMode):
    """Records on the emulated GPU.

    What is recorded is run at the same time, so that there is something to look at; the first run of it is left out
    instead.
    """

    def __init__(self, launcher: Emulator) -> None:
        super().__init__()
        self.launcher, self.records, self.replays = launcher, 0, 0
        self._steps: list[Callable[[], object]] = []
        self._kept: list[object] = []

    def rehearse(self, program: Callable[[], T]) -> T:
        return program()

    def record(self, program: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        with _RECORDING:
            return self._record(program, threading.get_ident())

    def _record(self, program: Callable[[], T], me: int) -> tuple[T, Callable[[], None]]:
        self._steps, self._kept = [], []
        usual = self.launcher.launch

        def launch(name: str, blocks: int, threads: int, *arguments: ctypes._CData) -> None:
            if threading.get_ident() != me:
                return usual(name, blocks, threads, *arguments)
            copies = [type(argument).from_buffer_copy(argument) for argument in arguments]  # type: ignore[attr-defined]
            self._steps.append(lambda: usual(name, blocks, threads, *copies))
            usual(name, blocks, threads, *arguments)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(self.launcher, "launch", launch)
            patch.setattr(on_device, "being_recorded", lambda: threading.get_ident() == me)
            for of, name in _UNSEEN:
                patch.setattr(of, name, _refusing(name, me, getattr(of, name)))
            with self, on_device.read_meanwhile() as things:
                result = program()
        self.records += 1
        steps, kept, run = self._steps, [self._kept, things], [0]

        @torch.no_grad()
        def again() -> None:
            run[0] += 1
            if run[0] > 1:
                self.replays += 1
                for step in steps:
                    step()
            assert kept  # lives as long as this

        return result, again

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = func.overloadpacket.__name__, kwargs or {}
        if name in _FROM_THE_CPU:
            raise RuntimeError(f"{name}: operation not permitted when stream is capturing")
        result = func(*args, **kwargs)
        inputs, outputs = ([t for t in tree_leaves(of) if isinstance(t, Tensor)] for of in ((args, kwargs), result))
        self._kept += [args, kwargs, result]
        if "empty" in name:
            return result
        there = {t.untyped_storage().data_ptr() for t in inputs}

        def again() -> None:
            new = [t for t in tree_leaves(func(*args, **kwargs)) if isinstance(t, Tensor)]
            for before, now in zip(outputs, new, strict=True):
                if before.untyped_storage().data_ptr() not in there:
                    before.copy_(now)

        self._steps.append(again)
        return result


def _refusing(name: str, recording: int, usual: Callable[..., Any]) -> Callable[..., Any]:
    def refuse(*arguments: Any, **named: Any) -> Any:
        if threading.get_ident() == recording:
            raise RuntimeError(f"{name}: operation not permitted when stream is capturing")
        return usual(*arguments, **named)

    return refuse
