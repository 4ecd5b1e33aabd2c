"""Steps that a GPU does by itself: their launches are recorded once, and then run again as they are."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from ctypes import c_int32, c_void_p
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from sarsplat.renderer.engines.cuda_arrays import Launcher
from sarsplat.renderer.engines.cuda_device import Device
from sarsplat.renderer.engines.on_device import read_meanwhile

T = TypeVar("T")

MOST_WORDS = 992
"""That can be told at a time, of csrc/cuda_training.cuh."""

_Words = c_int32 * MOST_WORDS

_RECORDING = threading.Lock()
"""Of several threads, one records at a time: torch lists all graphs beside its random numbers, unguarded."""

_RETIRED: list[torch.cuda.CUDAGraph] = []
"""Graphs that nobody needs, and that leave that list when nobody records."""

_IDLE: dict[torch.device, list[tuple[torch.cuda.Stream, torch.cuda.Stream | None]]] = {}
"""Streams that recorders have given back, and on which their records were run, perhaps to this moment."""


class Recorder(Protocol):
    """What records on one device: a GPU, or the tests' emulation of one."""

    @property
    def launcher(self) -> Launcher:
        """What queues launches there."""
        ...

    def rehearse(self, program: Callable[[], T]) -> T:
        """Run a program where it would be recorded, so that all that is made once has been made."""
        ...

    def record(self, program: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """Record a program without running it.

        Returns the tensors that it gives, and what runs it again, with other numbers in the same places; until another
        program is recorded.
        """
        ...


class CudaRecorder:
    """Records on one GPU, as a graph of CUDA.

    Its stream is its own: what another thread launched there would be recorded, too, and tensors that are kept on the
    device for it (`kept_on_device`) stay for as long as a record reads them.
    """

    def __init__(self, launcher: Device) -> None:
        self.launcher, self._graphs = launcher, list[torch.cuda.CUDAGraph]()
        self._read: list[object] = []  # by the latest
        self._usual: torch.cuda.Stream | None = None
        try:
            self._stream, before = _IDLE.setdefault(launcher.device, []).pop()
        except IndexError:
            self._stream, before = launcher.new_stream(), None
        if before is not None:  # what it read must not be overwritten yet
            self._stream.wait_stream(before)

    def __del__(self) -> None:
        if hasattr(self, "_stream"):
            _IDLE[self.launcher.device].append((self._stream, self._usual))
            _RETIRED.extend(self._graphs)
            self._graphs.clear()
            if _RECORDING.acquire(blocking=False):  # it may be this very thread that records
                _RETIRED.clear()
                _RECORDING.release()

    def rehearse(self, program: Callable[[], T]) -> T:
        """As `Recorder.rehearse`."""
        self._usual = usual = torch.cuda.current_stream(self.launcher.device)
        self._stream.wait_stream(usual)
        with torch.cuda.stream(self._stream):
            result = program()
        usual.wait_stream(self._stream)
        return result

    def record(self, program: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """As `Recorder.record`. Programs share their memory: each is the last to be run until the next is recorded."""
        graph = torch.cuda.CUDAGraph()

        def recorded() -> T:
            graph.capture_begin(pool=memory, capture_error_mode="thread_local")
            try:
                made = program()
            except BaseException:
                with suppress(RuntimeError):  # which would only say that it failed
                    graph.capture_end()
                raise
            graph.capture_end()
            return made

        with _RECORDING, read_meanwhile() as self._read:
            memory = self._graphs[-1].pool() if self._graphs else None
            if memory is None:
                torch.cuda.empty_cache()  # what the rehearsal took is kept there, and could not be given to a record
            self._graphs.append(graph)
            result = self.rehearse(recorded)
            del self._graphs[:-1]  # not before: the memory lives as long as one of them
            _RETIRED.clear()
        return result, self._replay

    def _replay(self) -> None:
        self._graphs[-1].replay()


class Told:
    """Numbers on a device that change from step to step, and reach it with the arguments of a launch.

    Parameters
    ----------
    recorder : Recorder
        Whose device it is.
    sizes : dict of str to (torch.dtype, int)
        What there is to tell, by name: a type of 4 or 8 bytes, and how many numbers.
    """

    def __init__(self, recorder: Recorder, sizes: dict[str, tuple[torch.dtype, int]]) -> None:
        self._launcher, self._words = recorder.launcher, _Words()
        self._there = torch.zeros(MOST_WORDS, dtype=torch.int32, device=self._launcher.device)
        self._here = torch.frombuffer(self._words, dtype=torch.int32)
        self.tensors: dict[str, Tensor] = {}
        self._at: dict[str, Tensor] = {}
        begin = 0
        for name, (dtype, count) in sorted(sizes.items(), key=lambda item: -item[1][0].itemsize):  # so they are aligned
            end = begin + count * dtype.itemsize // 4
            self.tensors[name], self._at[name] = (w[begin:end].view(dtype) for w in (self._there, self._here))
            begin = end
        self._count = c_int32(begin)

    def tell(self, **numbers: Tensor) -> None:
        """Let the tensors have these numbers, which are on the CPU, from now on."""
        for name, values in numbers.items():
            self._at[name].copy_(values)
        self._launcher.launch("tell", 1, 256, self._words, self._count, c_void_p(self._there.data_ptr()))
