"""SAR-NeRF: a field of attenuation and scattering, imaged along rays in azimuth, range and elevation.

`docs/concepts/baselines-sar-nerf.md` has both image equations ("published" and "sound") and all choices.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from msgspec import Meta
from torch import Tensor
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from sarsplat.baselines.baseline import Baseline, BaselineConfig, Scene
from sarsplat.baselines.fields import Field, Perceptron, Rays, isosurface, level_of_half
from sarsplat.baselines.method import BaselineMethod
from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.geometry.view import ground_radius_m
from sarsplat.settings.kinds import Count, Positive

_CLEAR = -4.0  # bias of the attenuation's activation: initially e⁻⁴ per resolution cell, which is transparent
_DIM = -2.0  # bias of the scattering's activation
_SOFTENED = 1e-3  # amplitude, relative to the brightest, below which roots of powers are softened
_FLOOR = 1e-4  # power, relative to the brightest, added to images without ground in the speckle's likelihood
_LEAST_NOISE = 1e-3  # power, relative to the mean, added to images with ground in the speckle's likelihood
_FIRST_NOISE = 0.05  # initial noise floor, relative to the mean power
_NOISE_RATE = 2e-3  # maximum learning rate of the noise floor: a faster one explains the clutter before the ground does


@dataclass(frozen=True)
class SarNerfConfig(BaselineConfig):
    """Settings of SAR-NeRF with its multi-layer perceptron."""

    mode: Literal["published", "sound"] = "published"
    """"published": the paper's image equation and loss; "sound": equations in metres, and a likelihood of speckle."""
    rays: Annotated[int, Meta(ge=1, le=1000)] = 20
    """Number of rays in elevation for each azimuth column; if sound, over ground at least one per resolution cell."""
    iterations: Count = 250_000
    checkpoint_every: Count = 10
    learning_rate: Positive = 5e-4
    """Learning rate of Adam; it falls tenfold in the whole training."""
    surface_voxels: Annotated[int, Meta(ge=4, le=1024)] = 256
    """Number of voxels along the longest side of the surface's box."""


class SarNerf(Baseline):
    """SAR-NeRF on a scene.

    The field is limited to the target's box and, with ground, the box of all visible ground; the published perceptron's
    is unlimited.
    """

    start: tuple[float, float] = (0.0, 0.0)
    """Biases of attenuation and scattering in the published activations."""

    endless: bool = True
    """True if the published field is not limited to its boxes."""

    def __init__(self, scene: Scene, config: SarNerfConfig) -> None:
        super().__init__(scene, config)
        self._boxes = scene_boxes(scene)
        self.low_m = np.min([low for low, _ in self._boxes], axis=0)
        self.high_m = np.max([high for _, high in self._boxes], axis=0)
        self._sound = config.mode == "sound"
        self._speckled = self._sound and scene.looks is not None
        self._endless = self.endless and not self._sound
        self.field = self._new_field()
        self.log_noise: torch.nn.Parameter | None = None
        if self._speckled and scene.ground:
            self.log_noise = torch.nn.Parameter(torch.tensor(math.log(_FIRST_NOISE), dtype=torch.float32))

    def _new_field(self) -> Field:
        """Make the initial field; the published one is neither centred nor scaled."""
        generator = torch.Generator().manual_seed(self.config.seed)
        if self._sound:
            side = self.high_m - self.low_m
            return Perceptron((self.low_m + self.high_m) / 2, float(side.max()) / 2, generator)
        return Perceptron(np.zeros(3), 1.0, generator)

    def _prior(self, samples: float) -> Float[Tensor, ""] | float:
        """Negative log-prior of the field, nats per sample of speckle."""
        return 0.0

    def loss(
        self, chosen: Int64[Tensor, " v"], images: Float[Tensor, "v rows columns"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Mean squared difference of amplitudes, relative to the brightest; or the speckle's negative log-likelihood.

        The likelihood is used in sound mode, for speckled images.
        """
        views = [self.scene.views[index] for index in chosen.tolist()]
        power = torch.stack([self._image(view, generator) for view in views])
        if torch.is_grad_enabled() and not power.requires_grad:
            raise SarsplatError(
                f"the box from {self.low_m} to {self.high_m} m appears in none of the {len(views)} training images; "
                "give the box of a target that they show"
            )
        images = images.to(power)
        if self._speckled and self.scene.looks is not None:
            floor = _LEAST_NOISE if self.scene.ground else _FLOOR * self.scene.brightest
            nats = _mean((power + floor).log() + (images + floor) / (power + floor))
            samples = len(self.scene.views) * self.scene.grid.independent_samples * self.scene.looks
            return nats + self._prior(samples)
        brightest = self.scene.brightest
        if self._sound:
            amplitude = (power / brightest + _SOFTENED**2).sqrt()
            return _mean((amplitude - (images / brightest + _SOFTENED**2).sqrt()) ** 2)
        return _mean((_amplitude(power / brightest) - (images / brightest).sqrt()) ** 2)

    def optimiser(self) -> torch.optim.Adam:
        rate = self.config.learning_rate
        groups = [{"params": list(self.field.parameters()), "lr": rate}]
        if self.log_noise is not None:
            groups.append({"params": [self.log_noise], "lr": min(rate, _NOISE_RATE)})
        return torch.optim.Adam(groups)

    def image(self, view: View) -> Float[Tensor, "{self.scene.grid.rows} {self.scene.grid.columns}"]:
        """β⁰ from rays in the middle of their strata."""
        return self._image(view, None)

    @torch.no_grad()
    def surface(self) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "f 3"]]:
        """Marching cubes of the attenuation in the target's box, at `level_of_half` of all views."""
        low, high = self.scene.low_m, self.scene.high_m
        depths = []
        for view in self.scene.views:
            rays = Rays.through(view, self.scene.grid, low, high, self.config.rays, whole=False)
            offsets = rays.offsets(None)
            for columns in self._parts(rays):
                places = rays.places(offsets, columns, self._like)
                depths.append(self.attenuation(places.reshape(-1, 3)).reshape(places.shape[:3]).flatten(0, 1))
        level = level_of_half(depths)
        return isosurface(self.attenuation, low, high, self.config.surface_voxels, level, self._like)

    def attenuation(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        """Optical depth of a range cell at places (world frame, m), one-way if published, two-way if sound."""
        return self._depth(self.field.attenuation(places)) * self._inside(places)

    def _image(self, view: View, generator: torch.Generator | None) -> Float[Tensor, "rows columns"]:
        """β⁰ by rays at random places in their strata, or without `generator` in the middle."""
        grid, rays = self.scene.grid, self._rays(view)
        offsets = rays.offsets(generator)
        direction = torch.from_numpy(-rays.turn[2]).to(self._like)
        parts = self._parts(rays)
        stored = len(parts) == 1 or not torch.is_grad_enabled()
        again = partial(
            checkpoint, self._columns, use_reentrant=False, preserve_rng_state=False
        )  # in the backward pass
        columns = [(self._columns if stored else again)(rays, offsets, part, direction) for part in parts]
        shown = torch.cat(columns).T if columns else torch.zeros(0, 0).to(self._like)
        right = grid.columns - rays.first_column - shown.shape[1]
        below = grid.rows - rays.first_row - shown.shape[0]
        image = functional.pad(shown, (rays.first_column, right, rays.first_row, below))
        if self.log_noise is None:
            return image
        return image + self.log_noise.exp().expand(grid.columns)  # so that its gradient is summed column by column

    def _rays(self, view: View) -> Rays:
        """Rays of a view; if sound, over ground at least one per resolution cell, so that no row lacks rays."""
        grid = self.scene.grid
        rays = Rays.through(view, grid, self.low_m, self.high_m, self.config.rays, whole=self._endless)
        if not (self._sound and self.scene.ground):
            return rays
        return replace(rays, count=max(rays.count, math.ceil(rays.count * rays.spacing_m / grid.cell_m)))

    def _columns(
        self, rays: Rays, offsets: Float64[Tensor, "a k"], part: slice, direction: Float[Tensor, " 3"]
    ) -> Float[Tensor, "c r"]:
        """β⁰ of a part of the rays' columns, by the image equation of the mode."""
        places = rays.places(offsets, part, self._like)
        inside = self._inside(places)
        raw_attenuation, raw_scattering = self.field(
            places.reshape(-1, 3) if self._endless else places[inside], direction
        )
        zeros = places.new_zeros(places.shape[:3])
        depth = zeros.masked_scatter(inside, self._depth(raw_attenuation))
        scattering = zeros.masked_scatter(inside, self._scattering(raw_scattering))
        if not self._sound:
            received = torch.exp(-depth.cumsum(2)) * scattering
            return self.scene.brightest * received.sum(1) ** 2
        before = functional.pad(depth[..., :-1].cumsum(2), (1, 0))
        returned = scattering * torch.exp(-before) * -torch.expm1(-depth)
        return returned.sum(1) * (rays.spacing_m / self.scene.grid.spacing_m[1])

    def _depth(self, raw: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        """Optical depth of a range cell, as `attenuation`, of the field's attenuation."""
        if self._sound:  # raw attenuation is per resolution cell: learning does not depend on the scene's scale
            length = 2 * self.scene.grid.spacing_m[1] / self.scene.grid.cell_m
            return _softplus(raw + _CLEAR) * length
        return (raw + self.start[0]).relu()

    def _scattering(self, raw: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        if self._sound:
            return _softplus(raw + _DIM)
        return torch.sigmoid(raw + self.start[1])

    def _inside(self, places: Float[Tensor, "*p 3"]) -> Bool[Tensor, "*p"]:
        """Mask of the places at which the field is defined."""
        inside = torch.full(places.shape[:-1], self._endless, device=places.device)
        for box in self._boxes:
            low, high = (torch.from_numpy(corner).to(places) for corner in box)
            within = torch.ones_like(inside)
            for axis in range(3):  # faster than one comparison and reduction
                within &= (places[..., axis] >= low[axis]) & (places[..., axis] <= high[axis])
            inside = inside | within
        return inside

    def _parts(self, rays: Rays) -> list[slice]:
        """Batches of columns, within the field's limit of places; empty if no pixel shows the box."""
        total = len(rays.azimuth_m) if len(rays.range_m) else 0
        step = max(1, self.field.at_once // max(1, rays.count * len(rays.range_m)))
        return [slice(first, min(first + step, total)) for first in range(0, total, step)]

    @property
    def _like(self) -> Tensor:
        """Tensor of the parameters' dtype and device."""
        return next(self.field.parameters())


def scene_boxes(scene: Scene) -> list[tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]]:
    """Boxes of the field (low and high corner, m): the target's, and that of any ground in the images, ± a cell."""
    boxes = [(scene.low_m, scene.high_m)]
    if scene.ground:
        radius, cell = ground_radius_m(scene.views, scene.grid), scene.grid.cell_m
        boxes.append((np.array([-radius, -radius, -cell]), np.array([radius, radius, cell])))
    return boxes


def _softplus(raw: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
    """log(1 + exp(raw)); unlike `functional.softplus`, its bits do not depend on the number of threads."""
    return raw.relu() + torch.log1p(torch.exp(-raw.abs()))


def _amplitude(power: Float[Tensor, "v rows columns"]) -> Float[Tensor, "v rows columns"]:
    """Square root with gradient 0 at 0."""
    lit = power > 0
    return torch.where(lit, torch.where(lit, power, 1.0).sqrt(), 0.0)


def _mean(images: Float[Tensor, "v rows columns"]) -> Float[Tensor, ""]:
    """Mean, axis by axis, so that bits do not depend on the number of threads."""
    return images.mean(2).mean(1).mean(0)


LOSS = "squared difference of amplitudes or, in sound mode with speckle, its negative log-likelihood"

METHOD = BaselineMethod(
    "sar-nerf", "SAR-NeRF", "a perceptron that knows attenuation and scattering", LOSS, SarNerfConfig(), SarNerf
)
