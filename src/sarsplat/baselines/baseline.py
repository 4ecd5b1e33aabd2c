"""Interface of a baseline: its settings, and a torch module that renders a view and has a surface."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64, UInt8
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.settings.config import AnyConfig
from sarsplat.settings.kinds import Count, Seed


@dataclass(frozen=True)
class BaselineConfig(AnyConfig):
    """Base of a baseline's settings."""

    iterations: Count = 1000
    """Length of a whole training."""
    checkpoint_every: Count = 100
    """Iterations between two checkpoints."""
    views_per_step: Count = 1
    """Training images in one step."""
    seed: Seed = 0
    """Seed of all random numbers."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Data for a baseline: training views, masks, units and the target's box, which must not be empty."""

    views: tuple[View, ...]
    """Views of the training images."""
    grid: ImageGrid
    """Pixels of every image."""
    low_m: Float64[np.ndarray, " 3"]
    high_m: Float64[np.ndarray, " 3"]
    """Corners of the box the target lies in, world frame, m."""
    unit: float
    """Power that counts as 1."""
    masks: UInt8[np.ndarray, "v rows columns"] | None = None
    """Class of each pixel of the training images: 0 clutter, 1 target, 2 shadow; None if unknown."""
    brightest: float = 1.0
    """Largest usual power of the training images (`usual_peak`), in units of `unit`."""
    ground: bool = False
    """True if the images show the ground around the target."""
    looks: float | None = None
    """Number of looks of the training images' speckle; None without speckle."""

    def __post_init__(self) -> None:
        corners = np.array([self.low_m, self.high_m])
        if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
            raise SarsplatError(
                f"the target's box from {self.low_m} to {self.high_m} m is empty or not finite; "
                "the training images show too little of a target"
            )
        if self.looks is not None and not 0 < self.looks < float("inf"):
            raise SarsplatError(f"the number of looks {self.looks} is not positive and finite; None means no speckle")


class Baseline(torch.nn.Module, ABC):
    """A model that learns from the training images of a dataset and then renders any view."""

    config: Any

    def __init__(self, scene: Scene, config: BaselineConfig) -> None:
        super().__init__()
        self.scene, self.config = scene, config

    @torch.no_grad()
    def images(self, views: Sequence[View]) -> Float32[np.ndarray, "v rows columns"]:
        """β⁰ of any views, linear power, float32 [V, rows, columns]."""
        images = np.empty((len(views), self.scene.grid.rows, self.scene.grid.columns), np.float32)
        for image, view in zip(images, views, strict=True):
            image[:] = (self.image(view) * self.scene.unit).cpu().numpy()
        return images

    @abstractmethod
    def loss(
        self, chosen: Int64[Tensor, " v"], images: Float[Tensor, "v rows columns"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Loss of the `chosen` training images.

        `images` are their β⁰, linear power, in units of `Scene.unit`. All random numbers come from `generator`, which
        is on the CPU.
        """

    @abstractmethod
    def optimiser(self) -> torch.optim.Adam:
        """New optimiser of all parameters."""

    def rate(self, iteration: int) -> float:
        """Factor on the optimiser's learning rates; it falls tenfold in the whole training."""
        return float(0.1 ** (iteration / self.config.iterations))

    @abstractmethod
    def image(self, view: View) -> Float[Tensor, "rows columns"]:
        """β⁰ from a view, linear power, in units of `Scene.unit`, differentiable, [rows, columns]."""

    @abstractmethod
    def surface(self) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "f 3"]]:
        """Triangle mesh of the target: vertices, float64 [N, 3], world frame, m; and faces, int64 [F, 3]."""
