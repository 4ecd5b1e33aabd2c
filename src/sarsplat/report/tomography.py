"""A vertical slice through layover: reconstructed points, those of Capon's method, and the true surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sarsplat.errors import counted
from sarsplat.evaluation import read_truth_mesh
from sarsplat.evaluation.capon import capon_points
from sarsplat.evaluation.surface import of_stacks
from sarsplat.report.figure import Block, Figure, Panel, axis, chart, polyline, written
from sarsplat.report.images import view_name
from sarsplat.report.layover import Points, Slice
from sarsplat.runs import Run

Lines = Float[np.ndarray, "lines 2 3"]
Frame = tuple[tuple[float, float], tuple[float, float]]

_MARGIN = 0.04  # around everything, of the longer side


def slice_figure(run: Run, cut: Slice, truth: Path | None) -> Figure | None:
    """Ground range and height of the points in a slice, beside those of Capon's method and the true surface.

    None if there are none.
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
    """One cloud in front of the true surface, as far away in height as in range."""
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
    """What is shown: where points are, and as high as the true surface is there; ground range and height, m."""
    ranges, heights = cut.axes(np.concatenate(clouds))
    near, far = float(ranges.min()), float(ranges.max())
    of_ends, heights_of_ends = cut.axes(lines.reshape(-1, 3))
    there = (of_ends >= near) & (of_ends <= far)
    heights = np.concatenate([heights, heights_of_ends[there]])
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
