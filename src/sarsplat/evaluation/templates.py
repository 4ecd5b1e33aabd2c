"""Templates: runs rendered from all azimuths around a view, and the window in which they are compared with images."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float32, Real

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.memory import required
from sarsplat.radiometry import DYNAMIC_RANGE_DB, from_db
from sarsplat.renderer import render
from sarsplat.runs import Run

COARSE = 2
"""Pixels of the coarse search along each side."""

_REACH_CELLS = 3.0  # largest displacement of an image, resolution cells
_MARGIN_CELLS = 8.0  # margin of the window around targets and shadows, resolution cells
_MASKS = 12  # number of azimuths at which the runs' targets and shadows are outlined
_AT_A_TIME = 8  # views that are rendered at once
_BYTES = 27  # maximum memory of a prediction while it is prepared for matching, bytes per pixel


@dataclass(frozen=True)
class Window:
    """Rows and columns that are compared, relative to the pixel of the scene's origin, and coarse displacements."""

    rows: tuple[int, int]
    columns: tuple[int, int]
    steps: tuple[int, int]
    """Coarse steps each way, of rows and of columns; the fine search adds a pixel."""

    @property
    def margins(self) -> tuple[int, int]:
        """Pixels by which images may be displaced each way, rows and columns."""
        return COARSE * self.steps[0] + 1, COARSE * self.steps[1] + 1

    @property
    def size(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]

    def cut(
        self, images: Real[np.ndarray, "*v rows columns"], grid: ImageGrid, margins: tuple[int, int] = (0, 0)
    ) -> Real[np.ndarray, "*v m n"]:
        """Cut the window, wider by margins, out of images on a grid."""
        (top, bottom), (left, right) = self.rows, self.columns
        (down, across), (row, column) = margins, _origin(grid)
        return images[..., row + top - down : row + bottom + down, column + left - across : column + right + across]

    def within(self, larger: Window, images: Float32[np.ndarray, "v r c"]) -> Float32[np.ndarray, "v m n"]:
        """Cut the window with its margins out of images that a larger window with its margins has cut."""
        top, left = self.rows[0] - larger.rows[0], self.columns[0] - larger.columns[0]
        rows, columns = (side + 2 * margin for side, margin in zip(self.size, self.margins, strict=True))
        return images[:, top : top + rows, left : left + columns]

    @classmethod
    def around(cls, windows: Sequence[Window]) -> Window:
        """Return the smallest window that contains windows of equal steps."""
        rows, columns = np.array([one.rows for one in windows]), np.array([one.columns for one in windows])
        ends = [(int(spans[:, 0].min()), int(spans[:, 1].max())) for spans in (rows, columns)]
        return cls(ends[0], ends[1], windows[0].steps)


def window_around(extents_m: Sequence[tuple[float, float]], grids: Sequence[ImageGrid]) -> Window:
    """Return the window of these extents in range and azimuth, cut to all grids; the first is the image's."""
    pixels = grids[0]
    steps = [
        max(1, round(_REACH_CELLS * width / spacing / COARSE))
        for width, spacing in zip(pixels.resolution_m, pixels.spacing_m, strict=True)
    ][::-1]
    spans = []
    for axis, (low_m, high_m) in enumerate(extents_m):
        spacing, reach = pixels.spacing_m[1 - axis], COARSE * steps[axis] + 1
        before = min(_origin(grid)[axis] for grid in grids) - reach
        after = min((grid.rows, grid.columns)[axis] - _origin(grid)[axis] for grid in grids) - reach
        low, high = max(math.floor(low_m / spacing), -before), min(math.ceil(high_m / spacing), after)
        if high - low < 2 * COARSE:
            raise SarsplatError(
                f"images of {pixels.rows} × {pixels.columns} pixels leave no window when moved by {reach} each "
                "way; give larger ones"
            )
        spans.append((low, high - (high - low) % COARSE))
    return Window(spans[0], spans[1], (steps[0], steps[1]))


def extents_m(runs: Sequence[Run], view: View) -> list[tuple[float, float]]:
    """Return the extent of the runs' targets and shadows in range and azimuth, with a margin, m."""
    views = [replace(view, azimuth_deg=360 * k / _MASKS) for k in range(_MASKS)]
    ends: list[list[float]] = [[], []]
    for run in runs:
        grid, shown = run.grid, run.masks(views).max(axis=0)
        for axis, places in enumerate((grid.range_m, grid.azimuth_m)):
            within = places[shown.any(axis=1 - axis)]
            ends[axis] += [float(within.min()), float(within.max())] if len(within) else [0.0]
    margin = _MARGIN_CELLS * max(run.grid.cell_m for run in runs)
    return [(min(one) - margin, max(one) + margin) for one in ends]


def _exact_origin(grid: ImageGrid) -> tuple[float, float]:
    """Row and column of the scene's origin, pixels from the image's corner, to a thousandth."""
    (across, down), (across_m, down_m) = grid.spacing_m, grid.center_m
    return round(grid.rows / 2 - down_m / down, 3), round(grid.columns / 2 - across_m / across, 3)


def _origin(grid: ImageGrid) -> tuple[int, int]:
    """Row and column of the pixel that contains the scene's origin."""
    row, column = _exact_origin(grid)
    return math.floor(row), math.floor(column)


def phase_of(grid: ImageGrid) -> tuple[float, float]:
    """Place of the scene's origin in its pixel, rows and columns: ½ for odd numbers of pixels around it."""
    row, column = _exact_origin(grid)
    return round(row % 1, 3), round(column % 1, 3)


def grid_for(run: Run, pixels: ImageGrid) -> ImageGrid:
    """Return the grid on which a run is rendered: that of the images if their pixels differ, or else its own.

    The latter is displaced by less than a pixel, so that its pixels coincide with those of the images.
    """
    own = run.grid
    if (own.spacing_m, own.resolution_m) != (pixels.spacing_m, pixels.resolution_m):
        return pixels
    away, across = np.subtract(phase_of(own), phase_of(pixels)).tolist()
    (across_m, away_m), (width, height) = own.center_m, own.spacing_m
    return replace(own, center_m=(across_m + across * width, away_m + away * height)) if away or across else own


def require_memory(window: Window, count: int, remedy: str) -> None:
    """Raise if matching with `count` predictions takes more than the free memory."""
    rows, columns = (side + 2 * margin for side, margin in zip(window.size, window.margins, strict=True))
    required("matching images", _BYTES * count * rows * columns, remedy)


def predicted(
    predict: Callable[[Sequence[View]], Real[np.ndarray, "v rows columns"]],
    views: Sequence[View],
    window: Window,
    grid: ImageGrid,
) -> Real[np.ndarray, "v m n"]:
    """Predict images on a grid, a few at a time, and cut out the window with its margins."""
    parts = (views[first : first + _AT_A_TIME] for first in range(0, len(views), _AT_A_TIME))
    return np.concatenate([window.cut(predict(part), grid, window.margins) for part in parts])


def templates(
    run: Run, views: Sequence[View], window: Window, grid: ImageGrid, ground: Literal["learned", "flat"]
) -> Float32[np.ndarray, "v m n"]:
    """Render a run from these views: linear power in the window with its margins."""
    if grid != run.grid and run.model is None:
        raise SarsplatError(
            f"a run of {run.target} by {run.method} renders only the pixels that it was trained with; give images with "
            "these, and with rows and columns that are odd where the training's are"
        )
    on_grid = None if grid == run.grid else grid

    def predict(some: Sequence[View]) -> Float32[np.ndarray, "v rows columns"]:
        return run.render(some, on_grid) if ground == "learned" else _on_flat(run, some, grid)

    return predicted(predict, views, window, grid)


def floored(power: Real[np.ndarray, "v m n"]) -> Float32[np.ndarray, "v m n"]:
    """Raise power to at least −40 dB of the mean."""
    return np.maximum(power, float(power.mean(dtype=np.float64)) * from_db(-DYNAMIC_RANGE_DB)).astype(np.float32)


@torch.no_grad()
def _on_flat(run: Run, views: Sequence[View], grid: ImageGrid) -> Float32[np.ndarray, "v rows columns"]:
    """Render a run on ground of its mean γ⁰; estimated parts of the model (texture) apply to the target alone."""
    model = run.model
    if model is None or (learned := model.ground()) is None:
        raise SarsplatError("ground is 'flat', but a run has learned no ground; leave it out")
    scene = model.target(model.degree(run.iteration))
    how: dict[str, Any] = {
        "rays": RayGrid.for_image(grid, model.config.rays_per_pixel),
        "ground": replace(learned, gamma0=learned.gamma0.mean()),
        "echoes": model.echoes(),
    }
    shot = model.shot(views, grid)
    rendering = render(scene, shot.views, shot.grid, shift=shot.shift, **how)
    power = rendering.images[:, shot.power_channel]
    assert rendering.ground is not None
    target = (power - rendering.ground).clamp(min=0) / power.clamp(min=torch.finfo(power.dtype).tiny)
    plain, textured = (model.developed(rendering.images, shot, estimated) for estimated in (False, True))
    both = plain + target[:, None] * (textured - plain)
    return both[:, shot.power_channel].clamp(min=0).cpu().numpy()
