"""Choice of the device for training and rendering."""

from __future__ import annotations

import warnings
from functools import cache

import torch

from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.renderer.engines.cuda_device import require_cuda
from sarsplat.renderer.engines.trial import objection


def device_named(name: str) -> torch.device:
    """The device of that name; "auto" is "cuda" where there is a GPU on which the CUDA engine passes its check.

    Refused if there is no such device, or it cannot be used.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise SarsplatError(f"device {name!r} is unknown; choose auto, cpu or cuda")
    return _automatic() if name == "auto" else usable_device("cuda:0" if name == "cuda" else name)


def usable_device(device: torch.device | str) -> torch.device:
    """A device that models can be trained on, as torch names it; refused if it is none, or cannot be used."""
    try:
        found = torch.device(device)
    except RuntimeError as error:
        raise SarsplatError(f"device {shown(device)} is unknown; give cpu or cuda") from error
    if found.type not in ("cpu", "cuda", "meta"):  # "meta": its tensors have no numbers
        raise SarsplatError(f"nothing is trained on the device {shown(device)}; give cpu or cuda")
    if found.type == "cuda":
        require_cuda()
    return found


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
