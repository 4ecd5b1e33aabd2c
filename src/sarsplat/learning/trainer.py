"""Trainer: makes the steps of a training, and saves and restores its state, exact to the bit."""

import logging
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.gaussians import Gaussians, scattering_named
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.batching import detached
from sarsplat.learning.device_choice import usable_device
from sarsplat.learning.losses import Loss
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations import Batch, Observation, observations_of
from sarsplat.learning.optimiser import EngineAdam, Optimiser, followed
from sarsplat.learning.parts.target import dropped, share_dropped
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.strategies import Info, Strategy, strategies_of
from sarsplat.learning.strategies.strategy import Configured
from sarsplat.learning.training_images import ViewQueue
from sarsplat.renderer import Rendering
from sarsplat.renderer.engines.choice import recorder_for
from sarsplat.renderer.engines.on_device import NotRecordable
from sarsplat.renderer.engines.recorder import MOST_WORDS, Recorder, Told
from sarsplat.settings.config import Config

_log = logging.getLogger("sarsplat")

StepResult = tuple[Tensor, Rendering, dict[str, Tensor]]
"""Results of a recorded step: loss, rendering and penalties."""


class Trainer:
    """A training: its state, and the next step.

    Parameters
    ----------
    loss : callable, optional
        Loss of rendered and true images, β⁰ in linear power, that replaces the configuration's; returns one number.
    device : torch.device or str
        Device of all tensors; a seed gives the same start on every device.
    strategies : sequence of Strategy
        Strategies that act after the configuration's; names must be unique.
    observation : Observation, optional
        Observation that replaces the configuration's.

    Raises
    ------
    SarsplatError
        If the training images are black, a strategy does not support the parameters, or the device cannot be used.
    """

    @checks_arguments
    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        loss: Loss | None = None,
        device: torch.device | str = "cpu",
        strategies: Sequence[Strategy] = (),
        observation: Observation | None = None,
    ) -> None:
        self.config = config
        self.device = usable_device(device)
        self._observation = observation or observations_of(config)[0](dataset, config, self.device)
        self._finest = self._observation.images
        self._generator = torch.Generator().manual_seed(config.seed)
        self._queue = ViewQueue(len(self._finest.views), config.views_per_step, self._generator)
        self.strategies = [*strategies_of(config, dataset.select("train")), *strategies]
        self._learn(self._observation.first_model(self._generator))
        self._penalty_unit = self._observation.minimise(loss, self.model)
        self.iteration = 0
        self._terms: dict[str, Tensor] = {}
        self._recorded = self._recorder(loss)

    def _learn(self, model: SceneModel) -> None:
        """Begin to train a model, at full resolution, with new states of optimiser and strategies."""
        self._observation.begin(model)
        self.model, self._bounds, self.images, self._factor = model, model.target_part.bounds(), self._finest, 1
        self.optimiser = Optimiser(model.parameters, model.learned, self.config.iterations)
        for name, count in Counter(strategy.name for strategy in self.strategies).items():
            if count > 1:
                raise SarsplatError(f"{count} strategies are called {shown(name)}; give each another `name`")
        for strategy in self.strategies:
            strategy.check(model.parameters)
        self._states = [strategy.initial_state(model.parameters) for strategy in self.strategies]

    def step(self) -> Float32[Tensor, ""]:
        """Make one step of Adam on a few views; return the loss, on the device, without waiting for a GPU.

        `check` raises errors of a GPU.
        """
        factor = self.model.levels.factor(self.iteration)
        if factor != self._factor:
            self.images, self._factor = self._finest.multilooked(factor, self.views), factor
            self.model.look_at(self.images.grid.cell_m)
            self.optimiser.relearn(self.model.learned)
        chosen, step = self._queue.next(), self.iteration + 1
        loss, rendering = self._recorded_step(chosen, step) or self._eager_step(chosen, step)
        self.iteration += 1
        self._each_strategy("step_post_backward", step, chosen, rendering)
        return loss

    def _eager_step(self, chosen: Sequence[int], step: int) -> tuple[Tensor, Rendering]:
        """Make the step without a CUDA graph."""
        loss, total, rendering = self._losses(chosen, step, step)
        self._each_strategy("step_pre_backward", step, chosen, rendering)
        total.backward()
        rendering = detached(rendering)
        self._gather(step, rendering)
        self.optimiser.step(self.iteration)
        return loss, rendering

    def _recorded_step(self, chosen: Sequence[int], step: int) -> tuple[Tensor, Rendering] | None:
        """Make the step by a CUDA graph; None if it cannot be recorded."""
        if self._recorded is None:
            return None
        model, stepper = self.model, self.optimiser.stepper
        assert isinstance(stepper, EngineAdam)

        def program(chosen: Tensor, step_number: Tensor, rates: Tensor) -> StepResult:
            loss, total, rendering = self._losses(chosen, step, step_number)
            gradients = torch.autograd.grad(total, list(model.parameters.values()))
            rendering = detached(rendering)
            self._gather(step, rendering)
            stepper.step_on_device(gradients, rates)
            return loss, rendering, self._terms

        gradients_wanted = tuple(strategy.wants_plane_gradients(step) for strategy in self.strategies)
        kind = self._factor, model.degree(self.iteration), self._rays, gradients_wanted
        states = [tensor for part in model.parts for tensor in part.state().values()]
        states += [tensor for state in self._states for tensor in state.tensors().values()]
        objects = stepper, self.images.truth, self.images.views, *model.parameters.values(), *states
        rates = self.optimiser.numbers(self.iteration)
        try:
            loss, rendering, self._terms = self._recorded.run((kind, objects), program, chosen, step, rates)
        except (NotRecordable, RuntimeError, SarsplatError) as error:
            self._recorded = None
            message = f"CUDA graphs are off, because this step cannot be recorded: {error}"
            if isinstance(error, NotRecordable):
                _log.info(message)
            else:  # if the step itself is wrong, the eager step raises the same error
                warnings.warn(message, SarsplatWarning, stacklevel=2)
            return None
        self.optimiser.stepped()
        stepper.mark_changed()
        return loss.clone(), rendering

    def _losses(
        self, chosen: Sequence[int] | Tensor, step: int, step_number: int | Tensor
    ) -> tuple[Tensor, Tensor, Rendering]:
        """Loss, total with penalties, and rendering; `step_number` is `step`, for CUDA graphs as a tensor."""
        share = share_dropped(self.config, len(self.views))
        batch = Batch(
            chosen,
            self.model.degree(self.iteration),
            self._rays,
            self._bounds,
            dropped=dropped(len(self.model), share, self.config.seed, step_number, self.device) if share else None,
            plane_gradients=self._wants_plane_gradients(step),
        )
        loss, rendering = self._observation.compared(self.model, self.images, batch)
        if not isinstance(loss, Tensor) or loss.ndim != 0 or not loss.requires_grad or loss.is_complex():
            what = f"{tuple(loss.shape)} of {loss.dtype}" if isinstance(loss, Tensor) else type(loss).__name__
            raise SarsplatError(
                f"the loss returned {what}; it must return one real number, a tensor of shape () computed from the "
                "rendered images by torch"
            )
        terms = {name: self._penalty_unit * value for name, value in self.model.penalties().items()}
        if (penalty := self.model.penalty()) is not None:
            terms = {"priors": penalty} | terms
        self._terms = {name: term.detach() for name, term in terms.items()}
        return loss.detach(), sum(terms.values(), loss), rendering

    @property
    def terms(self) -> dict[str, Tensor]:
        """Penalties in the newest step, by name; copies."""
        return {name: term.clone() for name, term in self._terms.items()}  # a CUDA graph overwrites its results

    @property
    def records(self) -> bool:
        """True if steps are CUDA graphs; set it to False to switch these off."""
        return self._recorded is not None

    @records.setter
    def records(self, wanted: bool) -> None:
        if wanted > self.records:
            raise SarsplatError("records is True, but CUDA graphs are not available in this training; leave it False")
        self._recorded = self._recorded if wanted else None

    def _wants_plane_gradients(self, step: int) -> bool:
        return any(strategy.wants_plane_gradients(step) for strategy in self.strategies)

    def _recorder(self, loss: Loss | None) -> "RecordedSteps | None":
        """Recorder of CUDA graphs; None if the device has none, or for custom losses, laws and strategies."""
        recorder = recorder_for(next(iter(self.model.parameters.values())))
        law = scattering_named(self.config.scattering)
        built_in = loss is None and law.__module__.startswith("sarsplat.")
        built_in = built_in and all(isinstance(one, Configured) and not one.acts_before() for one in self.strategies)
        views, rates = self._queue.size, len(self.model.parameters) + 2
        if recorder is None or 2 * views + 2 + rates > MOST_WORDS:
            return None
        if not built_in or not self._observation.recordable or not isinstance(self.optimiser.stepper, EngineAdam):
            _log.info("CUDA graphs are off: they support built-in losses, laws and strategies on single images only")
            return None
        return RecordedSteps(recorder, views, rates)

    def _gather(self, step: int, rendering: Rendering) -> None:
        """Let strategies accumulate statistics of a step with plane gradients."""
        if self._wants_plane_gradients(step):
            for strategy, state in zip(self.strategies, self._states, strict=True):
                strategy.gather(state, step, rendering, self.images.grid)

    def _each_strategy(self, method: str, step: int, chosen: Sequence[int], rendering: Rendering) -> None:
        """Call a method of all strategies; when one moves rows, the states of the others follow."""
        degree, rays = self.model.degree(self.iteration), self._rays
        rendering = replace(rendering, cross_sections=rendering.cross_sections.detach())
        info = Info(self.model, self.images, tuple(chosen), rendering, degree, rays, self._bounds, self._generator)
        for strategy, state in zip(self.strategies, self._states, strict=True):
            getattr(strategy, method)(self.model.parameters, self.optimiser, state, step, info)
            if (moves := self.optimiser.take_moves()) is not None:
                self.optimiser.constrain()
                source, kept = moves.clamp(min=0), moves >= 0
                for other in self._states:
                    if other is not state:
                        other.follow(source, kept)
                info = replace(info, rendering=_followed(info.rendering, source, kept))

    @property
    def grid(self) -> ImageGrid:
        """Grid of the dataset's images; steps may use coarser ones, `images`."""
        return self.model.frame.grid

    @property
    def views(self) -> tuple[View, ...]:
        """Views of the training images, as refined so far."""
        return self.images.views

    @property
    def _rays(self) -> RayGrid:
        config = self.config
        fine = self.model.levels.fine(self.iteration, config.fine_from)
        return RayGrid.for_image(self.images.grid, config.fine_rays_per_pixel if fine else config.rays_per_pixel)

    def check(self) -> None:
        """Wait for the device; raise a SarsplatError if a step so far had values that cannot be rendered."""
        self._bounds.check()

    @property
    def learning_rates(self) -> dict[str, float]:
        """Learning rates of the next step by parameter, of the first column; those of means and shifts are in m."""
        return self.optimiser.rates(self.iteration)

    @checks_arguments
    def rendered(self, views: Sequence[View]) -> Float32[np.ndarray, "v rows columns"]:
        """Render β⁰ of any views, linear power, with the rays of the training."""
        return self.model.unseen(views, self.grid, self.model.degree(self.iteration), self._rays)

    @property
    def gaussian_count(self) -> int:
        """Number of the target's Gaussians."""
        return len(self.model)

    @property
    def gaussians(self) -> Gaussians:
        """The target's Gaussians after the last step."""
        return self.model.target(self.model.degree(self.iteration)).detach()

    @checks_arguments
    def snapshot(self, seconds: float) -> Snapshot:
        """Return all state that the next step depends on; `seconds` is the training time so far."""
        self.check()
        tensors = {"generator": self._generator.get_state(), **self.model.tensors()}
        tensors |= {f"optimiser/{name}": tensor for name, tensor in self.optimiser.tensors().items()}
        for strategy, state in zip(self.strategies, self._states, strict=True):
            # records the strategy, even without state
            tensors[f"strategy/{strategy.name}"] = torch.empty(0, dtype=torch.float32, device="cpu")
            tensors |= {f"strategy/{strategy.name}/{name}": tensor for name, tensor in state.tensors().items()}
        tensors = {name: tensor.cpu().clone() for name, tensor in tensors.items()}
        queue, unit, brightest = tuple(self._queue.waiting), self.model.unit, self.images.brightest
        stacks = self.model.frame.stacks
        return Snapshot(
            self.iteration, seconds, queue, self.grid, self.views, unit, brightest, stacks=stacks, tensors=tensors
        )

    @checks_arguments
    def restore(self, snapshot: Snapshot) -> None:
        """Restore the state of a snapshot.

        Raises a SarsplatError if its training had other strategies, KeyError or ValueError if it holds no training.
        """
        if not snapshot.part("optimiser"):
            raise SarsplatError("the snapshot holds Gaussians that were not trained here, which cannot be resumed")
        names = [name.removeprefix("strategy/") for name in snapshot.tensors if name.startswith("strategy/")]
        begun, own = {name for name in names if "/" not in name}, {strategy.name for strategy in self.strategies}
        if begun != own:
            raise SarsplatError(
                f"the training was begun with the strategies {', '.join(sorted(begun)) or 'none'}, not "
                f"{', '.join(sorted(own)) or 'none'}; give the same"
            )
        self._learn(SceneModel.saved(snapshot, self.config, self.device))
        self.optimiser.load(snapshot.part("optimiser"))
        for strategy, state in zip(self.strategies, self._states, strict=True):
            state.load(snapshot.part(f"strategy/{strategy.name}"))
        self._queue.restore(snapshot)
        self.images.views, self.iteration = snapshot.views, snapshot.iteration


def _followed(rendering: Rendering, source: Tensor, kept: Tensor) -> Rendering:
    """Re-index the per-Gaussian results of a rendering; they are 0 where not `kept`."""

    def moved(rows: Tensor) -> Tensor:
        return followed(rows.transpose(0, 1), source, kept).transpose(0, 1)

    gradients = None if rendering.plane_gradients is None else moved(rendering.plane_gradients)
    sections, lit_area = moved(rendering.cross_sections), moved(rendering.lit_area)
    return replace(rendering, cross_sections=sections, lit_area=lit_area, plane_gradients=gradients)


class RecordedSteps:
    """A recorded training step, recorded anew when the training changes.

    The first step of a kind is rehearsed: it runs normally, with its numbers on the device. The second is recorded; it
    and all later ones replay the record. `views` and `rates` are how many views and numbers for Adam a step has.
    """

    def __init__(self, recorder: Recorder, views: int, rates: int) -> None:
        self._recorder = recorder
        self._told = Told(
            recorder, {"chosen": (torch.int64, views), "step": (torch.int64, 1), "rates": (torch.float32, rates)}
        )
        self._values: Hashable = None
        self._objects: Sequence[object] = ()  # kept alive: a later object could have the same address
        self._record: tuple[StepResult, Callable[[], None]] | None = None

    def run(
        self,
        kind: tuple[Hashable, Sequence[object]],
        program: Callable[..., StepResult],
        chosen: Sequence[int],
        step: int,
        rates: Sequence[float],
    ) -> StepResult:
        """Make one step and return the program's result, whose tensors the next step may overwrite.

        `kind` is all that determines the program's launches: values, and objects that must stay identical. The program
        gets the other three as tensors. Raises NotRecordable, RuntimeError or SarsplatError if the step cannot be
        recorded; the parameters are then unchanged.
        """
        self._told.tell(
            chosen=torch.tensor(chosen, device="cpu"),
            step=torch.tensor([step], device="cpu"),
            rates=torch.tensor(rates, dtype=torch.float32, device="cpu"),
        )
        values, objects = kind
        if self._values != values or [*map(id, objects)] != [*map(id, self._objects)]:
            self._record = None
            result = self._recorder.rehearse(lambda: program(*self._told.tensors.values()))
            self._values, self._objects = values, objects
            return result
        if self._record is None:
            self._record = self._recorder.record(lambda: program(*self._told.tensors.values()))
        result, run = self._record
        run()
        return result
