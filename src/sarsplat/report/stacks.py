"""Figures of stacks: interferograms of two passes, a vertical slice through layover, and polarisations."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Complex, Float, Float64
from scipy.ndimage import correlate, uniform_filter1d

from sarsplat.colours import COHERENCE, PHASE, gradient, ramp
from sarsplat.data import Dataset
from sarsplat.data.coverage import evenly_chosen
from sarsplat.errors import counted
from sarsplat.evaluation import read_truth_mesh
from sarsplat.evaluation.capon import capon_points
from sarsplat.evaluation.surface import of_stacks
from sarsplat.extras import Trimesh
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.radiometry import white_level
from sarsplat.report.figure import Block, ColourBar, Figure, Panel, axis, chart, colour_bar, polyline, written
from sarsplat.report.images import Part, address, indexed, power_bar, target_window, view_name
from sarsplat.runs import Run

Points = Float[np.ndarray, "p 3"]
Lines = Float[np.ndarray, "lines 2 3"]
Frame = tuple[tuple[float, float], tuple[float, float]]

_LARGEST = 256
_TURNS = ((0.0, "−π"), (0.25, "−π/2"), (0.5, "0"), (0.75, "π/2"), (1.0, "π"))
_INLIERS = 0.01, 0.99  # quantiles of the points' heights beyond which points are outliers

PAULI = frozenset(("HH", "VV"))
"""Polarisations that a Pauli picture needs."""

_MARGIN = 0.04  # around the slice, of the longer side

_SHOWN = 3  # training images in the Pauli figure
_BRIGHT = 0.99  # quantile of the measured powers at full brightness


@dataclass(frozen=True)
class Pair:
    """Numbers of two passes, ordered so that the phase of `first` × conj(`second`) grows with height."""

    first: int
    second: int
    cycle_m: float
    """Height that is one turn of the phase, m."""

    @classmethod
    def longest(cls, stack: Stack, view: View, height_m: float) -> "Pair":
        """Find the longest baseline whose phase turns at most once over `height_m`, else the shortest baseline."""
        per_height = stack.elevation_numbers(view) / view.look.height_per_elevation
        pairs = [  # rounded: of even passes, the first are alike
            cls(i, j, float(f"{2 * math.pi / (per_height[i] - per_height[j]):.6g}"))
            for i, j in itertools.permutations(range(len(stack)), 2)
            if per_height[i] > per_height[j]
        ]
        unambiguous = [pair for pair in pairs if pair.cycle_m >= height_m]
        return (min if unambiguous else max)(unambiguous or pairs, key=lambda pair: pair.cycle_m)

    def of(
        self, covariances: Complex[np.ndarray, "p p rows columns"], level: Float[np.ndarray, "p rows columns"]
    ) -> Float64[np.ndarray, "4 rows columns"]:
        """Both powers and the deramped product, from covariances of all passes and phases of level ground, rad."""
        i, j = self.first, self.second
        deramped = covariances[i, j] * np.exp(1j * (level[j] - level[i]))
        powers = covariances[i, i].real, covariances[j, j].real
        return np.stack([*powers, deramped.real, deramped.imag]).astype(np.float64)


@dataclass(frozen=True)
class Interferogram:
    """Phase, rad, and coherence, 0 to 1, of each pixel."""

    phase: Float64[np.ndarray, "rows columns"]
    coherence: Float64[np.ndarray, "rows columns"]

    @classmethod
    def of(cls, parts: Float64[np.ndarray, "4 rows columns"]) -> "Interferogram":
        """The interferogram from both powers and the deramped product of the two passes."""
        first, second, real, imaginary = parts
        least = np.finfo(np.float64).tiny
        coherence = np.hypot(real, imaginary) / np.sqrt(np.maximum(first * second, least))
        return cls(np.arctan2(imaginary, real), np.clip(coherence, 0, 1))


def averaged(parts: Float64[np.ndarray, "n rows columns"], window: int) -> Float64[np.ndarray, "n rows columns"]:
    """Means over `window` × `window` pixels, at edges over the part of the window inside, as in training."""
    weights = np.ones((1, window, window))
    count = correlate(np.ones_like(parts[:1]), weights, mode="constant")
    means: Float64[np.ndarray, "n rows columns"] = correlate(parts, weights, mode="constant") / count
    return means


def spread_m(points: Float[np.ndarray, "p 3"]) -> float:
    """Height range of points, m, without outliers."""
    return float(np.ptp(np.quantile(points[:, 2], _INLIERS))) if len(points) else 0.0


def covariances(signals: Complex[np.ndarray, "p rows columns"]) -> Complex[np.ndarray, "p p rows columns"]:
    """Covariances of single samples: products of every pass with the conjugate of every pass."""
    return signals[:, None] * signals[None].conj()


def phases_figure(run: Run, index: int, cut: "Slice", window: int) -> Figure:
    """Power, phase and coherence of a training stack, measured and rendered.

    A line on the measured power marks the slice `cut`. Covariances are averaged over `window` × `window` pixels.
    """
    dataset = run.dataset
    view, stack, power = dataset.views[index], dataset.stacks[index], dataset.power[index]
    assert dataset.signal is not None  # of stacks
    height_m = spread_m(run.points)
    pair, level = Pair.longest(stack, view, height_m), stack.plane_phases(view, dataset.grid)
    rendered = run.render_covariances([view], stack)[0]
    peak = white_level(dataset.images("train"))
    part = Part.of(dataset.grid, target_window(power[None], peak, dataset.score_margin), _LARGEST)
    blocks = []
    for name, image, parts, line in (
        ("measured", power, pair.of(covariances(dataset.signal[index]), level), _line(part, cut.azimuth_m)),
        ("rendered", np.trace(rendered).real / len(stack), pair.of(rendered, level), ""),
    ):
        interferogram = Interferogram.of(part.of_images(averaged(parts, window)))
        panels = [part.power("power", f"{name}: power", image, peak, line)]
        for title, values, ends, colours in (
            ("phase", interferogram.phase, (-math.pi, math.pi), PHASE),
            ("coherence", interferogram.coherence, (0, 1), COHERENCE),
        ):
            picture = address(indexed(values, *ends), ramp(colours))
            panels.append(part.panel(title, f"{name}: {title}", image=picture))
        blocks.append(Block(name, tuple(panels)))
    cycles = ColourBar(f"phase, rad; one cycle is {pair.cycle_m:.3g} m of height", gradient(PHASE), _TURNS)
    return Figure(
        "Phase and coherence",
        _text(run, index, pair, height_m, window),
        tuple(blocks),
        (power_bar(), cycles, colour_bar("coherence, 0 to 1", COHERENCE, 0, 1)),
    )


def _line(part: Part, azimuth_m: float) -> str:
    """Line along all ranges at one azimuth, as SVG."""
    left, right, *_ = part.grid.part(part.rows, part.columns).extent_m
    return f'<path class="line second" d="M{1000 * (azimuth_m - left) / (right - left):.4g} 0v1000"/>'


def _text(run: Run, index: int, pair: Pair, height_m: float, window: int) -> str:
    heights = f"{height_m:.2g} m, the range of the reconstructed heights, are"
    why = f"the longest baseline at which {heights} one cycle or less"
    if pair.cycle_m < height_m:
        why = f"the shortest baseline, at which {heights} still more than one cycle"
    return (
        f"A training stack ({view_name(run.dataset.views[index])}) and what was learned of it. Power is the mean of "
        f"all {len(run.dataset.stacks[index])} passes. Phase and coherence are those of passes {pair.first + 1} and "
        f"{pair.second + 1}, which have {why}. Covariances are averaged over {window} × {window} pixels, as in "
        "training, after the phase of level ground was taken out: what is at z = 0 has the phase 0, what is "
        f"{pair.cycle_m / 4:.3g} m higher a quarter of a cycle more. Averages of so few pixels leave some coherence "
        "where there is none."
    )


# ---- slice through layover ------------------------------------------------------------------------------------------
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
    return Figure("Slice through the layover", _slice_text(cut, lines), (Block("", panels),), legend=legend)


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


def _slice_text(cut: Slice, lines: Lines) -> str:
    half = written(float(f"{cut.thickness_m / 2:.2g}"))
    text = (
        f"What is within {half} m of the azimuth {written(round(cut.azimuth_m, 2))} m ({view_name(cut.view)}), where "
        "pixels that show several heights at once are brightest: along the line on the power above. The radar is at "
        "the upper left. Capon's method takes each pixel by itself, from covariances averaged over 3 × 3 pixels."
    )
    return text if len(lines) else f"{text} The true surface is unknown."


# ---- polarisations ---------------------------------------------------------------------------------------------------
def pauli(
    matrices: Complex[np.ndarray, "p p rows columns"], polarisations: tuple[str, ...]
) -> Float64[np.ndarray, "3 rows columns"]:
    """Powers of HH − VV (two bounces), of the cross-polarised channels (volumes), and of HH + VV (one bounce).

    E|HH ∓ VV|² / 2 and E|HV|² + E|VH|²; a missing HV or VH counts as equal to the other.
    """
    hh, vv = polarisations.index("HH"), polarisations.index("VV")
    both, between = matrices[hh, hh].real + matrices[vv, vv].real, matrices[hh, vv].real
    crossed = [matrices[i, i].real for i, name in enumerate(polarisations) if name in ("HV", "VH")]
    volume = 2 * np.mean(crossed, axis=0) if crossed else np.zeros_like(both)
    return np.stack([both / 2 - between, volume, both / 2 + between]).astype(np.float64)


def pauli_figure(run: Run, window: int) -> Figure:
    """Pauli pictures of some training images, measured (averaged over `window` × `window` pixels) and rendered."""
    train = run.dataset.select("train")
    assert train.signal is not None  # of stacks
    part = Part.of(train.grid, target_window(train.power, white_level(train.power), train.score_margin), _LARGEST)
    shown = evenly_chosen(train.views, min(_SHOWN, len(train)))
    measured, rendered = [], []
    for index in shown:
        stack, samples = train.stacks[index], covariances(train.signal[index])
        measured.append(averaged(pauli(samples, stack.of_channels), window))
        rendered.append(pauli(run.render_covariances([train.views[index]], stack)[0], stack.of_channels))
    brightest = max(float(np.quantile(np.stack(measured), _BRIGHT)), np.finfo(np.float32).tiny)
    blocks = []
    for name, images in (("measured", measured), ("rendered", rendered)):
        panels = []
        for index, image in zip(shown, images, strict=True):
            colours = indexed(np.sqrt(part.of_images(image.clip(min=0)) / brightest), 0, 1)
            title = f"azimuth {round(train.views[index].azimuth_deg, 1):g}°"
            picture = address(np.ascontiguousarray(np.moveaxis(colours, 0, -1)))
            panels.append(part.panel(title, f"{name}: polarisations, {view_name(train.views[index])}", image=picture))
        blocks.append(Block(name, tuple(panels)))
    text = (
        "Training images and what was learned of them. Red is the power of HH − VV, which two bounces make strong; "
        "green that of the cross-polarised channels, which volumes do; blue that of HH + VV, which single bounces do. "
        f"Brightness is amplitude, measured ones averaged over {window} × {window} pixels, as in training."
    )
    return Figure("Polarisations", text, tuple(blocks))
