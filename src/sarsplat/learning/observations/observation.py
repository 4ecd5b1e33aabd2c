"""Interface of an observation, which renders training images from the model and compares the two."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import RayGrid
from sarsplat.learning.losses import Loss
from sarsplat.learning.method import Inputs
from sarsplat.learning.model import SceneModel
from sarsplat.learning.training_images import TrainingImages
from sarsplat.renderer import Bounds, Rendering
from sarsplat.settings.config import Config


@dataclass(frozen=True)
class Batch:
    """Images of a step, and options of their rendering."""

    chosen: Sequence[int] | Int64[Tensor, " v"]
    """Numbers of the training images; a tensor in CUDA graphs."""
    degree: int
    """Degree of the harmonics in use."""
    rays: RayGrid
    bounds: Bounds
    dropped: Bool[Tensor, " n"] | None = None
    """Mask of the Gaussians that are left out."""
    plane_gradients: bool = False
    """True if the rendering gets plane gradients, for strategies."""


class Observation(ABC):
    """Base of the observations, classes in the files of this folder: training images of a dataset, on a device."""

    order: ClassVar[int]
    """Rank: a training begins with the smallest among the observations of its configuration."""

    switch: ClassVar[str] = ""
    """Setting that selects it, and the value that does not, for errors: `passes off`."""

    goes_with: ClassVar[Mapping[str, object]] = {}
    """Settings that must have this value with it; None is off."""

    takes_strategies: ClassVar[bool] = True
    """True if it can be combined with custom strategies."""

    recordable: ClassVar[bool] = False
    """True if `compared` accepts `Batch.chosen` as a tensor, for CUDA graphs."""

    images: TrainingImages
    """Training images at full resolution."""

    def __init__(self, dataset: Dataset, config: Config, device: torch.device) -> None:
        self.dataset, self.config, self.device = dataset, config, device

    @classmethod
    @abstractmethod
    def wanted(cls, config: Config) -> bool:
        """Return True if a configuration learns from this observation."""

    @classmethod
    def refuse(cls, config: Config, dataset: Dataset, inputs: Inputs) -> None:
        """Raise if settings, inputs or dataset do not fit this observation."""
        found = [("custom strategies are given", "omit them")] if inputs.strategies and not cls.takes_strategies else []
        for name, value in cls.goes_with.items():
            if (asked := getattr(config, name)) != value:
                state, remedy = ("on", "off") if value is None else (shown(asked), shown(value))
                found.append((f"{name} is {state}", f"give {remedy}"))
        for conflict, remedy in found:
            setting, off = cls.switch.split()
            asked = "on" if off == "off" else getattr(config, setting)
            raise SarsplatError(
                f"{conflict}, which cannot be combined with {setting} {asked}; {remedy}, or give {cls.switch}"
            )

    def first_model(self, generator: torch.Generator) -> SceneModel:
        """Return the model before the first step."""
        return SceneModel.initial(self.config, self.dataset, generator, self.device)

    def begin(self, model: SceneModel) -> None:
        """Prepare a model for its first step, also after it was restored."""
        return

    @abstractmethod
    def minimise(self, loss: Loss | None, model: SceneModel) -> Tensor:
        """Set the loss, the configuration's unless given; return the unit of penalties."""

    @abstractmethod
    def compared(self, model: SceneModel, images: TrainingImages, batch: Batch) -> tuple[Tensor, Rendering]:
        """Return the loss of a batch of `images`, which may be multilooked, and the rendering."""
