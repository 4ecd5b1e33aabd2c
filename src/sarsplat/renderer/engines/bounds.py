"""Bounds of a scene, with which a GPU renders without synchronising with the CPU."""

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
from sarsplat.renderer.engines.cpu import FAULTS
from sarsplat.renderer.engines.on_device import NotRecordable, candidates

TILE = 16
"""Side of a tile, points, as in csrc/cuda_state.cuh."""

LEFT_BOUNDS = 127 << 56
"""Code in `Bounds.broken` of a Gaussian beyond the bounds; larger than any code of a kernel."""

_BAD_GAIN = 126 << 56  # code of an invalid gain, which no kernel reads; its index is added
_MAX_ALLOCATED = 1 << 26  # maximum slots or rays that are allocated for the worst case: a few gigabytes
_MARGIN = 1.001  # factor on extents, because the GPU computes in float32

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Bounds:
    """Limits that the Gaussians keep, so that their extent need not be read from a GPU.

    Parameters
    ----------
    low_m, high_m : tuple of float
        Corners of a box that contains every centre (x, y, z), m.
    scale_m : float
        Largest standard deviation, m.
    optical_depth : float
        Largest two-way optical depth.
    device : torch.device or str
        Device of the Gaussians.

    Attributes
    ----------
    broken : Tensor, int64, a single number on `device`
        Code of the first fault in any rendering with these bounds, −1 for none: see `check`.

    Raises
    ------
    SarsplatError
        If a limit is not finite, or the box is empty.
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
        """Synchronise with the device, and raise the first fault so far.

        Raises
        ------
        SarsplatError
            If a rendering with these bounds had a value out of range, or Gaussians beyond the bounds: its results, and
            all that was learned from them, are wrong.
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
        """Record the first gain that is out of range, for `check`, without synchronising."""
        bad = ~(gain.abs() <= STRONGEST)
        code = torch.where(bad.any(), bad.int().argmax() + _BAD_GAIN, -1)
        self.broken.copy_(torch.where(self.broken < 0, code, self.broken))

    def capacity(self, gaussians: int, views: Sequence[View], grid: ImageGrid, rays: RayGrid) -> "Capacity | None":
        """Return the worst case of a rendering of this many Gaussians; None if it is too large to allocate."""
        every, chosen = candidates(views)
        deviations = math.sqrt(2 * math.log(max(1.0, self.optical_depth / MIN_RAY_DEPTH)))
        on_rays = [
            _MARGIN * deviations * math.sqrt((self.scale_m / spacing) ** 2 + CELL_WIDENING)
            for spacing in rays.spacing_m
        ]
        on_pixels = [
            _MARGIN * math.sqrt(IMAGE_CUT * (self.scale_m**2 + variance)) / spacing
            for spacing, variance in zip(grid.spacing_m, grid.response_variance_m2, strict=True)
        ]
        lattices = tuple(_lattice(view, rays, self.low_m, self.high_m, (on_rays[0], on_rays[1])) for view in every)
        sides = [max(columns for *_, columns in lattices), max(rows for *_, rows, _ in lattices)]
        tiles = {"rays": _max_tiles(on_rays, sides), "pixels": _max_tiles(on_pixels, (grid.columns, grid.rows))}
        slots = len(views) * gaussians * max(tiles.values())
        sizes = [rows * columns for *_, rows, columns in lattices]
        points = sum(sizes) if chosen is None else len(views) * math.prod(sides)
        if max(slots, points) <= _MAX_ALLOCATED:
            return Capacity(lattices, tiles, self.broken, chosen)
        if chosen is not None:  # lattices by the Gaussians need a choice on the CPU
            raise NotRecordable("the worst case is too large to allocate")
        return None


@dataclass(frozen=True)
class Capacity:
    """Worst case of a rendering, for which arrays are allocated."""

    lattices: tuple[tuple[int, int, int, int], ...]
    """Rays (k0x, k0y, rows, columns) of each view, or of all candidates, that contain every footprint."""
    tiles: dict[str, int]
    """Maximum tiles that one footprint touches, by plane."""
    broken: Tensor
    """Flag `Bounds.broken`, set if it is exceeded."""
    chosen: Int64[Tensor, " v"] | None = None
    """Indices of the views' lattices, for `ChosenViews`."""


# A training renders the same few views again and again.
@lru_cache(maxsize=4096)
def _lattice(
    view: View, rays: RayGrid, low_m: Corner, high_m: Corner, reach: tuple[float, float]
) -> tuple[int, int, int, int]:
    """Return (k0x, k0y, rows, columns) of rays that contain a box, widened by `reach` + 1 rays on every side."""
    axes = view.look.frame[:2]
    centre, half = axes @ (np.add(low_m, high_m) / 2), abs(axes) @ (np.subtract(high_m, low_m) / 2)
    low = np.floor((centre - half * _MARGIN) / rays.spacing_m - reach) - 1
    high = np.ceil((centre + half * _MARGIN) / rays.spacing_m + reach) + 1
    columns, rows = high - low
    return int(low[0]), int(low[1]), int(rows), int(columns)


def _max_tiles(reach: Sequence[float], sides: Sequence[int]) -> int:
    """Return the maximum tiles that a footprint touches, from its half extent and the plane's sides, in points."""
    count = 1
    for half, points in zip(reach, sides, strict=True):
        # `widest` consecutive points may begin anywhere in a tile; kernels add a small margin (`points`)
        widest = math.floor(2 * (half + 2e-3)) + 1
        count *= min(-(-(widest - 1) // TILE) + 1, -(-points // TILE))
    return count
