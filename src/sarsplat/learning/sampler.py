"""Sampler of single images with speckle, as a radar would deliver them, from a learned scene."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32
from scipy.fft import next_fast_len
from torch import Tensor

from sarsplat.arguments import expect
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.model import SceneModel
from sarsplat.learning.parts.part import Shot
from sarsplat.names import Speckle
from sarsplat.renderer import render
from sarsplat.scenes.scattering import ResponseSpeckle, white_speckle

_PIXEL_STD = 1.5  # maximum size of the pixels on which scatterers are drawn, standard deviations of a small Gaussian
_SMALL_QUANTILE = 0.05  # quantile of the Gaussians' widths that counts as small
_MAX_PARTS = 5  # maximum oversampling factor along each side; odd
_SHARP = 0.05  # width of a negligible response, pixels
_INVISIBLE = 255.0**-2  # negligible power of a response relative to its peak: 8 bits do not show it
_MIN_TARGET_SHARE = 1e-3  # minimum share of the target in a pixel's power at which the pixel counts as target

LEARNED, UNIFORM = "learned", "uniform"
"""Grounds without a file: as learned, or with the mean γ⁰ everywhere."""


class Sampler:
    """Function that draws an image of a learned scene from a view and a seed.

    `degree` is that of the harmonics, `grid` that of the training images; the other arguments are those of
    `Run.sample`, which are checked here.
    """

    def __init__(
        self,
        model: SceneModel,
        degree: int,
        grid: ImageGrid,
        ground: str | Float32[np.ndarray, "r c"],
        speckle: Speckle,
        scatterers: float,
    ) -> None:
        expect(Speckle, speckle=speckle)
        if not scatterers > 0:
            raise SarsplatError(f"scatterers is {shown(scatterers)}; give a number above 0, or inf")
        if isinstance(ground, str) and ground not in (LEARNED, UNIFORM):
            raise SarsplatError(f"ground is {shown(ground)}; give {LEARNED}, {UNIFORM}, or its power")
        self._model, self._speckle = model, speckle
        self._rays = RayGrid.for_image(grid, model.config.rays_per_pixel)  # as in training; errors of 0.01 dB
        self._backdrop: Tensor | None = None
        with torch.no_grad():
            self._scene, self._ground, self._echoes = model.target(degree), model.ground(), model.echoes()
        self._parts = 1
        if speckle == "response":  # pixels smaller than the Gaussians, an odd number in each
            smallest = self._scene.scales.amin(1).double().quantile(_SMALL_QUANTILE).item()
            parts = math.ceil(max(grid.spacing_m) / (_PIXEL_STD * smallest))
            self._parts = min(parts + 1 - parts % 2, _MAX_PARTS)
        x, r = (spacing / self._parts for spacing in grid.spacing_m)
        self._grid = replace(grid, rows=self._parts * grid.rows, columns=self._parts * grid.columns, spacing_m=(x, r))
        self._margins, wider = _widened(self._grid)
        self._response = ResponseSpeckle(wider)
        self._shape = scatterers / self._response.pixels
        if isinstance(ground, str) and ground == LEARNED:
            return
        if self._ground is None:
            asked = shown(ground) if isinstance(ground, str) else "given"
            raise SarsplatError(f"ground is {asked}, but this run has learned no ground; omit it")
        self._ground = replace(self._ground, gamma0=self._ground.gamma0.mean())
        if isinstance(ground, str):
            self._backdrop = torch.ones(self._grid.rows, self._grid.columns, dtype=torch.float32)
            return
        smaller = ground.ndim != 2 or ground.shape[0] < grid.rows or ground.shape[1] < grid.columns
        if smaller or not ((ground >= 0) & (ground < math.inf)).all():
            raise SarsplatError(
                f"the ground is {list(ground.shape)} numbers, too few, negative or not finite; give power of at least "
                f"{grid.rows} × {grid.columns} pixels, as the images have"
            )
        self._backdrop = torch.from_numpy(ground).repeat_interleave(self._parts, 0).repeat_interleave(self._parts, 1)

    def __call__(self, view: View, seed: int) -> Complex64[np.ndarray, "rows columns"]:
        rng = np.random.default_rng(seed)
        shot = self._model.shot([view], self._grid, rng=rng)
        if self._speckle == "response":
            return self._through_the_response(shot, rng)
        amplitude = np.sqrt(self._powers(shot, shot.grid, rng)[0])
        if self._speckle == "none":
            return amplitude.astype(np.complex64)
        return amplitude * white_speckle(amplitude.shape, rng)

    def _through_the_response(self, shot: Shot, rng: np.random.Generator) -> Complex64[np.ndarray, "rows columns"]:
        """Draw scatterers with random phases, few and of very different power on the target, and image them.

        The response is applied by FFT, which wraps around; margins mirror the image, so that edges neither darken nor
        show the opposite side.
        """
        sharp = (_SHARP * shot.grid.spacing_m[0], _SHARP * shot.grid.spacing_m[1])
        inside = self._powers(shot, replace(shot.grid, resolution_m=sharp), rng)
        power, share = (np.pad(pixels, self._margins, mode="symmetric") for pixels in inside)
        target = share > _MIN_TARGET_SHARE
        if math.isfinite(self._shape):
            drawn = rng.standard_gamma(self._shape, int(target.sum()), np.float32) / np.float32(self._shape)
            power[target] *= 1 + share[target] * (drawn - 1)
        imaged = self._response.seen(np.sqrt(power) * white_speckle(power.shape, rng))
        (top, _), (left, _) = self._margins
        rows, columns = self._grid.rows, self._grid.columns
        middle = slice(self._parts // 2, None, self._parts)
        return np.ascontiguousarray(imaged[top : top + rows, left : left + columns][middle, middle])

    @torch.no_grad()
    def _powers(
        self, shot: Shot, grid: ImageGrid, rng: np.random.Generator
    ) -> tuple[Float32[np.ndarray, "rows columns"], Float32[np.ndarray, "rows columns"]]:
        """Expected power of the image, β⁰, through the response of `grid`, and the target's share of it.

        The rest is of ground and noise. The learned side lobes apply besides those of the response: samples are then
        harder to distinguish from measured chips.
        """
        rendering = render(
            self._scene, shot.views, grid, rays=self._rays, shift=shot.shift, ground=self._ground, echoes=self._echoes
        )
        images, channel = rendering.images, shot.power_channel
        without = torch.zeros_like(images)
        if rendering.ground is not None:
            without[:, channel] = rendering.ground
        if self._backdrop is None:
            developed = [self._model.developed(power, shot) for power in (images, without)]
        else:
            rows, columns = self._grid.rows, self._grid.columns
            top, left = (
                self._parts * int(rng.integers((had - needed) // self._parts + 1))
                for had, needed in zip(self._backdrop.shape, (rows, columns), strict=True)
            )
            part = self._backdrop[top : top + rows, left : left + columns]
            developed = [self._on_ground(power, without[:, channel], part, shot) for power in (images, without)]
        power, rest = (image[0, channel].clamp(min=0) for image in developed)
        share = (1 - rest / power.clamp(min=torch.finfo(power.dtype).tiny)).clamp(min=0)
        return power.cpu().numpy(), share.cpu().numpy()

    def _on_ground(
        self,
        images: Float[Tensor, "1 c rows columns"],
        ground: Float[Tensor, "1 rows columns"],
        backdrop: Tensor,
        shot: Shot,
    ) -> Float[Tensor, "1 c rows columns"]:
        """Replace the learned ground by another one; estimated parts (texture) then apply to the target alone."""
        images, channel = images.clone(), shot.power_channel
        target = (images[:, channel] - ground).clamp(min=0)
        images[:, channel] = target + ground * backdrop
        share = target / images[:, channel].clamp(min=torch.finfo(images.dtype).tiny)
        plain, textured = (self._model.developed(images, shot, estimated) for estimated in (False, True))
        return plain + share[:, None] * (textured - plain)


def _widened(grid: ImageGrid) -> tuple[list[tuple[int, int]], ImageGrid]:
    """Margins around rows and columns, as wide as the visible response or the image, and the grid with them."""
    reach = grid.response.reach_above(_INVISIBLE)
    margins = []
    for count, width, spacing in zip(
        (grid.rows, grid.columns), grid.resolution_m[::-1], grid.spacing_m[::-1], strict=True
    ):
        before = min(math.ceil(reach * width / spacing), count)
        margins.append((before, next_fast_len(count + 2 * before) - count - before))
    rows, columns = (sum(both) for both in margins)
    return margins, replace(grid, rows=grid.rows + rows, columns=grid.columns + columns)


def seed_of(seed: int, *place: int) -> int:
    """Derive an independent seed below 2⁶³ for each item of a set; raise if `seed` is negative."""
    if seed < 0:
        raise SarsplatError(f"seed {seed} must be at least 0")
    return int(np.random.SeedSequence([seed, *place]).generate_state(1, np.uint64)[0] >> np.uint64(1))
