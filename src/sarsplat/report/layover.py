"""A vertical slice through layover: reconstructed points, those of Capon's method, and the true surface."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.evaluation import read_truth_mesh
from sarsplat.evaluation.capon import capon_points
from sarsplat.evaluation.surface import of_stacks
from sarsplat.extras import Trimesh
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.report.figure import Block, Figure, Panel, axis, chart, polyline, written
from sarsplat.report.images import view_name
from sarsplat.runs import Run

Points = Float[np.ndarray, "p 3"]
Lines = Float[np.ndarray, "lines 2 3"]
Frame = tuple[tuple[float, float], tuple[float, float]]

_MARGIN = 0.04  # around everything, of the longer side


@dataclass(frozen=True)
class Slice:
    """A vertical slice along the line of sight of a view: all azimuths within half a thickness of one, m."""

    view: View
    azimuth_m: float
    thickness_m: float

    def axes(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """Ground range, growing away from the radar, and height of points, m."""
        return points[:, :2] @ self.view.look.ahead, points[:, 2]

    def within(self, points: Points) -> Bool[np.ndarray, " p"]:
        """Mask of the points in the slice."""
        return np.abs(points @ self.view.look.gradients[0] - self.azimuth_m) <= self.thickness_m / 2

    def through(self, mesh: Trimesh) -> Lines:
        """Line segments where the slice's middle plane cuts a mesh, m."""
        from trimesh.intersections import mesh_plane

        across = self.view.look.gradients[0]
        return np.asarray(mesh_plane(mesh, across, self.azimuth_m * across), dtype=np.float64).reshape(-1, 2, 3)


def brightest_layover(dataset: Dataset, points: Points, window: int) -> tuple[int, Slice]:
    """Index of the training image with the brightest layover, and the slice through it, `window` pixels thick.

    A pixel has layover if it holds points farther apart in elevation than the stack resolves. Without any layover, the
    slice goes through the brightest pixels.
    """
    found = []
    for index, (entry, power) in enumerate(zip(dataset.entries, dataset.power, strict=True)):
        if entry.split == "train" and entry.stack is not None:
            several = _several_heights(points, entry.view, entry.stack, dataset.grid)
            shown = np.where(several, power, 0) if several.any() else power
            sums = uniform_filter1d(shown.sum(0, dtype=np.float64), window, mode="constant")
            found.append((bool(several.any()), float(sums.max()), index, int(sums.argmax())))
    _, _, index, column = max(found)
    azimuth_m, width_m = float(dataset.grid.azimuth_m[column]), dataset.grid.spacing_m[0]
    return index, Slice(dataset.views[index], azimuth_m, window * width_m)


def _several_heights(
    points: Points, view: View, stack: Stack, grid: ImageGrid
) -> Bool[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Pixels that hold points whose elevations differ by more than the stack resolves."""
    across, elevation, slant = view.look.frame @ points.T
    column, row = (
        np.rint((places - centres[0]) / spacing).astype(int)
        for places, centres, spacing in zip(
            (across, slant), (grid.azimuth_m, grid.range_m), grid.spacing_m, strict=True
        )
    )
    inside = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.columns)
    pixels = row[inside], column[inside]
    low, high = np.full((grid.rows, grid.columns), np.inf), np.full((grid.rows, grid.columns), -np.inf)
    np.minimum.at(low, pixels, elevation[inside])
    np.maximum.at(high, pixels, elevation[inside])
    return high - low > stack.resolution_m


def slice_figure(run: Run, cut: Slice, truth: Path | None) -> Figure | None:
    """Points of a slice by ground range and height, reconstructed and by Capon's method, with the true surface.

    None if the slice has no points.
    """
    points = run.points
    if not len(points):
        return None
    low, high = float(points[:, 2].min()), float(points[:, 2].max())
    clouds = {"reconstruction": points, "Capon's method": capon_points(run.dataset, low, high)}
    clouds = {name: cloud[cut.within(cloud)] for name, cloud in clouds.items()}
    if not any(map(len, clouds.values())):
        return None
    lines = np.empty((0, 2, 3)) if truth is None else cut.through(of_stacks(read_truth_mesh(truth), run.dataset))
    frame = _frame(cut, [*clouds.values()], lines)
    panels = tuple(_panel(name, cut, cloud, lines, frame) for name, cloud in clouds.items())
    legend = "surface" if len(lines) else ""
    return Figure("Slice through the layover", _text(cut, lines), (Block("", panels),), legend=legend)


def _panel(name: str, cut: Slice, points: Points, lines: Lines, frame: Frame) -> Panel:
    """Chart of one cloud and the true surface, with one scale for range and height."""
    (left, right), (bottom, top) = frame

    def places(shown: Points) -> tuple[np.ndarray, np.ndarray]:
        ranges, heights = cut.axes(shown)
        return (ranges - left) / (right - left), (heights - bottom) / (top - bottom)

    dots = "".join(f"M{1000 * x:.4g} {1000 * (1 - y):.4g}h0" for x, y in zip(*places(points), strict=True))
    across, down = axis("ground range, m", left, right, 6), axis("height z, m", top, bottom)
    outline = [polyline(*places(line), "outline true") for line in lines]
    title = f"{name}, {counted(len(points), 'point')}"
    drawn = chart(title, f"{title}, in a vertical slice", across, down, [*outline, f'<path class="point" d="{dots}"/>'])
    return replace(drawn, aspect=(right - left) / (top - bottom))


def _frame(cut: Slice, clouds: Sequence[Points], lines: Lines) -> Frame:
    """Limits of ground range (of the points) and height (of points and true surface at these ranges), m."""
    ranges, heights = cut.axes(np.concatenate(clouds))
    near, far = float(ranges.min()), float(ranges.max())
    of_ends, heights_of_ends = cut.axes(lines.reshape(-1, 3))
    heights = np.concatenate([heights, heights_of_ends[(of_ends >= near) & (of_ends <= far)]])
    low, high = float(heights.min()), float(heights.max())
    margin = _MARGIN * max(far - near, high - low) or 1.0  # of a single point
    return (near - margin, far + margin), (low - margin, high + margin)


def _text(cut: Slice, lines: Lines) -> str:
    half = written(float(f"{cut.thickness_m / 2:.2g}"))
    text = (
        f"What is within {half} m of the azimuth {written(round(cut.azimuth_m, 2))} m ({view_name(cut.view)}), where "
        "pixels that show several heights at once are brightest: along the line on the power above. The radar is at "
        "the upper left. Capon's method takes each pixel by itself, from covariances averaged over 3 × 3 pixels."
    )
    return text if len(lines) else f"{text} The true surface is unknown."
