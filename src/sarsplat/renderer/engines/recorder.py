"""Recording of training steps as CUDA graphs, which are replayed."""

import threading
from collections.abc import Callable
from contextlib import suppress
from ctypes import c_int32, c_void_p
from typing import TypeVar

import torch
from torch import Tensor

from sarsplat.renderer.engines.cuda_device import Device
from sarsplat.renderer.engines.on_device import read_meanwhile

T = TypeVar("T")

MOST_WORDS = 992
"""Maximum words of 4 bytes that one launch can send, as in csrc/cuda_training.cuh."""

_Words = c_int32 * MOST_WORDS

_RECORDING = threading.Lock()  # lock of recordings: torch's list of graphs with its random generator is not thread-safe
_RETIRED: list[torch.cuda.CUDAGraph] = []  # unused graphs, which are freed while no thread records

_IDLE: dict[torch.device, list[tuple[torch.cuda.Stream, torch.cuda.Stream | None]]] = {}
"""Streams of deleted recorders, and the streams on which their records may still run."""


class Recorder:
    """Recorder of one GPU, by CUDA graphs.

    It has its own stream, so that launches of other threads are not recorded; tensors cached on the device for it
    (`kept_on_device`) stay alive as long as a record reads them.
    """

    def __init__(self, launcher: Device) -> None:
        self.launcher, self._graphs = launcher, list[torch.cuda.CUDAGraph]()
        self._read: list[object] = []  # by the latest record
        self._usual: torch.cuda.Stream | None = None
        try:
            self._stream, before = _IDLE.setdefault(launcher.device, []).pop()
        except IndexError:
            self._stream, before = launcher.new_stream(), None
        if before is not None:  # memory that its records read must not be overwritten yet
            self._stream.wait_stream(before)

    def __del__(self) -> None:
        if hasattr(self, "_stream"):
            _IDLE[self.launcher.device].append((self._stream, self._usual))
            _RETIRED.extend(self._graphs)
            self._graphs.clear()
            if _RECORDING.acquire(blocking=False):  # this thread may be recording
                _RETIRED.clear()
                _RECORDING.release()

    def rehearse(self, program: Callable[[], T]) -> T:
        """Run a program on the stream of recordings, so that all caches are filled."""
        self._usual = usual = torch.cuda.current_stream(self.launcher.device)
        self._stream.wait_stream(usual)
        with torch.cuda.stream(self._stream):
            result = program()
        usual.wait_stream(self._stream)
        return result

    def record(self, program: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """Record a program without running it.

        Return its tensors, and a function that replays it on the same memory, until another program is recorded.
        """
        graph = torch.cuda.CUDAGraph()

        def recorded() -> T:
            graph.capture_begin(pool=memory, capture_error_mode="thread_local")
            try:
                made = program()
            except BaseException:
                with suppress(RuntimeError):  # a second report of the same failure
                    graph.capture_end()
                raise
            graph.capture_end()
            return made

        with _RECORDING, read_meanwhile() as self._read:
            memory = self._graphs[-1].pool() if self._graphs else None
            if memory is None:
                torch.cuda.empty_cache()  # a graph cannot use memory that the rehearsal has cached
            self._graphs.append(graph)
            result = self.rehearse(recorded)
            del self._graphs[:-1]  # the memory lives as long as one of them
            _RETIRED.clear()
        return result, self._replay

    def _replay(self) -> None:
        self._graphs[-1].replay()


class Told:
    """Numbers on a device that change between replays, and are sent as arguments of a launch.

    `sizes` are dtype, of 4 or 8 bytes, and count of the numbers, by name.
    """

    def __init__(self, recorder: Recorder, sizes: dict[str, tuple[torch.dtype, int]]) -> None:
        self._launcher, self._words = recorder.launcher, _Words()
        self._device_words = torch.zeros(MOST_WORDS, dtype=torch.int32, device=self._launcher.device)
        self._host_words = torch.frombuffer(self._words, dtype=torch.int32)
        self.tensors: dict[str, Tensor] = {}
        self._host: dict[str, Tensor] = {}
        begin = 0
        for name, (dtype, count) in sorted(sizes.items(), key=lambda item: -item[1][0].itemsize):  # aligned
            end = begin + count * dtype.itemsize // 4
            self.tensors[name], self._host[name] = (
                w[begin:end].view(dtype) for w in (self._device_words, self._host_words)
            )
            begin = end
        self._count = c_int32(begin)

    def tell(self, **numbers: Tensor) -> None:
        """Send numbers on the CPU to the tensors, for the following launches."""
        for name, values in numbers.items():
            self._host[name].copy_(values)
        self._launcher.launch("tell", 1, 256, self._words, self._count, c_void_p(self._device_words.data_ptr()))
