"""Interface of a reconstruction method: settings, trainer, and the learned reconstruction."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Complex64, Complex128, Float32, Float64, UInt8

from sarsplat.data import Dataset, DatasetEntry
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import Trimesh
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.learning.losses import Loss
from sarsplat.learning.model import SceneModel
from sarsplat.learning.snapshot import Snapshot
from sarsplat.names import Speckle
from sarsplat.settings.config import AnyConfig


@dataclass(frozen=True)
class Inputs:
    """Inputs of a reconstruction that only some methods take (`Method.takes`)."""

    masks: Path | None = None
    """Folder of masks of the training images."""
    loss: Loss | None = None
    """Loss, overriding the settings."""
    strategies: Sequence[Any] = ()
    """Strategies besides the method's, which act between steps."""


class Trainable(Protocol):
    """Interface of a trainer, as the training loop uses it."""

    iteration: int
    config: Any
    """Its `AnyConfig`."""

    @property
    def gaussian_count(self) -> int | None:
        """Number of Gaussians, if it learns any."""
        return None

    def step(self) -> torch.Tensor:
        """Make one step; return the loss, a single number on the device."""

    def check(self) -> None:
        """Wait for the device and raise its errors."""

    @property
    def terms(self) -> dict[str, torch.Tensor]:
        """Penalties in the last step: single numbers by name, on the device."""
        return {}

    @property
    def learning_rates(self) -> dict[str, float]:
        """Learning rates of the next step, by parameter."""

    def rendered(self, views: Sequence[View]) -> Float32[np.ndarray, "v rows columns"]:
        """Render β⁰ of any views, linear power, without random numbers."""

    def snapshot(self, seconds: float) -> Snapshot:
        """Return all state that the next step depends on; `seconds` is the training time."""

    def restore(self, snapshot: Snapshot) -> None:
        """Restore the state of a snapshot."""


class Method(ABC):
    """A reconstruction method: one object, `METHOD` of a module `method_NAME.py` or an entry point."""

    name: str
    """Name on the command line and in files."""
    title: str
    """Name for readers."""
    settings: type[AnyConfig]
    takes: frozenset[str] = frozenset()
    """Fields of `Inputs` that it uses."""
    watchable: bool = False
    """True if the viewer can show its trainings: the trainer has a `model` of Gaussians."""

    @abstractmethod
    def preset(self, name: str, dataset: Dataset) -> Any:
        """Return the settings of that name; "auto" chooses by the dataset. Raise if the name is unknown."""

    @abstractmethod
    def trainer(
        self,
        dataset: Dataset,
        config: Any,
        inputs: Inputs,
        device: torch.device,
        begun: "Callable[[], Reconstruction] | None",
    ) -> Trainable:
        """Return a new trainer on the dataset's training images.

        `inputs` has only fields in `takes`; `begun` opens the reconstruction of the run to be resumed, if there is one.
        """

    @abstractmethod
    def open(self, snapshot: Snapshot, config: Any, device: str, folder: Path | None) -> "Reconstruction":
        """Return the reconstruction in a snapshot; `folder` is that of the run's results, if there is one.

        Raises KeyError, ValueError, TypeError, IndexError, RuntimeError or SarsplatError if the snapshot does not hold
        a whole model of these settings.
        """

    @abstractmethod
    def loss_title(self, config: Any) -> tuple[str, str]:
        """Return the title and the unit of the loss, for readers."""

    def about(self, config: Any, grid: ImageGrid) -> tuple[str, str | None]:
        """Return a heading and an optional line of text, shown during training."""
        return self.name, None

    def by_tiles(self, config: Any) -> bool:
        """True if training continues tile by tile, which needs a `Trainer`."""
        return False

    def checked(self, config: AnyConfig) -> AnyConfig:
        """Return the settings; raise if they are of another method."""
        if type(config) is not self.settings:
            raise SarsplatError(
                f"the settings are a {type(config).__name__}; {self.name} takes a {self.settings.__name__}"
            )
        return config

    def refuse_others(self, inputs: Inputs) -> None:
        """Raise if there are inputs that it does not use."""
        for field in fields(Inputs):
            value = getattr(inputs, field.name)
            if value != field.default and field.name not in self.takes:
                what = shown(str(value)) if isinstance(value, Path) else shown(value)
                raise SarsplatError(f"{self.name} uses no {field.name}; omit {what}, or choose a method that does")


DrawsSamples = Callable[[View, int], Complex64[np.ndarray, "rows columns"]]
"""Function that draws a single image, complex amplitudes √β⁰·e^jψ, from a view and a seed."""


class Reconstruction(ABC):
    """Interface of a learned target; results are numpy arrays, whatever the device."""

    gaussians: Gaussians | None = None
    """The target's Gaussians, of methods that learn any; γ⁰ in the unit of `model`."""
    model: SceneModel | None = None
    """The scene of Gaussians, of methods that learn one; radar maps and the viewer use it."""

    @abstractmethod
    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float32[np.ndarray, "v rows columns"]:
        """Render β⁰ of any views, linear power, on its grid or another one: see `Run.render`."""

    def covariances(
        self, views: Sequence[View], stack: Stack | Sequence[Stack], grid: ImageGrid | None = None
    ) -> Complex64[np.ndarray, "v p p rows columns"]:
        """Return covariances between passes (`Run.render_covariances`); raise if only power was learned."""
        raise SarsplatError(
            "this run has not learned phases, so it has no covariances between passes; reconstruct interferometric "
            "stacks with sar-gs (preset stack)"
        )

    def covariance_within(self, box: Box) -> Complex128[np.ndarray, "p p"]:
        """Return the polarimetric covariance of a part of the scene (`Run.covariance_within`); raise if it has none."""
        raise SarsplatError(
            "this run has learned one polarisation; reconstruct stacks of several with sar-gs (preset polarimetric)"
        )

    def sampler(self, ground: str | Float32[np.ndarray, "r c"], speckle: Speckle, scatterers: float) -> DrawsSamples:
        """Return a sampler of single speckled images (`Run.sample`); raise if only their mean was learned."""
        raise SarsplatError(
            "this run has learned mean images, but not how single ones differ (gain, shift, noise, speckle); "
            "reconstruct speckled images with sar-gs"
        )

    @abstractmethod
    def masks(self, views: Sequence[View], points: Float32[np.ndarray, "p 3"]) -> UInt8[np.ndarray, "v rows columns"]:
        """Masks of any views, given the points of the target: 0 clutter, 1 target, 2 shadow."""

    @abstractmethod
    def mesh(self, points: Float32[np.ndarray, "p 3"], normals: Float32[np.ndarray, "p 3"]) -> Trimesh:
        """Surface as triangles, world frame, m, from its points and normals; it may have no faces."""

    @abstractmethod
    def points(self) -> Float32[np.ndarray, "p 3"]:
        """Points of the surface, world frame, m."""

    @abstractmethod
    def normals_at(self, points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, "p 3"]:
        """Unit normals of the surface at these points, on the side that the radar saw."""

    def gamma0_at(self, points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, " p"] | None:
        """γ⁰ of these points, linear, averaged over the training views; None if the method does not know it."""
        return None

    @property
    def azimuth_offset_deg(self) -> Float64[np.ndarray, " k"] | None:
        """Corrections of the azimuths of the training views, degrees; None from methods that make none."""
        return None

    def views_of(self, entries: Sequence[DatasetEntry], train: Dataset) -> tuple[View, ...]:
        """Views of images, with the corrections that the training found for their passes."""
        return tuple(entry.view for entry in entries)

    @property
    @abstractmethod
    def learned(self) -> str:
        """Summary in words: `4,123 Gaussians`."""

    @property
    @abstractmethod
    def facts(self) -> dict[str, str]:
        """Facts for reports besides the number of steps: names and values."""

    def write(self, folder: Path) -> None:  # noqa: B027
        """Write files for other programs, besides the points."""
