"""What every rival is: learn from the training images of a dataset, then render any view."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, UInt8
from torch import Tensor

from sarsplat.geometry import ImageGrid, View


@dataclass(frozen=True, eq=False)
class Scene:
    """What a dataset fixes for a rival.

    Parameters
    ----------
    views : tuple of View
        Of the K training images.
    grid : ImageGrid
        Of every image.
    low_m, high_m : numpy.ndarray, float64 [3]
        Corners of the box that the target lies in, world frame, m.
    unit : float
        Power (β⁰) that counts as 1.
    masks : numpy.ndarray, uint8 [K, rows, columns], or None
        Of the training images: 0 clutter, 1 target (lit), 2 shadow.
    """

    views: tuple[View, ...]
    grid: ImageGrid
    low_m: Float64[np.ndarray, " 3"]
    high_m: Float64[np.ndarray, " 3"]
    unit: float
    masks: UInt8[np.ndarray, "k rows columns"] | None = None


class Rival(torch.nn.Module, ABC):
    """A method that learns from the training images of a dataset and then renders any view."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.scene = scene

    @abstractmethod
    def loss(
        self, chosen: Int64[Tensor, " v"], images: Float[Tensor, "v rows columns"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """What one step lowers: of the training images `chosen`, with their power in units of `Scene.unit`."""

    @abstractmethod
    def optimiser(self) -> torch.optim.Optimizer:
        """A fresh optimiser of the parameters."""

    @abstractmethod
    def rate(self, iteration: int) -> float:
        """Factor on the learning rates at an iteration."""

    @abstractmethod
    def image(self, view: View) -> Float[Tensor, "rows columns"]:
        """β⁰ in units of `Scene.unit`, linear power, row 0 near range; differentiable."""

    @abstractmethod
    def surface(self) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "f 3"]]:
        """Vertices, m, world frame, and triangles."""
