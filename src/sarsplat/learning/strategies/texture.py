"""Texture estimation: at intervals, ratios of measured to rendered power become maps on the ground."""

import numpy as np
import torch

from sarsplat.data import Dataset
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.parts.texture import Maps, Texture
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State, at_round
from sarsplat.settings.config import Config


class TextureEstimation(Configured):
    """Estimates the model's `Texture` at even intervals from `texture_from` to the end."""

    order = 40
    name = "texture"
    section = "surroundings"

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return Texture.wanted(config)

    def due(self, step: int) -> bool:
        iterations = self.config.iterations
        return at_round(step, self.settings.texture_from * iterations, iterations, self.settings.texture_rounds)

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
                part.maps = Maps.estimated(ratio, shift, images.views, images.grid, self.settings)
