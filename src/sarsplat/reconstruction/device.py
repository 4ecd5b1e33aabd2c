"""Where a model is trained and rendered."""

from __future__ import annotations

import torch

from sarsplat.errors import SarsplatError
from sarsplat.renderer.cuda_device import require_cuda


def device_named(name: str) -> torch.device:
    """The device of that name; "auto" is "cuda" where it can be used.

    Raises
    ------
    SarsplatError
        If there is no such device, or it cannot be used.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise SarsplatError(f"device {name!r} is unknown; choose auto, cpu or cuda")
    if name != "cpu":
        try:
            require_cuda()
        except SarsplatError:
            if name == "cuda":
                raise
            name = "cpu"
    return torch.device("cpu" if name == "cpu" else "cuda:0")
