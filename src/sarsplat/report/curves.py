"""Training curves: loss, number of Gaussians, and corrections of azimuths."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sarsplat.report.figure import Axis, Block, Figure, Panel, axis, chart, polyline, written
from sarsplat.runs import Run
from sarsplat.runs.run_folder import LogLine

_FALLS_FAR = 5.0  # times: the loss then gets a logarithmic axis


def curves_figure(history: Sequence[LogLine], loss_name: str, loss_unit: str) -> Figure:
    """Loss and, if any are learned, number of Gaussians against the iteration, of a history with at least one line."""
    iteration = np.array([line.iteration for line in history], dtype=float)
    loss = np.array([line.loss for line in history], dtype=float)
    counts = np.array([line.gaussians for line in history if line.gaussians is not None], dtype=float)
    panels = [_curve(f"loss: {loss[0]:.3g} → {loss[-1]:.3g}", loss_unit, iteration, loss)]
    if len(counts) == len(history):
        panels.append(_curve(f"Gaussians: {counts[-1]:,.0f}", "Gaussians", iteration, counts, zero=True))
    text = f"The loss is the {loss_name}, averaged over the training views."
    return Figure("Training", text, (Block("", tuple(panels)),))


def _curve(title: str, label: str, x: np.ndarray, y: np.ndarray, *, zero: bool = False) -> Panel:
    across = axis("iteration", 0, max(1.0, float(x.max())))
    if not zero and y.min() > 0 and y.max() > _FALLS_FAR * y.min():
        y = np.log10(y)
        low, high = _around(y)
        down = _powers_of_ten(label, low, high)
    else:
        low, high = (0.0, max(1.0, 1.05 * float(y.max()))) if zero else _around(y)
        down = axis(label, high, low)
    share = (y - low) / (high - low)
    line = polyline(x / max(1.0, float(x.max())), share, "line accent" if not zero else "line second")
    return chart(title, f"{title}, over {x.max():,.0f} iterations", across, down, [line])


def _around(values: np.ndarray) -> tuple[float, float]:
    """Limits of an axis with a margin; they differ even if all values are equal."""
    low, high = float(values.min()), float(values.max())
    room = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - room, high + room


def _powers_of_ten(label: str, low: float, high: float) -> Axis:
    """Ticks of a logarithmic axis between powers of ten; some are skipped where there are many decades."""
    step = max(1, int((high - low) // 5))
    factors = (1, 2, 5) if high - low < 2 else (1,)
    numbers = [(k + np.log10(f), f * 10.0**k) for k in range(int(low) - 1, int(high) + 2, step) for f in factors]
    shown = [((high - place) / (high - low), _short(number)) for place, number in numbers if low <= place <= high]
    return Axis(label, tuple(shown))


def _short(number: float) -> str:
    return written(number) if 1e-5 < number < 1e6 else f"{number:.0e}"


def azimuths_figure(run: Run) -> Figure | None:
    """Corrections against azimuths as labelled, with the standard deviations that the dataset gives, all in degrees.

    None if no azimuth was corrected.
    """
    if not run.azimuth_offset_deg.any():
        return None
    entries = run.dataset.select("train").entries
    azimuth = np.array([entry.view.azimuth_deg for entry in entries]) % 360
    order = np.argsort(azimuth, kind="stable")
    azimuth, offset = azimuth[order] / 360, run.azimuth_offset_deg[order]
    std = np.array([entry.azimuth_std_deg for entry in entries])[order]
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
