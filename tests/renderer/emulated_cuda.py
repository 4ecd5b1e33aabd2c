"""The CUDA engine's kernels on the CPU: the very same source, compiled with `ziglang`, run thread by thread."""

from __future__ import annotations

import ctypes
import hashlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import Bounds, Rendering, cuda, nvrtc
from sarsplat.renderer.operations import render_with

HERE = Path(__file__).with_name("emulator")
FLAGS = (
    *("-std=c++17", "-O2", "-g0", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=fast", "-Wall", "-Wextra"),
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


def compile_emulator(folder: Path, sources: Path = nvrtc.SOURCES, flags: tuple[str, ...] = STRICT) -> Path:
    """A shared library: the emulator with the engine's kernels in it, kept in `folder` until a source changes."""
    texts = [path.read_bytes() for part in (sources, HERE) for path in sorted(part.iterdir())]
    library = folder / f"emulator-{hashlib.sha256(repr((texts, FLAGS, flags)).encode()).hexdigest()[:24]}.so"
    if not library.exists():
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            made = Path(scratch) / library.name
            command = [sys.executable, "-m", "ziglang", "c++", *FLAGS, *flags, f"-I{sources}", f"-I{HERE}"]
            subprocess.run([*command, *map(str, sorted(HERE.glob("*.cpp"))), "-o", str(made)], check=True)
            made.replace(library)
    return library


def mutated(folder: Path, before: str, after: str, which: int = 0) -> Path:
    """The emulator with one place of `cuda_rays.cuh` changed; the changed sources are in `folder`."""
    folder.mkdir()
    for path in nvrtc.SOURCES.iterdir():
        if path.suffix in (".cu", ".cuh", ".h"):
            (folder / path.name).write_text(path.read_text())
    rays = folder / "cuda_rays.cuh"
    parts = rays.read_text().split(before)
    assert len(parts) > which + 1
    rays.write_text(before.join(parts[: which + 1]) + after + before.join(parts[which + 1 :]))
    return compile_emulator(folder.parent, folder, flags=())


class Emulator:
    """A launcher, as `sarsplat.renderer.cuda` wants it, whose device is the CPU."""

    device = torch.device("cpu")

    def __init__(self, library: Path, schedule: str = "in order") -> None:
        self._library, self._schedule = ctypes.CDLL(str(library)), schedule
        self._library.emulate.restype = ctypes.c_char_p

    def launch(self, name: str, blocks: int, threads: int, *arguments: ctypes._CData) -> None:
        """Run a kernel to its end."""
        order = (ctypes.c_int * threads)(*SCHEDULES[self._schedule](threads))
        addresses = (ctypes.c_void_p * len(arguments))(*(ctypes.addressof(argument) for argument in arguments))
        fault = self._library.emulate(name.encode(), blocks, threads, order, self._schedule == "backwards", addresses)
        if fault is not None:
            raise RuntimeError(f"{name}: {fault.decode()}")


def render_on(
    launcher: cuda.Launcher,
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid | None = None,
    amplitudes: Tensor | None = None,
    shift: Tensor | None = None,
    gain: Tensor | None = None,
    imaging_weight: str = "area",
    first_return_depth: float | None = None,
    plane_gradients: bool = False,
    bounds: Bounds | None = None,
) -> Rendering:
    """`sarsplat.render` with engine="cuda", as this launcher runs it."""
    rays = rays or RayGrid.for_image(grid)
    capacity = None if bounds is None else bounds.capacity(len(gaussians), views, grid, rays)
    return render_with(
        partial(cuda.Pass, launcher, capacity),
        gaussians,
        views,
        grid,
        rays=rays,
        amplitudes=amplitudes,
        shift=shift,
        gain=gain,
        imaging_weight=imaging_weight,
        first_return_depth=first_return_depth,
        plane_gradients=plane_gradients,
        bounds=bounds if capacity else None,
    )
