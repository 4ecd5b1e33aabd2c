"""Arrays on a GPU, whose addresses kernels hold, and launches of kernels."""

from __future__ import annotations

import ctypes
from typing import Protocol

import torch
from torch import Tensor

from sarsplat.renderer.engines.on_device import kept_on_device

THREADS = 256
"""Threads of a block, as in csrc/cuda_state.cuh."""


class Launcher(Protocol):
    """Launcher of kernels: a GPU, or the tests' emulator."""

    device: torch.device

    def launch(self, name: str, blocks: int, threads: int, *arguments: ctypes._CData) -> None:
        """Queue a kernel after those before it; its arguments are C values."""
        ...


class Arrays:
    """Arrays by name, kept while kernels may read them, and the launcher of kernels."""

    def __init__(self, launcher: Launcher) -> None:
        self.launcher = launcher
        self.arrays: dict[str, Tensor] = {}

    def launch(self, name: str, blocks: int, *arguments: ctypes._CData) -> None:
        """Queue blocks of a kernel, unless there are 0."""
        if blocks:
            self.launcher.launch(name, blocks, THREADS, *arguments)

    def new(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Make an uninitialised array."""
        return self.keep(name, torch.empty(shape, dtype=dtype, device=self.launcher.device))

    def keep(self, name: str, array: Tensor) -> Tensor:
        """Keep an array, in place of one of the same name."""
        self.arrays[name] = array  # kernels hold its address only
        return array

    def sent(self, content: bytes) -> Tensor:
        """Return a cached copy on the device."""
        return _sent(content, self.launcher.device)


# The pixels of views never change, and a training renders the same few views again and again.
@kept_on_device(maxsize=256)
def _sent(content: bytes, device: torch.device) -> Tensor:
    """Copy to the device asynchronously, from pinned memory: copies of other memory synchronise."""
    array = torch.frombuffer(bytearray(content), dtype=torch.uint8)
    return (array.pin_memory() if device.type == "cuda" else array).to(device, non_blocking=True)
