"""Corrections of uncertain azimuths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sarsplat.report.figure import Block, Figure, axis, chart, polyline


def azimuths_figure(
    azimuth_deg: Sequence[float], offset_deg: Float[np.ndarray, " k"], std_deg: Float[np.ndarray, " k"]
) -> Figure:
    """Corrections of azimuths against the azimuths.

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
    azimuth, offset, std = azimuth[order] / 360, offset_deg[order], std_deg[order]
    largest = 1.1 * max(float(np.abs(offset).max()), float(std.max()))

    def share(value: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return (value / largest + 1) / 2

    band = polyline(np.concatenate([azimuth, azimuth[::-1]]), share(np.concatenate([std, -std[::-1]])), "band")
    drawn = [
        polyline(np.array([x, x]), share(np.array(ends)), style)
        for x, y in zip(azimuth, offset, strict=True)
        for ends, style in (((0.0, y), "line second"), ((y, y), "dot second"))
    ]
    rms, most = np.sqrt((offset**2).mean()), np.abs(offset).max()
    title = f"rms {rms:.2f}°, largest {most:.2f}°"
    panel = chart(
        title,
        f"corrections of {len(offset)} azimuths, {title}",
        axis("azimuth as labelled, degrees", 0, 360, 5),
        axis("correction, degrees", largest, -largest, 5),
        [band, *drawn],
    )
    text = (
        "The estimated deviation of each training image's azimuth from its label. "
        "The band is ± one standard deviation, as the dataset gives it."
    )
    return Figure("Azimuth corrections", text, (Block("", (panel,)),))
