"""Single images as the radar would deliver them: what is expected of a view, drawn once."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32
from torch import Tensor

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.names import Speckle
from sarsplat.reconstruction.model import SceneModel
from sarsplat.reconstruction.parts.part import Shot
from sarsplat.renderer import render
from sarsplat.scenes.speckle import ResponseSpeckle, white_speckle

LEARNED, UNIFORM = "learned", "uniform"
"""Grounds without a file: as the training images show it, or everywhere as it is on average."""

SPECKLES: tuple[Speckle, ...] = get_args(Speckle)


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
    ground : str or numpy.ndarray [R, C]
        "learned", "uniform", or relative power, at least as large as the images, of which parts are drawn.
    speckle : {"response", "white", "none"}
        How neighbouring pixels' speckle is correlated.

    Raises
    ------
    SarsplatError
        If a choice is unknown, the scene has no ground, or that given is too small.
    """

    def __init__(
        self,
        model: SceneModel,
        degree: int,
        grid: ImageGrid,
        ground: str | Float32[np.ndarray, "r c"],
        speckle: Speckle,
    ) -> None:
        if speckle not in SPECKLES:
            raise SarsplatError(f"speckle is {shown(speckle)}; give one of {', '.join(SPECKLES)}")
        if isinstance(ground, str) and ground not in (LEARNED, UNIFORM):
            raise SarsplatError(f"ground is {shown(ground)}; give {LEARNED}, {UNIFORM}, or its power")
        self._model, self._grid, self._speckle = model, grid, speckle
        self._rays = RayGrid.for_image(grid, model.config.rays_per_pixel)  # as in training: .01 dB, far below speckle
        self._response = ResponseSpeckle(grid)
        self._backdrop: Tensor | None = None
        with torch.no_grad():
            self._scene, self._ground = model.scene(degree), model.ground()
        if isinstance(ground, str) and ground == LEARNED:
            return
        if self._ground is None:
            asked = shown(ground) if isinstance(ground, str) else "given"
            raise SarsplatError(f"ground is {asked}, but this run has learned no ground; leave it out")
        self._ground = replace(self._ground, gamma0=self._ground.gamma0.mean())
        if isinstance(ground, str):
            self._backdrop = torch.ones(grid.rows, grid.columns)
            return
        if ground.shape[0] < grid.rows or ground.shape[1] < grid.columns:
            raise SarsplatError(
                f"the ground has {ground.shape[0]} × {ground.shape[1]} pixels, fewer than the images' {grid.rows} × "
                f"{grid.columns}; give a larger picture of it"
            )
        self._backdrop = torch.from_numpy(ground)

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
            developed = self._before(images, rendering.ground, self._part_of(self._backdrop, chance), shot)
        power: Float32[np.ndarray, "rows columns"] = developed[0, shot.power_channel].clamp(min=0).cpu().numpy()
        return power

    def _part_of(self, backdrop: Tensor, chance: np.random.Generator) -> Tensor:
        rows, columns = self._grid.rows, self._grid.columns
        top = int(chance.integers(backdrop.shape[0] - rows + 1))
        left = int(chance.integers(backdrop.shape[1] - columns + 1))
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
