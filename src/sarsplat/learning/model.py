"""The scene model: a list of parts with parameters, which make a scene and render its images."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.examination.plausible import warn
from sarsplat.gaussians import Gaussians, Ground, scattering_named
from sarsplat.gaussians.initialise import Region
from sarsplat.geometry import ImageGrid, RayGrid, Stack, Terrain, View
from sarsplat.learning.image_windows import Windows
from sarsplat.learning.parts import parts_of
from sarsplat.learning.parts.part import Learned, Parameters, Shot
from sarsplat.learning.parts.target import Target
from sarsplat.learning.scene_frame import Levels, SceneFrame
from sarsplat.learning.snapshot import Snapshot, fitting
from sarsplat.learning.stack_loss import ExpectedStacks
from sarsplat.regions.target_region import cut_off, levelled
from sarsplat.renderer import Bounds, Rendering, channel_of, render
from sarsplat.renderer.covariances import lit_planes
from sarsplat.renderer.echoes import Echo
from sarsplat.settings.config import Config
from sarsplat.tiles import at_once, render_tiled

_MAX_BATCH = 8  # views
_REGION = ("normals", "offsets", "low", "high")


class SceneModel:
    """Parameters of a scene, with the parts that render images from them.

    `config` selects the parts, `frame` holds what the dataset fixes. The `parameters` that the parts declare are copied
    to leaves on the device, which row operations may replace; raises ValueError or KeyError if they do not fit.
    """

    def __init__(
        self, config: Config, frame: SceneFrame, parameters: Parameters, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.frame = frame
        self.unit = frame.unit
        self.device = torch.device(device)
        self.parts = parts_of(config, frame, self.device)
        self.target_part = next(part for part in self.parts if isinstance(part, Target))
        self.levels = Levels.of(config, frame)
        self.windows: Windows | None = None
        self.learned = self._learned()
        self.parameters: Parameters = {}
        count = len(parameters[self.rows[0]])
        for name, learned in self.learned.items():
            shape = [count if size is None else size for size in learned.shape]
            tensor = fitting(parameters, name, torch.float32, shape).detach()
            own = tensor.to(device, copy=True, memory_format=torch.contiguous_format)
            self.parameters[name] = own.requires_grad_()

    @classmethod
    def initial(
        cls, config: Config, dataset: Dataset, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> "SceneModel":
        """Return the initial model; warn if a part of the target lies outside of the box of the Gaussians.

        `generator` is on the CPU, so that a seed gives the same model on every device.
        """
        frame, train = SceneFrame.of(config, dataset), levelled(dataset.select("train"))
        parameters: Parameters = {}
        if config.ground or config.surroundings or config.target_box or dataset.target_box_m:
            warn(cut_off(frame.region, config.margin * frame.cell_m, dataset))
        for part in parts_of(config, frame, torch.device("cpu")):
            parameters |= part.initial(train, generator)
        return cls(config, frame, parameters, device)

    @classmethod
    def saved(cls, snapshot: Snapshot, config: Config, device: torch.device | str = "cpu") -> "SceneModel":
        """Return the model that a snapshot holds (`tensors`).

        Raises ValueError, KeyError, TypeError, IndexError, RuntimeError or SarsplatError if the tensors are not those
        of a model with this configuration.
        """
        arrays = [snapshot.tensors[f"region/{name}"].numpy() for name in _REGION]
        if arrays[0].shape != (len(arrays[1]), 3) or arrays[2].shape != (3,) or arrays[3].shape != (3,):
            raise ValueError(f"a region of {[array.shape for array in arrays]}")
        kept = snapshot.part("terrain")
        terrain = Terrain(kept["heights_m"].numpy(), tuple(kept["pitch_m"].tolist())) if kept else None
        frame = SceneFrame(Region(*arrays), snapshot.unit, snapshot.views, snapshot.grid, terrain, snapshot.stacks)
        learned = snapshot.part("model")
        model = cls(config, frame, learned, device)
        others = [learned[name] for name, how in model.learned.items() if not how.per_gaussian]
        if not all(tensor.isfinite().all() for tensor in (*others, *snapshot.part("part").values())):
            raise ValueError("numbers that are not finite")
        for part in model.parts:
            part.load({name: t.to(model.device) for name, t in snapshot.part(f"part/{part.name}").items()})
        model.target(config.harmonics_degree)  # checks the Gaussians' values
        return model

    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the model by name, to be saved."""
        region = {f"region/{name}": torch.from_numpy(getattr(self.frame.region, name)) for name in _REGION}
        learned = {f"model/{name}": tensor.detach() for name, tensor in self.parameters.items()}
        state = {f"part/{part.name}/{name}": tensor for part in self.parts for name, tensor in part.state().items()}
        kept = learned | state | region
        if (terrain := self.frame.terrain) is not None:
            kept["terrain/heights_m"] = torch.from_numpy(terrain.heights_m)
            kept["terrain/pitch_m"] = torch.tensor(terrain.pitch_m, dtype=torch.float64)
        return kept

    def __len__(self) -> int:
        """Number of the target's Gaussians."""
        return len(self.parameters[self.rows[0]])

    @property
    def rows(self) -> list[str]:
        """Names of the parameters with a row for each Gaussian."""
        return [name for name, learned in self.learned.items() if learned.per_gaussian]

    @property
    def power_channel(self) -> int:
        """Index of the image channel that is shown, scored and trained on: β⁰."""
        return scattering_named(self.config.scattering).power_channel

    def look_at(self, cell_m: float) -> None:
        """Set the resolution cell of the images to fit, m; updates `learned`."""
        for part in self.parts:
            part.look_at(cell_m)
        self.learned = self._learned()

    def look_through(self, windows: Windows) -> None:
        """Fit windows of the images and freeze parameters that are not per Gaussian; updates `learned`."""
        self.windows, self.learned = windows, self._learned()

    def _learned(self) -> dict[str, Learned]:
        """Parameters of all parts; in windows, those that are not per Gaussian are frozen."""
        learned = {name: how for part in self.parts for name, how in part.learned.items()}
        if self.windows is None:
            return learned
        return {name: how if how.per_gaussian else replace(how, rates=(0.0,)) for name, how in learned.items()}

    def copy(self, *, ground: bool = True) -> "SceneModel":
        """Copy the scene and its tensors, with or without the surroundings of the target."""
        copied = SceneModel(self.config, self.frame, self.parameters, self.device)
        copied.parts = [copy(part) for part in self.parts if ground or not part.surrounds]
        return copied

    def degree(self, iteration: int) -> int:
        """Degree of the harmonics in use at an iteration."""
        config = self.config
        degree = min(config.harmonics_degree, iteration // config.harmonics_every)
        while degree and config.views_per_coefficient * (degree + 1) ** 2 >= len(self.frame.views):
            degree -= 1
        return degree

    def target(self, degree: int, dropped: Bool[Tensor, " n"] | None = None) -> Gaussians:
        """The target's Gaussians but those `dropped`, differentiable with respect to the parameters."""
        return self.target_part.gaussians(self.parameters, degree, dropped)

    def ground(self) -> Ground | None:
        """Plane or terrain on which rays end, γ⁰ in the model's unit; None without ground."""
        return next((ground for part in self.parts if (ground := part.ground(self.parameters)) is not None), None)

    def echoes(self) -> list[Echo]:
        """Echoes besides the direct one and the ground's."""
        return [echo for part in self.parts for echo in part.echoes(self.parameters)]

    @property
    def scenes_rendered(self) -> int:
        """Memory of a rendering, in scenes: each echo adds the scene and its mirror image."""
        return 1 + 2 * len(self.echoes())

    def _refuse_echoes(self, rendering: str) -> None:
        """Raise if a part has an echo, which this kind of rendering cannot include."""
        if self.echoes():
            raise SarsplatError(f"a part of the model has an echo, which {rendering} cannot have; leave out that part")

    def render(
        self,
        views: Sequence[View],
        grid: ImageGrid,
        degree: int,
        *,
        rays: RayGrid | None = None,
        numbers: Int64[Tensor, " v"] | None = None,
        plane_gradients: bool = False,
        bounds: Bounds | None = None,
        amplitudes: Float[Tensor, "v n c"] | None = None,
        dropped: Bool[Tensor, " n"] | None = None,
        estimated: bool = True,
    ) -> tuple[Float[Tensor, "v c {grid.rows} {grid.columns}"], Rendering]:
        """Render images [V, C, rows, columns], with noise floor in the power channel; also return the `Rendering`.

        With `numbers` of training images, their window, shift and gain apply; without, images are the expectation of
        unseen views (`Shot`). `bounds` and `amplitudes` are those of `render`; `estimated=False` omits parts that are
        estimated rather than learned, such as the texture.
        """
        shot = self.shot(views, grid, numbers)
        how: dict[str, Any] = {
            "rays": rays,
            "shift": shot.shift,
            "ground": self.ground(),
            "echoes": self.echoes(),
            "plane_gradients": plane_gradients,
            "bounds": bounds,
            "amplitudes": amplitudes,
        }
        scene = self.target(degree, dropped)
        if self.windows is None or numbers is None:
            rendering = render(scene, views, shot.grid, **how)
        else:
            rendering = self.windows.render(scene, views, shot.grid, numbers.tolist(), **how)
        return self.developed(rendering.images, shot, estimated), rendering

    @torch.no_grad()
    def power_by_echo(self, degree: int) -> dict[str, float]:
        """Share of each kind of echo (target, ground, …) in the power of the training views."""
        ground, echoes = self.ground(), self.echoes()
        ways = ([] if ground is None else ["ground"]) + [echo.way for echo in echoes]
        scene, powers = self.target(degree), dict.fromkeys(["target", *ways], 0.0)
        for view in self.frame.views:  # one at a time, to save memory
            rendering = render(scene, [view], self.frame.grid, ground=ground, echoes=echoes)
            powers["target"] += float(rendering.channel(self.power_channel).double().sum())
            for way, returned in zip(ways, rendering.echoes, strict=True):
                power = float(returned.double().sum())
                powers[way] += power
                powers["target"] -= power
        total = sum(powers.values())
        return {way: power / total for way, power in powers.items()} if total else {}

    def covariances(
        self,
        views: Sequence[View],
        stacks: Sequence[Stack],
        grid: ImageGrid,
        degree: int,
        *,
        rays: RayGrid | None = None,
        numbers: Int64[Tensor, " v"] | None = None,
        dropped: Bool[Tensor, " n"] | None = None,
    ) -> tuple[ExpectedStacks, Rendering]:
        """Render covariances between channels, with noise, in the model's unit; otherwise like `render`.

        The images of the `Rendering` are the mean power of the channels, without noise.
        """
        self._refuse_echoes("covariances of stacks")
        shot = self.shot(views, grid, numbers)
        scene = self.target(degree, dropped)
        planes, sections, lit = lit_planes(scene, views, shot.grid, stacks, rays=rays, shift=shot.shift)
        power = planes.powers.detach()[:, list(planes.of_channels)].mean(1, keepdim=True)
        rendering = Rendering(power, sections[..., None], lit)
        noise = [noise for part in self.parts if (noise := part.noise(shot, self.parameters)) is not None]
        phases = [phases for part in self.parts if (phases := part.phases(shot, self.parameters)) is not None]
        return ExpectedStacks(planes, noise[0] if noise else None, phases[0] if phases else None), rendering

    @torch.no_grad()
    def unseen(
        self, views: Sequence[View], grid: ImageGrid, degree: int, rays: RayGrid
    ) -> Float32[np.ndarray, "v {grid.rows} {grid.columns}"]:
        """β⁰ of unseen views, rendered in batches; images too large for memory by tiles."""
        scene, images = self.target(degree), np.empty((len(views), grid.rows, grid.columns), np.float32)
        size = -(-min(at_once(scene, views, grid, rays), _MAX_BATCH) // self.scenes_rendered)
        for first in range(0, len(views), max(size, 1)):
            batch = slice(first, first + max(size, 1))
            if size:
                rendered, _ = self.render(views[batch], grid, degree, rays=rays)
            else:
                self._refuse_echoes("an image that is rendered by tiles")
                shot = self.shot(views[batch], grid)
                shift = None if shot.shift is None else shot.shift[0]
                image = render_tiled(scene, views[first], shot.grid, rays=rays, shift=shift, ground=self.ground())
                rendered = self.developed(image[None], shot)
            images[batch] = channel_of(rendered, self.power_channel).cpu().numpy()
        return images

    def developed(
        self, images: Float[Tensor, "v c h w"], shot: Shot, estimated: bool = True
    ) -> Float[Tensor, "v c h w"]:
        """Images after every part has altered them (texture, noise floor, …), in the dataset's unit."""
        for part in self.parts:
            if estimated or not part.estimated:
                images = part.images(images, shot, self.parameters)
        return images if self.unit == 1 else images * self.unit

    def shot(
        self,
        views: Sequence[View],
        grid: ImageGrid,
        numbers: Int64[Tensor, " v"] | None = None,
        rng: np.random.Generator | None = None,
    ) -> Shot:
        """Imaging conditions of these views (shift, gain, …), set by the parts."""
        shot = Shot(views, grid, self.power_channel, numbers, rng)
        for part in self.parts:
            shot = part.shot(shot, self.parameters)
        return shot

    def as_displaced(self, grid: ImageGrid) -> ImageGrid:
        """Grid on which an undisplaced scene appears where unseen images on `grid` show it: moved by the mean shift."""
        for part in self.parts:
            grid = part.displaced(grid, self.parameters)
        return grid

    def penalty(self) -> Float[Tensor, ""] | None:
        """Negative log prior of the parameters, nats per independent image sample; None without priors."""
        terms = [term for part in self.parts for term in part.nats(self.parameters)]
        return torch.stack(terms).sum() / self.frame.samples if terms else None

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        """Penalties by name, in units of the loss of black images, or in nats per pixel."""
        return dict(term for part in self.parts for term in part.penalties(self.parameters))
