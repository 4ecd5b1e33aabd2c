"""How well a small network tells two sets of chips apart that show the same targets from the same sides."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

_SIDE = 64
"""Pixels of the middle that it looks at, shifted by chance: the target, its shadow and some ground."""

_REACH, _STEPS, _BATCH, _RATE = 4, 300, 32, 2e-3


def area_under_curve(chips: np.ndarray, others: np.ndarray, seed: int = 0) -> float:
    """Chance that a chip of the first set is found likelier to be of it than one of the second; .5 if they are alike.

    Trained on every other pair, asked about the rest. Pairs, uint8 [n, rows, columns], are chips from the same view.
    """
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    both = np.stack([others, chips])
    network = _network()
    optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _STEPS)
    train = both[:, ::2]
    for _ in range(_STEPS):
        kind, which = rng.integers(2, size=_BATCH), rng.integers(train.shape[1], size=_BATCH)
        offsets = rng.integers(-_REACH, _REACH + 1, (_BATCH, 2))
        images = np.stack([_cut(train[k, w], *offset) for k, w, offset in zip(kind, which, offsets, strict=True)])
        loss = nn.functional.binary_cross_entropy_with_logits(network(_seen(images)), torch.from_numpy(kind).float())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    network.eval()
    with torch.no_grad():
        found = [network(_seen(np.stack([_cut(chip) for chip in some[1::2]]))).numpy() for some in both]
    likelier, alike = (compare(found[1][:, None], found[0][None]).mean() for compare in (np.greater, np.equal))
    return float(likelier + alike / 2)


def _network() -> nn.Module:
    def layer(before: int, after: int) -> list[nn.Module]:
        return [nn.Conv2d(before, after, 5, bias=False), nn.BatchNorm2d(after), nn.ReLU(), nn.MaxPool2d(2)]

    return nn.Sequential(
        *layer(1, 16), *layer(16, 32), *layer(32, 64), nn.Flatten(), nn.Dropout(0.5), nn.LazyLinear(1), nn.Flatten(0)
    )


def _cut(chip: np.ndarray, down: int = 0, right: int = 0) -> np.ndarray:
    top, left = ((side - _SIDE) // 2 + offset for side, offset in zip(chip.shape, (down, right), strict=True))
    return chip[top : top + _SIDE, left : left + _SIDE]


def _seen(images: np.ndarray) -> torch.Tensor:
    """Roots of magnitudes, as a classifier is given them."""
    return torch.from_numpy(images)[:, None].float().div(255).sqrt() - 0.3
