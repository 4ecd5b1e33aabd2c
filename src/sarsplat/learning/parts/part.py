"""A part of a model: what it learns, and what it does to the scene, to the way it is rendered and to the images."""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, View
from sarsplat.learning.scene_frame import SceneFrame
from sarsplat.renderer import Bounds
from sarsplat.renderer.echoes import Echo
from sarsplat.settings.config import Config

Parameters = dict[str, Tensor]
"""Every parameter of a model by name: leaves, float32, contiguous and on one device."""


def late(done: float) -> float:
    """Factor on most rates when this share of the training is done: it falls tenfold over the second half."""
    return 0.1 ** max(0.0, 2 * done - 1)


@dataclass(frozen=True)
class Learned:
    """How a parameter is learned."""

    shape: tuple[int | None, ...]
    """None is the number of Gaussians: the parameter has a row for each, and follows where Gaussians come and go."""
    rates: tuple[float, ...]
    """First learning rate: one, or one for each column. 0 for what keeps its value."""
    decay: Callable[[float], float] = late
    """From the share of the training that is done to a factor on the rates."""
    low: Tensor | float = -torch.inf
    """Range that it is brought back into after each step: one number, or one for each column."""
    high: Tensor | float = torch.inf
    logarithmic: bool = False
    """Whether its logarithm is stepped: it is positive and changes by factors."""

    @property
    def per_gaussian(self) -> bool:
        """Whether it has a row for each Gaussian."""
        return self.shape[0] is None


@dataclass(frozen=True)
class Shot:
    """Imaging conditions: views, grid, and shift and gain of each image."""

    views: Sequence[View]
    grid: ImageGrid
    """Pixels and response that the scene is rendered with."""
    power_channel: int
    """The channel of the images that is β⁰."""
    numbers: Int64[Tensor, " v"] | None
    """Which training images they are. None for unseen ones: of what belongs to single images (shift, gain), only the
    distribution is known, and their expectation is rendered, unless `rng` draws from it."""
    rng: np.random.Generator | None = None
    """Draws what belongs to single unseen images."""
    shift: Float[Tensor, "v 2"] | None = None
    """Displacement (azimuth, range) of each image, m."""
    gain: Float[Tensor, " v"] | None = None
    """Of each image's power, where it was drawn."""
    additive: Float[Tensor, ""] | None = None
    """Factor on power that is added to unseen images instead of being scattered."""


class Part(ABC):
    """Base of the parts; each does only what it has methods for.

    To add a part, put a file with a class derived from this one into this folder.
    """

    order: ClassVar[int]
    """Parts with a smaller one come before it: they make what it changes."""

    section: ClassVar[str] = ""
    """The field of `Config` with its settings, None where a model lacks this part. Without one, every model has it."""

    name: ClassVar[str] = ""
    """What its state is saved under; only for parts that have any."""

    surrounds: ClassVar[bool] = False
    """Whether its Gaussians are not the target's, but around it."""

    estimated: ClassVar[bool] = False
    """Whether it is what images show beyond all that is learned, and therefore estimated without it."""

    def __init__(self, config: Config, frame: SceneFrame, device: torch.device) -> None:
        self.config, self.frame, self.device = config, frame, device
        self.settings: Any = getattr(config, self.section, None)

    @classmethod
    def wanted(cls, config: Config) -> bool:
        """Whether a configuration's model has this part."""
        return not cls.section or getattr(config, cls.section) is not None

    # ---- what is learned --------------------------------------------------------------------------------------------
    @property
    def learned(self) -> dict[str, Learned]:
        """Its parameters by names that no other part uses."""
        return {}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        """Their first values, float32 on the CPU; `generator` is one of the CPU: a seed is the same on every device."""
        return {}

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        """Negative logarithms of the priors of its parameters: terms, nats."""
        return iter(())

    def penalties(self, p: Parameters) -> Iterator[tuple[str, Float[Tensor, ""]]]:
        """What else is minimised, by name, in units of the loss of black images, or in nats per pixel."""
        return iter(())

    def look_at(self, cell_m: float) -> None:
        """Set the resolution cell of the images that are fitted from now on, m; until then it is the dataset's."""
        return

    # ---- what it does -----------------------------------------------------------------------------------------------
    def scene(
        self, scene: Gaussians | None, p: Parameters, degree: int, dropped: Bool[Tensor, " n"] | None
    ) -> Gaussians | None:
        """Add this part to the scene: harmonics up to `degree`, without the target's Gaussians that are `dropped`."""
        return scene

    def ground(self, p: Parameters) -> Ground | None:
        """The plane or the terrain on which rays end, in the model's unit; None unless it is that."""
        return None

    def echoes(self, p: Parameters) -> tuple[Echo, ...]:
        """Returns besides the direct one and the ground's."""
        return ()

    def reach(self) -> Bounds | None:
        """Bounds that its Gaussians keep as long as parameters are within theirs; None if it has none."""
        return None

    def shot(self, shot: Shot, p: Parameters) -> Shot:
        """The imaging conditions with this part's share filled in (shift, gain, grid)."""
        return shot

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        """Apply this part to images [V, C, rows, columns] in the model's unit."""
        return images

    def noise(self, shot: Shot, p: Parameters) -> Float[Tensor, "v p"] | None:
        """Power of the noise of each channel of stacks, in the model's unit; None unless it is that."""
        return None

    def phases(self, shot: Shot, p: Parameters) -> Float[Tensor, "v p h w"] | None:
        """What is added to the phases of each channel of stacks, rad; None unless it is that."""
        return None

    def displaced(self, grid: ImageGrid, p: Parameters) -> ImageGrid:
        """The grid on which a scene that is not displaced lies as unseen images on `grid` show it."""
        return grid

    # ---- what else is saved -----------------------------------------------------------------------------------------
    def state(self) -> Parameters:
        """State besides the parameters, to be saved."""
        return {}

    def load(self, state: Parameters) -> None:
        """Undo `state`; raises ValueError or KeyError if that is not of this model."""
        return


def drawn_like(values: Float[Tensor, "n ..."], count: int, rng: np.random.Generator) -> Float[Tensor, "{count} ..."]:
    """Random values for unseen images, normal with the mean and standard deviation of the learned ones."""
    mean, std = values.detach().mean(0), values.detach().std(0, correction=0)
    normal = torch.from_numpy(rng.standard_normal((count, *values.shape[1:]), np.float32))
    return mean + std * normal.to(values.device)


def normal_nats(values: Float[Tensor, "n ..."], std: float) -> Float[Tensor, ""]:
    """Negative log prior of values that are normal around zero with this standard deviation, nats."""
    deviations = values.reshape(len(values), -1) / std
    return len(deviations) * column_means(deviations**2).sum() / 2


def column_means(table: Float[Tensor, "n k"]) -> Float[Tensor, " k"]:
    """The mean of each column; never of one alone, which torch would split by threads."""
    columns = table.shape[1]
    return table.expand(-1, max(columns, 2)).mean(0)[:columns]


def in_rows(row: Float[Tensor, "1 k"], count: int) -> Float[Tensor, "{count} k"]:
    """The same row so many times; as above, the sums of its gradient are those of several columns."""
    return row.repeat(1, 2).expand(count, -1)[:, : row.shape[1]]
