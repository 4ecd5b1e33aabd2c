"""Training: how a scene advances by one step, and its whole state, exact to the bit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import RayGrid, View
from sarsplat.reconstruction import azimuths, relocation, texture
from sarsplat.reconstruction.config import Config, Surroundings
from sarsplat.reconstruction.density import DensityControl
from sarsplat.reconstruction.losses import ImageScale, Loss, named_loss, speckle_nats
from sarsplat.reconstruction.model import PER_GAUSSIAN, SceneModel
from sarsplat.reconstruction.optimiser import Optimiser
from sarsplat.reconstruction.saved_model import AZIMUTH_OFFSETS, region_tensors, saved_model
from sarsplat.reconstruction.snapshot import Snapshot
from sarsplat.reconstruction.texture import Texture
from sarsplat.renderer import channel_of

_FAINTEST = 1e-30
"""Largest β⁰ below which images count as black: squares and reciprocals of it would leave float32."""


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
        Where everything is computed and stays; a seed starts alike on every device.

    Raises
    ------
    SarsplatError
        If the training images are black.
    """

    def __init__(
        self, dataset: Dataset, config: Config, loss: Loss | None = None, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.device = torch.device(device)
        self.grid = dataset.grid
        train = dataset.select("train")
        self.azimuths = azimuths.Azimuths(train)
        self._looks = train.looks or 1.0
        power = torch.from_numpy(dataset.images("train"))
        if not float(power.max()) > _FAINTEST:
            raise SarsplatError(
                f"the training images of {dataset} are black everywhere (largest β⁰ {float(power.max()):.3g}); "
                "simulate or import again"
            )
        self._brightest = float(power.max())
        self._truth = power.to(self.device)
        self._numbers = torch.arange(len(self.views), device=self.device)
        self._generator = torch.Generator().manual_seed(config.seed)
        self.model = SceneModel.initial(config, dataset, self._generator, self.device)
        self._bounds = self.model.scene_bounds()  # which density control does not change
        self.optimiser = Optimiser(self.model.parameters, self.model.bounds, config, self.grid.cell_m)
        self.density = (
            DensityControl(config.densification, len(self.model), self.device) if config.densification else None
        )
        self._loss = loss or named_loss(config, ImageScale(self._brightest, self.model.unit))
        self._black_loss = _of_black(self._loss, self._truth[: config.views_per_step])
        self.iteration = 0
        self.terms: dict[str, Tensor] = {}
        self._queue: list[int] = []

    def step(self) -> Float32[Tensor, ""]:
        """One step of Adam on a few views; returns the loss, still on the device: nothing waits for a GPU.

        What it was given out of range on a GPU, `check` tells.
        """
        chosen = self._next_views()
        gather = self.density is not None and self.density.wanted(self.iteration)
        images, rendering = self.model.render(
            [self.views[i] for i in chosen],
            self.grid,
            self.model.degree(self.iteration),
            rays=self._rays,
            chips=torch.stack([self._numbers[i] for i in chosen]),
            plane_gradients=gather,
            bounds=self._bounds,
            left_out=self._left_out(),
        )
        truth = torch.stack([self._truth[i] for i in chosen])  # much faster than an index
        loss = self._loss(channel_of(images, self.model.power_channel), truth)
        if not isinstance(loss, Tensor) or loss.ndim != 0 or not loss.requires_grad or loss.is_complex():
            what = f"{tuple(loss.shape)} of {loss.dtype}" if isinstance(loss, Tensor) else type(loss).__name__
            raise SarsplatError(
                f"the loss returned {what}; it must return one real number, a tensor of shape () computed from the "
                "rendered images by torch"
            )
        total, penalty, self.terms = loss, self.model.penalty(), {}
        if penalty is not None:
            total = total + penalty
            self.terms["priors"] = penalty.detach()
        if self.config.scattering_penalty:
            spread = self.config.scattering_penalty * self._black_loss * self.model.scattering_spread()
            total = total + spread
            self.terms["scattering penalty"] = spread.detach()
        total.backward()
        if gather and self.density is not None:
            self.density.gather(rendering, self.grid)
        self.optimiser.step(self.iteration)
        self.iteration += 1
        if self.density is not None and self.density.due(self.iteration):
            self._densify(self.density)
        if relocation.due(self.config.relocation, self.iteration, self.config.iterations):
            self._relocate()
        if self.config.surroundings:
            self._look_around(self.config.surroundings)
        return loss.detach()

    @property
    def views(self) -> tuple[View, ...]:
        """From where the training images were taken, as far as is known by now."""
        return self.azimuths.views

    @property
    def _rays(self) -> RayGrid:
        """Coarse at first, finer towards the end."""
        config = self.config
        fine = self.iteration >= config.fine_from * config.iterations
        return RayGrid.for_image(self.grid, config.fine_rays_per_pixel if fine else config.rays_per_pixel)

    def check(self) -> None:
        """Wait for the device, and see that every step so far was given what it can render.

        Raises
        ------
        SarsplatError
            If not.
        """
        self._bounds.check()

    def _next_views(self) -> list[int]:
        """Every view once in a random order, then again."""
        count = min(self.config.views_per_step, len(self.views))
        while len(self._queue) < count:
            self._queue += torch.randperm(len(self.views), generator=self._generator, device="cpu").tolist()
        chosen, self._queue = self._queue[:count], self._queue[count:]
        return chosen

    def _left_out(self) -> Bool[Tensor, " n"] | None:
        """Gaussians that this step does without: the images must not hang on single ones."""
        if not self.config.dropout:
            return None
        chances = torch.rand(len(self.model), generator=self._generator, device="cpu")
        return (chances < self.config.dropout).to(self.device)

    @torch.no_grad()
    def _look_around(self, surroundings: Surroundings) -> None:
        """Now and then, what is not learned by steps: uncertain azimuths, and the texture."""
        if self.azimuths.uncertain and azimuths.due(surroundings, self.iteration, self.config.iterations):
            self.check()
            self.azimuths.refine(self._nats)
        if texture.due(surroundings, self.iteration, self.config.iterations):
            self.check()
            everyone = np.arange(len(self.views))
            ratio = torch.cat([measured / rendered for measured, rendered in self._bare(self.views, everyone)])
            self.model.texture = Texture.estimated(
                ratio, self.model.parameters["shift"].detach(), self.views, self.grid, surroundings
            )

    def _nats(self, views: Sequence[View], chips: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Negative log-likelihood of training chips seen from these views, nats."""
        found = [speckle_nats(rendered, measured).double().cpu() for measured, rendered in self._bare(views, chips)]
        return torch.cat(found).numpy() * self.grid.independent_samples * self._looks

    def _bare(self, views: Sequence[View], chips: Int64[np.ndarray, " n"]) -> Iterator[tuple[Tensor, Tensor]]:
        """Training chips and their renderings from these views, of their own shifts and gains, without texture."""
        degree, rays = self.model.degree(self.iteration), self._rays
        for first in range(0, len(views), self.config.views_per_step):  # what a step takes fits into memory
            some = slice(first, first + self.config.views_per_step)
            numbers = self._numbers[torch.from_numpy(chips[some]).to(self.device)]
            images, _ = self.model.render(
                views[some], self.grid, degree, rays=rays, chips=numbers, bounds=self._bounds, textured=False
            )
            yield self._truth[numbers] / self.model.unit, channel_of(images, self.model.power_channel) / self.model.unit

    def _densify(self, density: DensityControl) -> None:
        self.check()
        with torch.no_grad():
            gaussians = self.model.target(self.model.degree(self.iteration))
            source, kept, displacement, shrink = density.decide(gaussians, self.grid, self._generator)
            parameters = {
                name: tensor[source] if name in PER_GAUSSIAN else tensor
                for name, tensor in self.model.parameters.items()
            }
            parameters["means"] = parameters["means"] + displacement
            parameters["scales"] = parameters["scales"] * shrink[:, None]
        self._replace(parameters, torch.where(kept, source, -1))

    @torch.no_grad()
    def _relocate(self) -> None:
        self.check()
        idle, strong = relocation.pairs(self._cross_sections(), self.config.relocation.idle_share, self._generator)
        displacement, optical_depth = relocation.halve(self.gaussians, strong, self._generator)
        idle, strong = idle.to(self.device), strong.to(self.device)
        everyone = torch.arange(len(self.model), device=self.device)
        source = everyone.index_copy(0, idle, strong)
        parameters = {
            name: tensor[source] if name in PER_GAUSSIAN else tensor for name, tensor in self.model.parameters.items()
        }
        for rows, side in ((idle, displacement), (strong, -displacement)):
            parameters["means"][rows] += side
            parameters["optical_depth"][rows] = optical_depth
        self._replace(parameters, everyone.index_fill(0, torch.cat([idle, strong]), -1))

    def _cross_sections(self) -> Float[Tensor, " n"]:
        """Of the target's Gaussians, mean over the training views, m²."""
        total = torch.zeros(len(self.model), device=self.device)
        degree, rays = self.model.degree(self.iteration), self._rays
        for first in range(0, len(self.views), self.config.views_per_step):  # what a step takes fits into memory
            some = self.views[first : first + self.config.views_per_step]
            _, rendering = self.model.render(some, self.grid, degree, rays=rays, textured=False)
            sections = rendering.cross_sections[..., self.model.power_channel]
            total += sections[:, : len(total)].sum(0)  # the ground's come after the target's
        return total / len(self.views)

    def _replace(self, parameters: dict[str, Tensor], source: Int64[Tensor, " n"]) -> None:
        """Go on with other Gaussians; `source` is the row whose moments each inherits, or −1."""
        shared = self.model.texture
        self.model = SceneModel(self.config, self.model.setting, parameters, self.device)
        self.model.texture = shared
        self.model.constrain()
        self.optimiser = self.optimiser.rebuild(self.model.parameters, source)

    @property
    def learning_rates(self) -> dict[str, float]:
        """Of the next step, by parameter: of its first column; of means and shifts in m."""
        return self.optimiser.rates(self.iteration)

    @torch.no_grad()
    def rendered(self, views: Sequence[View]) -> Float32[np.ndarray, "v rows columns"]:
        """β⁰ of any views as they are now, linear power, with the rays of the training."""
        degree, some = self.model.degree(self.iteration), self.config.views_per_step
        power = self.model.power_channel
        images = [
            self.model.render(views[first : first + some], self.grid, degree, rays=self._rays)[0][:, power]
            .cpu()
            .numpy()
            for first in range(0, len(views), some)  # what a step takes fits into memory
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

    def snapshot(self, seconds: float) -> Snapshot:
        """Everything the next step depends on, as it is now; `seconds` is how long the training took until here.

        Raises
        ------
        SarsplatError
            If a step was given what it cannot render.
        """
        self.check()
        tensors = {f"model/{name}": tensor.detach() for name, tensor in self.model.parameters.items()}
        tensors |= {f"optimiser/{name}": tensor for name, tensor in self.optimiser.state().items()}
        tensors |= {"generator": self._generator.get_state(), **region_tensors(self.model.setting.region)}
        if self.model.texture is not None:
            tensors |= {f"texture/{name}": tensor for name, tensor in self.model.texture.tensors.items()}
        if self.azimuths.uncertain:
            tensors |= {AZIMUTH_OFFSETS: torch.from_numpy(self.azimuths.offset_deg)}
        if self.density:
            tensors |= {"density/gradient": self.density.gradient, "density/seen": self.density.seen}
        return Snapshot(
            self.iteration,
            seconds,
            tuple(self._queue),
            self.grid,
            self.views,
            self.model.unit,
            self._brightest,
            {name: tensor.cpu().clone() for name, tensor in tensors.items()},
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Undo `snapshot`."""
        self.model = saved_model(snapshot, self.config, self.device)
        self._bounds = self.model.scene_bounds()
        self.optimiser = Optimiser(self.model.parameters, self.model.bounds, self.config, self.grid.cell_m)
        self.optimiser.load_state(snapshot.part("optimiser"))
        self._generator.set_state(snapshot.tensors["generator"])
        if self.azimuths.uncertain:
            self.azimuths.correct(snapshot.tensors[AZIMUTH_OFFSETS].numpy())
        if self.density:
            density = snapshot.part("density")
            self.density.gradient, self.density.seen = (density[name].to(self.device) for name in ("gradient", "seen"))
        self.iteration, self._queue = snapshot.iteration, list(snapshot.queue)
        if not all(0 <= k < len(self.views) for k in self._queue):
            raise ValueError("it queues views that are not there")


@torch.no_grad()
def _of_black(loss: Loss, truth: Float32[Tensor, "v rows columns"]) -> Tensor:
    """The loss of black images, the unit of what else is minimised; 1 where it is no measure of distance."""
    value = loss(torch.zeros_like(truth), truth)
    if not isinstance(value, Tensor) or value.is_complex():  # the first step says so
        return truth.new_ones(())
    return torch.where(value.isfinite() & (value > 0), value, 1.0)
