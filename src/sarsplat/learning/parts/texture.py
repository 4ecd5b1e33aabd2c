"""Texture: residuals of the training images that neighbouring images share, as maps on the ground."""

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import grid_sample

from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.view import ground_radius_m
from sarsplat.learning.parts.part import Parameters, Part, Shot
from sarsplat.learning.snapshot import fitting
from sarsplat.settings.config import Config
from sarsplat.settings.sections import Surroundings

_NEGLIGIBLE = 0.02  # weight below which an image is neglected
_PITCH = 0.6  # spacing of the maps on the ground, resolution cells
_TRUNCATED = 4.0  # radius of the smoothing window, standard deviations
_MAX_NUMBERS = 2**27  # maximum size of all maps together, numbers; larger maps are coarser


class Texture(Part):
    """Factor on images from `Maps`, which `TextureEstimation` estimates; saved with the model."""

    order = 70
    section = "surroundings"
    name = "texture"
    estimated = True
    maps: "Maps | None" = None

    @classmethod
    def wanted(cls, config: Config) -> bool:
        return config.surroundings is not None and config.surroundings.texture_looks > 0

    def images(self, images: Float[Tensor, "v c h w"], shot: Shot, p: Parameters) -> Float[Tensor, "v c h w"]:
        if self.maps is None:
            return images
        if shot.numbers is not None:
            factor = self.maps.among_images[shot.numbers]
        else:
            factor = self.maps.factor(shot.views, shot.grid, None if shot.rng is None else shot.shift)
        return images * factor[:, None]

    def state(self) -> Parameters:
        return {} if self.maps is None else self.maps.tensors

    def load(self, state: Parameters) -> None:
        self.maps = None
        if not state:
            return
        count, grid = len(self.frame.views), self.frame.grid
        fitting(state, "ratio", torch.float32, (count, grid.rows, grid.columns))
        fitting(state, "shift_m", torch.float32, (count, 2))
        fitting(state, "view_deg", torch.float64, (count, 4 if state["view_deg"].shape[-1:] == (4,) else 2))
        if not all(tensor.isfinite().all() for tensor in state.values()):
            raise ValueError("the texture has numbers that are not finite")
        self.maps = Maps(state, grid, self.settings)


class Maps:
    """Ratios of measured to rendered power of the training images as maps on the ground: a factor for any image.

    Uneven ground and glints, which last a few degrees, are not in the scene, but stay in place on the ground from image
    to image (equation in docs/concepts/measured-chips.md).

    The tensors are, of K training images: `ratio`, float32 [K, rows, columns], smoothed; `shift_m`, float32 [K, 2],
    displacement in azimuth and slant range, m; `view_deg`, float64 [K, 2], azimuth and grazing, or [K, 4], also tilt,
    and 1 where the radar looks to the left, else 0.
    """

    def __init__(self, tensors: dict[str, Tensor], grid: ImageGrid, settings: Surroundings) -> None:
        self.tensors, ratio = tensors, tensors["ratio"]
        self._shifts_m = tensors["shift_m"].cpu().double().numpy()
        self._views = tuple(_view(*numbers) for numbers in tensors["view_deg"].tolist())
        self._grid, self._settings = grid, settings
        radius_m = ground_radius_m(self._views, grid)
        self._pitch_m = max(_PITCH * grid.cell_m, 2 * radius_m * math.sqrt(2 * len(ratio) / _MAX_NUMBERS))
        self._half = math.ceil(radius_m / self._pitch_m)
        axis = np.arange(-self._half, self._half + 1) * self._pitch_m
        ground = np.stack(np.meshgrid(axis, axis), axis=-1)
        self._latest: tuple[tuple[tuple[View, ...], ImageGrid, bytes], Tensor] | None = None
        half_m = np.array(grid.spacing_m) * np.array([grid.columns, grid.rows]) / 2
        maps = []
        for layer, view, shift_m in zip(ratio, self._views, self._shifts_m, strict=True):
            place = (ground @ _onto_image(view).T + shift_m - grid.center_m) / half_m
            maps.append(_sampled(torch.stack([layer, torch.ones_like(layer)]), place))
        self._maps = torch.stack(maps)  # [K, 2, y, x]: the ratio, and 1 where the image shows the place

    @classmethod
    def estimated(
        cls,
        ratio: Float32[Tensor, "k rows columns"],
        shift_m: Float32[Tensor, "k 2"],
        views: Sequence[View],
        grid: ImageGrid,
        settings: Surroundings,
    ) -> "Maps":
        """Smooth the ratios by the width of the settings, and make their maps."""
        sigma = [0.0, *(settings.texture_width * grid.cell_m / spacing for spacing in reversed(grid.spacing_m))]
        radius = [min(int(_TRUNCATED * s + 0.5), count) for s, count in zip(sigma, ratio.shape, strict=True)]
        smooth = gaussian_filter(ratio.cpu().double().numpy(), sigma, mode="nearest", radius=radius)
        count = 4 if any(view.tilt_deg or view.side == "left" for view in views) else 2  # as earlier versions read
        numbers = [(view.azimuth_deg, view.grazing_deg, view.tilt_deg, float(view.side == "left")) for view in views]
        view_deg = torch.tensor([row[:count] for row in numbers], dtype=torch.float32).double()  # exact enough
        return cls(
            {"ratio": torch.from_numpy(smooth).to(ratio), "shift_m": shift_m.clone(), "view_deg": view_deg},
            grid,
            settings,
        )

    def factor(
        self, views: Sequence[View], grid: ImageGrid, shift_m: Float32[Tensor, "v 2"] | None = None
    ) -> Float32[Tensor, "v {grid.rows} {grid.columns}"]:
        """Factor for images from any views on any grid, with the mean shift by default; 1 where no image reaches."""
        mean = self._shifts_m.mean(axis=0)
        shifts = [mean] * len(views) if shift_m is None else shift_m.cpu().double().numpy()
        asked = (tuple(views), grid, np.asarray(shifts).tobytes())
        if self._latest is None or self._latest[0] != asked:  # cached: samples need it twice
            factors = [self._factor(view, shift, None, grid) for view, shift in zip(views, shifts, strict=True)]
            self._latest = (asked, torch.stack(factors))
        return self._latest[1]

    @cached_property
    def among_images(self) -> Float32[Tensor, "k rows columns"]:
        """Texture of each training image from all others (leave-one-out): it must not explain its own speckle."""
        return torch.stack([self._factor(view, self._shifts_m[k], k, self._grid) for k, view in enumerate(self._views)])

    def _factor(
        self, view: View, shift_m: Float64[np.ndarray, " 2"], dropped: int | None, grid: ImageGrid
    ) -> Float32[Tensor, "{grid.rows} {grid.columns}"]:
        """Weighted mean ratio of images from nearby azimuths, but `dropped`, with `texture_looks` more of ratio 1."""
        total = torch.zeros_like(self._maps[0])
        for k, source in enumerate(self._views):
            turn_deg = (source.azimuth_deg - view.azimuth_deg + 180) % 360 - 180
            weight = math.exp(-abs(turn_deg) / self._settings.texture_reach_deg)
            if k != dropped and weight > _NEGLIGIBLE:
                total += weight * self._maps[k]
        pixels = np.stack(np.meshgrid(grid.azimuth_m, grid.range_m), axis=-1)
        ground_m = (pixels - shift_m) @ np.linalg.inv(_onto_image(view)).T
        ratios, weights = _sampled(total, ground_m / (self._pitch_m * (self._half + 0.5)))
        return (self._settings.texture_looks + ratios) / (self._settings.texture_looks + weights)


def _view(azimuth_deg: float, grazing_deg: float, tilt_deg: float = 0.0, left: float = 0.0) -> View:
    return View(azimuth_deg, grazing_deg, tilt_deg, "left" if left else "right")


def _onto_image(view: View) -> Float64[np.ndarray, "2 2"]:
    """Matrix from x, y on the ground to azimuth, slant range."""
    return view.look.gradients[:, :2]


def _sampled(layers: Float32[Tensor, "2 h w"], where: Float64[np.ndarray, "rows columns 2"]) -> Tensor:
    """Interpolate layers at places in half widths and heights from the middle; 0 outside."""
    places = torch.from_numpy(where).to(layers)
    return grid_sample(layers[None], places[None], mode="bilinear", padding_mode="zeros", align_corners=False)[0]
