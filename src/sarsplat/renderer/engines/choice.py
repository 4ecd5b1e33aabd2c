"""Which engine does what: the one place that decides it, for the renderer and for trainings."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.renderer.checks import check_for_cpu, check_for_cuda
from sarsplat.renderer.engines import cpu, cuda
from sarsplat.renderer.engines.cuda_device import device, require_cuda
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.engines.recorder import CudaRecorder, Recorder
from sarsplat.renderer.engines.trial import objection

Tensors = Mapping[str, Tensor | None]
"""What is to be calculated with, by the names that errors use."""


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
    recorder : callable, optional
        Given a device, what records steps there.
    objection : callable
        Given the device, why "auto" must not take the engine there; "" if nothing speaks against it.
    """

    device_type: str
    prepare: Callable[[Tensors, ImageGrid | None, str], NewPass]
    takes_bounds: bool = False
    recorder: Callable[[torch.device], Recorder] | None = None
    objection: Callable[[torch.device], str] = lambda device: ""


def _on_cpu(tensors: Tensors, grid: ImageGrid | None, instruction_set: str) -> NewPass:
    check_for_cpu(grid, tensors)
    return partial(cpu.Pass, instruction_set)


def _on_cuda(tensors: Tensors, grid: ImageGrid | None, instruction_set: str) -> NewPass:
    require_cuda()
    return partial(cuda.Pass, device(check_for_cuda(tensors)))


def _recorder(where: torch.device) -> Recorder:
    return CudaRecorder(device(where.index or 0))


ENGINES = {
    "cpu": Engine("cpu", _on_cpu),
    "cuda": Engine("cuda", _on_cuda, takes_bounds=True, recorder=_recorder, objection=objection),
}
"""Engines by name. Beside them there are "reference", which is plain torch, and "auto", which chooses."""


def passes_for(
    name: str, tensors: Tensors, grid: ImageGrid | None = None, instruction_set: str = "auto"
) -> NewPass | None:
    """What makes passes of the engine that is meant, over these tensors; None where plain torch calculates.

    What an engine does not have, `Operation.on` leaves to plain torch, too.

    Parameters
    ----------
    name : {"auto", "cpu", "cuda", "reference"}
        "auto" is what fits the dtype and the device of the first tensor.
    tensors : mapping of str to Tensor
        All that kernels read.
    grid : ImageGrid, optional
        Of the images that are rendered.
    instruction_set : {"auto", "base", "avx2", "avx512"}
        Of the CPU engine.

    Raises
    ------
    SarsplatError
        If the engine is unknown, is not available, or does not take the tensors.
    """
    chosen = chosen_engine(name, next(tensor for tensor in tensors.values() if tensor is not None))
    return ENGINES[chosen].prepare(tensors, grid, instruction_set) if chosen in ENGINES else None


def recorder_for(like: Tensor) -> Recorder | None:
    """What records steps on the device of a tensor; None where nothing does."""
    engine = ENGINES.get(chosen_engine("auto", like))
    return None if engine is None or engine.recorder is None else engine.recorder(like.device)


def chosen_engine(name: str, like: Tensor) -> str:
    """The engine that is meant: "auto" is what fits the dtype and the device of the tensor.

    Raises
    ------
    SarsplatError
        If there is none of that name, or what "auto" means there did not pass its check.
    """
    if name == "auto":
        return _fitting(like.dtype, like.device)
    if name not in ENGINES and name != "reference":
        raise SarsplatError(f"engine {name!r} is unknown; choose one of auto, {', '.join(ENGINES)}, reference")
    return name


@cache
def _fitting(dtype: torch.dtype, device: torch.device) -> str:
    """What "auto" takes; says so once."""
    fits = (name for name, engine in ENGINES.items() if (torch.float32, engine.device_type) == (dtype, device.type))
    fitting = next(fits, "reference")
    if fitting in ENGINES and (reason := ENGINES[fitting].objection(device)):
        raise SarsplatError(
            f"engine='auto' does not use the {fitting} engine on {device}: {reason}; move the tensors to the CPU, or "
            f"ask for engine='{fitting}', which is not checked"
        )
    logging.getLogger("sarsplat").info("engine='auto' is %r for %s on %s", fitting, dtype, device)
    return fitting
