"""Arrays on a GPU, which kernels have the addresses of, and the launches of kernels."""

from __future__ import annotations

import ctypes
from typing import Protocol

import torch
from torch import Tensor

from sarsplat.renderer.engines.on_device import kept_on_device

THREADS = 256
"""Of every block, of csrc/cuda_state.cuh."""


class Launcher(Protocol):
    """What runs kernels: a GPU, or the tests' emulator."""

    device: torch.device

    def launch(self, name: str, blocks: int, threads: int, *arguments: ctypes._CData) -> None:
        """Queue a kernel after those before it; its arguments are C values."""
        ...


class Arrays:
    """Arrays by name, kept as long as kernels may read them, and what runs kernels over them."""

    def __init__(self, launcher: Launcher) -> None:
        self.launcher = launcher
        self.arrays: dict[str, Tensor] = {}

    def launch(self, name: str, blocks: int, *arguments: ctypes._CData) -> None:
        """Queue so many blocks of a kernel, if there are any."""
        if blocks:
            self.launcher.launch(name, blocks, THREADS, *arguments)

    def new(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """An array that nothing was written to."""
        return self.keep(name, torch.empty(shape, dtype=dtype, device=self.launcher.device))

    def keep(self, name: str, array: Tensor) -> Tensor:
        """Keep an array, in place of one of the same name."""
        self.arrays[name] = array  # kernels hold its address only
        return array

    def sent(self, content: bytes) -> Tensor:
        """A copy of this on the device."""
        return _sent(content, self.launcher.device)


# The pixels of views are always the same, and a training asks for the same few views again and again.
@kept_on_device(maxsize=256)
def _sent(content: bytes, device: torch.device) -> Tensor:
    """On the device, as soon as the stream gets there; from pinned memory, for the CPU waits for any other copy."""
    array = torch.frombuffer(bytearray(content), dtype=torch.uint8)
    return (array.pin_memory() if device.type == "cuda" else array).to(device, non_blocking=True)
