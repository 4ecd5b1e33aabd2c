"""Dropout: the random Gaussians that a step omits, computed on the device and equal on all devices."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from sarsplat.renderer.engines.on_device import kept_on_device
from sarsplat.settings.config import Config

_STEP, _SEED = 0x9E3779B97F4A7C15, 0xD1B54A32D192ED03
"""Odd multipliers that spread step and seed over 64 bits."""

_MIX = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
"""Steele, Lea & Flood, Fast splittable pseudorandom number generators, 2014, as improved by Stafford (variant 13)."""

_BITS = 24

_MAX_SHARE = 0.4
"""Maximum share dropped because there are few views."""


def share_dropped(config: Config, views: int) -> float:
    """Share of the Gaussians that a step drops, given the number of training views."""
    return max(config.dropout, min(_MAX_SHARE, (config.few_views / views) ** 2))


def dropped(
    count: int, share: float, seed: int, step: int | Int64[Tensor, " 1"], device: torch.device
) -> Bool[Tensor, " {count}"]:
    """Mask of the dropped Gaussians, a random share (0 to 1) of `count`.

    A hash of seed, step and row decides; the state of a generator would have to be copied to the device.
    """
    if isinstance(step, Tensor):  # wraps around by itself
        mixed = step * _signed(_STEP) + _signed(seed * _SEED) + _rows(count, device)
    else:
        mixed = _rows(count, device) + _signed(seed * _SEED + step * _STEP)
    for factor, shift in zip(_MIX, (30, 27), strict=True):
        mixed.bitwise_xor_(mixed >> shift).mul_(_signed(factor))
    first_kept = math.ceil(np.float32(share * 2**_BITS))  # an integer: others are rounded to torch's default dtype
    return (mixed >> 32).bitwise_and_(2**_BITS - 1) < first_kept


@kept_on_device(maxsize=4)
def _rows(count: int, device: torch.device) -> Int64[Tensor, " {count}"]:
    return torch.arange(count, device=device) * _signed(_STEP * _STEP)


def _signed(number: int) -> int:
    """The last 64 bits as a signed integer, torch's int64."""
    return (number + 2**63) % 2**64 - 2**63
