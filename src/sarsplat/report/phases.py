"""A training stack beside what was learned of it: power, phase and coherence of two passes."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from sarsplat.colours import COHERENCE, PHASE, gradient, ramp
from sarsplat.report.figure import Block, ColourBar, Figure, Panel, colour_bar
from sarsplat.report.images import Part, address, indexed, power_bar, target_window, view_name
from sarsplat.report.interferogram import Interferogram, Pair, averaged, spread_m
from sarsplat.report.layover import Slice
from sarsplat.runs import Run
from sarsplat.settings.sections import Passes

_LARGEST = 256
_TURNS = ((0.0, "−π"), (0.25, "−π/2"), (0.5, "0"), (0.75, "π/2"), (1.0, "π"))


def window_of(run: Run) -> int:
    """Side of the square of pixels over which its training averages covariances."""
    return (run.config.passes or Passes()).window


def phases_figure(run: Run, index: int, cut: Slice) -> Figure:
    """A training image of the run's dataset, of an interferometric stack, and what was learned of it.

    A line on the measured power shows where it is cut.
    """
    dataset, window = run.dataset, window_of(run)
    view, stack, power = dataset.views[index], dataset.stacks[index], dataset.power[index]
    assert dataset.signal is not None  # of stacks
    height_m = spread_m(run.points)
    pair, level = Pair.longest(stack, view, height_m), stack.plane_phases(view, dataset.grid)
    rendered = run.render_covariances([view], stack)[0]
    peak = float(dataset.images("train").max())
    part = Part.of(dataset.grid, target_window(power[None], peak, dataset.score_margin), _LARGEST)
    blocks = [
        _block(part, name, image, Interferogram.of(part.of_images(averaged(parts, window))), peak, line)
        for name, image, parts, line in (
            ("measured", power, pair.of_signals(dataset.signal[index], level), _line(part, cut.azimuth_m)),
            ("rendered", np.trace(rendered).real / len(stack), pair.of_covariances(rendered, level), ""),
        )
    ]
    return Figure(
        "Phase and coherence",
        _text(run, index, pair, height_m),
        tuple(blocks),
        (power_bar(), _phase_bar(pair), colour_bar("coherence, 0 to 1", COHERENCE, 0, 1)),
    )


def _block(
    part: Part, name: str, power: Float[np.ndarray, "r c"], shown: Interferogram, peak: float, drawing: str
) -> Block:
    def panel(title: str, indices: np.ndarray, colours: str) -> Panel:
        return part.panel(title, f"{name}: {title}", image=address(indices, ramp(colours)))

    return Block(
        name,
        (
            part.power("power", f"{name}: power", power, peak, drawing),
            panel("phase", indexed(shown.phase, -math.pi, math.pi), PHASE),
            panel("coherence", indexed(shown.coherence, 0, 1), COHERENCE),
        ),
    )


def _line(part: Part, azimuth_m: float) -> str:
    """Along all ranges of a part of the images, as SVG."""
    left, right, *_ = part.grid.part(part.rows, part.columns).extent_m
    return f'<path class="line second" d="M{1000 * (azimuth_m - left) / (right - left):.4g} 0v1000"/>'


def _phase_bar(pair: Pair) -> ColourBar:
    label = f"phase, rad; one cycle is {pair.cycle_m:.3g} m of height"
    return ColourBar(label, gradient(PHASE), _TURNS)


def _text(run: Run, index: int, pair: Pair, height_m: float) -> str:
    window, stack = window_of(run), run.dataset.stacks[index]
    why = (
        f"the longest baseline at which {height_m:.2g} m, the range of the reconstructed heights, are one cycle or less"
    )
    if pair.cycle_m < height_m:
        why = (
            f"the shortest baseline, at which {height_m:.2g} m, the range of the reconstructed heights, are still more "
        )
        why += "than one cycle"
    return (
        f"A training stack ({view_name(run.dataset.views[index])}) and what was learned of it. Power is the mean of "
        f"all {len(stack)} passes. Phase and coherence are those of passes {pair.first + 1} and {pair.second + 1}, "
        f"which have {why}. Covariances are averaged over {window} × {window} pixels, as in training, after the phase "
        f"of level ground was taken out: what is at z = 0 has the phase 0, what is {pair.cycle_m / 4:.3g} m higher a "
        "quarter of a cycle more. Averages of so few pixels leave some coherence where there is none."
    )
