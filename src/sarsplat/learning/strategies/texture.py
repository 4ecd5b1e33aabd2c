"""Texture estimation: at intervals, ratios of measured to rendered power become maps on the ground."""

from typing import Self

import numpy as np
import torch

from sarsplat.data import Dataset
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.parts.texture import Maps, Texture
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State, at_round
from sarsplat.settings.config import Config
from sarsplat.settings.sections import Surroundings


class TextureEstimation(Configured):
    """Estimates the model's `Texture` at even intervals from `texture_from` to the end."""

    order = 40
    name = "texture"

    def __init__(self, settings: Surroundings, iterations: int) -> None:
        self._settings, self._iterations = settings, iterations

    @classmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        return cls(config.surroundings, config.iterations) if config.surroundings and Texture.wanted(config) else None

    def due(self, step: int) -> bool:
        first = self._settings.texture_from * self._iterations
        return at_round(step, first, self._iterations, self._settings.texture_rounds)

    @torch.no_grad()
    def act(self, params: Params, optimizers: Optimiser, state: State, info: Info) -> None:
        images = info.images
        if images.grid != info.model.frame.grid:  # only at full resolution
            return
        compared = info.compared(images.views, np.arange(len(images.views)))
        ratio = torch.cat([measured / rendered for measured, rendered in compared])
        shift = info.model.shot(images.views, images.grid, images.numbers).shift
        for part in info.model.parts:
            if isinstance(part, Texture) and shift is not None:
                part.maps = Maps.estimated(ratio, shift, images.views, images.grid, self._settings)
