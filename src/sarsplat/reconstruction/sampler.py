"""Single images as the radar would deliver them: what is expected of a view, drawn once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32
from scipy.ndimage import gaussian_filter
from torch import Tensor

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.importers.pictures import read_pixels
from sarsplat.importers.quantity import likely_quantity, power_or_signal
from sarsplat.names import Speckle
from sarsplat.reconstruction.model import SceneModel
from sarsplat.reconstruction.parts.part import Shot
from sarsplat.renderer import render
from sarsplat.scenes.speckle import ResponseSpeckle, white_speckle

LEARNED, UNIFORM = "learned", "uniform"
"""Grounds without a file: as the training images show it, or everywhere as it is on average."""

SPECKLES: tuple[Speckle, ...] = get_args(Speckle)

_GROUND_CELLS = 3.0
"""Standard deviation of the window through which a picture of ground is seen, resolution cells: without its speckle."""


class Sampler:
    """Draws images of a learned scene, each from a view and a seed alone.

    Parameters
    ----------
    model : SceneModel
        The scene.
    degree : int
        Of its harmonics.
    grid : ImageGrid
        Pixels of the training images.
    ground : str or Path
        "learned", "uniform", or a picture of ground.
    speckle : {"response", "white", "none"}
        How neighbouring pixels' speckle is correlated.

    Raises
    ------
    SarsplatError
        If a choice is unknown, or the picture cannot be read, is too small or black, or the scene has no ground.
    """

    def __init__(self, model: SceneModel, degree: int, grid: ImageGrid, ground: str | Path, speckle: Speckle) -> None:
        if speckle not in SPECKLES:
            raise SarsplatError(f"speckle is {shown(speckle)}; give one of {', '.join(SPECKLES)}")
        self._model, self._grid, self._speckle = model, grid, speckle
        self._rays = RayGrid.for_image(grid, model.config.rays_per_pixel)  # as in training: .01 dB, far below speckle
        self._response = ResponseSpeckle(grid)
        self._backdrop: Callable[[np.random.Generator], Tensor] | None = None
        with torch.no_grad():
            self._scene, self._ground = model.scene(degree), model.ground()
        if str(ground) == LEARNED:
            return
        if self._ground is None:
            raise SarsplatError(f"ground is {shown(str(ground))}, but this run has learned no ground; leave it out")
        self._ground = replace(self._ground, gamma0=self._ground.gamma0.mean())
        self._backdrop = _uniform if str(ground) == UNIFORM else _Picture(Path(ground), grid)

    def __call__(self, view: View, seed: int) -> Complex64[np.ndarray, "rows columns"]:
        """Complex amplitudes √β⁰·e^jψ."""
        chance = np.random.default_rng(seed)
        amplitude = np.sqrt(self._power(view, chance))
        if self._speckle == "none":
            return amplitude.astype(np.complex64)
        if self._speckle == "white":
            return amplitude * white_speckle(amplitude.shape, chance)
        return amplitude * self._response.draw(chance)

    @torch.no_grad()
    def _power(self, view: View, chance: np.random.Generator) -> Float32[np.ndarray, "rows columns"]:
        """Expected power of the image that has the drawn shift and gain; β⁰."""
        model = self._model
        shot = model.shot([view], self._grid, chance=chance)
        rendering = render(self._scene, [view], shot.grid, rays=self._rays, shift=shot.shift, ground=self._ground)
        images = rendering.images
        if self._backdrop is None:
            developed = model.developed(images, shot)
        else:
            assert rendering.ground is not None
            developed = self._before(images, rendering.ground, self._backdrop(chance), shot)
        power: Float32[np.ndarray, "rows columns"] = developed[0, shot.power_channel].clamp(min=0).cpu().numpy()
        return power

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


def _uniform(chance: np.random.Generator) -> Tensor:
    return torch.ones(())


class _Picture:
    """Ground as a picture shows it: parts of it, drawn by chance, relative to its mean power."""

    def __init__(self, path: Path, grid: ImageGrid) -> None:
        pixels = read_pixels(path)
        power = power_or_signal(pixels, likely_quantity(pixels, str(path)), str(path))
        power = np.abs(power) ** 2 if np.iscomplexobj(power) else power
        if power.shape[0] < grid.rows or power.shape[1] < grid.columns:
            raise SarsplatError(
                f"{path} has {power.shape[0]} × {power.shape[1]} pixels, fewer than the chips' {grid.rows} × "
                f"{grid.columns}; give a larger picture of ground"
            )
        if not power.any():
            raise SarsplatError(f"{path} is black; give a picture of ground")
        sigma = [_GROUND_CELLS * grid.cell_m / spacing for spacing in reversed(grid.spacing_m)]
        smooth = gaussian_filter(power.astype(np.float64), sigma, mode="nearest")
        self._factor = torch.from_numpy(smooth / smooth.mean()).float()
        self._rows, self._columns = grid.rows, grid.columns

    def __call__(self, chance: np.random.Generator) -> Tensor:
        top = int(chance.integers(self._factor.shape[0] - self._rows + 1))
        left = int(chance.integers(self._factor.shape[1] - self._columns + 1))
        return self._factor[top : top + self._rows, left : left + self._columns]


def seed_of(seed: int, *place: int) -> int:
    """A seed of its own for each place in a set, the same whatever else is drawn; below 2⁶³.

    Raises
    ------
    SarsplatError
        If the set's seed is negative.
    """
    if seed < 0:
        raise SarsplatError(f"seed {seed} must be at least 0")
    return int(np.random.SeedSequence([seed, *place]).generate_state(1, np.uint64)[0] >> np.uint64(1))
