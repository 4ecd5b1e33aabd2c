"""Interface of a part of the model: its parameters, and its effect on scene, imaging conditions and images."""

from abc import ABC
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.gaussians import Ground
from sarsplat.geometry import ImageGrid, View
from sarsplat.learning.scene_frame import SceneFrame
from sarsplat.renderer.echoes import Echo
from sarsplat.settings.config import Config

Parameters = dict[str, Tensor]
"""Every parameter of a model by name: leaves, float32, contiguous and on one device."""


def late(done: float, begin: float = 0.0) -> float:
    """Decay of most learning rates at a share of the training: 0 before `begin`, tenfold over the second half."""
    return 0.1 ** max(0.0, 2 * done - 1) if done >= begin else 0.0


@dataclass(frozen=True)
class Learned:
    """Shape, learning rates and range of a parameter."""

    shape: tuple[int | None, ...]
    """Shape; None is the number of Gaussians: the parameter has a row for each, which comes and goes with it."""
    rates: tuple[float, ...]
    """Initial learning rate, one or one for each column; 0 freezes."""
    decay: Callable[[float], float] = late
    """Function from the share of the training done to a factor on the rates."""
    low: Tensor | float = -torch.inf
    """Range to which values are clamped after each step: one number, or one for each column."""
    high: Tensor | float = torch.inf
    logarithmic: bool = False
    """True if steps change its logarithm: it is positive."""
    start: float = 0.0
    """Initial value, unless the part computes it (`Part.initial`)."""

    @property
    def per_gaussian(self) -> bool:
        """True if it has a row for each Gaussian."""
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
    """Numbers of the training images; None for unseen ones, whose expectation over shifts and gains is rendered."""
    rng: np.random.Generator | None = None
    """Generator that draws shift and gain of unseen images, instead of their expectation."""
    shift: Float[Tensor, "v 2"] | None = None
    """Displacement (azimuth, range) of each image, m."""
    gain: Float[Tensor, " v"] | None = None
    """Random gain of each image's power."""
    additive: Float[Tensor, ""] | None = None
    """Factor on the additive power of unseen images."""


class Part(ABC):
    """Base of the parts, classes in the files of this folder, which override the methods they need."""

    order: ClassVar[int]
    """Rank: parts act in ascending order."""

    section: ClassVar[str] = ""
    """Field of `Config` with its settings, None in a model without this part; empty: every model has it."""

    name: ClassVar[str] = ""
    """Name of its state in snapshots; empty without state."""

    surrounds: ClassVar[bool] = False
    """True if it belongs to the surroundings, not to the target."""

    estimated: ClassVar[bool] = False
    """True if it is estimated from the images' residuals instead of learned."""

    def __init__(self, config: Config, frame: SceneFrame, device: torch.device) -> None:
        self.config, self.frame, self.device = config, frame, device
        self.settings: Any = getattr(config, self.section, None)

    @classmethod
    def wanted(cls, config: Config) -> bool:
        """Return True if a configuration's model has this part."""
        return not cls.section or getattr(config, cls.section) is not None

    # ---- parameters -------------------------------------------------------------------------------------------------
    @property
    def learned(self) -> dict[str, Learned]:
        """Parameters by name; names are unique among parts."""
        return {}

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        """Initial parameters, float32 on the CPU, as is `generator`: a seed is the same on every device."""
        return {
            name: torch.full([size or 0 for size in how.shape], how.start, dtype=torch.float32, device="cpu")
            for name, how in self.learned.items()
        }

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        """Negative log priors of its parameters, nats."""
        return iter(())

    def penalties(self, p: Parameters) -> Iterator[tuple[str, Float[Tensor, ""]]]:
        """Penalties by name, in units of the loss of black images, or in nats per pixel."""
        return iter(())

    def look_at(self, cell_m: float) -> None:
        """Set the resolution cell of the images to fit, m; at first it is the dataset's."""
        return

    # ---- effects ----------------------------------------------------------------------------------------------------
    def ground(self, p: Parameters) -> Ground | None:
        """Plane or terrain on which rays end, γ⁰ in the model's unit; None from other parts."""
        return None

    def echoes(self, p: Parameters) -> tuple[Echo, ...]:
        """Echoes besides the direct one and the ground's."""
        return ()

    def shot(self, shot: Shot, p: Parameters) -> Shot:
        """Set this part's imaging conditions (shift, gain, grid)."""
        return shot

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        """Apply this part to images [V, C, rows, columns] in the model's unit."""
        return images

    def noise(self, shot: Shot, p: Parameters) -> Float[Tensor, "v p"] | None:
        """Noise power of each channel of stacks, in the model's unit; None from other parts."""
        return None

    def phases(self, shot: Shot, p: Parameters) -> Float[Tensor, "v p h w"] | None:
        """Phases added to each channel of stacks, rad; None from other parts."""
        return None

    def displaced(self, grid: ImageGrid, p: Parameters) -> ImageGrid:
        """Grid on which an undisplaced scene appears where unseen images on `grid` show it."""
        return grid

    # ---- state ------------------------------------------------------------------------------------------------------
    def state(self) -> Parameters:
        """State besides the parameters, to be saved."""
        return {}

    def load(self, state: Parameters) -> None:
        """Restore `state`; raise ValueError or KeyError if it does not fit this model."""
        return


def drawn_like(values: Float[Tensor, "n ..."], count: int, rng: np.random.Generator) -> Float[Tensor, "{count} ..."]:
    """Draw values for unseen images, normal with the mean and standard deviation of the learned ones."""
    mean, std = values.detach().mean(0), values.detach().std(0, correction=0)
    normal = torch.from_numpy(rng.standard_normal((count, *values.shape[1:]), np.float32))
    return mean + std * normal.to(values.device)


def normal_nats(values: Float[Tensor, "n ..."], std: float) -> Float[Tensor, ""]:
    """Negative log prior of values, normal around zero with standard deviation `std`, nats."""
    deviations = values.reshape(len(values), -1) / std
    return len(deviations) * column_means(deviations**2).sum() / 2


def column_means(table: Float[Tensor, "n k"]) -> Float[Tensor, " k"]:
    """Mean of each column, always of two or more: the bits of a single sum would depend on torch's threads."""
    columns = table.shape[1]
    return table.expand(-1, max(columns, 2)).mean(0)[:columns]


def exact_scale(values: Float[Tensor, "n k"]) -> Float64[Tensor, ""]:
    """Power of two by which values become whole numbers of 64 bits; the sum of 2²⁷ of these has no rounding."""
    return torch.exp2(36 - values.abs().max().double().clamp(min=torch.finfo(values.dtype).tiny).log2().ceil())
