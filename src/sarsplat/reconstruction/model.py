"""What is learned: the target's Gaussians and, on measured chips, ground, side lobes, noise floor, shifts and gains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.data.plausible import warn
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import SCATTERINGS, Gaussians, Scattering, join
from sarsplat.gaussians.ground import ground_radius_m, ground_sheet
from sarsplat.gaussians.initialise import BRIGHT_DB, Region, bounded_region, hemisphere_shell, random_quaternions
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.radiometry import beta0_of_gamma0, brighter
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.lengths import scales_m
from sarsplat.reconstruction.side_lobes import with_side_lobes
from sarsplat.reconstruction.target_box import target_box
from sarsplat.reconstruction.texture import Texture
from sarsplat.renderer import Bounds, Rendering, render
from sarsplat.scenes.mesh_files import read_mesh

PER_GAUSSIAN = ("means", "quaternions", "scales", "optical_depth", "scattering")
"""Parameters with one row for each Gaussian; the others are nuisances of measured data."""

LOGARITHMIC = ("scales", "optical_depth")
"""Positive ones, which move by factors: what is stepped is their logarithm."""

LENGTHS = ("means", "shift")
"""Lengths that are stepped themselves, m: their rates are in resolution cells."""

PRIORS = {"shift": "shift_std", "log_gain": "gain_std", "ground_texture": "ground_std"}
"""Parameters that are expected near zero, and the setting that says how near; with 0 they stay there."""

_MIN_OPTICAL_DEPTH = 1e-3

_FAINT = 0.05
"""Optical depth that is hardly noticed."""

_PER_CELL = 18
"""Gaussians for a resolution cell that the target covers in an image."""

_FEWEST = 100

_START = (1.0, 1.0, 0.9)
"""Widths of an oriented Gaussian at the start, relative: which axis is the shortest must not hang on rounding."""

_ALIKE = 0.6
"""Parameters of the scattering that differ by less are alike; how much more others differ hardly matters."""


@dataclass(frozen=True)
class Setting:
    """What the dataset fixes about the learned scene.

    Parameters
    ----------
    region : Region
        The space the target may occupy.
    unit : float
        Power that counts as 1: every γ⁰, the noise floor and P_min are in this unit. β⁰ itself, or with surroundings,
        calibrated or not, the training set's mean.
    ground_radius_m : float
        Radius of the ground that the images show, m; used with surroundings only.
    cell_m : float
        Resolution cell of the images, m: lengths in configurations are multiples of it.
    views : int
        How many training images there are.
    samples : float
        Independent samples of speckle in all of them.
    """

    region: Region
    unit: float
    ground_radius_m: float
    cell_m: float
    views: int
    samples: float

    @classmethod
    def of(cls, config: Config, dataset: Dataset) -> Setting:
        """The setting of a configuration on a dataset."""
        train = dataset.select("train")
        if not config.surroundings:
            return cls.seen(bounded_region(train.power, train.views, train.grid), 1.0, train.views, train.grid)
        box = Region.box(*(dataset.target_box_m or target_box(train.power, train.views, train.grid)))
        return cls.seen(box, float(train.power.mean(dtype=np.float64)), train.views, train.grid)

    @classmethod
    def seen(cls, region: Region, unit: float, views: Sequence[View], grid: ImageGrid) -> Setting:
        """The setting of a region in images from these views."""
        samples = len(views) * grid.independent_samples
        return cls(region, unit, ground_radius_m(views, grid), grid.cell_m, len(views), samples)


class SceneModel:
    """Learned tensors and how they make a scene.

    Parameters
    ----------
    config : Config
        The reconstruction's configuration.
    setting : Setting
        What the dataset fixes.
    parameters : dict of str to Tensor
        See `PER_GAUSSIAN`; with `config.surroundings` also `noise`, `shift` [V, 2], `log_gain` [V] and, unless they are
        switched off, `ground` [K], `ground_texture` [G, 1] and `log_side_lobes` [2].
    device : torch.device or str
        Where the parameters are copied to, and rendered.

    Attributes
    ----------
    texture : Texture or None
        Factor on the images that the training chips share with their neighbours, where it has been estimated.
    """

    def __init__(
        self,
        config: Config,
        setting: Setting,
        parameters: dict[str, Tensor],
        device: torch.device | str = "cpu",
    ) -> None:
        self.config = config
        self.setting = setting
        self.unit = setting.unit
        self.device = torch.device(device)
        n = len(parameters["means"])
        self._law = _law(config, 1, 0.0)
        columns = self._law.parameters.shape[1:]
        if parameters["scattering"].shape[1:] != columns:
            raise ValueError(f"{config.scattering} have {columns} columns, not {list(parameters['scattering'].shape)}")
        for name in PER_GAUSSIAN:
            if parameters[name].dtype != torch.float32 or len(parameters[name]) != n:
                raise ValueError(f"{name} is {parameters[name].dtype} {list(parameters[name].shape)}")
        self.parameters = {
            name: tensor.detach().to(device, copy=True, memory_format=torch.contiguous_format).requires_grad_()
            for name, tensor in parameters.items()
        }
        sheet = _ground(config, setting)
        self._ground = None if sheet is None else sheet.to(self.device)
        self.texture: Texture | None = None

    @classmethod
    def initial(
        cls, config: Config, dataset: Dataset, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> SceneModel:
        """The state training starts from; warns if a given region leaves out a part of the true target.

        `generator` is one of the CPU: a seed starts alike on every device.
        """
        setting, train = Setting.of(config, dataset), dataset.select("train")
        if config.surroundings:
            warn(_cut_off(setting.region, config.margin * setting.cell_m, dataset))
        sample = hemisphere_shell if config.initialisation == "hemisphere" else Region.sample
        n = config.gaussians or _enough(train)
        means = torch.from_numpy(
            sample(setting.region, n, generator)
        ).float()  # on the CPU, as all that is made like it
        parameters = {
            "means": means,
            "quaternions": random_quaternions(n, generator),
            "scales": means.new_tensor(_start_scales_m(config, setting.cell_m)).repeat(n, 1),
            "optical_depth": means.new_full((n,), config.initial_optical_depth),
            "scattering": _law(config, n, config.initial_scattering).parameters,
        }
        if config.surroundings:
            parameters |= {
                "noise": means.new_tensor([math.log(config.surroundings.noise_floor)]),
                "shift": means.new_zeros(len(train), 2),
                "log_gain": means.new_zeros(len(train)),
            }
            if (sheet := _ground(config, setting)) is not None:
                mean_tangent = float(np.mean([beta0_of_gamma0(1.0, view.grazing_deg) for view in train.views]))
                # γ⁰ of single-look clutter, from its median
                level = float(np.median(train.power)) / setting.unit / math.log(2) / mean_tangent
                parameters["ground"] = _law(config, 1, level).parameters[0]
                parameters["ground_texture"] = means.new_zeros(len(sheet), 1)
            if config.surroundings.side_lobes:
                parameters["log_side_lobes"] = means.new_full((2,), math.log(config.surroundings.side_lobes))
        return cls(config, setting, parameters, device)

    def __len__(self) -> int:
        return self.parameters["means"].shape[0]

    def copy(self, *, ground: bool = True) -> SceneModel:
        """The same scene in tensors of its own, with or without its ground."""
        copied = SceneModel(self.config, self.setting, self.parameters, self.device)
        copied.texture = self.texture  # which is replaced, never changed
        copied._ground = copied._ground if ground else None
        return copied

    def degree(self, iteration: int) -> int:
        """Degree of the harmonics in use at an iteration."""
        config = self.config
        degree = min(config.harmonics_degree, iteration // config.harmonics_every)
        while degree and config.views_per_coefficient * (degree + 1) ** 2 >= self.setting.views:
            degree -= 1
        return degree

    def target(self, degree: int) -> Gaussians:
        """The target's Gaussians, differentiable with respect to the parameters."""
        p = self.parameters
        law = self._scattering(p["scattering"], degree)
        return Gaussians(p["means"], p["quaternions"], p["scales"], p["optical_depth"], law)

    def scene(self, degree: int) -> Gaussians:
        """Target and, where there is one, ground."""
        target = self.target(degree)
        if self._ground is None:
            return target
        uniform = self.parameters["ground"].expand(len(self._ground), -1)
        # only its level is learned: chips of one grazing angle cannot tell how γ⁰ goes on at others
        level = torch.cat([uniform[:, :1] + self.parameters["ground_texture"], uniform[:, 1:].detach()], dim=1)
        return join(target, replace(self._ground, scattering=self._scattering(level, degree)))

    def _scattering(self, parameters: Float[Tensor, "n k"], degree: int) -> Scattering:
        return replace(self._law, parameters=parameters).detailed(degree)

    def render(
        self,
        views: Sequence[View],
        grid: ImageGrid,
        degree: int,
        *,
        rays: RayGrid | None = None,
        chips: Int64[Tensor, " v"] | None = None,
        plane_gradients: bool = False,
        bounds: Bounds | None = None,
        left_out: Bool[Tensor, " n"] | None = None,
        textured: bool = True,
    ) -> tuple[Float[Tensor, "v c {grid.rows} {grid.columns}"], Rendering]:
        """Images [V, C, rows, columns], in the power channel with noise floor, and the rendering behind them.

        `chips` are the indices of training views, whose own shift and gain then apply. Of an unseen chip only the
        distribution of its shift and gain is known: its expected image is seen through a response widened by that
        spread, above the expected floor. `bounds` are those of `render`; `left_out` are Gaussians to do without;
        `textured` is whether the texture is applied.
        """
        scene = self.scene(degree)
        if left_out is not None:
            scene = replace(scene, optical_depth=self._made_up_for(scene.optical_depth, left_out))
        if not self.config.surroundings:
            rendering = render(scene, views, grid, rays=rays, plane_gradients=plane_gradients, bounds=bounds)
            return rendering.images if self.unit == 1 else rendering.images * self.unit, rendering
        p, gain = self.parameters, self.gains
        if chips is None:
            grid = grid.widened(*p["shift"].detach().var(dim=0, correction=0).tolist())
            shift = p["shift"].mean(0).expand(len(views), 2)
        else:
            shift = p["shift"][chips]
        rendering = render(scene, views, grid, rays=rays, shift=shift, plane_gradients=plane_gradients, bounds=bounds)
        images, floor = rendering.images, p["noise"].exp()
        if "log_side_lobes" in p:
            images = with_side_lobes(images.flatten(0, 1), p["log_side_lobes"].exp(), grid).view_as(images)
        if chips is None:
            floor = floor * gain.reciprocal().mean()
        else:  # not by `render`, which would look at its values, and a GPU would be waited for
            # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
            images = images * gain[chips, None, None, None].expand(-1, images.shape[1], 1, grid.columns)
        # expanded, so that its gradient is summed column by column
        images = images + (floor * self._power(images)).expand(-1, 1, grid.columns)
        if self.texture is not None and textured:
            factor = self.texture.factor(views, grid) if chips is None else self.texture.among_chips[chips]
            images = images * factor[:, None]
        return images if self.unit == 1 else images * self.unit, rendering

    @property
    def power_channel(self) -> int:
        """The channel of the images that is shown, scored and trained on."""
        return self._law.power_channel

    def _power(self, images: Float[Tensor, "v c rows columns"]) -> Float[Tensor, "c 1 1"]:
        """1 for the power channel, 0 for the others."""
        channels = torch.arange(images.shape[1], device=images.device)
        return (channels == self.power_channel).to(images)[:, None, None]

    @property
    def gains(self) -> Float[Tensor, " v"]:
        """Of the training chips' power; of mean 1."""
        return torch.softmax(self.parameters["log_gain"], dim=0) * len(self.parameters["log_gain"])

    def _made_up_for(self, optical_depth: Float[Tensor, " n"], left_out: Bool[Tensor, " m"]) -> Float[Tensor, " n"]:
        """Optical depths without the target's Gaussians that are left out; all others of it have more for that."""
        target, ground = optical_depth[: len(self)], optical_depth[len(self) :]
        more = (target / (1 - self.config.dropout)).clamp(max=self.config.max_optical_depth)
        return torch.cat([torch.where(left_out, 0.0, more), ground])

    def as_displaced(self, grid: ImageGrid) -> ImageGrid:
        """The grid on which a scene that is not displaced lies as unseen chips on `grid` show it: as the mean one."""
        if not self.config.surroundings:
            return grid
        azimuth, slant_range = self.parameters["shift"].detach().mean(0).tolist()
        return replace(grid, center_m=(grid.center_m[0] - azimuth, grid.center_m[1] - slant_range))

    def scattering_spread(self) -> Float[Tensor, ""]:
        """How much the Gaussians' scattering differs: of small differences the variance, of large ones little more.

        The negative logarithm of Student's t-distribution, up to factors: most Gaussians are alike, some are not.
        """
        parameters = self.parameters["scattering"]
        difference = parameters - _column_means(parameters.detach())
        return _ALIKE**2 * _column_means(torch.log1p((difference / _ALIKE) ** 2)).sum()

    def penalty(self) -> Float[Tensor, ""] | None:
        """How unlikely the parameters were before the images were seen, nats per independent sample of those."""
        p, surprises = self.parameters, []
        if self.config.sparsity:
            filled = torch.log1p(p["optical_depth"] / _FAINT)
            surprises.append(self.config.sparsity * len(filled) * _column_means(filled[:, None]).sum())
        if self.config.surroundings:
            for name, std in PRIORS.items():
                spread = getattr(self.config.surroundings, std) * (self.setting.cell_m if name in LENGTHS else 1)
                if spread and name in p:
                    deviations = p[name].reshape(len(p[name]), -1) / spread
                    surprises.append(len(deviations) * _column_means(deviations**2).sum() / 2)
        if self.config.directional_std is not None and p["scattering"].shape[1] > 1:
            uniform = self._scattering(p["scattering"].detach(), 0)
            upwards = p["means"].new_tensor([[0.0, 0.0, 1.0]])
            level = uniform.amplitudes(upwards, p["quaternions"], p["scales"])[0, :, uniform.power_channel]
            deviations = p["scattering"][:, 1:] / (self.config.directional_std * level[:, None].detach())
            surprises.append(len(deviations) * _column_means(deviations**2).sum() / 2)
        return torch.stack(surprises).sum() / self.setting.samples if surprises else None

    @cached_property
    def bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Smallest and largest values of parameters that have any, by name; one number, or one for each column."""
        config = self.config
        low, high = (corner.to(self.device) for corner in self._box())
        scales = torch.tensor(scales_m(config, self.setting.cell_m), device=self.device)
        depths = torch.tensor([_MIN_OPTICAL_DEPTH, config.max_optical_depth], device=self.device)
        return {
            "means": (low, high),
            "scales": (scales[0], scales[2]),
            "optical_depth": (depths[0], depths[1]),
        }

    def _box(self) -> tuple[Tensor, Tensor]:
        """Corners [3] of where the target's centres may be, m, on the CPU."""
        region = self.setting.region
        low, high = (torch.from_numpy(corner).float() for corner in (region.low, region.high))
        if self.config.initialisation == "hemisphere":  # the shell reaches beyond the region
            half = (high - low).norm() / 2
            centre = (low + high) / 2
            low, high = torch.minimum(low, centre - half), torch.maximum(high, centre + half)
        margin = self.config.margin * self.setting.cell_m
        return low - margin, high + margin

    def scene_bounds(self) -> Bounds:
        """What target and ground keep as long as parameters are brought into `bounds`, and when training begins."""
        config = self.config
        low, high = self._box()
        scale_m = max(scales_m(config, self.setting.cell_m))
        optical_depth = max(config.max_optical_depth, config.initial_optical_depth)
        if (ground := _ground(config, self.setting)) is not None:
            low = torch.minimum(low, ground.means.amin(0))
            high = torch.maximum(high, ground.means.amax(0))
            scale_m = max(scale_m, float(ground.scales.max()))
            optical_depth = max(optical_depth, float(ground.optical_depth.max()))
        return Bounds((*low.tolist(),), (*high.tolist(),), scale_m, optical_depth, self.device)

    @torch.no_grad()
    def constrain(self) -> None:
        """Bring every parameter into its bounds."""
        for name, (low, high) in self.bounds.items():
            self.parameters[name].clamp_(low, high)


def _column_means(table: Float[Tensor, "n k"]) -> Float[Tensor, " k"]:
    """The mean of each column; never of one alone, which torch would split by threads."""
    columns = table.shape[1]
    return table.expand(-1, max(columns, 2)).mean(0)[:columns]


def _enough(train: Dataset) -> int:
    """How many Gaussians a target of this size needs, seen at this resolution."""
    bright = brighter(train.power, BRIGHT_DB).sum() / len(train)
    cells = bright * math.prod(train.grid.spacing_m) / train.grid.cell_m**2
    return max(_FEWEST, round(_PER_CELL * cells))


def _ground(config: Config, setting: Setting) -> Gaussians | None:
    """The ground, where there is one, on the CPU."""
    if config.surroundings is None or config.surroundings.ground_pitch == 0:
        return None
    return ground_sheet(setting.ground_radius_m, config.surroundings.ground_pitch * setting.cell_m)


def _start_scales_m(config: Config, cell_m: float) -> list[float]:
    """Standard deviations of a Gaussian at the start, m."""
    smallest, first, _ = scales_m(config, cell_m)
    if not SCATTERINGS[config.scattering].oriented:
        return [first] * 3
    return [max(share * first, min(smallest, first)) for share in _START]


def _law(config: Config, count: int, gamma0: float) -> Scattering:
    """The configuration's law of scattering, as a training starts with it."""
    return SCATTERINGS[config.scattering].initial(count, gamma0, config.p_min).detailed(config.harmonics_degree)


def _cut_off(region: Region, margin: float, dataset: Dataset) -> list[str]:
    """What of the true target lies outside; a list of one sentence, or empty."""
    if dataset.truth_mesh is None:
        return []
    try:
        vertices = np.asarray(read_mesh(dataset.truth_mesh).vertices)
    except (ImportError, SarsplatError):  # training does not need it; evaluation, which does, says what is wrong
        return []
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if (low >= region.low - margin).all() and (high <= region.high + margin).all():
        return []

    def spans(low: np.ndarray, high: np.ndarray) -> str:
        return ", ".join(f"{name} {a:.3g} … {b:.3g}" for name, a, b in zip("xyz", low, high, strict=True))

    return [
        f"the target ({spans(low, high)} m) is larger than the box it is looked for in "
        f"({spans(region.low, region.high)} m) and will be cut off; widen target_box_m in the dataset, or simulate "
        "without ground for the preset default"
    ]
