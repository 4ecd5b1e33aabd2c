"""Residuals of rendered images: in decibels, or under speckle in its standard deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Real

from sarsplat.colours import DIFFERENCE_IN_WORDS
from sarsplat.evaluation import UndefinedScore, register
from sarsplat.evaluation.images import smoothed
from sarsplat.geometry import ImageGrid
from sarsplat.radiometry import DYNAMIC_RANGE_DB, difference_db, from_db

Stack = Real[np.ndarray, "v rows columns"]

_LARGEST_DB, _LARGEST_SIGMA = 6.0, 4.0
"""Ends of the colour scale; larger differences are clipped."""

_LEAST_WINDOW = 3
_DARKEST_DB = -60.0  # floor of rendered power below the peak: σ is never 0


def window(grid: ImageGrid) -> tuple[int, int, float]:
    """Rows and columns of the averaging window of residuals, and its number of independent samples.

    The smallest window of odd sides, at least 3 × 3 pixels, that holds a resolution cell; see
    `ImageGrid.independent_samples`.
    """
    columns, rows = (
        max(_LEAST_WINDOW, 2 * math.ceil((width / spacing - 1) / 2) + 1)
        for width, spacing in zip(grid.resolution_m, grid.spacing_m, strict=True)
    )
    share = grid.independent_samples / (grid.rows * grid.columns)
    return rows, columns, max(1.0, share * rows * columns)


@dataclass(frozen=True)
class Difference:
    """Error shown in figures: its label, range and explanation.

    `looks` is that of the true images (None without speckle), `peak` the power shown white.
    """

    looks: float | None
    grid: ImageGrid
    peak: float

    @property
    def largest(self) -> float:
        """End of the colour scale; larger values are clipped."""
        return _LARGEST_DB if self.looks is None else _LARGEST_SIGMA

    @property
    def label(self) -> str:
        """Label of the colour bar."""
        return "reconstruction over truth, dB" if self.looks is None else "residual ÷ σ of the speckle"

    @property
    def explained(self) -> str:
        """Caption."""
        colours = f"{DIFFERENCE_IN_WORDS.capitalize()}."
        if self.looks is None:
            return (
                f"{colours} Values more than {DYNAMIC_RANGE_DB:g} dB below what is white in the images count as equal."
            )
        rows, columns, independent = window(self.grid)
        return (
            "Each reconstruction is shifted by up to 3 pixels and scaled to fit its image best, as in scoring. "
            f"{colours} The residual, reconstruction minus measured power averaged over {rows} × "
            f"{columns} pixels (the smallest odd window that holds a resolution cell), is divided by σ, the "
            f"standard deviation that speckle of {self.looks:g} look{'' if self.looks == 1 else 's'} leaves in that "
            f"average of {independent:.1f} independent samples: speckle alone gives values within about ±2."
        )

    def of(self, truth: Stack, rendered: Stack) -> Float64[np.ndarray, "v rows columns"]:
        """Error of rendered against true images, β⁰ in linear power [V, rows, columns].

        Without speckle 10·log10(rendered / truth), both at least −40 dB of the peak. With speckle of L looks (mean(S) −
        mean(I)) / √(mean(S²) / (L·n)), means over a window with n independent samples: I scatters around S by S/√L.
        """
        truth, rendered = truth.astype(np.float64), rendered.astype(np.float64)
        if self.looks is None:
            return difference_db(rendered, truth, self.peak, -DYNAMIC_RANGE_DB)
        rendered = np.maximum(rendered, self.peak * from_db(_DARKEST_DB))
        *size, independent = window(self.grid)
        sigma = np.sqrt(smoothed(rendered**2, *size) / (self.looks * independent))
        return smoothed(rendered - truth, *size) / sigma


def fitted(truth: Stack, rendered: Stack, looks: float | None, margin: int) -> Stack:
    """Align rendered images as in scoring: under speckle, shift and scale them to fit the true images best."""
    if looks is None:
        return rendered
    try:
        best = register(truth, rendered, margin)
    except UndefinedScore:  # the evaluation gives the reason
        return rendered
    moved = [np.roll(image, tuple(shift), (0, 1)) for image, shift in zip(rendered, best.shift, strict=True)]
    return np.stack(moved) * best.gain[:, None, None]
