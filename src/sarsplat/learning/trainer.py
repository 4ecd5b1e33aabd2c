"""Training: how a scene advances by one step, and its whole state, exact to the bit."""

from __future__ import annotations

import logging
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.gaussians import Gaussians, scattering_named
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.adam import EngineAdam
from sarsplat.learning.device import usable_device
from sarsplat.learning.dropout import dropped, share_dropped
from sarsplat.learning.losses import Loss
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations import Batch, Observation, observations_of
from sarsplat.learning.optimiser import Optimiser, followed
from sarsplat.learning.recorded_steps import RecordedSteps
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.strategies import Info, Strategy, strategies_of
from sarsplat.learning.strategies.strategy import Configured, of_rows
from sarsplat.learning.training_images import ViewQueue
from sarsplat.renderer import Rendering
from sarsplat.renderer.engines.choice import recorder_for
from sarsplat.renderer.engines.on_device import NotRecordable
from sarsplat.settings.config import Config

_log = logging.getLogger("sarsplat")


class Trainer:
    """The state of a training and how it advances by one step.

    Parameters
    ----------
    dataset : Dataset
        Its training images are learned from.
    config : Config
        How.
    loss : callable, optional
        Instead of the configuration's: of rendered and true images, β⁰ in linear power, one number.
    device : torch.device or str
        Where everything is computed and stays; a seed starts the same on every device.
    strategies : sequence of Strategy
        What else changes the model, after the configuration's own; each of another name.
    observation : Observation, optional
        What is learned from, instead of what the configuration says.

    Raises
    ------
    SarsplatError
        If the training images are black, a strategy cannot do with the parameters, or the device cannot be used.
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
        self._observation.begin(model)
        self.model, self._bounds, self.images, self._factor = model, model.scene_bounds(), self._finest, 1
        self.optimiser = Optimiser(model.parameters, model.learned, self.config.iterations)
        for name, count in Counter(strategy.name for strategy in self.strategies).items():
            if count > 1:
                raise SarsplatError(f"{count} strategies are called {shown(name)}; give each a `name` of its own")
        for strategy in self.strategies:
            strategy.check(model.parameters)
        self._states = [strategy.initial_state(model.parameters) for strategy in self.strategies]

    def _look(self) -> None:
        """Look at the images of the level that the next step is on."""
        factor = self.model.levels.factor(self.iteration)
        if factor != self._factor:
            self.images, self._factor = self._finest.multilooked(factor, self.views), factor
            self.model.look_at(self.images.grid.cell_m)
            self.optimiser.relearn(self.model.learned)

    def step(self) -> Float32[Tensor, ""]:
        """One step of Adam on a few views; returns the loss, still on the device: nothing waits for a GPU.

        `check` reports what was out of range on a GPU.
        """
        self._look()
        chosen, step = self._queue.next(), self.iteration + 1
        loss, rendering = self._by_itself(chosen, step) or self._launch_by_launch(chosen, step)
        self.iteration += 1
        self._each_strategy("step_post_backward", step, chosen, rendering)
        return loss

    def _launch_by_launch(self, chosen: Sequence[int], step: int) -> tuple[Tensor, Rendering]:
        loss, total, rendering = self._compared(chosen, step, step)
        self._each_strategy("step_pre_backward", step, chosen, rendering)
        total.backward()
        self._gather(step, rendering)
        self.optimiser.step(self.iteration)
        return loss, _done(rendering)

    def _by_itself(self, chosen: Sequence[int], step: int) -> tuple[Tensor, Rendering] | None:
        """The step, made by a device that was told what changes; None where it has to be told every launch."""
        if self._recorded is None:
            return None
        model, stepper = self.model, self.optimiser.stepper
        assert isinstance(stepper, EngineAdam)

        def program(chosen: Tensor, now: Tensor, rates: Tensor) -> tuple[Tensor, Rendering, dict[str, Tensor]]:
            loss, total, rendering = self._compared(chosen, step, now)
            gradients = torch.autograd.grad(total, list(model.parameters.values()))
            self._gather(step, rendering)
            stepper.step_told(gradients, rates)
            return loss, _done(rendering), self._terms

        wanted = tuple(strategy.wants_plane_gradients(step) for strategy in self.strategies)
        kind = self._factor, model.degree(self.iteration), self._rays, wanted
        kept = [tensor for part in model.parts for tensor in part.state().values()]
        kept += [tensor for state in self._states for tensor in state.tensors().values()]
        things = stepper, self.images.truth, self.images.views, *model.parameters.values(), *kept
        rates = self.optimiser.numbers(self.iteration)
        try:
            loss, rendering, self._terms = self._recorded.run((kind, things), program, chosen, step, rates)
        except (NotRecordable, RuntimeError, SarsplatError) as error:
            self._recorded = None
            said = f"steps are made launch by launch, because they cannot be recorded: {error}"
            if isinstance(error, NotRecordable):
                _log.info(said)
            else:  # or the same step fails again, and says why
                warnings.warn(said, SarsplatWarning, stacklevel=2)
            return None
        self.optimiser.stepped()
        stepper.tell_torch()
        return loss.clone(), rendering

    def _compared(
        self, chosen: Sequence[int] | Tensor, step: int, now: int | Tensor
    ) -> tuple[Tensor, Tensor, Rendering]:
        """The loss alone, and with all else that is minimised, and what was rendered; `now` is the step, too."""
        share = share_dropped(self.config, len(self.views))
        batch = Batch(
            chosen,
            self.model.degree(self.iteration),
            self._rays,
            self._bounds,
            dropped=dropped(len(self.model), share, self.config.seed, now, self.device) if share else None,
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
        """What the newest step minimised besides the loss, by name; they stay, whatever later steps do."""
        return {name: term.clone() for name, term in self._terms.items()}  # a recorded step writes where the last did

    @property
    def records(self) -> bool:
        """Whether the device makes steps by itself, as it was recorded to; they can be asked for one by one instead."""
        return self._recorded is not None

    @records.setter
    def records(self, wanted: bool) -> None:
        if wanted > self.records:
            raise SarsplatError("steps cannot be recorded here, or not any more; leave records as it is")
        self._recorded = self._recorded if wanted else None

    def _wants_plane_gradients(self, step: int) -> bool:
        return any(strategy.wants_plane_gradients(step) for strategy in self.strategies)

    def _recorder(self, loss: Loss | None) -> RecordedSteps[tuple[Tensor, Rendering, dict[str, Tensor]]] | None:
        """What records steps that are ours alone, where the device can and all that changes can be told."""
        recorder = recorder_for(next(iter(self.model.parameters.values())))
        law = scattering_named(self.config.scattering)
        ours = loss is None and law.__module__.startswith("sarsplat.")
        ours = ours and all(isinstance(one, Configured) and not one.acts_before() for one in self.strategies)
        views, rates = self._queue.size, len(self.model.parameters) + 2
        if recorder is None or not RecordedSteps.has_room(views, rates):
            return None
        if not ours or not self._observation.recordable or not isinstance(self.optimiser.stepper, EngineAdam):
            _log.info("steps are made launch by launch: only those of images, with nothing of one's own, are recorded")
            return None
        return RecordedSteps(recorder, views, rates)

    def _gather(self, step: int, rendering: Rendering) -> None:
        """Let strategies add up what they need of every step."""
        if self._wants_plane_gradients(step):
            seen = of_rows(rendering, lambda rows: rows[:, : len(self.model)])
            for strategy, state in zip(self.strategies, self._states, strict=True):
                strategy.gather(state, step, seen, self.images.grid)

    def _each_strategy(self, method: str, step: int, chosen: Sequence[int], rendering: Rendering) -> None:
        """Let all strategies act; what they remember of single Gaussians follows where others move rows."""
        info = Info(
            self.model,
            self.images,
            tuple(chosen),
            of_rows(rendering, lambda rows: rows[:, : len(self.model)]),
            self.model.degree(self.iteration),
            self._rays,
            self._bounds,
            self._generator,
        )
        for strategy, state in zip(self.strategies, self._states, strict=True):
            getattr(strategy, method)(self.model.parameters, self.optimiser, state, step, info)
            if (moves := self.optimiser.take_moves()) is not None:
                self.optimiser.constrain()
                source, kept = moves.clamp(min=0), moves >= 0
                for other in self._states:
                    if other is not state:
                        other.follow(source, kept)
                info = replace(info, rendering=of_rows(info.rendering, partial(_followed_in, source, kept)))

    @property
    def grid(self) -> ImageGrid:
        """Of the dataset's images; steps may look at coarser ones, `images`."""
        return self.model.frame.grid

    @property
    def views(self) -> tuple[View, ...]:
        """From where the training images were taken, as refined so far."""
        return self.images.views

    @property
    def _rays(self) -> RayGrid:
        config = self.config
        fine = self.model.levels.fine(self.iteration, config.fine_from)
        return RayGrid.for_image(self.images.grid, config.fine_rays_per_pixel if fine else config.rays_per_pixel)

    def check(self) -> None:
        """Wait for the device, and raise a SarsplatError if a step so far was given what it cannot render."""
        self._bounds.check()

    @property
    def learning_rates(self) -> dict[str, float]:
        """Of the next step, by parameter: of its first column; of means and shifts in m."""
        return self.optimiser.rates(self.iteration)

    @torch.no_grad()
    @checks_arguments
    def rendered(self, views: Sequence[View]) -> Float32[np.ndarray, "v rows columns"]:
        """β⁰ of any views as they are now, linear power, with the rays of the training."""
        degree, few, power = self.model.degree(self.iteration), self.config.views_per_step, self.model.power_channel
        images = [
            self.model.render(views[first : first + few], self.grid, degree, rays=self._rays)[0][:, power].cpu().numpy()
            for first in range(0, len(views), few)  # what a step takes fits into memory
        ]
        return np.concatenate(images or [np.empty((0, self.grid.rows, self.grid.columns), np.float32)])

    @property
    def gaussian_count(self) -> int:
        """Number of the target's Gaussians."""
        return len(self.model)

    @property
    def gaussians(self) -> Gaussians:
        """The target as it is now."""
        return self.model.target(self.model.degree(self.iteration)).detach()

    @checks_arguments
    def snapshot(self, seconds: float) -> Snapshot:
        """Everything the next step depends on, as it is now; `seconds` is how long the training took until here."""
        self.check()
        tensors = {"generator": self._generator.get_state(), **self.model.tensors()}
        tensors |= {f"optimiser/{name}": tensor for name, tensor in self.optimiser.tensors().items()}
        for strategy, state in zip(self.strategies, self._states, strict=True):
            tensors[f"strategy/{strategy.name}"] = torch.empty(
                0, dtype=torch.float32, device="cpu"
            )  # it is there, even without any state
            tensors |= {f"strategy/{strategy.name}/{name}": tensor for name, tensor in state.tensors().items()}
        return Snapshot(
            self.iteration,
            seconds,
            tuple(self._queue.waiting),
            self.grid,
            self.views,
            self.model.unit,
            self.images.brightest,
            stacks=self.model.frame.stacks,
            tensors={name: tensor.cpu().clone() for name, tensor in tensors.items()},
        )

    @checks_arguments
    def restore(self, snapshot: Snapshot) -> None:
        """Go back to the state of a snapshot.

        Raises a SarsplatError if it is of a training with other strategies, KeyError or ValueError if of no training.
        """
        if not snapshot.part("optimiser"):
            raise SarsplatError("it holds Gaussians that were not trained here, which cannot be resumed")
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


def _followed_in(source: Tensor, kept: Tensor, rows: Tensor) -> Tensor:
    return followed(rows.transpose(0, 1), source, kept).transpose(0, 1)


def _done(rendering: Rendering) -> Rendering:
    """What was rendered, without what the backward pass needed: strategies render anew, and need that memory."""
    return replace(
        rendering,
        images=rendering.images.detach(),
        cross_sections=rendering.cross_sections.detach(),
        echoes=tuple(one.detach() for one in rendering.echoes),
        ground=None if rendering.ground is None else rendering.ground.detach(),
    )
