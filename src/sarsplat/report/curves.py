"""How training went: loss, and number of Gaussians where some are learned."""

from __future__ import annotations

from collections.abc import Sequence

from sarsplat.reconstruction.log import LogLine
from sarsplat.report.canvas import BLUE, FAINT, ORANGE, dress, new_figure, to_png


def curves_figure(history: Sequence[LogLine], loss_name: str) -> bytes:
    """Loss and, if any are learned, number of Gaussians against the iteration, as PNG.

    Parameters
    ----------
    history : sequence of LogLine
        Lines of `metrics.jsonl`, at least one.
    loss_name : str
        What the loss is, with its unit; it gets a logarithmic axis if it falls far.
    """
    iteration = [line.iteration for line in history]
    loss = [line.loss for line in history]
    counts = [line.gaussians for line in history if line.gaussians is not None]
    figure = new_figure(11, 3.2)
    every = figure.subplots(1, 2, width_ratios=(2, 1)) if counts else [figure.subplots()]
    left = every[0]
    left.plot(iteration, loss, color=BLUE, linewidth=1.4)
    if min(loss) > 0 and max(loss) > 5 * min(loss):
        left.set_yscale("log")
    left.set(xlabel="iteration", ylabel=loss_name, title=f"Loss: {loss[0]:.3g} → {loss[-1]:.3g}")
    if counts:
        right = every[1]
        right.plot(iteration, counts, color=ORANGE, linewidth=1.4)
        right.set_ylim(bottom=0)
        right.yaxis.set_major_formatter("{x:,.0f}")
        right.set(xlabel="iteration", title=f"Gaussians: {counts[-1]:,}")
    for axes in every:
        dress(axes)
        axes.set_xlim(0, max(1, *iteration))
        axes.grid(color=FAINT, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return to_png(figure)
