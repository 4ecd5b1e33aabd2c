"""Contributors to a pixel: the line of its azimuth and range, and the Gaussians on it."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Real

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import GroundBounce, attenuate, project, render
from sarsplat.renderer.constants import IMAGE_CUT
from sarsplat.renderer.stretched import imaged

_PARALLEL = 1e-12  # cosine below which the line is parallel to a side of the box


@dataclass(frozen=True)
class Pixel:
    """Pixel of an image.

    Parameters
    ----------
    row, column : int
        Slant range and azimuth; row 0 is near range.
    """

    row: int
    column: int

    def place_m(self, grid: ImageGrid) -> tuple[float, float]:
        """Azimuth and slant range of its centre, m.

        Raises
        ------
        SarsplatError
            If the grid has no such pixel.
        """
        if not (0 <= self.row < grid.rows and 0 <= self.column < grid.columns):
            raise SarsplatError(
                f"there is no pixel in row {self.row} and column {self.column} of an image of {grid.rows} × "
                f"{grid.columns} pixels; give one inside"
            )
        return float(grid.azimuth_m[self.column]), float(grid.range_m[self.row])


@checks_arguments
def iso_range_line(
    view: View, grid: ImageGrid, pixel: Pixel, low: Real[np.ndarray, " 3"], high: Real[np.ndarray, " 3"]
) -> Float64[np.ndarray, "2 3"] | None:
    """Line of all places in a box that appear in a pixel, whatever their height.

    It is an arc around the radar, which is so far away that the arc is straight, perpendicular to the line of sight.

    Parameters
    ----------
    view, grid, pixel
        Pixel of an image.
    low, high : numpy.ndarray [3]
        Corners of the box, world frame, m.

    Returns
    -------
    numpy.ndarray, float64 [2, 3], or None
        Both ends, the lower one first, m; None if the line misses the box.

    Raises
    ------
    SarsplatError
        If the grid has no such pixel.
    """
    frame = view.look.frame
    azimuth, away = view.look.in_frame(*pixel.place_m(grid))
    origin, direction = azimuth * frame[0] + away * frame[2], frame[1]
    first, last = -math.inf, math.inf
    for start, step, a, b in zip(origin, direction, low, high, strict=True):
        if abs(step) < _PARALLEL:
            if not a <= start <= b:
                return None
            continue
        enter, leave = sorted(((a - start) / step, (b - start) / step))
        first, last = max(first, enter), min(last, leave)
    return np.stack([origin + first * direction, origin + last * direction]) if first <= last else None


@torch.no_grad()
@checks_arguments
def contributions(
    gaussians: Gaussians,
    view: View,
    grid: ImageGrid,
    pixel: Pixel,
    *,
    rays: RayGrid | None = None,
    bounce: GroundBounce | None = None,
) -> Float[np.ndarray, " n"]:
    """Power that each Gaussian adds to a pixel; the sum is the pixel of `render`.

    With `bounce`, the power that it adds by way of the ground; the sum is the pixel of this echo.

    Parameters
    ----------
    gaussians : Gaussians
        The scene, N Gaussians.
    view, grid, pixel
        Pixel of an image.
    rays : RayGrid, optional
        As for `render`.
    bounce : GroundBounce, optional
        Echo by way of the ground.

    Returns
    -------
    numpy.ndarray, float [N]
        β⁰, linear power. Divided by their sum they are shares of the pixel.

    Raises
    ------
    SarsplatError
        If the grid has no such pixel.
    """
    place, rays = pixel.place_m(grid), rays or RayGrid.for_image(grid)
    if len(gaussians) == 0:
        return np.zeros(0, np.float32)
    gaussians = gaussians.detach()
    if bounce is None and view.stretch != 1:  # which `project` does not support
        rendering = render(gaussians, [view], grid, rays=rays)
        sections = rendering.cross_sections[0, :, gaussians.scattering.power_channel]
        footprints = imaged(gaussians, [view], grid, None)
    elif bounce is None:
        projection = project(gaussians, [view], grid, rays=rays)
        gamma0 = projection.amplitudes[..., gaussians.scattering.power_channel]
        sections, footprints = (attenuate(projection, rays).lit_area * gamma0)[0], projection.pixels
    else:
        parts, footprints = bounce.parts(bounce.visible(gaussians), [view], grid, rays)
        sections = parts[0] * bounce.reflectivity.detach()
    a, b, c = footprints.roots[0].unbind(-1)
    x, y = (footprints.centers.new_tensor(place) - footprints.centers[0]).unbind(-1)
    squared = (a * x + b * y) ** 2 + (c * y) ** 2  # |L d|² (`Footprints`)
    mass = 2 * math.pi * (1 - math.exp(-IMAGE_CUT / 2))  # integral of a footprint, cut as in the renderer
    weight = torch.where(squared <= IMAGE_CUT, torch.exp(-squared / 2), 0) * a * c / mass
    return (sections * weight).cpu().numpy()
