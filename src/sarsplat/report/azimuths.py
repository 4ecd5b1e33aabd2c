"""Uncertain azimuths: what the training made of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sarsplat.report.canvas import BLUE, FAINT, MUTED, ORANGE, dress, new_figure, to_png


def azimuths_figure(
    azimuth_deg: Sequence[float], offset_deg: Float[np.ndarray, " k"], std_deg: Float[np.ndarray, " k"]
) -> bytes:
    """Corrections of azimuths against the azimuths, as PNG.

    Parameters
    ----------
    azimuth_deg : sequence of float
        As labelled, degrees.
    offset_deg : numpy.ndarray, float [K]
        What was added to each, degrees.
    std_deg : numpy.ndarray, float [K]
        Their standard deviations before, degrees.
    """
    azimuth = np.asarray(azimuth_deg) % 360
    order = np.argsort(azimuth, kind="stable")
    azimuth, offset, std = azimuth[order], offset_deg[order], std_deg[order]
    figure = new_figure(11, 3.2)
    axes = figure.subplots()
    axes.fill_between(azimuth, -std, std, color=BLUE, alpha=0.2, linewidth=0, step="mid")
    axes.axhline(0, color=MUTED, linewidth=0.8)
    axes.vlines(azimuth, 0, offset, color=ORANGE, linewidth=1)
    axes.plot(azimuth, offset, "o", color=ORANGE, markersize=4)
    rms, largest = np.sqrt((offset**2).mean()), np.abs(offset).max()
    axes.set(
        xlabel="azimuth as labelled, degrees",
        ylabel="correction, degrees",
        title=f"Azimuth corrections: rms {rms:.2f}°, largest {largest:.2f}°",
        xlim=(0, 360),
        xticks=range(0, 361, 45),
    )
    dress(axes)
    axes.grid(color=FAINT, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return to_png(figure)
