"""The interface of a reconstruction method: settings, trainer, and what was learned."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Complex64, Complex128, Float32, Float64, UInt8

from sarsplat.data import Dataset, DatasetEntry
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.names import Speckle
from sarsplat.settings.config import AnyConfig

if TYPE_CHECKING:
    import torch
    import trimesh

    from sarsplat.gaussians import Gaussians
    from sarsplat.learning.losses import Loss
    from sarsplat.learning.model import SceneModel
    from sarsplat.learning.snapshot import Snapshot


@dataclass(frozen=True)
class Inputs:
    """What a reconstruction is given that only some methods take (`Method.takes`)."""

    masks: Path | None = None
    """Folder of masks of the training images."""
    scattering: str | None = None
    """Kind of the law of scattering, instead of the settings'."""
    loss: Loss | None = None
    """Loss to be trained with."""
    strategies: Sequence[Any] = ()
    """What else happens between steps."""


class Trainable(Protocol):
    """Interface of a trainer, as the training loop uses it; what is derived from it omits what it lacks."""

    iteration: int
    config: Any
    """Its `AnyConfig`."""

    @property
    def gaussian_count(self) -> int | None:
        """Number of Gaussians, if it learns any."""
        return None

    def step(self) -> torch.Tensor:
        """One step; returns the loss, a single number, still on the device."""

    def check(self) -> None:
        """Wait for the device, and raise what went wrong there."""

    @property
    def terms(self) -> dict[str, torch.Tensor]:
        """What the last step minimised besides the loss: single numbers by name, still on the device."""
        return {}

    @property
    def learning_rates(self) -> dict[str, float]:
        """Learning rates of the next step, by parameter."""

    def rendered(self, views: Sequence[View]) -> Float32[np.ndarray, "v rows columns"]:
        """β⁰ of any views as they are now, linear power; nothing random is drawn."""

    def snapshot(self, seconds: float) -> Snapshot:
        """Everything the next step depends on, after so many seconds of training."""

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to the state of a snapshot."""


class Method(ABC):
    """A way from images to a target. One object, `METHOD` of a module `method_NAME.py` or an entry point."""

    name: str
    """On the command line and in files."""
    title: str
    """For readers."""
    settings: type[AnyConfig]
    """What its settings are."""
    takes: frozenset[str] = frozenset()
    """Fields of `Inputs` that it uses."""
    watchable: bool = False
    """Whether the viewer can show its trainings: its trainer has a `model` of Gaussians."""

    @abstractmethod
    def preset(self, name: str, dataset: Dataset) -> Any:
        """Its settings of that name; "auto" is what suits the dataset. A SarsplatError if none have that name."""

    @abstractmethod
    def trainer(
        self,
        dataset: Dataset,
        config: Any,
        inputs: Inputs,
        device: torch.device,
        begun: Callable[[], Reconstruction] | None,
    ) -> Trainable:
        """A training at its beginning: on the dataset's training images, with settings of the type `settings`.

        `inputs` has only what it `takes`; `begun` opens what the run that will be resumed has learned, if that has a
        checkpoint.
        """

    @abstractmethod
    def open(self, snapshot: Snapshot, config: Any, device: str, folder: Path | None) -> Reconstruction:
        """What a training has learned; `folder` is where it keeps its results, if it has a folder.

        Raises KeyError, ValueError, TypeError, IndexError, RuntimeError or SarsplatError if the snapshot does not hold
        a whole model of these settings.
        """

    @abstractmethod
    def loss_title(self, config: Any) -> tuple[str, str]:
        """What its training minimises, and the unit of that, for readers."""

    def about(self, config: Any, grid: ImageGrid) -> tuple[str, str | None]:
        """What is shown while it trains: a heading, and one line, if there is something to say."""
        return self.name, None

    def by_tiles(self, config: Any) -> bool:
        """Whether a training goes on tile by tile, its trainer being a `Trainer`."""
        return False

    def checked(self, config: AnyConfig) -> AnyConfig:
        """The settings; refused if they are not its own."""
        if type(config) is not self.settings:
            raise SarsplatError(
                f"the settings are a {type(config).__name__}; {self.name} takes a {self.settings.__name__}"
            )
        return config

    def refuse_others(self, inputs: Inputs) -> None:
        """Refuse inputs that it does not use."""
        for field in fields(Inputs):
            value = getattr(inputs, field.name)
            if value != field.default and field.name not in self.takes:
                what = shown(str(value)) if isinstance(value, Path) else shown(value)
                raise SarsplatError(f"{self.name} uses no {field.name}; omit {what}, or choose a method that does")


DrawsSamples = Callable[[View, int], Complex64[np.ndarray, "rows columns"]]
"""One image as the radar would deliver it, complex amplitudes √β⁰·e^jψ, from a view and a seed."""


class Reconstruction(ABC):
    """Interface of a learned target: it renders and has points; results are numpy arrays, whatever the device."""

    gaussians: Gaussians | None = None
    """The target's Gaussians, of methods that learn any."""
    model: SceneModel | None = None
    """The scene of Gaussians, of methods that learn one: what radar maps and the viewer take apart."""

    @abstractmethod
    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float32[np.ndarray, "v rows columns"]:
        """β⁰ of any views, linear power, on its grid or another one: see `Run.render`."""

    def covariances(
        self, views: Sequence[View], stack: Stack | Sequence[Stack], grid: ImageGrid | None = None
    ) -> Complex64[np.ndarray, "v p p rows columns"]:
        """Covariances between passes: see `Run.render_covariances`; refused by methods that know of power alone."""
        raise SarsplatError(
            "this run has not learned phases, so it has no covariances between passes; give one that sar-gs has "
            "learned from interferometric stacks (preset stack)"
        )

    def covariance_within(self, box: Box) -> Complex128[np.ndarray, "p p"]:
        """How a part of the scene returns polarisations together (`Run.covariance_within`); refused if it has one."""
        raise SarsplatError(
            "this run has learned one polarisation; give one that sar-gs has learned from stacks of several (preset "
            "polarimetric)"
        )

    def sampler(self, ground: str | Float32[np.ndarray, "r c"], speckle: Speckle, scatterers: float) -> DrawsSamples:
        """A sampler of single speckled images (see `Run.sample`); refused by methods that know only their mean."""
        raise SarsplatError(
            "this run knows what is expected of images, but not how single ones differ (gain, shift, noise, speckle); "
            "give one that sar-gs has learned from speckled images"
        )

    @abstractmethod
    def masks(self, views: Sequence[View], points: Float32[np.ndarray, "p 3"]) -> UInt8[np.ndarray, "v rows columns"]:
        """What the pixels of any views show, given the points of the target: 0 clutter, 1 target, 2 shadow."""

    @abstractmethod
    def mesh(self, points: Float32[np.ndarray, "p 3"], normals: Float32[np.ndarray, "p 3"]) -> trimesh.Trimesh:
        """The surface as triangles, world frame, m, given its points and their normals; perhaps without faces."""

    @abstractmethod
    def points(self) -> Float32[np.ndarray, "p 3"]:
        """Points of the surface, world frame, m."""

    @abstractmethod
    def normals_at(self, points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, "p 3"]:
        """Unit normals of the surface at these of its points, on the side that the radar saw."""

    def gamma0_at(self, points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, " p"] | None:
        """γ⁰ of these points, linear, as the training views saw it; None if the method does not know it."""
        return None

    @property
    def azimuth_offset_deg(self) -> Float64[np.ndarray, " k"] | None:
        """Corrections of the azimuths of the training views, degrees; None from methods that make none."""
        return None

    def views_of(self, entries: Sequence[DatasetEntry], train: Dataset) -> tuple[View, ...]:
        """Views of images, as far as training images corrected the passes that they are of."""
        return tuple(entry.view for entry in entries)

    @property
    @abstractmethod
    def learned(self) -> str:
        """What was learned, in words: `4,123 Gaussians`."""

    @property
    @abstractmethod
    def facts(self) -> dict[str, str]:
        """Facts for reports besides the number of steps: names and values."""

    def write(self, folder: Path) -> None:  # noqa: B027
        """Write what other programs read, besides the points, if there is anything."""
