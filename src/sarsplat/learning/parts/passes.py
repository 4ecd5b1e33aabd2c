"""Nuisances of the passes of stacks: noise, known or learned, and phase screens."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.learning.parts.part import Learned, Parameters, Part, Shot, normal_nats
from sarsplat.settings.config import Config

_HEIGHTS = 512  # number of heights tried for the mean scatterer of a stack


class PassNoise(Part):
    """Noise power of each pass; its logarithm is learned unless the stacks state it."""

    order = 60
    section = "passes"

    @property
    def learned(self) -> dict[str, Learned]:
        if self._known is not None:
            return {}
        shape = len(self.frame.stacks), len(self.frame.stacks[0])
        return {"pass_noise": Learned(shape, (self.config.rates.nuisance,), start=math.log(self.settings.noise))}

    def of_passes(self, p: Parameters) -> Float[Tensor, "v passes"]:
        """Noise power of the passes of each training image, in the model's unit."""
        return p["pass_noise"].exp() if self._known is None else self._known

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        """Add the mean noise of all passes."""
        return images + self.of_passes(p).mean(1).mean(0)

    def noise(self, shot: Shot, p: Parameters) -> Float[Tensor, "v p"]:
        """Noise power; for unseen images the mean over all passes, as in `images`."""
        noise = self.of_passes(p)
        return noise.mean().expand(1, 1) if shot.numbers is None else noise[shot.numbers]

    @property
    def _known(self) -> Float[Tensor, "v passes"] | None:
        noise = [stack.noise for stack in self.frame.stacks]
        if None in noise:
            return None
        return torch.tensor(noise, dtype=torch.float64).div(self.frame.unit).float().to(self.device)


class PhaseScreen(Part):
    """Phases of each pass from atmosphere and unknown baselines: a constant, and slopes over the image.

    Phases in proportion to the baselines are not determined: heights explain them as well. Unseen images have none.
    """

    order = 50
    section = "passes"

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.passes is not None and config.passes.screen_std > 0

    @property
    def learned(self) -> dict[str, Learned]:
        stacks = self.frame.stacks
        return {"phase_screen": Learned((len(stacks), 3 * len(stacks[0])), (self.config.rates.nuisance,))}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        """Initial constants: residual phases of each stack after fitting one scatterer at its best height."""
        assert train.signal is not None  # of stacks
        start = torch.zeros(len(train), train.passes, 3, dtype=torch.float32, device="cpu")
        pairs = zip(train.signal, train.views, train.stacks, strict=True)
        for index, (signal, view, stack) in enumerate(pairs):
            start[index, :, 0] = torch.from_numpy(_residual_phases(signal, view, stack, train.grid))
        return {"phase_screen": start.flatten(1)}

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        yield normal_nats(p["phase_screen"], self.settings.screen_std)

    def phases(self, shot: Shot, p: Parameters) -> Float[Tensor, "v p h w"] | None:
        if shot.numbers is None:
            return None
        constant, along, away = p["phase_screen"][shot.numbers].unflatten(1, (-1, 3)).unbind(-1)
        down, across = (
            torch.linspace(-1, 1, size, dtype=torch.float32).to(constant)
            for size in (shot.grid.rows, shot.grid.columns)
        )
        return constant[..., None, None] + along[..., None, None] * across + away[..., None, None] * down[:, None]


def _residual_phases(
    signal: Complex64[np.ndarray, "p rows columns"], view: View, stack: Stack, grid: ImageGrid
) -> Float32[np.ndarray, " p"]:
    """Phases of the strongest component of all pixels, minus those of the height that fits them best, rad."""
    level = (signal * np.exp(-1j * stack.plane_phases(view, grid))).reshape(len(stack), -1).astype(np.complex128)
    _, vectors = np.linalg.eigh(level @ level.conj().T)
    phases = np.angle(vectors[:, -1])
    numbers = stack.elevation_numbers(view)
    step = np.ptp(numbers) / max(len(stack) - 1, 1)  # mean, rad/m: evenly spaced passes repeat every 2π / step
    heights = np.linspace(-np.pi, np.pi, _HEIGHTS) / step if step else np.zeros(1)
    agreement = np.exp(1j * (phases - heights[:, None] * numbers)).sum(1)
    best = int(np.abs(agreement).argmax())
    residual = np.angle(np.exp(1j * (phases - heights[best] * numbers - np.angle(agreement[best]))))
    return residual.astype(np.float32)
