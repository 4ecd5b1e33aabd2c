"""The classifier of the benchmark: A-ConvNets, with batch norm, on the middle of chips of 8 bits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

SIDE = 88
"""Pixels of the square in the middle of a chip that it sees."""

REACH = 4
"""By how many pixels that square is displaced at most, in training."""

_BATCH, _RATE, _DECAY = 32, 2e-3, 1e-2
_RECKONED, _RECKONED_AT_A_TIME = 8, 64
"""Batches from which the statistics of the batch norm are taken at the end, and their size."""


@dataclass(frozen=True)
class Source:
    """Chips of which each batch has a share."""

    chips: np.ndarray
    """Magnitudes of any scale [n, rows, columns], at least SIDE + 2 REACH each way."""
    classes: np.ndarray
    """int64 [n]."""
    share: float

    def drawn(self, count: int, chance: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """So many, each cut out at a displacement of its own, and their classes."""
        which = chance.integers(len(self.chips), size=count)
        middle = [(side - SIDE) // 2 for side in self.chips.shape[1:]]
        places = middle + chance.integers(-REACH, REACH + 1, (count, 2))
        cut = [self.chips[k, i : i + SIDE, j : j + SIDE] for k, (i, j) in zip(which, places, strict=True)]
        return np.stack(cut), self.classes[which]


def trained(measured: Source, others: Sequence[Source], classes: int, seed: int, steps: int) -> tuple[nn.Module, float]:
    """A network after so many steps, and its loss in the last tenth of them.

    The rate falls as a half cosine. The statistics of the batch norm are taken anew at the end from the measured
    chips: batches are mixtures, and what is asked about is measured.
    """
    torch.manual_seed(seed)
    chance = np.random.default_rng([seed, 1])
    network = _network(classes)
    optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    sources = [source for source in (measured, *others) if source.share]
    counts = [round(source.share * _BATCH) for source in sources]
    losses = []
    for _ in range(steps):
        drawn = [source.drawn(count, chance) for source, count in zip(sources, counts, strict=True)]
        chips, labels = (np.concatenate(arrays) for arrays in zip(*drawn, strict=True))
        loss = nn.functional.cross_entropy(_scores(network, chips), torch.from_numpy(labels))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(loss.item())
    _reckon(network, measured, chance)
    return network.eval(), float(np.mean(losses[-max(1, steps // 10) :]))


def predicted(network: nn.Module, chips: np.ndarray) -> np.ndarray:
    """The classes of chips, by the square in the middle of each; int64 [n]."""
    return log_odds(network, chips).argmax(axis=1)


def log_odds(network: nn.Module, chips: np.ndarray) -> np.ndarray:
    """Logarithm of the softmax for chips, by the square in the middle of each; float64 [n, classes]."""
    top, left = ((side - SIDE) // 2 for side in chips.shape[1:])
    middle = chips[:, top : top + SIDE, left : left + SIDE]
    with torch.no_grad():
        found = [_scores(network, middle[k : k + 128]).double().log_softmax(1) for k in range(0, len(middle), 128)]
    return torch.cat(found).numpy()


def _scores(network: nn.Module, chips: np.ndarray) -> torch.Tensor:
    scores: torch.Tensor = network(_seen(chips))
    return scores


def _seen(chips: np.ndarray) -> torch.Tensor:
    """Roots of magnitudes, each chip with mean 0 and standard deviation 1: neither its gain nor its scale is seen."""
    roots = torch.from_numpy(np.ascontiguousarray(chips)).float().sqrt()
    std, mean = torch.std_mean(roots, (1, 2), keepdim=True)
    return ((roots - mean) / (std + 1e-6))[:, None].to(memory_format=torch.channels_last)


def _network(classes: int) -> nn.Module:
    def layer(before: int, after: int, side: int, pool: bool = True) -> list[nn.Module]:
        halve = [nn.MaxPool2d(2)] if pool else []
        return [nn.Conv2d(before, after, side, bias=False), *halve, nn.BatchNorm2d(after), nn.ReLU()]

    network = nn.Sequential(
        *layer(1, 16, 5),
        *layer(16, 32, 5),
        *layer(32, 64, 6),
        nn.Dropout(0.5),
        *layer(64, 128, 5, pool=False),
        nn.Conv2d(128, classes, 3),
        nn.Flatten(),
    )
    for module in network:
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch does not declare it


def _reckon(network: nn.Module, measured: Source, chance: np.random.Generator) -> None:
    """Take the statistics of the batch norm from measured chips."""
    network.train()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.reset_running_stats()
            module.momentum = None  # the mean of all batches
        elif isinstance(module, nn.Dropout):
            module.eval()
    with torch.no_grad():
        for _ in range(_RECKONED):
            _scores(network, measured.drawn(_RECKONED_AT_A_TIME, chance)[0])
