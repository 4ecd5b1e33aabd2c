"""Restriction of stacks of one direction to elevations, which phases determine, in the first steps."""

from typing import Self

import numpy as np
import torch

from sarsplat.data import Dataset
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State
from sarsplat.regions.stack_region import of_one_direction
from sarsplat.settings.config import Config


class ElevationOnly(Configured):
    """Restricts the movement of centres to one axis, up to step `until`."""

    order = 5
    name = "elevation"

    def __init__(self, axis: np.ndarray, until: int) -> None:
        self._axis, self._until = torch.from_numpy(axis).float(), until

    @classmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        if config.passes is None or not of_one_direction(train.views):
            return None
        return cls(train.views[0].look.frame[1], round(config.passes.elevation_only * config.iterations))

    def step_pre_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        if step <= self._until:
            self._before = params["means"].detach().clone()

    def step_post_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        if step > self._until:
            return
        with torch.no_grad():
            means, axis = params["means"], self._axis.to(self._before.device)
            means.copy_(self._before + ((means - self._before) @ axis)[:, None] * axis)
        optimizers.constrain()
