"""Observation of stacks: covariances between passes, or polarisations."""

from typing import ClassVar

import torch
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Polarimetric
from sarsplat.learning.losses import Loss
from sarsplat.learning.method import Inputs
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations.observation import Batch, Observation
from sarsplat.learning.stack_loss import packed, windowed, windowed_nats
from sarsplat.learning.training_images import TrainingImages
from sarsplat.memory import required
from sarsplat.renderer import Rendering
from sarsplat.settings.config import Config
from sarsplat.settings.sections import Passes

_AVERAGING, _STEP = 11, 4
"""Memory in numbers per pixel and pair of channels: while one stack is averaged, and for each stack of a step."""

_MIN_NOISE = 1e-6  # minimum noise, relative to the mean power, with which covariances can be inverted in float32


class StackImages(TrainingImages):
    """Training stacks of a dataset on a device.

    Of each image: `stacks`; `plane_phases` [P, rows, columns], phases of level ground, rad, by which stacks are
    deramped; `measured` [P², rows, columns], covariances y_i y_j*, deramped and averaged around each pixel, `packed`,
    linear power.
    """

    def __init__(self, dataset: Dataset, window: int, together: int, device: torch.device) -> None:
        super().__init__(dataset, device)
        train = dataset.select("train")
        assert train.signal is not None  # of stacks
        self.stacks = train.stacks
        pairs, channels = train.passes**2, train.passes
        numbers = len(train) * (pairs + channels) + (_AVERAGING + _STEP * min(together, len(train))) * pairs
        needed = 4.0 * numbers * self.grid.rows * self.grid.columns
        required("learning from these stacks", needed, "give smaller images, fewer of them or fewer passes")
        self.plane_phases, self.measured = list[Tensor](), list[Tensor]()
        for signal, stack, view in zip(train.signal, self.stacks, self.views, strict=True):  # to save memory
            level, y = (torch.from_numpy(one).to(device) for one in (stack.plane_phases(view, self.grid), signal))
            self.plane_phases.append(level.float())
            self.measured.append(packed(windowed((y[:, None] * y.conj())[None], level.float()[None], window))[0])


class Stacks(Observation):
    """Covariances between the channels of stacks, compared by their likelihood."""

    order = 1
    switch = "passes off"
    goes_with: ClassVar = {
        "loss": "passes",
        "coarsest": 1,
        "tiles": 1,
        "ground": None,
        "surroundings": None,
        "densification": None,
        "ssim_weight": 0.0,
        "total_power": 0.0,
    }

    images: StackImages

    def __init__(self, dataset: Dataset, config: Config, device: torch.device) -> None:
        super().__init__(dataset, config, device)
        self.images = StackImages(dataset, self._settings.window, config.views_per_step, device)

    @property
    def _settings(self) -> Passes:
        assert self.config.passes is not None  # `wanted`
        return self.config.passes

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.passes is not None

    @classmethod
    def refuse(cls, config: Config, dataset: Dataset, inputs: Inputs) -> None:
        if not (dataset.interferometric or dataset.polarimetric):
            has = "stacks of one offset and one polarisation" if dataset.passes else "single images"
            raise SarsplatError(
                f"passes is on (preset {config.preset}), which learns from stacks, but {dataset} has {has}; give "
                "passes off, or choose another preset"
            )
        if dataset.polarimetric and config.scattering != Polarimetric.kind:
            raise SarsplatError(
                f"scattering is {config.scattering}, which is equal in all polarisations, but {dataset} has "
                f"{', '.join(dict.fromkeys(dataset.stacks[0].of_channels))}; choose {Polarimetric.kind}"
            )
        _refuse_stacks(config, dataset.select("train"), dataset)
        super().refuse(config, dataset, inputs)

    def minimise(self, loss: Loss | None, model: SceneModel) -> Tensor:
        """Set nothing, as the loss is the likelihood; penalties are in nats per channel."""
        return self.images.truth.new_tensor(float(len(self.images.stacks[0])))

    def compared(self, model: SceneModel, images: TrainingImages, batch: Batch) -> tuple[Tensor, Rendering]:
        if batch.plane_gradients:
            raise SarsplatError(
                "a strategy asks for plane gradients, which cannot be combined with passes on; omit it, or give passes "
                "off"
            )
        own, chosen = self.images, batch.chosen
        expected, rendering = model.covariances(
            [images.views[i] for i in chosen],
            [own.stacks[i] for i in chosen],
            own.grid,
            batch.degree,
            rays=batch.rays,
            numbers=torch.stack([own.numbers[i] for i in chosen]),
            dropped=batch.dropped,
        )
        level, measured = (torch.stack([tensors[i] for i in chosen]) for tensors in (own.plane_phases, own.measured))
        return windowed_nats(expected, level, measured / model.unit, self._settings.window), rendering


def _refuse_stacks(config: Config, train: Dataset, dataset: Dataset) -> None:
    """Raise if training stacks do not fit each other or the settings."""
    grid, first = train.grid, train.entries[0]
    assert config.passes is not None and first.stack is not None  # implied by `wanted`
    if first.view.aloft:
        raise SarsplatError(
            f"{dataset} has stacks of a target aloft, whose heights phases do not bound; choose a preset that learns "
            "from power"
        )
    for entry in train.entries:
        if entry.stack is not None and entry.stack.of_channels != first.stack.of_channels:
            own, other = (", ".join(stack.of_channels) for stack in (first.stack, entry.stack))
            raise SarsplatError(
                f"{first.name} has the polarisations {own} and {entry.name} has {other}; give all views of "
                f"{dataset} the same, in the same order"
            )
    if config.passes.window > max(grid.rows, grid.columns):
        raise SarsplatError(
            f"passes.window is {config.passes.window}, more than the {grid.rows} × {grid.columns} pixels of the "
            "images; give a smaller one, such as 3"
        )
    mean = float(train.power.mean(dtype="float64"))
    for entry in train.entries:
        if entry.stack is not None and entry.stack.noise and (least := min(entry.stack.noise)) < _MIN_NOISE * mean:
            raise SarsplatError(
                f"{entry.name} states noise of {least:.3g} where the mean power is {mean:.3g}, too little for 32-bit "
                f"numbers; state at least {_MIN_NOISE * mean:.2g}, or none, so that it is learned"
            )
