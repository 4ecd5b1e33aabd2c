"""Choice of the engine, for the renderer and for trainings."""

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
from sarsplat.renderer.engines.recorder import Recorder
from sarsplat.renderer.engines.trial import objection

Tensors = Mapping[str, Tensor | None]
"""Arguments of a calculation, by the names that errors use."""


@dataclass(frozen=True)
class Engine:
    """Engine of one kind of device."""

    device_type: str | None
    """Device of float32 tensors for which "auto" means this engine; None: it never does."""
    prepare: Callable[[Tensors, ImageGrid | None], NewPass]
    """Return a constructor of passes for tensors and a grid, or raise a `SarsplatError`."""
    takes_bounds: bool = False
    """True if passes can be made with a `Capacity`, and then do not synchronise."""
    recorder: Callable[[torch.device], Recorder] | None = None
    objection: Callable[[torch.device], str] = lambda device: ""
    """Return the reason why "auto" must not use the engine on a device, or ""."""


def _on_cpu(tensors: Tensors, grid: ImageGrid | None, instruction_set: str = "auto") -> NewPass:
    check_for_cpu(grid, tensors)
    return partial(cpu.Pass, instruction_set)


def _on_cuda(tensors: Tensors, grid: ImageGrid | None) -> NewPass:
    require_cuda()
    return partial(cuda.Pass, device(check_for_cuda(tensors)))


def _recorder(where: torch.device) -> Recorder:
    return Recorder(device(where.index or 0))


ENGINES = {
    "cpu": Engine("cpu", _on_cpu),
    **{f"cpu-{name}": Engine(None, partial(_on_cpu, instruction_set=name)) for name in cpu.INSTRUCTION_SETS[1:]},
    "cuda": Engine("cuda", _on_cuda, takes_bounds=True, recorder=_recorder, objection=objection),
}
"""Engines by name; further names are "reference", which is plain torch, and "auto"."""


def passes_for(name: str, tensors: Tensors, grid: ImageGrid | None = None) -> NewPass | None:
    """Return the constructor of passes of an engine over these tensors and images on the grid; None for plain torch.

    "auto" fits the dtype and the device of the first tensor. `Operation.on` also uses plain torch for operations that
    the engine does not have. Raise if the engine is unknown, is not available, or does not take the tensors.
    """
    chosen = chosen_engine(name, next(tensor for tensor in tensors.values() if tensor is not None))
    return ENGINES[chosen].prepare(tensors, grid) if chosen in ENGINES else None


def recorder_for(like: Tensor) -> Recorder | None:
    """Return the recorder of the device of a tensor; None if it has none."""
    engine = ENGINES.get(chosen_engine("auto", like))
    return None if engine is None or engine.recorder is None else engine.recorder(like.device)


def chosen_engine(name: str, like: Tensor) -> str:
    """Return the engine's name: for "auto", the one that fits the dtype and the device of the tensor.

    Raise if the name is unknown, or the engine of "auto" did not pass its check.
    """
    if name == "auto":
        return _fitting(like.dtype, like.device)
    if name not in ENGINES and name != "reference":
        raise SarsplatError(f"engine {name!r} is unknown; choose one of auto, {', '.join(ENGINES)}, reference")
    return name


@cache
def _fitting(dtype: torch.dtype, device: torch.device) -> str:
    """Return the engine of "auto", and log it once."""
    fits = (name for name, engine in ENGINES.items() if (torch.float32, engine.device_type) == (dtype, device.type))
    fitting = next(fits, "reference")
    if fitting in ENGINES and (reason := ENGINES[fitting].objection(device)):
        raise SarsplatError(
            f"engine='auto' does not use the {fitting} engine on {device}: {reason}; move the tensors to the CPU, or "
            f"ask for engine='{fitting}', which is not checked"
        )
    logging.getLogger("sarsplat").info("engine='auto' is %r for %s on %s", fitting, dtype, device)
    return fitting
