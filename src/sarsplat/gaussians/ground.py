"""Flat ground as Gaussians: an opaque sheet at z = 0."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from sarsplat.errors import SarsplatError
from sarsplat.gaussians.gaussians import Gaussians
from sarsplat.gaussians.law_harmonics import Harmonics
from sarsplat.geometry import ImageGrid, View

_WIDTH = 0.6
"""Standard deviation in pitches: the sum of footprints then ripples by three thousandths at most."""

_OPTICAL_DEPTH = 3.0
"""Two-way, at a Gaussian's peak; overlapping, the sheet has 2π·0.6²·3 = 6.8 at any grazing angle."""

_THICKNESS = 0.025
"""Standard deviation of the height, in pitches."""

_LARGEST = 2500  # pitches


def ground_sheet(radius: float, pitch: float) -> Gaussians:
    """A disc of flat Gaussians around the origin, on a square lattice.

    Parameters
    ----------
    radius : float
        Of the disc, m.
    pitch : float
        Of the lattice, m: also how finely a shadow's edge can fall.

    Returns
    -------
    Gaussians
        float32, with harmonics of zero.

    Raises
    ------
    SarsplatError
        If the disc is wider than 2 × 2500 pitches, or narrower than two.
    """
    if radius < pitch:
        raise SarsplatError(
            f"Gaussians {pitch:g} m apart are too few for a ground of {radius:.6g} m radius; put them closer together"
        )
    if not radius <= _LARGEST * pitch:
        raise SarsplatError(
            f"a ground of {radius:.6g} m radius needs too many Gaussians {pitch:g} m apart; its radius may be at most "
            f"{_LARGEST * pitch:g} m, so use smaller images"
        )
    half = math.ceil(radius / pitch)
    steps = (np.arange(-half, half) + 0.5) * pitch
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    inside = np.hypot(x, y) < radius
    means = torch.from_numpy(np.column_stack([x, y, np.zeros_like(x)])[inside]).float()
    n = len(means)
    return Gaussians(
        means,
        means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        means.new_tensor([_WIDTH * pitch, _WIDTH * pitch, _THICKNESS * pitch]).repeat(n, 1),
        means.new_full((n,), _OPTICAL_DEPTH),
        Harmonics(means.new_zeros(n, 1)),
    )


def ground_radius_m(views: Sequence[View], grid: ImageGrid) -> float:
    """Radius of the ground that images from these views show, m, with a margin for footprints and responses."""
    across = grid.columns * grid.spacing_m[0] + 2 * abs(grid.center_m[0])
    steepest = math.cos(math.radians(max(view.grazing_deg for view in views)))
    along = (grid.rows * grid.spacing_m[1] + 2 * abs(grid.center_m[1])) / steepest
    return math.hypot(across, along) / 2 + 2 * max(grid.resolution_m)
