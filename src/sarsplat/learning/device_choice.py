"""Choice of the device for training and rendering, by name or by timing steps."""

import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache

import torch

from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.learning.method import Trainable
from sarsplat.renderer.engines import cpu
from sarsplat.renderer.engines.cuda_device import require_cuda
from sarsplat.renderer.engines.trial import objection

_UNTIMED = 3  # untimed first steps on a GPU, which compile, copy and record a CUDA graph
_TIMED = 10  # timed steps on each device
_MIN_ITERATIONS = 10 * (_UNTIMED + _TIMED)  # minimum length of a training for which timing pays

_CPU = torch.device("cpu")


def device_named(name: str) -> torch.device:
    """Return the device of that name; raise if it does not exist or cannot be used.

    "auto" is a GPU if there is one and the CUDA engine passes its check there, else the CPU.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise SarsplatError(f"device {name!r} is unknown; choose auto, cpu or cuda")
    return _automatic() if name == "auto" else usable_device("cuda:0" if name == "cuda" else name)


def usable_device(device: torch.device | str) -> torch.device:
    """Return a device for training from its torch name; raise if it is unknown or cannot be used."""
    found = None
    with suppress(RuntimeError):
        found = torch.device(device)
    if found is None or found.type not in ("cpu", "cuda", "meta"):  # "meta": its tensors have no numbers
        raise SarsplatError(f"device {shown(device)} is unknown, or nothing is trained there; give cpu or cuda")
    if found.type == "cuda":
        require_cuda()
    return found


@cache
def _automatic() -> torch.device:
    """Return a GPU if the CUDA engine passes its check there, else the CPU; warn once of a GPU that fails."""
    gpu = torch.device("cuda:0")
    try:
        require_cuda()
    except SarsplatError:
        return _CPU
    if not (reason := objection(gpu)):
        return gpu
    warnings.warn(
        f"the CPU is used, because the CUDA engine did not pass its check on the GPU: {reason}",
        SarsplatWarning,
        stacklevel=3,
    )
    return _CPU


def quicker_device(
    make: Callable[[torch.device], Trainable], gpu: torch.device, iterations: int
) -> tuple[torch.device, str]:
    """Return the CPU and the reason if steps are slower on the GPU or fail there; else the GPU and "".

    `make` makes a new trainer on a device. Short trainings use the GPU without timing.
    """
    if iterations < _MIN_ITERATIONS:
        return gpu, ""
    try:
        cpu.library()  # warns once, which must happen before warnings are muted
    except SarsplatError:
        return gpu, ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the training repeats them
        try:
            gpu_seconds = _seconds(make(gpu), _TIMED, untimed=_UNTIMED)  # its memory is freed on return
        except (SarsplatError, torch.OutOfMemoryError) as error:  # such as a GPU that is too small
            return _CPU, f"training on the CPU: on the GPU, {str(error).partition(chr(10))[0]}"
        try:
            on_cpu = make(_CPU)
            _seconds(on_cpu, 1)
            cpu_seconds = 0.0
            for _ in range(_TIMED):
                if (cpu_seconds := cpu_seconds + _seconds(on_cpu, 1)) >= gpu_seconds:
                    return gpu, ""
        except SarsplatError:
            return gpu, ""
    cpu_ms, gpu_ms = (seconds / _TIMED * 1e3 for seconds in (cpu_seconds, gpu_seconds))
    times = f"a step takes {cpu_ms:.3g} ms there, and {gpu_ms:.3g} ms on the GPU"
    return _CPU, f"training on the CPU: {times}; device cuda takes the GPU nevertheless"


def _seconds(trainer: Trainable, steps: int, untimed: int = 0) -> float:
    """Time of this many steps after untimed ones, until the device is done, s."""
    for _ in range(untimed):
        trainer.step()
    trainer.check()
    begun = time.perf_counter()
    for _ in range(steps):
        trainer.step()
    trainer.check()
    return time.perf_counter() - begun
