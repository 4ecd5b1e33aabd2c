"""What an engine is, and which there are besides the reference."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Protocol

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.renderer import cpu, cuda
from sarsplat.renderer.checks import check_for_cpu, check_for_cuda
from sarsplat.renderer.cuda_device import device, require_cuda

Tensors = dict[str, Tensor | None]
"""What is to be rendered, by the names that errors use."""


class Pass(Protocol):
    """What an engine does: one forward pass, and what its backward pass needs."""

    def forward(self, problem: ctypes.Structure, outputs: ctypes.Structure) -> tuple[str, int]:
        """Run; returns what was rejected ("" for nothing) and at which index."""
        ...

    def backward(self, problem: ctypes.Structure, gradients: ctypes.Structure) -> None:
        """Run the adjoint of the last forward pass."""
        ...

    def lattice(self, view: int) -> ctypes.Structure:
        """Where the rays of a view stand."""
        ...

    def trace(self, problem: ctypes.Structure, view: int, depth: float, transmittance: int, first_return: int) -> None:
        """Fill T_end and the first-return range of a view's rays."""
        ...

    # one step alone each (structs.Projection between them), and its adjoint
    def project(self, problem: ctypes.Structure, out: ctypes.Structure) -> tuple[str, int]: ...
    def project_backward(
        self, problem: ctypes.Structure, seeds: ctypes.Structure, gradients: ctypes.Structure
    ) -> None: ...
    def attenuate(self, problem: ctypes.Structure, footprints: ctypes.Structure, lit_area: int) -> tuple[str, int]: ...
    def attenuate_backward(
        self,
        problem: ctypes.Structure,
        d_lit_area: int | None,
        d_transmittance: int | None,
        gradients: ctypes.Structure,
    ) -> None: ...
    def trace_step(
        self,
        problem: ctypes.Structure,
        footprints: ctypes.Structure,
        view: int,
        depth: float,
        transmittance: int,
        first_return: int,
    ) -> None: ...
    def splat(
        self, problem: ctypes.Structure, footprints: ctypes.Structure, channels: ctypes.Structure, images: int
    ) -> tuple[str, int]: ...
    def splat_backward(
        self,
        problem: ctypes.Structure,
        channels: ctypes.Structure,
        d_images: int,
        gradients: ctypes.Structure,
        d_cross_sections: int,
    ) -> None: ...


@dataclass(frozen=True)
class Engine:
    """One engine.

    Parameters
    ----------
    device_type : str
        "auto" means this engine for float32 tensors on such a device.
    prepare : callable
        Given the tensors, the image grid (None where there is no image) and an instruction set, it returns what makes
        passes over them; a `SarsplatError` says why not.
    takes_bounds : bool
        Its passes can be made with a `Capacity`, and then wait for nothing.
    """

    device_type: str
    prepare: Callable[[Tensors, ImageGrid | None, str], Callable[..., Pass]]
    takes_bounds: bool = False


def _on_cpu(tensors: Tensors, grid: ImageGrid | None, instruction_set: str) -> Callable[[], Pass]:
    check_for_cpu(grid, tensors)
    return partial(cpu.Pass, instruction_set)


def _on_cuda(tensors: Tensors, grid: ImageGrid | None, instruction_set: str) -> Callable[..., Pass]:
    require_cuda()
    return partial(cuda.Pass, device(check_for_cuda(tensors)))


ENGINES = {"cpu": Engine("cpu", _on_cpu), "cuda": Engine("cuda", _on_cuda, takes_bounds=True)}
"""Engines by name. Beside them there are "reference", which is plain torch, and "auto", which chooses."""


def chosen_engine(name: str, like: Tensor) -> str:
    """The engine that is meant: "auto" is what fits the dtype and the device of the tensor.

    Raises
    ------
    SarsplatError
        If there is none of that name.
    """
    known = ("auto", *ENGINES, "reference")
    if name not in known:
        raise SarsplatError(f"engine {name!r} is unknown; choose one of {', '.join(known)}")
    return _fitting(like.dtype, like.device.type) if name == "auto" else name


@cache
def _fitting(dtype: torch.dtype, device_type: str) -> str:
    """What "auto" takes; says so once."""
    fits = (name for name, engine in ENGINES.items() if (torch.float32, engine.device_type) == (dtype, device_type))
    found = next(fits, "reference")
    logging.getLogger("sarsplat").info("engine='auto' is %r for %s on %s", found, dtype, device_type)
    return found
