"""The CUDA engine's kernels on the CPU: the very same source, compiled with `ziglang`, run thread by thread."""

from __future__ import annotations

import ctypes
import hashlib
import math
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sarsplat.renderer import Rendering, render
from sarsplat.renderer.engines import choice, cuda, on_device
from sarsplat.renderer.engines.abi import SOURCES
from sarsplat.renderer.engines.cuda_device import Device
from sarsplat.renderer.engines.recorder import Recorder

HERE = Path(__file__).with_name("emulator")
FLAGS = (
    *("-std=c++17", "-O2", "-g0", "-fPIC", "-fvisibility=hidden", "-fno-exceptions", "-fno-rtti", "-ffp-contract=fast"),
    *("-Wall", "-Wextra"),
    "-U_FORTIFY_SOURCE",  # which takes a jump between fibers for an attack
)
STRICT = ("-fsanitize=undefined", "-fsanitize-trap=undefined")
"""Undefined behaviour ends the program."""

SCHEDULES: dict[str, Callable[[int], list[int]]] = {
    "in order": lambda count: list(range(count)),
    "backwards": lambda count: list(range(count))[::-1],
    "shuffled": lambda count: torch.randperm(count, generator=torch.Generator().manual_seed(count)).tolist(),
}
"""In which order the threads of a block take turns."""


def compile_emulator(folder: Path, sources: Path = SOURCES, flags: tuple[str, ...] = STRICT) -> Path:
    """A shared library: the emulator with the engine's kernels in it, kept in `folder` until a source changes."""
    texts = [path.read_bytes() for part in (sources, HERE) for path in sorted(part.iterdir())]
    library = folder / f"emulator-{hashlib.sha256(repr((texts, FLAGS, flags)).encode()).hexdigest()[:24]}.so"
    if not library.exists():
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            zig, made = partial(subprocess.run, cwd=scratch, check=True), Path(scratch) / library.name
            compiler = [sys.executable, "-m", "ziglang"]
            zig([*compiler, "c++", *FLAGS, *flags, f"-I{sources}", f"-I{HERE}", "-c", *sorted(HERE.glob("*.cpp"))])
            # as C: the standard library of C++ would be compiled first, for a minute, and nothing of it is called
            zig([*compiler, "cc", "-O2", "-shared", *sorted(Path(scratch).glob("*.o")), "-o", made])
            made.replace(library)
    return library


def mutated(kept: Path, folder: Path, file: str, before: str, after: str) -> Path:
    """The emulator with one place of a source file changed, in `kept` like the other; `folder` is for its sources."""
    shutil.copytree(SOURCES, folder)
    text = (folder / file).read_text()
    assert before in text
    (folder / file).write_text(text.replace(before, after, 1))
    return compile_emulator(kept, folder, flags=())


class _LeftOut(ctypes.Structure):
    _fields_ = [("file", ctypes.c_char_p), ("line", ctypes.c_int)]


@contextmanager
def without_barrier(library: Path, file: str, which: int) -> Iterator[None]:
    """Meanwhile threads do not wait for each other at that barrier of a source file."""
    lines = (SOURCES / file).read_text().splitlines()
    line = [number for number, text in enumerate(lines, 1) if "__syncthreads();" in text][which]
    left_out = _LeftOut.in_dll(ctypes.CDLL(str(library)), "left_out")
    left_out.file, left_out.line = file.encode(), line
    yield
    left_out.line = 0


_ONE_AT_A_TIME = threading.Lock()  # the emulated GPU runs one kernel after the other, whichever threads ask for them


class Emulator(Device):
    """A launcher, as `sarsplat.renderer.engines.cuda` wants it, whose device is the CPU."""

    device = torch.device("cpu")

    def __init__(self, library: Path, schedule: str = "in order") -> None:
        self._library, self._schedule = ctypes.CDLL(str(library)), schedule
        self._library.emulate.restype = ctypes.c_char_p

    def launch(self, name: str, blocks: int, threads: int, *arguments: ctypes._CData) -> None:
        """Run a kernel to its end."""
        order = (ctypes.c_int * threads)(*SCHEDULES[self._schedule](threads))
        addresses = (ctypes.c_void_p * len(arguments))(*(ctypes.addressof(argument) for argument in arguments))
        backwards = self._schedule == "backwards"
        with _ONE_AT_A_TIME:
            fault = self._library.emulate(name.encode(), blocks, threads, order, backwards, addresses)
        if fault is not None:
            raise RuntimeError(f"{name}: {fault.decode()}")


@contextmanager
def guarded() -> Iterator[None]:
    """Meanwhile the engine's arrays begin as NaN, with a margin on both sides that nobody may write to."""
    arrays, margin = [], 1024

    def new(self: cuda.Pass, key: str, *shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        whole = torch.full((math.prod(shape) * dtype.itemsize + 2 * margin,), 255, dtype=torch.uint8)  # NaN, or -1
        arrays.append(whole)
        return self.keep(key, whole[margin:-margin].view(dtype).view(shape))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda.Pass, "new", new)
        yield
    assert len(arrays) > 20
    for whole in arrays:
        assert bool((whole[:margin] == 255).all() and (whole[-margin:] == 255).all())


@contextmanager
def on_emulated_gpu(
    launcher: Device, recorder: Callable[[torch.device], EmulatedRecorder] | None = None
) -> Iterator[None]:
    """Meanwhile tensors on the CPU are on this GPU, which has a queue and recorders for each thread, or this one."""
    engine = choice.Engine(
        "cpu",
        lambda *_: partial(cuda.Pass, launcher),
        takes_bounds=True,
        recorder=recorder or (lambda _: EmulatedRecorder(launcher)),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(choice.ENGINES, "cuda", engine)
        patch.setitem(choice.ENGINES, "cpu", replace(choice.ENGINES["cpu"], device_type="none"))  # so "auto" is not
        patch.setattr(on_device, "queue_of", lambda device: threading.get_ident())
        choice._fitting.cache_clear()
        yield
    choice._fitting.cache_clear()


def render_on(launcher: Device, *arguments: Any, **options: Any) -> Rendering:
    """`sarsplat.render` with engine="cuda", as this launcher runs it."""
    with on_emulated_gpu(launcher):
        return render(*arguments, engine="cuda", **options)


# ---- what `Recorder` does: operations of torch and launches, recorded and run again ------------------------------
T = TypeVar("T")

_FROM_THE_CPU = ("_local_scalar_dense", "lift_fresh", "nonzero", "is_nonzero", "equal", "masked_select", "pin_memory")
"""What would make a CPU wait for a GPU, or the other way round: while a graph is recorded, CUDA refuses it."""

_UNSEEN = [(Tensor, "tolist"), (Tensor, "numpy"), (Tensor, "cpu"), (torch, "from_numpy"), (torch, "as_tensor")]
"""The same, of which there are no operations where everything is on the CPU."""


_RECORDING = threading.Lock()  # one thread records at a time, while others launch


class EmulatedRecorder(TorchDispatchMode, Recorder):
    """Records on the emulated GPU.

    What is recorded is run at the same time, so that there is something to look at; the first run of it is left out
    instead.
    """

    def __init__(self, launcher: Device) -> None:
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
