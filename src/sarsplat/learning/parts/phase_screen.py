"""Phase screens: what atmosphere and unknown baselines add to the phases of each measured pass."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.learning.parts.part import Learned, Parameters, Part, Shot, normal_nats
from sarsplat.settings.config import Config

_TRIED = 512
"""Heights at which the mean scatterer of a stack is looked for."""


class PhaseScreen(Part):
    """A phase of each pass of each training image: constant, and slopes along azimuth and range.

    All passes together do not show what grows with their baselines, which heights explain as well. Unseen images have
    none.
    """

    order = 50

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.passes is not None and config.passes.screen_std > 0

    @property
    def learned(self) -> dict[str, Learned]:
        stacks = self.frame.stacks
        return {"phase_screen": Learned((len(stacks), 3 * len(stacks[0])), (self.config.rates.nuisance,))}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        """Constants: what the mean scatterer of each stack, at whatever height, leaves of its phases."""
        assert train.signal is not None  # of stacks
        start = torch.zeros(len(train), train.passes, 3, device="cpu")
        pairs = zip(train.signal, train.views, train.stacks, strict=True)
        for index, (signal, view, stack) in enumerate(pairs):
            start[index, :, 0] = torch.from_numpy(_left_over(signal, view, stack, train.grid))
        return {"phase_screen": start.flatten(1)}

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        """Prior: phases are small."""
        assert self.config.passes is not None  # `wanted`
        yield normal_nats(p["phase_screen"], self.config.passes.screen_std)

    def phases(self, shot: Shot, p: Parameters) -> Float[Tensor, "v p h w"] | None:
        if shot.numbers is None:
            return None
        constant, along, away = p["phase_screen"][shot.numbers].unflatten(1, (-1, 3)).unbind(-1)
        down, across = (torch.linspace(-1, 1, size).to(constant) for size in (shot.grid.rows, shot.grid.columns))
        return constant[..., None, None] + along[..., None, None] * across + away[..., None, None] * down[:, None]


def _left_over(
    signal: Complex64[np.ndarray, "p rows columns"], view: View, stack: Stack, grid: ImageGrid
) -> Float32[np.ndarray, " p"]:
    """Phases of the strongest component of all pixels, but for those of the height that explains them best, rad."""
    level = (signal * np.exp(-1j * stack.plane_phases(view, grid))).reshape(len(stack), -1).astype(np.complex128)
    _, vectors = np.linalg.eigh(level @ level.conj().T)
    phases = np.angle(vectors[:, -1])
    numbers = stack.elevation_numbers(view)
    least = np.ptp(numbers) / max(len(stack) - 1, 1)
    heights = np.linspace(-np.pi, np.pi, _TRIED) / least if least else np.zeros(1)
    agreement = np.exp(1j * (phases - heights[:, None] * numbers)).sum(1)
    best = int(np.abs(agreement).argmax())
    left = np.angle(np.exp(1j * (phases - heights[best] * numbers - np.angle(agreement[best]))))
    return left.astype(np.float32)
