"""Match of an image with templates: coarse correlation over displacements, then the likelihood of speckle.

The score is the negative log-likelihood of exponential power I with mean gS for its best gain g = mean(I / S):
log g + mean(log S) + 1, nats per pixel. Azimuths are chosen by that of a Lomax distribution, in which S is known up to
a factor, log g + mean(log S + (a + 1) log(1 + I / agS)): few bright pixels decide less. The window is fixed in the
image, and the template S is displaced. An image's result depends neither on other images nor on the number of threads:
products of matrices have a fixed shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sarsplat.evaluation.templates import COARSE, Window
from sarsplat.radiometry import DYNAMIC_RANGE_DB, from_db

_CANDIDATES, _REVERSED = (12, 3), (6, 1)
"""Number of azimuths whose likelihood is computed, and of those whose displacement is refined: of all, and of those
around the opposite of the best one."""

_SECTOR_DEG = 45.0  # half width of the sector of opposite azimuths, degrees

_FINE = np.array([(down, right) for down in (0, -1, 1) for right in (0, -1, 1)])
"""Displacements of the fine search, pixels."""

_SHAPES = (4.0, 8.0, 16.0, np.inf)
"""Shapes a of the Lomax distribution; the likeliest, by the run that fits an image best, is that of all runs."""

_ROUNDS = 4  # number of steps of expectation maximisation to the best gain of a Lomax distribution
_LEAST_CURVATURE = 1e-12  # minimum second difference, nats per pixel and square step


@dataclass(frozen=True)
class Match:
    """Best match of an image with each of Q runs."""

    nats: Float64[np.ndarray, " q"]
    """Least negative log-likelihood of speckle, nats per pixel, of the image divided by its mean in the window."""
    azimuth_deg: Float64[np.ndarray, " q"]
    """Likeliest azimuth by the Lomax distribution, degrees, in [0, 360)."""
    reversal: Float64[np.ndarray, " q"]
    """Nats per pixel, of that distribution, by which azimuths within 45° of the opposite one are less likely."""
    curvature: Float64[np.ndarray, " q"]
    """Second derivative of these nats with respect to azimuth, degrees⁻²."""
    shift: Int64[np.ndarray, "q 2"]
    """Displacement of the target, pixels in range and azimuth."""
    gain: Float64[np.ndarray, " q"]
    """Factor on the rendered power."""


class Matcher:
    """Templates of Q runs, prepared for matching.

    Parameters
    ----------
    power : sequence of numpy.ndarray, float32 [A, m, n]
        Linear power > 0 of each run at A evenly spaced azimuths from 0, in the window with its margins.
    window : Window
        The window.
    """

    def __init__(self, power: Sequence[Float32[np.ndarray, "a m n"]], window: Window) -> None:
        self._window, self._runs, self._azimuths = window, len(power), len(power[0])
        down, across = window.margins
        inner = [_smooth_logs(torch.from_numpy(one))[:, down:-down, across:-across] for one in power]
        coarse = torch.cat([_standardised(avg_pool2d(one, COARSE).flatten(1)) for one in inner])
        self._coarse = coarse.T.contiguous()
        self._inverse = sliding_window_view(np.stack([1 / one for one in power]), window.size, (2, 3))
        self._mean_log = np.stack([_box_means(np.log(one, dtype=np.float64), window.size) for one in power])

    def __call__(self, power: Float32[np.ndarray, "m n"]) -> Match:
        """Match linear power, not all zero, in the window with its margins."""
        down, across = self._window.margins
        level = power[down:-down, across:-across].mean(dtype=np.float64)
        image = np.maximum(power / level, from_db(-DYNAMIC_RANGE_DB)).astype(np.float32)
        fits, shifts = self._correlations(image)
        image = image[down:-down, across:-across]
        nats, azimuth, shift = self._best(image, fits, shifts, *_CANDIDATES)
        at, run = np.unravel_index([nats.argmin()], nats.shape), np.arange(self._runs)[:, None]
        shape = min(_SHAPES, key=lambda a: self._nats(image, at[0], azimuth[at], shift[at], a)[0].item())
        best = self._nats(image, run, azimuth, shift, shape)[0].argmin(axis=1)[:, None]
        first = np.take_along_axis(azimuth, best, axis=1)
        turns = np.abs((np.arange(self._azimuths) - first) * 360 / self._azimuths % 360 - 180)
        opposite = np.where(turns <= _SECTOR_DEG, fits, -np.inf)
        others = self._best(
            image, opposite, shifts, min(_REVERSED[0], int((turns[0] <= _SECTOR_DEG).sum())), _REVERSED[1]
        )
        found, other = (self._between_azimuths(image, shifts, one, shape) for one in (first, others[1]))
        better = other[0] < found[0]  # then what correlates best is the reversed one
        chosen = (np.where(better.reshape(-1, *[1] * (b.ndim - 1)), a, b) for a, b in zip(other, found, strict=True))
        _, azimuth_deg, curvature, gain, shift = chosen
        least = np.minimum(nats.min(axis=1), others[0].min(axis=1))
        return Match(least, azimuth_deg, np.abs(found[0] - other[0]), curvature, shift, gain * level)

    def _between_azimuths(
        self,
        image: Float32[np.ndarray, "r c"],
        shifts: Int64[np.ndarray, "q a 2"],
        azimuth: Int64[np.ndarray, "q 1"],
        shape: float,
    ) -> tuple[np.ndarray, ...]:
        """Return nats, azimuth (degrees), curvature (per square degree), gain and displacement of each run, all [q].

        The first three are of the vertex of a parabola through `azimuth` and its neighbours; gain and displacement are
        those of speckle at `azimuth`.
        """
        run, three = np.arange(self._runs)[:, None], (azimuth + np.array([-1, 0, 1])) % self._azimuths
        _, moved = self._displaced(image, run, three, shifts)
        nats, _ = self._nats(image, run, three, moved, shape)
        _, gain = self._nats(image, run[:, 0], three[:, 1], moved[:, 1])
        step_deg, bend = 360 / self._azimuths, np.maximum(nats[:, 0] + nats[:, 2] - 2 * nats[:, 1], _LEAST_CURVATURE)
        offset = np.clip((nats[:, 0] - nats[:, 2]) / (2 * bend), -0.5, 0.5)
        vertex = nats[:, 1] + offset * ((nats[:, 2] - nats[:, 0]) / 2 + offset * bend / 2)
        return vertex, (three[:, 1] + offset) * step_deg % 360, bend / step_deg**2, gain, moved[:, 1]

    def _correlations(
        self, image: Float32[np.ndarray, "m n"]
    ) -> tuple[Float32[np.ndarray, "q a"], Int64[np.ndarray, "q a 2"]]:
        """Return the best correlation of logarithms with each template, and its displacement, pixels."""
        logs = avg_pool2d(_smooth_logs(torch.from_numpy(image)[None])[:, 1:-1, 1:-1], COARSE)[0]
        rows, columns = (side // COARSE for side in self._window.size)
        moved = logs.unfold(0, rows, 1).unfold(1, columns, 1)
        found = (_standardised(moved.reshape(-1, rows * columns)) @ self._coarse) / (rows * columns)
        fits, index = (one.view(self._runs, self._azimuths).numpy() for one in found.max(dim=0))
        steps = np.stack(np.divmod(index, moved.shape[1]), axis=-1) - np.array(self._window.steps)
        return fits, COARSE * steps

    def _best(
        self,
        image: Float32[np.ndarray, "r c"],
        fits: Float32[np.ndarray, "q a"],
        shifts: Int64[np.ndarray, "q a 2"],
        candidates: int,
        refined: int,
    ) -> tuple[Float64[np.ndarray, "q k"], Int64[np.ndarray, "q k"], Int64[np.ndarray, "q k 2"]]:
        """Return nats, indices and displacements of the most likely of the azimuths that correlate best."""
        run = np.arange(self._runs)[:, None]
        azimuth = np.argsort(-fits, axis=1, kind="stable")[:, :candidates]
        nats, _ = self._nats(image, run, azimuth, shifts[run, azimuth])
        azimuth = np.take_along_axis(azimuth, np.argsort(nats, axis=1, kind="stable")[:, :refined], axis=1)
        nats, moved = self._displaced(image, run, azimuth, shifts)
        return nats, azimuth, moved

    def _displaced(
        self,
        image: Float32[np.ndarray, "r c"],
        run: Int64[np.ndarray, "q 1"],
        azimuth: Int64[np.ndarray, "q k"],
        shifts: Int64[np.ndarray, "q a 2"],
    ) -> tuple[Float64[np.ndarray, "q k"], Int64[np.ndarray, "q k 2"]]:
        """Return nats of speckle and displacements, the most likely near those that correlate best."""
        moved = shifts[run, azimuth][:, :, None] + _FINE
        nats, _ = self._nats(image, run[..., None], azimuth[..., None], moved)
        best = nats.argmin(axis=-1)[..., None]
        moved = np.take_along_axis(moved, best[..., None], axis=2)[:, :, 0]
        return np.take_along_axis(nats, best, axis=-1)[..., 0], moved

    def _nats(
        self,
        image: Float32[np.ndarray, "r c"],
        run: Int64[np.ndarray, "*#k"],
        azimuth: Int64[np.ndarray, "*#k"],
        shift: Int64[np.ndarray, "*#k 2"],
        shape: float = np.inf,
    ) -> tuple[Float64[np.ndarray, "*#k"], Float64[np.ndarray, "*#k"]]:
        """Return nats per pixel and gain of displaced templates, by a Lomax distribution of that shape."""
        first = np.array(self._window.margins) - shift
        at = (run, azimuth, first[..., 0], first[..., 1])
        relative = self._inverse[at] * image
        gain, tails = relative.mean(axis=(-2, -1), keepdims=True), np.float64(1)
        if shape < np.inf:
            for _ in range(_ROUNDS):
                gain = (relative / (shape + relative / gain)).mean(axis=(-2, -1), keepdims=True) * (shape + 1)
            tails = (shape + 1) * np.log1p(relative / (shape * gain)).mean(axis=(-2, -1))
        gain = gain[..., 0, 0].astype(np.float64)
        return np.log(gain) + self._mean_log[at] + tails, gain


def _smooth_logs(power: Float[Tensor, "v m n"]) -> Float[Tensor, "v m n"]:
    """Logarithms of means over 3 × 3 pixels."""
    return avg_pool2d(power[:, None], 3, stride=1, padding=1, count_include_pad=False)[:, 0].log()


def _standardised(rows: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    """Rows of mean 0 and variance 1."""
    centred = rows - rows.mean(1, keepdim=True)
    return centred / centred.square().mean(1, keepdim=True).sqrt().clamp(min=1e-6)


def _box_means(images: Float64[np.ndarray, "a m n"], size: tuple[int, int]) -> Float64[np.ndarray, "a u v"]:
    """Means over all windows of a size."""
    sums = np.pad(images.cumsum(1).cumsum(2), ((0, 0), (1, 0), (1, 0)))
    rows, columns = size
    sums = sums[:, rows:] - sums[:, :-rows]
    return (sums[..., columns:] - sums[..., :-columns]) / (rows * columns)
