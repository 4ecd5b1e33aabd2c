"""Draw time against Gaussians and against pixels, with the floor under it: docs/images/growth.png."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

PANELS = {"gaussians": "Gaussians (0.24 to a pixel)", "pixels": "pixels (64 to a Gaussian)"}


def draw(growth: dict[str, Any], path: Path) -> None:
    """Both series, log-log."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.7), sharey=True, layout="constrained")
    for ax, (name, label) in zip(axes, PANELS.items(), strict=True):
        rows = growth["series"][name]
        sizes = [row["gaussians"] if name == "gaussians" else row["side"] ** 2 for row in rows]
        panel(ax, np.array(sizes, dtype=float), rows, growth["slopes"][name])
        ax.set_xlabel(label)
    axes[0].set_ylabel("forward + backward (ms)")
    axes[0].legend(loc="upper left", fontsize=9)
    figure.savefig(path, dpi=90, facecolor="white", pil_kwargs={"optimize": True})
    plt.close(figure)


def panel(ax: Axes, sizes: np.ndarray, rows: list[dict[str, Any]], slope: float) -> None:
    """One series: medians with their 10 … 90 %, the fitted line, and the floor."""
    median, low, high = (1e3 * np.array([row["seconds"][key] for row in rows]) for key in ("median", "p10", "p90"))
    floor = 1e3 * np.array([row["floor_s"] for row in rows])
    fit = np.exp(np.log(median).mean() + slope * (np.log(sizes) - np.log(sizes).mean()))
    ax.plot(sizes, fit, color="#4878a8", lw=1, alpha=0.6)
    spread = np.maximum([median - low, high - median], 0)
    ax.errorbar(sizes, median, spread, fmt="o", ms=5, color="#4878a8", capsize=2, label="measured, 10 … 90 %")
    ax.plot(sizes, floor, color="#c0392b", lw=1.2, ls="--", label="floor: arithmetic of the visited blocks")
    ax.text(0.97, 0.06, f"slope {slope:.2f}", transform=ax.transAxes, ha="right", fontsize=11, color="#4878a8")
    for row, x, y in zip(rows, sizes, median, strict=True):
        ax.annotate(f"{row['side']}²", (x, y), (-4, 7), textcoords="offset points", ha="right", fontsize=8)
    ax.set(xscale="log", yscale="log")
    ax.margins(x=0.12, y=0.12)
    ax.grid(alpha=0.25)
