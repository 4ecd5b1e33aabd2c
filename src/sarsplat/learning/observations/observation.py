"""What a training learns from: an observation renders it from the model and compares the two."""

from __future__ import annotations

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
    """What a step looks at, and how it is rendered."""

    chosen: Sequence[int] | Int64[Tensor, " v"]
    """Numbers of the training images; on the device where only that knows them."""
    degree: int
    """Of the harmonics in use."""
    rays: RayGrid
    bounds: Bounds
    """What the Gaussians keep."""
    dropped: Bool[Tensor, " n"] | None = None
    """Gaussians that are left out."""
    plane_gradients: bool = False
    """Whether the rendering gets the gradients in the planes, for strategies."""


class Observation(ABC):
    """Base of the observations: the training images of a dataset, on a device.

    To add one, put a file with a class derived from this one into this folder.

    Parameters
    ----------
    dataset : Dataset
        Its training images are learned from.
    config : Config
        How.
    device : torch.device
        Where the images are kept.
    """

    order: ClassVar[int]
    """A training begins with the one of the smallest order among those that its configuration wants."""

    switch: ClassVar[str] = ""
    """The setting that asks for it, and the value that does not, for errors: `passes off`."""

    goes_with: ClassVar[Mapping[str, object]] = {}
    """Settings that it can only be combined with at this value; None is off. All others suit every observation."""

    takes_strategies: ClassVar[bool] = True
    """Whether it can be combined with strategies of the user's own."""

    recordable: ClassVar[bool] = False
    """Whether `compared` takes a batch that the device chooses."""

    images: TrainingImages
    """At the finest level."""

    def __init__(self, dataset: Dataset, config: Config, device: torch.device) -> None:
        self.dataset, self.config, self.device = dataset, config, device

    @classmethod
    @abstractmethod
    def wanted(cls, config: Config) -> bool:
        """Whether a configuration learns from this."""

    @classmethod
    def refuse(cls, config: Config, dataset: Dataset, inputs: Inputs) -> None:
        """Refuse what it cannot be combined with, which would otherwise be left out in silence.

        Raises
        ------
        SarsplatError
            If the configuration or the inputs ask for it, or the dataset does not have what it learns from.
        """
        for name, value in cls.goes_with.items():
            if (asked := getattr(config, name)) != value:
                said, remedy = ("on", "off") if value is None else (shown(asked), shown(value))
                raise SarsplatError(
                    f"{name} is {said}, which cannot be combined with {_asked(config, cls.switch)}; give {remedy}, or "
                    f"{cls.switch}"
                )
        if inputs.strategies and not cls.takes_strategies:
            raise SarsplatError(
                f"strategies of one's own cannot be combined with {_asked(config, cls.switch)}; omit them, or give "
                f"{cls.switch}"
            )

    def first_model(self, generator: torch.Generator) -> SceneModel:
        """What is learned, as it is before the first step."""
        return SceneModel.initial(self.config, self.dataset, generator, self.device)

    def begin(self, model: SceneModel) -> None:
        """Before a model's first step, also after it was restored."""
        return

    @abstractmethod
    def minimise(self, loss: Loss | None, model: SceneModel) -> Tensor:
        """Compare by this loss, or the configuration's; returns the unit of what else is minimised."""

    @abstractmethod
    def compared(self, model: SceneModel, images: TrainingImages, batch: Batch) -> tuple[Tensor, Rendering]:
        """The loss of some of the images, which may be coarser than at the finest level, and what was rendered."""


def _asked(config: Config, switch: str) -> str:
    """What a setting is: `passes on`, `tiles 2`."""
    name, off = switch.split()
    return f"{name} on" if off == "off" else f"{name} {getattr(config, name)}"
