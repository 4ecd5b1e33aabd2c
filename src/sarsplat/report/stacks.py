"""Figures of stacks: measured and rendered interferograms of two passes, and polarisations in Pauli's basis."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Float64
from scipy.ndimage import correlate

from sarsplat.colours import COHERENCE, PHASE, gradient, ramp
from sarsplat.data.coverage import evenly_chosen
from sarsplat.geometry import Stack, View
from sarsplat.radiometry import white_level
from sarsplat.report.figure import Block, ColourBar, Figure, colour_bar
from sarsplat.report.images import Part, address, indexed, power_bar, target_window, view_name
from sarsplat.report.layover import Slice
from sarsplat.runs import Run

_LARGEST = 256
_TURNS = ((0.0, "−π"), (0.25, "−π/2"), (0.5, "0"), (0.75, "π/2"), (1.0, "π"))
_INLIERS = 0.01, 0.99  # quantiles of the points' heights beyond which points are outliers

PAULI = frozenset(("HH", "VV"))
"""Polarisations that a Pauli picture needs."""

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


def phases_figure(run: Run, index: int, cut: Slice, window: int) -> Figure:
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
