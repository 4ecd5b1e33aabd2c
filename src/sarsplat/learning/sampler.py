"""Single images as the radar would deliver them: what is expected of a view, drawn once."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32
from scipy.fft import next_fast_len
from torch import Tensor

from sarsplat.errors import SarsplatError, shown
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.model import SceneModel
from sarsplat.learning.parts.part import Shot
from sarsplat.names import Speckle
from sarsplat.renderer import render
from sarsplat.scenes.scattering import ResponseSpeckle, white_speckle

_FINE_ENOUGH = 1.5
"""Pixels on which what is scattered is imaged without a response, in standard deviations of small Gaussians …"""

_SMALL = 0.05
"""… which so many are smaller than."""

_FINEST = 5
"""Into how many a pixel is divided at most, along each side."""

_SHARP = 0.05
"""Width of a response that can be neglected, pixels."""

_UNSEEN = 255.0**-2
"""Power relative to the brightest that 8 bits do not show: beyond where a response falls below, it is neglected."""

_NO_TARGET = 1e-3
"""Share of the target in a pixel's power below which it does not count."""

LEARNED, UNIFORM = "learned", "uniform"
"""Grounds without a file: as the training images show it, or everywhere as it is on average."""

SPECKLES: tuple[Speckle, ...] = get_args(Speckle)


class Sampler:
    """Draws images of a learned scene, with harmonics up to a degree, each from a view and a seed alone.

    `grid` is that of the training images; the rest as of `Run.sample`, whose refusals are made here.
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
        if speckle not in SPECKLES:
            raise SarsplatError(f"speckle is {shown(speckle)}; give one of {', '.join(SPECKLES)}")
        if not scatterers > 0:
            raise SarsplatError(f"scatterers is {shown(scatterers)}; give a number above 0, or inf")
        if isinstance(ground, str) and ground not in (LEARNED, UNIFORM):
            raise SarsplatError(f"ground is {shown(ground)}; give {LEARNED}, {UNIFORM}, or its power")
        self._model, self._speckle = model, speckle
        self._rays = RayGrid.for_image(grid, model.config.rays_per_pixel)  # as in training: .01 dB, far below speckle
        self._backdrop: Tensor | None = None
        with torch.no_grad():
            self._scene, self._ground, self._echoes = model.scene(degree), model.ground(), model.echoes()
        self._parts = _divided(grid, self._scene) if speckle == "response" else 1
        self._grid = _finer(grid, self._parts)
        self._margins, wider = _widened(self._grid)
        self._response = ResponseSpeckle(wider)
        self._shape = scatterers / self._response.pixels
        if isinstance(ground, str) and ground == LEARNED:
            return
        if self._ground is None:
            asked = shown(ground) if isinstance(ground, str) else "given"
            raise SarsplatError(f"ground is {asked}, but this run has learned no ground; leave it out")
        self._ground = replace(self._ground, gamma0=self._ground.gamma0.mean())
        if isinstance(ground, str):
            self._backdrop = torch.ones(self._grid.rows, self._grid.columns, dtype=torch.float32)
            return
        if ground.ndim != 2 or not ((ground >= 0) & (ground < math.inf)).all():
            raise SarsplatError(
                f"the ground is {list(ground.shape)} numbers from {ground.min():g} to {ground.max():g}; give power in "
                "rows and columns, finite and not negative"
            )
        if ground.shape[0] < grid.rows or ground.shape[1] < grid.columns:
            raise SarsplatError(
                f"the ground has {ground.shape[0]} × {ground.shape[1]} pixels, fewer than the images' {grid.rows} × "
                f"{grid.columns}; give a larger picture of it"
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
        """Scatterers with phases of their own, imaged; of a target they are few, and some are much the brightest.

        Applied by FFT, the response goes on across opposite edges; between them lies a margin in which what is at each
        is mirrored, so that the image neither darkens there nor shows what is at the other side.
        """
        sharp = (_SHARP * shot.grid.spacing_m[0], _SHARP * shot.grid.spacing_m[1])
        inside = self._powers(shot, replace(shot.grid, resolution_m=sharp), rng)
        power, share = (np.pad(some, self._margins, mode="symmetric") for some in inside)
        target = share > _NO_TARGET
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
        """Expected power of the image with the drawn shift and gain, β⁰, and which share of it is the target's.

        The rest is of the ground and of noise. Through the response of `grid`. The side lobes that were learned are
        of all that is around bright scatterers: without them, though the response has its own, samples were told from
        measured chips more easily.
        """
        rendering = render(
            self._scene,
            shot.views,
            grid,
            rays=self._rays,
            shift=shot.shift,
            ground=self._ground,
            echoes=self._echoes,
        )
        images, channel = rendering.images, shot.power_channel
        without = torch.zeros_like(images)
        if rendering.ground is not None:
            without[:, channel] = rendering.ground
        if self._backdrop is None:
            developed = [self._model.developed(some, shot) for some in (images, without)]
        else:
            part = self._part_of(self._backdrop, rng)
            developed = [self._before(some, without[:, channel], part, shot) for some in (images, without)]
        power, rest = (some[0, channel].clamp(min=0) for some in developed)
        share = (1 - rest / power.clamp(min=torch.finfo(power.dtype).tiny)).clamp(min=0)
        return power.cpu().numpy(), share.cpu().numpy()

    def _part_of(self, backdrop: Tensor, rng: np.random.Generator) -> Tensor:
        rows, columns = self._grid.rows, self._grid.columns
        top, left = (
            self._parts * int(rng.integers((had - needed) // self._parts + 1))
            for had, needed in zip(backdrop.shape, (rows, columns), strict=True)
        )
        return backdrop[top : top + rows, left : left + columns]

    def _before(
        self,
        images: Float[Tensor, "1 c rows columns"],
        ground: Float[Tensor, "1 rows columns"],
        backdrop: Tensor,
        shot: Shot,
    ) -> Float[Tensor, "1 c rows columns"]:
        """The target before another ground; what images show beyond the scene is shown of the target alone."""
        images, channel = images.clone(), shot.power_channel
        target = (images[:, channel] - ground).clamp(min=0)
        images[:, channel] = target + ground * backdrop
        share = target / images[:, channel].clamp(min=torch.finfo(images.dtype).tiny)
        plain, textured = (self._model.developed(images, shot, estimated) for estimated in (False, True))
        return plain + share[:, None] * (textured - plain)


def _divided(grid: ImageGrid, scene: Gaussians) -> int:
    """Oversampling factor of the pixels, so that they are smaller than the Gaussians; odd."""
    smallest = scene.scales.amin(1).double().quantile(_SMALL).item()
    needed = math.ceil(max(grid.spacing_m) / (_FINE_ENOUGH * smallest))
    return min(needed + 1 - needed % 2, _FINEST)


def _finer(grid: ImageGrid, parts: int) -> ImageGrid:
    """The same image in pixels so many times as fine, of which those in the middle are the grid's."""
    azimuth, slant_range = (spacing / parts for spacing in grid.spacing_m)
    return replace(grid, rows=parts * grid.rows, columns=parts * grid.columns, spacing_m=(azimuth, slant_range))


def _widened(grid: ImageGrid) -> tuple[list[tuple[int, int]], ImageGrid]:
    """Pixels before and after the rows and columns, as far as the response shows anything, and the grid with them.

    They are no more than the image has, beyond which its own side lobes reach over all of it.
    """
    reach = grid.response.reach_above(_UNSEEN)
    margins = []
    for count, width, spacing in zip(
        (grid.rows, grid.columns), grid.resolution_m[::-1], grid.spacing_m[::-1], strict=True
    ):
        before = min(math.ceil(reach * width / spacing), count)
        margins.append((before, next_fast_len(count + 2 * before) - count - before))
    rows, columns = (sum(both) for both in margins)
    return margins, replace(grid, rows=grid.rows + rows, columns=grid.columns + columns)


def seed_of(seed: int, *place: int) -> int:
    """Derive a seed for each item of a set, independent of what else is drawn; below 2⁶³. Refused: a negative seed."""
    if seed < 0:
        raise SarsplatError(f"seed {seed} must be at least 0")
    return int(np.random.SeedSequence([seed, *place]).generate_state(1, np.uint64)[0] >> np.uint64(1))
