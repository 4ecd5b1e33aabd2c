"""Where a model is trained and rendered."""

from __future__ import annotations

import warnings
from functools import cache

import torch

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.renderer.cuda_device import require_cuda
from sarsplat.renderer.trial import objection


def device_named(name: str) -> torch.device:
    """The device of that name; "auto" is "cuda" where there is a GPU on which the CUDA engine passes its check.

    Raises
    ------
    SarsplatError
        If there is no such device, or it cannot be used.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise SarsplatError(f"device {name!r} is unknown; choose auto, cpu or cuda")
    if name == "cuda":
        require_cuda()
    return _automatic() if name == "auto" else torch.device("cpu" if name == "cpu" else "cuda:0")


@cache
def _automatic() -> torch.device:
    """A GPU if there is one that can be trusted; warns of one that cannot, once."""
    gpu, cpu = torch.device("cuda:0"), torch.device("cpu")
    try:
        require_cuda()
    except SarsplatError:
        return cpu
    if not (reason := objection(gpu)):
        return gpu
    warnings.warn(
        f"the CPU is used, because the CUDA engine did not pass its check on the GPU: {reason}",
        SarsplatWarning,
        stacklevel=3,
    )
    return cpu
