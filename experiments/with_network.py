"""A network trained on the chips of runs, and products of odds."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from chip_arms import EACH, made_of
from chip_draws import middle
from chips import ARMS, STEPS
from classifier import Source, log_odds, trained
from scipy.optimize import minimize
from scipy.special import log_softmax

from sarsplat import Run
from sarsplat.recognition.chips import Chip

ARM = ARMS["ours-turned"]
"""How it is trained: on measured chips, turned ones, and those that runs generate."""


def network_log_odds(runs: Sequence[Run], seed: int, asked: Sequence[Chip], kept: Path) -> np.ndarray:
    """Logarithms of the softmax for chips, float64 [n, classes] with the classes as the runs; kept in a folder."""
    content = [str((seed, STEPS, EACH)), *(run.snapshot.digest() for run in runs), *(chip.name for chip in asked)]
    path = kept / f"{hashlib.sha256(' '.join(content).encode()).hexdigest()[:20]}.npy"
    if not path.exists():
        train = [run.dataset.select("train") for run in runs]
        power = [power for dataset in train for power in dataset.power]
        classes = np.arange(len(runs))
        own = Source(_seen(power), np.repeat(classes, [len(dataset) for dataset in train]), ARM.measured)
        others = [
            Source(made_of(kind, train, runs), np.repeat(classes, EACH), share) for kind, share in ARM.others.items()
        ]
        network, _ = trained(own, others, len(runs), seed, STEPS)
        kept.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".tmp.npy")
        np.save(unfinished, log_odds(network, _seen([chip.power for chip in asked])))
        unfinished.replace(path)
    return np.load(path)


def _seen(power: Sequence[np.ndarray]) -> np.ndarray:
    """Magnitudes in the middle of chips."""
    return np.stack([middle(np.sqrt(one)) for one in power])


def product(log_odds: Sequence[np.ndarray], labels: np.ndarray, count: int) -> np.ndarray:
    """Odds of images by powers of odds [n, classes] that make the images after the first `count` most probable."""
    helping = np.arange(count, len(labels))

    def powered(x: np.ndarray) -> np.ndarray:
        mixed: np.ndarray = log_softmax(sum(np.exp(a) * one for a, one in zip(x, log_odds, strict=True)), axis=1)
        return mixed

    def cost(x: np.ndarray) -> float:
        return float((x**2).sum() / 2 - powered(x)[helping, labels[helping]].sum())

    return np.exp(powered(minimize(cost, np.zeros(len(log_odds))).x))
