"""A strategy of your own: every so often, only the brightest Gaussians are kept."""

from dataclasses import replace

import torch
from torch import Tensor

from sarsplat import Dataset, ImageGrid, SarImage, View, preset, reconstruct, simulate_images, target_mesh
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies import Info, State, Strategy, ops


class KeepBrightest(Strategy):
    """Its state is saved with the training, and restored when it is resumed."""

    def __init__(self, every: int, count: int) -> None:
        self.every, self.count = every, count

    def initial_state(self, params: dict[str, Tensor]) -> State:
        """Mean cross-section of each Gaussian, m²: a row for each, which follows when others move rows."""
        return State(rows={"sigma": torch.zeros(len(params["means"]))})

    def step_post_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        """Sum up, and now and then remove all but the brightest."""
        state.rows["sigma"] += info.rendering.cross_sections[..., 0].mean(0)
        if step % self.every == 0 and len(state.rows["sigma"]) > self.count:
            brightest = state.rows["sigma"].topk(self.count).indices
            ops.remove(params, optimizers, state, torch.ones_like(state.rows["sigma"]).index_fill(0, brightest, 0) > 0)


if __name__ == "__main__":
    grid = ImageGrid(rows=64, columns=64, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
    views = [View(azimuth, 45.0) for azimuth in range(0, 360, 45)]
    arrays = simulate_images(target_mesh("t72"), views, grid)
    dataset = Dataset.from_images([SarImage(power, view, grid) for power, view in zip(arrays, views)])
    settings = replace(preset("quick"), iterations=120, gaussians=1500)
    run = reconstruct(dataset, settings, strategies=[KeepBrightest(50, 1000)])  # or the folder of a dataset
    print(run.learned)
