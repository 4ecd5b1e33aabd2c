"""Initial positions of Gaussians: random in a region bounded by the images, or on the paper's hemisphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import brighter, usual_peak

BRIGHT_DB = -30.0
"""Minimum level of the target's pixels, relative to the brightest of the set (`usual_peak`), dB."""

_ONE_SIDE = 1e-3  # length of the mean direction to the radars below which they are on all sides
_BATCH = 1 << 18  # points that are compared with all planes at once


@dataclass(frozen=True)
class Region:
    """Convex region normals · x ≤ offsets, with its bounding box [low, high]; world frame, m."""

    normals: Float64[np.ndarray, "planes 3"]
    offsets: Float64[np.ndarray, " planes"]
    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]

    @classmethod
    def box(cls, low: Sequence[float], high: Sequence[float]) -> Region:
        """Box parallel to the axes."""
        corners = np.array(low, float), np.array(high, float)
        return cls(np.concatenate([-np.eye(3), np.eye(3)]), np.concatenate([-corners[0], corners[1]]), *corners)

    def sample(self, count: int, generator: torch.Generator) -> Float64[np.ndarray, "{count} 3"]:
        """Random points, uniform in the region, float64 [count, 3]."""
        accepted: list[np.ndarray] = []
        while sum(map(len, accepted)) < count:
            unit = torch.rand(4 * count, 3, generator=generator, device="cpu", dtype=torch.float64).numpy()
            points = self.low + (self.high - self.low) * unit
            batches = (points[first : first + _BATCH] for first in range(0, len(points), _BATCH))
            accepted += [batch[(batch @ self.normals.T <= self.offsets).all(axis=1)] for batch in batches]
        return np.concatenate(accepted)[:count]


def bounded_region(
    power: Float[np.ndarray, "v {grid.rows} {grid.columns}"], views: Sequence[View], grid: ImageGrid
) -> Region:
    """Region that can contain the target if nothing else returns power: an intersection of half-spaces.

    In every view the target is within the azimuths of the bright pixels, behind the nearest bright range, and above the
    ground z = 0. These bounds contain all of the target, also its hidden parts. Aloft, there is no ground, and all
    radars may be on one side; then hidden parts on the other side may be cut off.

    `power` is β⁰ of the training images, linear, without ground; bright pixels are at least `BRIGHT_DB` above
    `usual_peak` of all. Raise if an image has no bright pixel, or the bounds leave no space.
    """
    from scipy.optimize import linprog  # slow to import, and only needed by trainings

    bright = brighter(power, BRIGHT_DB, usual_peak(power))
    aloft = views[0].aloft
    normals, offsets = ([], []) if aloft else ([np.array([0.0, 0.0, -1.0])], [0.0])
    shown: list[tuple[Float64[np.ndarray, " 3"], float]] = []
    half_a, half_r = grid.spacing_m[0] / 2, grid.spacing_m[1] / 2
    for mask, view in zip(bright, views, strict=True):
        if not mask.any():
            raise SarsplatError(
                f"the image at azimuth {view.azimuth_deg:g}°, grazing {view.grazing_deg:g}° is dark everywhere "
                f"({BRIGHT_DB:g} dB below the brightest pixel of the set); leave it out or check the simulation"
            )
        azimuth, slant_range = view.look.gradients
        columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
        normals += [azimuth, -azimuth, -slant_range]
        offsets += [
            grid.azimuth_m[columns[-1]] + half_a,
            half_a - grid.azimuth_m[columns[0]],
            half_r - grid.range_m[rows[0]],
        ]
        shown.append((slant_range, grid.range_m[rows[-1]] + half_r))
    a, b = np.array(normals), np.array(offsets)
    reach = float(np.hypot(grid.rows * grid.spacing_m[1], grid.columns * grid.spacing_m[0]))
    if aloft and (behind := _behind(a, b, views, shown, reach)) is not None:
        a, b = np.vstack([a, behind[0]]), np.append(b, behind[1])
    # one program for both extremes along each axis: linprog's checks take longer than the solver
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    extremes = linprog(axes.ravel(), np.kron(np.eye(6), a), np.tile(b, 6), bounds=(-reach, reach))
    if not extremes.success:
        raise SarsplatError(
            "no region of space could explain the bright pixels of all views; check the sense of the azimuths and the "
            "image orientation (row 0 = near range)"
        )
    low, high = extremes.x.reshape(2, 3, 3).diagonal(axis1=1, axis2=2) + 0.0  # no −0
    return Region(a, b, low, high)


def _behind(
    a: Float64[np.ndarray, "planes 3"],
    b: Float64[np.ndarray, " planes"],
    views: Sequence[View],
    shown: Sequence[tuple[Float64[np.ndarray, " 3"], float]],
    reach: float,
) -> tuple[Float64[np.ndarray, " 3"], float] | None:
    """Plane behind all visible parts, perpendicular to the mean direction of the views; None if they are all around.

    `shown` has each view's gradient of slant range, and its farthest bright range, m: no visible part is farther.
    """
    from scipy.optimize import linprog

    away = -np.sum([view.direction for view in views], axis=0) / len(views)
    if not np.linalg.norm(away) > _ONE_SIDE:
        return None
    away /= np.linalg.norm(away)
    farthest = -np.inf
    for slant_range, far in shown:
        found = linprog(-away, np.vstack([a, slant_range]), np.append(b, far), bounds=(-reach, reach))
        if found.success:  # otherwise the bounds of other views contradict this view
            farthest = max(farthest, -float(found.fun))
    return (away, farthest) if farthest > -np.inf else None


def hemisphere_shell(region: Region, count: int, generator: torch.Generator) -> Float64[np.ndarray, "{count} 3"]:
    """Random points, uniform on a hemisphere around a region, float64 [count, 3] (the paper's start)."""
    centre = (region.low + region.high) / 2 * (1, 1, 0)
    radius = float(np.linalg.norm((region.high - region.low)[:2])) / 2
    unit = torch.rand(count, 2, generator=generator, device="cpu", dtype=torch.float64).numpy()
    z, angle = unit[:, 0], 2 * np.pi * unit[:, 1]
    ring = np.sqrt(1 - z**2)
    return centre + radius * np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])


def random_quaternions(count: int, generator: torch.Generator) -> Float32[Tensor, "{count} 4"]:
    """Random orientations, uniformly distributed, float32 [count, 4]."""
    return torch.nn.functional.normalize(
        torch.randn(count, 4, generator=generator, dtype=torch.float32, device="cpu"), dim=1
    )
