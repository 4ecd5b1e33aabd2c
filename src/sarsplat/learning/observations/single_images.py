"""Observation of the power of single images."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float32
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Polarimetric
from sarsplat.learning.batching import compared_in_groups, in_groups
from sarsplat.learning.losses import LOSSES, ImageScale, Loss, named_loss
from sarsplat.learning.method import Inputs
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations.observation import Batch, Observation
from sarsplat.learning.training_images import TrainingImages
from sarsplat.renderer import Rendering, channel_of
from sarsplat.settings.config import Config


class SingleImages(Observation):
    """β⁰ of each training image, compared by the configuration's loss or a custom one."""

    order = 2
    recordable = True

    def __init__(self, dataset: Dataset, config: Config, device: torch.device) -> None:
        super().__init__(dataset, config, device)
        self.images = TrainingImages(dataset, device)

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return True

    @classmethod
    def refuse(cls, config: Config, dataset: Dataset, inputs: Inputs) -> None:
        if config.scattering == Polarimetric.kind and not (config.passes and dataset.polarimetric):
            lacks = "passes is off" if dataset.polarimetric else f"{dataset} has one"
            raise SarsplatError(
                f"scattering is {config.scattering}, which needs passes on and several polarisations, but {lacks}; "
                f"choose harmonics{', or passes on' if dataset.polarimetric else ''}"
            )
        if config.bounce is not None and dataset.terrain is not None:
            raise SarsplatError(f"bounce is on, which needs level ground, but {dataset} has terrain; give bounce off")
        super().refuse(config, dataset, inputs)

    def minimise(self, loss: Loss | None, model: SceneModel) -> Tensor:
        self._mean_over_views = loss is None  # true of all named losses
        self._loss = loss or named_loss(self.config, ImageScale(self.images.brightest, model.unit))
        if loss is None and LOSSES[self.config.loss].unit.startswith("nats"):  # penalties are in nats, too
            return torch.ones((), dtype=torch.float32, device=self.device)
        return _of_black(self._loss, self.images.truth[: self.config.views_per_step])

    def compared(self, model: SceneModel, images: TrainingImages, batch: Batch) -> tuple[Tensor, Rendering]:
        chosen = batch.chosen
        if isinstance(chosen, Tensor) or not self._mean_over_views:
            return self._compared(model, images, batch)
        groups = in_groups(len(chosen), len(chosen), model.parameters, images.grid, batch.rays, model.scenes_rendered)
        return compared_in_groups(
            lambda group: self._compared(model, images, replace(batch, chosen=chosen[group])),
            groups,
            [*model.parameters.values()],
        )

    def _compared(self, model: SceneModel, images: TrainingImages, batch: Batch) -> tuple[Tensor, Rendering]:
        numbers, truth = images.of(batch.chosen)
        rendered, rendering = model.render(
            images.views_of(batch.chosen),
            images.grid,
            batch.degree,
            rays=batch.rays,
            numbers=numbers,
            plane_gradients=batch.plane_gradients,
            bounds=batch.bounds,
            dropped=batch.dropped,
        )
        return self._loss(channel_of(rendered, model.power_channel), truth), rendering


@torch.no_grad()
def _of_black(loss: Loss, truth: Float32[Tensor, "v rows columns"]) -> Tensor:
    """Loss of black images, the unit of penalties; 1 if it is not finite and positive."""
    value = loss(torch.zeros_like(truth), truth.clone())  # a copy: custom losses may change it
    if not isinstance(value, Tensor) or value.is_complex():  # the first step raises
        return truth.new_ones(())
    return torch.where(value.isfinite() & (value > 0), value, 1.0)
