"""Interface of a strategy, which changes a model between steps of Adam."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.few_at_once import in_groups
from sarsplat.learning.model import SceneModel
from sarsplat.learning.optimiser import Optimiser, followed
from sarsplat.learning.training_images import TrainingImages
from sarsplat.renderer import Bounds, Rendering, channel_of
from sarsplat.settings.config import Config

_FAINTEST = 1e-6
"""Of the brightest pixel: what is darker has no error of its own."""


@dataclass
class State:
    """What a strategy remembers from step to step; saved and restored with the training."""

    rows: dict[str, Tensor] = field(default_factory=dict)
    """Tensors with a row for each Gaussian: rows follow where Gaussians come and go, and are 0 for a new one."""
    whole: dict[str, Tensor] = field(default_factory=dict)
    """Tensors of any other shape, which stays."""
    added: tuple[str, ...] = ()
    """Those that checkpoints of earlier versions do not have: they are then as at the beginning."""

    def follow(self, source: Int64[Tensor, " n"], kept: Bool[Tensor, " n"]) -> None:
        """Re-index per-Gaussian state: row k takes that of row `source`[k], or zeros unless `kept`[k] (it is new)."""
        self.rows = {name: followed(rows, source, kept) for name, rows in self.rows.items()}

    def tensors(self) -> dict[str, Tensor]:
        """All state tensors by name, to be saved."""
        return self.rows | self.whole

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Undo `tensors`; raises KeyError or ValueError if they are not those."""
        for of in (self.rows, self.whole):
            for name, like in of.items():
                if name in self.added and name not in tensors:
                    continue
                saved = tensors[name]
                if saved.shape != like.shape or saved.dtype != like.dtype:
                    raise ValueError(f"{name} is {saved.dtype} {list(saved.shape)}")
                of[name] = saved.to(like.device, copy=True)


@dataclass(frozen=True)
class Info:
    """What a strategy can see of a step: model, images, rendering, source of random numbers."""

    model: SceneModel
    images: TrainingImages
    """What the model learns from; their `views` may be changed."""
    chosen: tuple[int, ...]
    """Numbers of the images that this step rendered."""
    rendering: Rendering
    """What it rendered, with `plane_gradients` if any strategy asked for them. What it says of single Gaussians is
    about the target's, detached; where a strategy before this one moved rows, it has followed: 0 for new ones."""
    degree: int
    """Degree of the harmonics in use."""
    rays: RayGrid
    bounds: Bounds
    """What the Gaussians keep."""
    generator: torch.Generator
    """The only source of random numbers, on the CPU."""

    def check(self) -> None:
        """Wait for the device, and raise what went wrong there: before anything is read from it."""
        self.bounds.check()

    @torch.no_grad()
    def compared(
        self, views: Sequence[View], chosen: Int64[np.ndarray, " v"]
    ) -> Iterator[tuple[Float[Tensor, "n rows columns"], Float[Tensor, "n rows columns"]]]:
        """Training images, and how the model shows them as seen from these views; a few at a time, in its unit.

        Each has its own shift and gain; what is estimated from such comparisons (`Part.estimated`) is left out.
        """
        for few in self._few(len(views)):
            numbers = self.images.numbers[torch.from_numpy(chosen[few]).to(self.model.device)]
            images, _ = self._rendered(views[few], numbers)
            yield (
                self.images.truth[numbers] / self.model.unit,
                channel_of(images, self.model.power_channel) / self.model.unit,
            )

    @torch.no_grad()
    def cross_sections(self) -> Float[Tensor, " n"]:
        """Radar cross-sections σ of the target's Gaussians, in the training view in which each is largest, m².

        The mean over the views would take for idle what only one of them sees.
        """
        views, largest = self.images.views, torch.zeros(len(self.model), dtype=torch.float32, device=self.model.device)
        for few in self._few(len(views)):
            _, rendering = self._rendered(views[few], None)
            sections = rendering.cross_sections[:, : len(largest), self.model.power_channel]  # then the surroundings'
            largest = torch.maximum(largest, sections.amax(0))
        return largest

    def errors(self) -> Float[Tensor, " n"]:
        """The training images' error by the target's Gaussians that are in its place.

        That of a pixel is the difference of amplitudes, and each Gaussian has the share of it that it has of the power.
        """
        total = torch.zeros(len(self.model), dtype=torch.float32, device=self.model.device)
        for few in self._few(len(self.images.views)):
            total += self._errors_in(few)[: len(total)]  # then the surroundings'
        return total

    def _errors_in(self, few: slice) -> Float[Tensor, " n"]:
        """`errors` in some of the images: what one rendering needs is gone before the next."""
        channel, faintest = self.model.power_channel, _FAINTEST * self.images.brightest
        views, truth = self.images.views[few], self.images.truth[few]
        with torch.no_grad():
            scene = self.model.scene(self.degree)
            towards = scene.means.new_tensor(np.array([view.look.facing for view in views]))
            amplitudes = scene.scattering.amplitudes(towards, scene.quaternions, scene.scales)
        amplitudes.requires_grad_()
        images, _ = self._rendered(views, self.images.numbers[few], amplitudes)
        power = channel_of(images, channel)
        with torch.no_grad():
            error = (power.sqrt() - truth.sqrt()).abs() / (power + faintest)
        (slope,) = torch.autograd.grad((error * power).sum(), amplitudes)
        return (slope * amplitudes.detach())[..., channel].sum(0)

    def _few(self, count: int) -> list[slice]:
        """Views at a time: what a step takes fits into memory."""
        model = self.model
        return in_groups(count, model.config.views_per_step, model.parameters, self.images.grid, self.rays)

    def _rendered(
        self,
        views: Sequence[View],
        numbers: Int64[Tensor, " v"] | None,
        amplitudes: Float[Tensor, "v n c"] | None = None,
    ) -> tuple[Tensor, Rendering]:
        return self.model.render(
            views,
            self.images.grid,
            self.degree,
            rays=self.rays,
            numbers=numbers,
            bounds=self.bounds,
            amplitudes=amplitudes,
            estimated=False,
        )


def of_rows(rendering: Rendering, pick: Callable[[Tensor], Tensor]) -> Rendering:
    """A rendering with its per-Gaussian results re-indexed: `pick` maps [V, N, …] to [V, M, …]."""
    gradients = rendering.plane_gradients
    return replace(
        rendering,
        cross_sections=pick(rendering.cross_sections.detach()),
        lit_area=pick(rendering.lit_area),
        plane_gradients=None if gradients is None else pick(gradients),
    )


class Strategy(ABC):
    """Base of the strategies, also of your own: `Trainer(…, strategies=[mine])`.

    A training calls each in turn, ours first. Whatever else one remembers than its settings belongs into its `State`,
    and chance comes from `Info.generator`: then a training that stops and goes on is the same bit for bit.
    """

    @property
    def name(self) -> str:
        """What its state is saved under; that of its class unless it says otherwise."""
        return type(self).__name__

    def check(self, params: dict[str, Tensor]) -> None:
        """Raise a `SarsplatError` if these parameters are not what it needs."""
        return

    def initial_state(self, params: dict[str, Tensor]) -> State:
        """The state at the beginning of a training."""
        return State()

    def wants_plane_gradients(self, step: int) -> bool:
        """Whether `Info.rendering` of this step is to have gradients on the planes; steps are counted from 1."""
        return False

    def step_pre_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        """Called after the images of a step are rendered, before their gradients are computed; changes no parameter."""
        return

    def gather(self, state: State, step: int, rendering: Rendering, grid: ImageGrid) -> None:
        """Add what a step with gradients on the planes shows, once they are there, to tensors of the state, in place.

        A GPU that makes steps by itself does this, too: it may depend on the step only as `wants_plane_gradients` does.
        """
        return

    @abstractmethod
    def step_post_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        """Called after each step of Adam, the `step`-th.

        Of `params`, rows come and go by the functions of `strategies.ops`; values are changed in place, under
        `torch.no_grad`, and kept in their ranges by `optimizers.constrain()`. `state` is its own.
        """


class Configured(Strategy):
    """Base of the strategies in this folder, which configurations switch on."""

    order: ClassVar[int]
    """Those with a smaller one act before it."""

    @classmethod
    def acts_before(cls) -> bool:
        """Whether it has anything to do before a step's gradients, which cannot be recorded, then."""
        return cls.step_pre_backward is not Strategy.step_pre_backward

    @classmethod
    @abstractmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        """The strategy of a configuration on training images, if there is one."""


def at_round(iteration: int, first: float, last: float, steps: int) -> bool:
    """Whether an iteration is one of `steps` + 1 evenly spaced ones, the first and the last included."""
    if steps == 0 or first == last:
        return iteration == round(first)
    near = min(max(round((iteration - first) * steps / (last - first)), 0), steps)
    around = range(max(0, near - 1), min(steps, near + 1) + 1)  # there may be 10⁸
    return any(iteration == round(first + (last - first) * k / steps) for k in around)
