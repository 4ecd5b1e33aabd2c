"""What networks are trained on: measured chips, and others that were made of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from chip_draws import SIDE, Draw, Measured, datasets, middle, runs
from scipy.ndimage import map_coordinates

from sarsplat import Dataset, Run, View, chips
from sarsplat.evaluation.baselines import rotated_average
from sarsplat.samples import Encoding
from sarsplat.scenes.scattering import ResponseSpeckle
from sarsplat.settings.config import DEFAULT_METHOD

EACH = 720
"""Generated chips of a class."""

SAR_NERF = "sar-nerf-grid"
AVERAGE, TURNED = "rotated average", "turned"
OURS, OURS_AT_17, OURS_SPECKLE = "sarsplat", "sarsplat 17", "sarsplat speckle"

OPTIONS: dict[str, dict[str, Any]] = {
    OURS: {"grazing_deg": (14.5, 17.5)},
    OURS_AT_17: {"grazing_deg": (16.5, 17.5)},
    OURS_SPECKLE: {"grazing_deg": (14.5, 17.5), "scatterers": math.inf},
}
"""Of `sarsplat.chips`: grazing angles with the tests' 15° among them, or around the training's alone."""

METHOD_OF = dict.fromkeys(OPTIONS, DEFAULT_METHOD) | {SAR_NERF: SAR_NERF}
"""Method by whose reconstructions chips of a kind are generated."""

ENCODING = Encoding(near="top")
_GOLDEN = (5**0.5 - 1) / 2
_DARK = 1e-6  # of the brightest pixel: a logarithm is taken


@dataclass(frozen=True)
class Arm:
    """A way to train a network: shares of a batch."""

    title: str
    measured: float = 1.0
    others: Mapping[str, float] = field(default_factory=dict)
    """By the kind of chips."""

    @property
    def methods(self) -> tuple[str, ...]:
        """By which classes must have been reconstructed."""
        return tuple(dict.fromkeys(METHOD_OF[kind] for kind in self.others if kind in METHOD_OF))


def pool(kind: str, draw: Draw, measured: Measured, work: Path) -> np.ndarray:
    """Chips of one kind, EACH of a class in the order of the classes, uint8 [n, SIDE, SIDE]; made once."""
    path = work / draw.name.replace(" ", "-") / f"{kind.replace(' ', '-')}.npy"
    if not path.exists():
        train = [dataset.select("train") for dataset in datasets(measured, draw, work)]
        made = made_of(kind, train, runs(measured, draw, work, METHOD_OF[kind]) if kind in METHOD_OF else ())
        unfinished = path.with_suffix(".tmp.npy")
        np.save(unfinished, made)
        unfinished.replace(path)
    return np.load(path)


def made_of(kind: str, train: Sequence[Dataset], runs: Sequence[Run]) -> np.ndarray:
    """Chips of one kind, EACH of a class, of the training chips of each class, or of its reconstruction."""
    own = runs if kind in METHOD_OF else [None] * len(train)
    return np.concatenate([of_class(kind, *one) for one in zip(range(len(train)), train, own, strict=True)])


def of_class(kind: str, number: int, train: Dataset, run: Run | None) -> np.ndarray:
    """Chips of one kind and class."""
    if run is not None and kind in OPTIONS:
        made = chips([run], count=EACH, crop=SIDE, near="top", **OPTIONS[kind])
        return np.stack([made[index][0][0].numpy() for index in range(EACH)])
    chance = np.random.default_rng(number)
    if kind == TURNED:
        powers = (turned(train, chance) for _ in range(EACH))
        return np.stack([_stored(np.sqrt(power)) for power in powers])
    azimuths = [360 * ((number / 10 + k * _GOLDEN) % 1) for k in range(EACH)]
    views = [View(azimuth % 360, train.views[0].grazing_deg) for azimuth in azimuths]
    expected = expectation(train, run)
    speckle = ResponseSpeckle(train.grid)
    return np.stack([_stored(np.sqrt(_displaced(expected(view), chance)) * speckle.draw(chance)) for view in views])


def expectation(train: Dataset, run: Run | None) -> Callable[[View], np.ndarray]:
    """Expected power of a view: of a reconstruction, or without a third dimension."""
    if run is not None:
        return lambda view: run.render([view])[0].astype(np.float64)
    level = np.median(train.power, axis=(1, 2), keepdims=True)  # each chip has a scale of its own
    power = (train.power / level).astype(np.float64)
    return lambda view: rotated_average(power, train.views, [view], train.grid)[0]


def turned(train: Dataset, chance: np.random.Generator) -> np.ndarray:
    """A measured chip's power, turned in the ground plane by up to half of the mean gap to the next one."""
    number = chance.integers(len(train))
    turn = np.radians(180 / len(train) * chance.uniform(-1, 1))
    slant, across = np.meshgrid(train.grid.range_m, train.grid.azimuth_m, indexing="ij")
    ground = slant / np.cos(np.radians(train.views[number].grazing_deg))
    to_slant = np.cos(np.radians(train.views[number].grazing_deg)) * (np.cos(turn) * ground - np.sin(turn) * across)
    to_across = np.cos(turn) * across + np.sin(turn) * ground
    rows = (to_slant - train.grid.range_m[0]) / train.grid.spacing_m[1]
    columns = (to_across - train.grid.azimuth_m[0]) / train.grid.spacing_m[0]
    power: np.ndarray = map_coordinates(
        train.power[number].astype(np.float64), [rows, columns], order=1, mode="reflect"
    )
    return power


def _displaced(power: np.ndarray, chance: np.random.Generator) -> np.ndarray:
    """By parts of a pixel."""
    down, right = chance.uniform(-0.5, 0.5, 2)
    rows, columns = (np.fft.fftfreq(side) for side in power.shape)
    phase = np.exp(-2j * np.pi * (rows[:, None] * down + columns * right))
    moved: np.ndarray = np.fft.ifft2(np.fft.fft2(np.log(np.maximum(power, _DARK * power.max()))) * phase).real
    return np.exp(moved)


def _stored(sample: np.ndarray) -> np.ndarray:
    return ENCODING.stored(middle(sample).astype(np.complex64), 1.0)
