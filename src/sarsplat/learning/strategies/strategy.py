"""Interface of a strategy, which changes a model between steps of Adam."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.batching import in_groups
from sarsplat.learning.model import SceneModel
from sarsplat.learning.optimiser import Optimiser, followed
from sarsplat.learning.snapshot import fitting
from sarsplat.learning.training_images import TrainingImages
from sarsplat.renderer import Bounds, Rendering, channel_of
from sarsplat.settings.config import Config

Params = dict[str, Tensor]
"""Parameters of a training, by name."""

_FAINTEST = 1e-6  # power relative to the brightest pixel, added before errors are divided by power


@dataclass
class State:
    """State of a strategy between steps; saved and restored with the training."""

    rows: dict[str, Tensor] = field(default_factory=dict)
    """Tensors with a row for each Gaussian; rows come and go with it and are 0 for a new one."""
    whole: dict[str, Tensor] = field(default_factory=dict)
    """Tensors of other shapes, which are constant; one that begins empty gets its rows in a step."""
    added: tuple[str, ...] = ()
    """Names that may be missing in checkpoints of earlier versions; they keep their initial value."""

    def follow(self, source: Int64[Tensor, " n"], kept: Bool[Tensor, " n"]) -> None:
        """Re-index per-Gaussian state: row k takes that of row `source`[k], or 0 where not `kept`[k] (it is new)."""
        for name, rows in self.rows.items():
            new = followed(rows, source, kept)
            self.rows[name] = rows.copy_(new) if len(new) == len(rows) else new  # as CUDA graphs hold tensors

    def tensors(self) -> dict[str, Tensor]:
        """All state tensors by name, to be saved; names of those with a row for each Gaussian begin with "rows/"."""
        return {f"rows/{name}": rows for name, rows in self.rows.items()} | self.whole

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Restore `tensors`; raise KeyError or ValueError if they do not fit."""
        for kind, own in (("rows/", self.rows), ("", self.whole)):
            for name, like in own.items():
                saved = kind + name if kind + name in tensors else name  # as earlier versions saved rows
                if saved in tensors or name not in self.added:
                    shape = like.shape if like.numel() else (len(tensors[saved]), *like.shape[1:])
                    own[name] = fitting(tensors, saved, like.dtype, shape).to(like.device, copy=True)


@dataclass(frozen=True)
class Info:
    """Information for a strategy about a step: model, images, rendering, random generator."""

    model: SceneModel
    images: TrainingImages
    """Training images; a strategy may change their `views`."""
    chosen: tuple[int, ...]
    """Numbers of the images that this step rendered."""
    rendering: Rendering
    """Rendering of the step, with `plane_gradients` if any strategy wants them; per-Gaussian results are detached,
    and re-indexed after earlier strategies: 0 for new Gaussians."""
    degree: int
    """Degree of the harmonics in use."""
    rays: RayGrid
    bounds: Bounds
    generator: torch.Generator
    """The only source of random numbers, on the CPU."""

    def check(self) -> None:
        """Wait for the device and raise its errors; call it before reading results."""
        self.bounds.check()

    @torch.no_grad()
    def compared(
        self, views: Sequence[View], chosen: Int64[np.ndarray, " v"]
    ) -> Iterator[tuple[Float[Tensor, "n rows columns"], Float[Tensor, "n rows columns"]]]:
        """Yield batches of chosen training images and their renderings from these views, in the model's unit.

        Shift and gain of each image apply; estimated parts (`Part.estimated`) are left out.
        """
        for batch in self._batches(len(views)):
            numbers = self.images.numbers[torch.from_numpy(chosen[batch]).to(self.model.device)]
            images, _ = self._rendered(views[batch], numbers)
            power = channel_of(images, self.model.power_channel)
            yield self.images.truth[numbers] / self.model.unit, power / self.model.unit

    @torch.no_grad()
    def lit_areas(self) -> Float[Tensor, " n"]:
        """Lit area of each of the target's Gaussians in the view that lights it best, m²."""
        views, largest = self.images.views, torch.zeros(len(self.model), dtype=torch.float32, device=self.model.device)
        for batch in self._batches(len(views)):
            _, rendering = self._rendered(views[batch], None)
            largest = torch.maximum(largest, rendering.lit_area.amax(0))
        return largest

    def errors(self) -> Float[Tensor, " n"]:
        """Error of the training images, attributed to the target's Gaussians.

        A pixel's error is the difference of amplitudes; each Gaussian gets the share that it has of the power.
        """
        total = torch.zeros(len(self.model), dtype=torch.float32, device=self.model.device)
        for batch in self._batches(len(self.images.views)):
            total += self._errors_in(batch)
        return total

    def _errors_in(self, batch: slice) -> Float[Tensor, " n"]:
        """`errors` of a batch; a function, so that its memory is freed before the next one."""
        channel, faintest = self.model.power_channel, _FAINTEST * self.images.brightest
        views, truth = self.images.views[batch], self.images.truth[batch]
        with torch.no_grad():
            scene = self.model.target(self.degree)
            towards = scene.means.new_tensor(np.array([view.look.facing for view in views]))
            amplitudes = scene.scattering.amplitudes(towards, scene.quaternions, scene.scales)
        amplitudes.requires_grad_()
        images, _ = self._rendered(views, self.images.numbers[batch], amplitudes)
        power = channel_of(images, channel)
        with torch.no_grad():
            error = (power.sqrt() - truth.sqrt()).abs() / (power + faintest)
        (slope,) = torch.autograd.grad((error * power).sum(), amplitudes)
        return (slope * amplitudes.detach())[..., channel].sum(0)

    def _batches(self, count: int) -> list[slice]:
        """Batches of views no larger than a step's, which fits into memory."""
        model = self.model
        return in_groups(count, model.config.views_per_step, model.parameters, self.images.grid, self.rays)

    def _rendered(
        self, views: Sequence[View], numbers: Int64[Tensor, " v"] | None, amplitudes: Tensor | None = None
    ) -> tuple[Tensor, Rendering]:
        grid, degree, rays = self.images.grid, self.degree, self.rays
        return self.model.render(
            views, grid, degree, rays=rays, numbers=numbers, bounds=self.bounds, amplitudes=amplitudes, estimated=False
        )


class Strategy(ABC):
    """Base of the strategies, also of custom ones: `Trainer(…, strategies=[mine])`.

    A training calls each in turn, built-in ones first. Keep all memory in the `State` and draw random numbers from
    `Info.generator`: a resumed training is then the same bit for bit.
    """

    @property
    def name(self) -> str:
        """Name of its state in snapshots; the class's name by default."""
        return type(self).__name__

    def check(self, params: Params) -> None:
        """Raise a `SarsplatError` if it does not support these parameters."""
        return

    def initial_state(self, params: Params) -> State:
        """The state at the beginning of a training."""
        return State()

    def wants_plane_gradients(self, step: int) -> bool:
        """Return True if it needs plane gradients in `Info.rendering` of this step, counted from 1."""
        return False

    def step_pre_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        """Act after the rendering of a step, before its gradients; change no parameter."""
        return

    def gather(self, state: State, step: int, rendering: Rendering, grid: ImageGrid) -> None:
        """Accumulate statistics of a step with plane gradients in tensors of the state, in place.

        CUDA graphs include this: it may depend on the step only as `wants_plane_gradients` does.
        """
        return

    @abstractmethod
    def step_post_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        """Act after step number `step` of Adam.

        Add and remove rows of `params` by the functions of `strategies.ops`; change values in place, under
        `torch.no_grad`, then call `optimizers.constrain()`. `state` is this strategy's.
        """


class Configured(Strategy):
    """Base of the built-in strategies, which configurations switch on."""

    order: ClassVar[int]
    """Rank: strategies act in ascending order."""

    section: ClassVar[str] = ""
    """Field of `Config` with its settings, None in a training without this strategy."""

    def __init__(self, config: Config, train: Dataset) -> None:
        self.config = config
        self.settings: Any = getattr(config, self.section, None)

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        """Return True if a training with this configuration has this strategy."""
        return getattr(config, cls.section) is not None

    def due(self, step: int) -> bool:
        """Return True if it acts after this step."""
        return False

    def act(self, params: Params, optimizers: Optimiser, state: State, info: Info) -> None:
        """Act, as in `step_post_backward`, after a step that is `due`; errors of the device have been raised."""
        return

    def step_post_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        if self.due(step):
            info.check()
            self.act(params, optimizers, state, info)

    @classmethod
    def acts_before(cls) -> bool:
        """True if it acts before a step's gradients; CUDA graphs are then off."""
        return cls.step_pre_backward is not Strategy.step_pre_backward


def at_round(iteration: int, first: float, last: float, steps: int) -> bool:
    """True if an iteration is one of `steps` + 1 evenly spaced ones from `first` to `last`."""
    if steps == 0 or first == last:
        return iteration == round(first)
    near = min(max(round((iteration - first) * steps / (last - first)), 0), steps)
    around = range(max(0, near - 1), min(steps, near + 1) + 1)  # there may be 10⁸
    return any(iteration == round(first + (last - first) * k / steps) for k in around)
