"""Restriction of stacks of one direction to elevations, which phases determine, in the first steps."""

import torch

from sarsplat.data import Dataset
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State
from sarsplat.regions.stack_region import of_one_direction
from sarsplat.settings.config import Config


class ElevationOnly(Configured):
    """Restricts the movement of centres to one axis, up to a share `elevation_only` of the steps."""

    order = 5
    name = "elevation"
    section = "passes"

    def __init__(self, config: Config, train: Dataset) -> None:
        super().__init__(config, train)
        self._axis = torch.from_numpy(train.views[0].look.frame[1]).float()
        self._until = round(self.settings.elevation_only * config.iterations)

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return config.passes is not None and of_one_direction(train.views)

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
