"""Bounds of a scene: known beforehand, they spare the CPU its waits for a GPU."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.checks import ALLOWED, STRONGEST
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH
from sarsplat.renderer.engines.chosen_views import ChosenViews
from sarsplat.renderer.engines.cpu import FAULTS
from sarsplat.renderer.engines.on_device import NotRecordable

TILE = 16
"""Points on a side, of csrc/cuda_state.cuh."""

LEFT_BOUNDS = 127 << 56
"""In `Bounds.broken`, beside the faults that kernels report: a status no kernel has."""

_BAD_GAIN = 126 << 56
"""The same for a gain, which no kernel reads, plus its index."""

_MOST = 1 << 26
"""Slots or rays that are allocated unasked: a few gigabytes."""

_MARGIN = 1.001
"""Factor on extents, because the GPU computes in float32."""

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Bounds:
    """Limits that the Gaussians keep, so that a GPU need not be asked how far they reach.

    Parameters
    ----------
    low_m, high_m : tuple of float
        Corners of a box that holds every centre (x, y, z), m.
    scale_m : float
        Largest standard deviation, m.
    optical_depth : float
        Largest two-way optical depth.
    device : torch.device or str
        Where the Gaussians are.

    Attributes
    ----------
    broken : Tensor, int64, a single number on `device`
        The first thing that went wrong in any rendering with these bounds, −1 for nothing: see `check`.

    Raises
    ------
    SarsplatError
        If no Gaussian could keep them.
    """

    low_m: Corner
    high_m: Corner
    scale_m: float
    optical_depth: float
    device: torch.device | str = "cpu"
    broken: Tensor = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        extent = [high - low for low, high in zip(self.low_m, self.high_m, strict=True)]
        if not all(0 <= number < math.inf for number in (*extent, self.scale_m, self.optical_depth)):
            raise SarsplatError(
                f"{self} hold no Gaussian; give finite corners, the lower one first, and positive limits"
            )
        object.__setattr__(self, "broken", torch.full((), -1, dtype=torch.int64, device=self.device))

    def check(self) -> None:
        """Wait for the device, and see that all was well so far.

        Raises
        ------
        SarsplatError
            If a rendering with these bounds was given a value out of range, or Gaussians beyond the bounds: what it
            returned, and what was learned from it since, is wrong.
        """
        code = int(self.broken)
        if code == LEFT_BOUNDS:
            raise SarsplatError(f"a Gaussian has left its bounds, {self}; clamp the parameters or give wider bounds")
        if code >= 0:
            name = "gain" if code >= _BAD_GAIN else FAULTS[code >> 56]
            index = code & (1 << 56) - 1
            where = f"{name}.flatten(0, 1)" if name == "amplitudes" else name
            raise SarsplatError(f"{where}[{index}] was out of range when it was rendered; it must be {ALLOWED[name]}")

    def watch(self, gain: Tensor) -> None:
        """Note the first gain that is out of range, for `check`; without waiting for the device."""
        bad = ~(gain.abs() <= STRONGEST)
        code = torch.where(bad.any(), bad.int().argmax() + _BAD_GAIN, -1)
        self.broken.copy_(torch.where(self.broken < 0, code, self.broken))

    def capacity(self, gaussians: int, views: Sequence[View], grid: ImageGrid, rays: RayGrid) -> Capacity | None:
        """What a rendering of so many Gaussians takes at most; None if that is too much to allocate unasked.

        Raises
        ------
        NotRecordable
            If it is too much, and only the device knows which views these are.
        """
        chosen = views.numbers if isinstance(views, ChosenViews) else None
        of = views.all if isinstance(views, ChosenViews) else views
        deviations = math.sqrt(2 * math.log(max(1.0, self.optical_depth / MIN_RAY_DEPTH)))
        reach = [
            _MARGIN * deviations * math.sqrt((self.scale_m / spacing) ** 2 + CELL_WIDENING)
            for spacing in rays.spacing_m
        ]
        on_pixels = [
            _MARGIN * math.sqrt(IMAGE_CUT * (self.scale_m**2 + variance)) / spacing
            for spacing, variance in zip(grid.spacing_m, grid.response_variance_m2, strict=True)
        ]
        lattices = tuple(_lattice(view, rays, self.low_m, self.high_m, (reach[0], reach[1])) for view in of)
        sides = [max(columns for *_, columns in lattices), max(rows for *_, rows, _ in lattices)]
        tiles = {"rays": _most_tiles(reach, sides), "pixels": _most_tiles(on_pixels, (grid.columns, grid.rows))}
        slots = len(views) * gaussians * max(tiles.values())
        sizes = [rows * columns for *_, rows, columns in lattices]
        points = sum(sizes) if chosen is None else len(views) * math.prod(sides)
        if max(slots, points) <= _MOST:
            return Capacity(lattices, tiles, self.broken, chosen)
        if chosen is not None:  # there are no other lattices of all that may be chosen
            raise NotRecordable("the worst would be too much to allocate unasked")
        return None


@dataclass(frozen=True)
class Capacity:
    """What a rendering takes at most.

    Parameters
    ----------
    lattices : tuple of (k0x, k0y, rows, columns)
        Rays of each view that hold every footprint; of all views that may be chosen.
    tiles : dict of str to int
        Tiles that one footprint touches at most, by plane.
    broken : Tensor
        Where to say that this was not enough.
    chosen : Tensor, int64 [V], or None
        Which of the lattices are those of the views, if only the device knows.
    """

    lattices: tuple[tuple[int, int, int, int], ...]
    tiles: dict[str, int]
    broken: Tensor
    chosen: Int64[Tensor, " v"] | None = None


# A training asks for the same few views again and again.
@lru_cache(maxsize=4096)
def _lattice(
    view: View, rays: RayGrid, low_m: Corner, high_m: Corner, reach: tuple[float, float]
) -> tuple[int, int, int, int]:
    """(k0x, k0y, rows, columns) of rays that hold a box and so much around it, in rays; one more on every side."""
    axes = view.look.frame[:2]
    centre, half = axes @ (np.add(low_m, high_m) / 2), abs(axes) @ (np.subtract(high_m, low_m) / 2)
    low = np.floor((centre - half * _MARGIN) / rays.spacing_m - reach) - 1
    high = np.ceil((centre + half * _MARGIN) / rays.spacing_m + reach) + 1
    columns, rows = high - low
    return int(low[0]), int(low[1]), int(rows), int(columns)


def _most_tiles(reach: Sequence[float], sides: Sequence[int]) -> int:
    """Tiles that a footprint touches at most, from half its extent and the sides of the plane, in points."""
    most = 1
    for half, points in zip(reach, sides, strict=True):
        # so many consecutive points begin anywhere in a tile; kernels look a little further (`points`)
        widest = math.floor(2 * (half + 2e-3)) + 1
        most *= min(-(-(widest - 1) // TILE) + 1, -(-points // TILE))
    return most
