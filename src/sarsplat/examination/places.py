"""Single images that are not where they belong: two files swapped, a wrong azimuth, some images mirrored or turned.

Brought to one frame on the ground, an image is like those of neighbouring azimuths. One that belongs elsewhere is not,
and where it belongs it is, as much as others are: only both together count, for a flash is like no other image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Complex64, Float32
from scipy.fft import irfft2, next_fast_len, rfft2

from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.examination.neighbouring_views import normalised, reach, shown_at
from sarsplat.examination.outcome import Examination
from sarsplat.examination.repeated import named
from sarsplat.geometry import ImageGrid, View
from sarsplat.regions.outlines import levels_db

_PLACES = 64
"""Along a side of the ground."""

_FREE = 0.25
"""Shift with which images may match, of half the side of the ground: what is high is displaced."""

_FARTHEST_DEG = 31.0
_SAME_GRAZING_DEG = 5.0
_ON_EACH_SIDE = 2
"""Neighbours: so many clockwise and counter-clockwise, not farther and of about the same grazing angle."""

_LEAST_GAIN, _GAIN_AT_30_DEG = 0.05, 0.1
"""Correlation by which an image must match better elsewhere at least, and by how much more if its neighbours are 30°
away, by the square of that: the farther, the less they are like it by themselves. Of honest sets, SLICY comes nearest
for a single image, to 0.7 of it; see docs/lab/2026-11-single-azimuths.md."""

_ALONE = 2.0
"""Factor on that if nothing else speaks for it: of a pair, each image does."""

_FARTHEST_ALONE_DEG = 20.0
"""Neighbours beyond which nothing is said of an image alone."""

_STEP_DEG = 5.0
"""Of the azimuths that are tried for an image."""

_ALIKE = 0.6
"""Correlation of neighbours, the median of all images: below, nothing follows from what is unlike."""

_CANDIDATES = 12
"""Images that are looked at more closely: those least like their neighbours."""

_MOST_PAIRS = 3
"""That are named."""

_AT_ONCE = 64
"""Images whose decibels are held at a time."""

_FEWEST = 8
"""Images: of fewer nothing is said."""

_Flip: TypeAlias = tuple[int, int]
"""Steps along rows and columns."""

_Spectrum: TypeAlias = Complex64[np.ndarray, "m n"]

_AS_IT_IS: _Flip = (1, 1)

_FLIPS: dict[str, _Flip] = {"mirrored": (1, -1), "upside down": (-1, 1), "turned by a half": (-1, -1)}
"""What may have been done to an image."""


@dataclass(frozen=True)
class Fit:
    """How well an image matches the neighbours of a place."""

    correlation: float
    """The second highest with a neighbour, so that one that is wrong itself does not count; −1 if there are too few."""
    apart_deg: float
    """How far away the second nearest of these is."""

    @property
    def least_gain(self) -> float:
        """By which another fit must be better."""
        return _LEAST_GAIN + _GAIN_AT_30_DEG * (self.apart_deg / 30) ** 2

    def is_like(self, usual: float) -> bool:
        """Whether it is as good as usual, nearly."""
        return self.correlation > usual - self.least_gain


_NO_FIT = Fit(-1.0, 360.0)


class _OnGround:
    """Images in one frame on the ground, and how well they match one another there."""

    def __init__(self, dataset: Dataset, ground: bool) -> None:
        self.views = list(dataset.views)
        self.half = reach(dataset.grid)
        axis = np.linspace(-self.half, self.half, _PLACES)
        self.x, self.y = np.meshgrid(axis, axis)
        self.inside = np.hypot(self.x, self.y) < self.half
        self.grid, self.bright = _coarse(dataset, ground, float(axis[1] - axis[0]))
        free = round(_FREE * _PLACES / 2)
        self.padded = (next_fast_len(_PLACES + free, real=True),) * 2
        shift = np.fft.fftfreq(self.padded[0], 1 / self.padded[0])
        self.near = np.hypot(shift[:, None], shift) <= free
        self.azimuths = np.array([view.azimuth_deg for view in self.views])
        self.grazings = np.array([view.grazing_deg for view in self.views])
        self.known: dict[tuple[int, int, int], _Spectrum] = {}

    def own(self, k: int, flip: _Flip = _AS_IT_IS) -> _Spectrum:
        """Spectrum of image k as one of its view."""
        if (k, *flip) not in self.known:
            self.known[k, *flip] = self.spectrum(k, self.views[k], flip)
        return self.known[k, *flip]

    def spectrum(self, k: int, view: View, flip: _Flip = _AS_IT_IS) -> _Spectrum:
        """Spectrum of image k on the ground, as if it were of this view, mirrored or turned before."""
        azimuth, slant_range = np.tensordot(view.look.gradients[:, :2], np.stack([self.x, self.y]), 1)
        ground = shown_at(self.bright[k][:: flip[0], :: flip[1]], self.grid, azimuth, slant_range)
        return rfft2(normalised(ground, self.inside).astype(np.float32), self.padded)

    def clockwise(self, k: int, j: int) -> float:
        """Degrees from image k clockwise to image j, −180 to 180."""
        return float((self.azimuths[j] - self.azimuths[k] + 180) % 360 - 180)

    def neighbours(self, view: View, *without: int) -> list[int]:
        """The nearest images on either side of a view, but for some."""
        apart = (self.azimuths - view.azimuth_deg + 180) % 360 - 180
        within = np.array(self.within(view, *without), dtype=int)
        nearest = within[np.argsort(np.abs(apart[within]), kind="stable")]
        sides = nearest[apart[nearest] >= 0], nearest[apart[nearest] < 0]
        return [int(k) for side in sides for k in side[:_ON_EACH_SIDE]]

    def within(self, view: View, *without: int) -> list[int]:
        """All images that may be like one of a view, but for some."""
        apart = np.abs((self.azimuths - view.azimuth_deg + 180) % 360 - 180)
        suits = (np.abs(self.grazings - view.grazing_deg) <= _SAME_GRAZING_DEG) & (apart <= _FARTHEST_DEG)
        suits[list(without)] = False
        return [int(k) for k in np.flatnonzero(suits)]

    def sides(self, k: int) -> tuple[list[int], list[int]]:
        """The neighbours of image k before it and, clockwise, after it, the nearest first."""
        neighbours = self.neighbours(self.views[k], k)
        after = [j for j in neighbours if self.clockwise(k, j) >= 0]
        return [j for j in neighbours if j not in after], after

    def fits(self) -> list[Fit]:
        """How well each image fits where it is."""
        return [self.fit(k, view) for k, view in enumerate(self.views)]

    def exchanged(self, i: int, j: int) -> Fit:
        """How well image i would fit in the place of image j, if that is elsewhere."""
        return self.fit(i, self.views[j], without=(i, j))

    def fit(self, k: int, view: View, flip: _Flip = _AS_IT_IS, without: Sequence[int] = ()) -> Fit:
        """How well image k would fit as one of this view, mirrored or turned before."""
        neighbours = self.neighbours(view, k, *without)
        if len(neighbours) < 2:
            return _NO_FIT
        spectrum = self.own(k, flip) if view is self.views[k] else self.spectrum(k, view, flip)
        found = [self.alike(spectrum, self.own(j)) for j in neighbours]
        apart = np.sort(np.abs((self.azimuths[neighbours] - view.azimuth_deg + 180) % 360 - 180))
        return Fit(sorted(found)[-2], float(apart[1]))

    def around(self, k: int) -> float:
        """How well image k, which has two neighbours or more, matches two of all that are as near as these may be."""
        return sorted(self.alike(self.own(k), self.own(j)) for j in self.within(self.views[k], k))[-2]

    def alike(self, one: _Spectrum, other: _Spectrum) -> float:
        """Highest correlation of two images."""
        return float(irfft2(one.conj() * other, self.padded)[self.near].max())

    def across(self, k: int, flip: _Flip = _AS_IT_IS) -> Fit:
        """How alike image k and the one before it are to the two after it, these mirrored or turned before.

        The mean over all pairs but the outermost.
        """
        before, after = self.sides(k)
        if len(after) < 2 or not before:
            return _NO_FIT
        pairs = (k, after[0]), (k, after[1]), (before[0], after[0])
        alike = [self.alike(self.own(i), self.own(j, flip)) for i, j in pairs]
        return Fit(float(np.mean(alike)), self.clockwise(k, after[1]))

    def beside(self, k: int, fits: Sequence[Fit]) -> float:
        """The lesser of the correlations of the images two before and two after image k, which has both."""
        beside = [fits[side[-1]].correlation for side in self.sides(k)]
        return min((one for one in beside if one > -1), default=1.0)

    def swap(self, i: int, j: int) -> None:
        """Let each of two images be of the other's view."""
        for values in (self.views, self.azimuths, self.grazings):
            values[i], values[j] = values[j], values[i]
        self.known = {key: spectrum for key, spectrum in self.known.items() if key[0] not in (i, j)}


def examine_places(dataset: Dataset, ground: bool, examined: Examination) -> None:
    """Add contradictions of single images that are not where they belong, given images that otherwise are.

    `ground` says whether they show ground.
    """
    if len(dataset) < _FEWEST or reach(dataset.grid) <= 0:
        examined.checks["single azimuths"] = "cannot be determined: too few images"
        return
    scene = _OnGround(dataset, ground)
    fits = scene.fits()
    told = [k for k, fit in enumerate(fits) if fit.correlation > -1]
    if not told:
        examined.checks["single azimuths"] = f"cannot be determined: none has two others within {_FARTHEST_DEG:.0f}°"
        return
    if np.median([fits[k].correlation for k in told]) < _ALIKE:
        examined.checks["single azimuths"] = "cannot be determined: images of neighbouring azimuths are not alike"
        return
    flipped, parted, elsewhere = (find(dataset, scene, fits) for find in (_flipped, _parted, _elsewhere))
    pairs = _swaps(scene, fits)
    if not pairs:
        possible = [flipped, parted, elsewhere]
    elif len(pairs) > 1 and parted:  # of a target that is nearly symmetric, a part that is mirrored is like many swaps
        possible = [flipped, parted]
    else:
        possible = [flipped, _said_of_swaps(dataset, pairs)]
    wrong = max((found for found in possible if found), default=None)
    none = f"none of {counted(len(told), 'image')} matches those of another azimuth better than its neighbours"
    examined.conclude("single azimuths", [] if wrong is None else [wrong[1]], none)


def _coarse(dataset: Dataset, ground: bool, pitch_m: float) -> tuple[ImageGrid, Float32[np.ndarray, "v m n"]]:
    """Decibels above the ground, or what counts as nothing, in pixels about as large as the places on the ground."""
    grid = dataset.grid
    across, along = (max(1, int(pitch_m / spacing)) for spacing in grid.spacing_m)
    rows, columns = grid.rows // along, grid.columns // across
    cut_off = (grid.columns % across, grid.rows % along)
    made = np.empty((len(dataset), rows, columns), np.float32)
    parts = math.ceil(len(dataset) / _AT_ONCE)
    for part in range(parts):  # evenly chosen: without ground, what counts as nothing follows from the median image
        levels = np.maximum(levels_db(dataset.power[part::parts], grid, ground), 0)
        cut = levels[:, : rows * along, : columns * across]
        made[part::parts] = cut.reshape(-1, rows, along, columns, across).mean(axis=(2, 4))
    coarse = replace(
        grid,
        rows=rows,
        columns=columns,
        spacing_m=(across * grid.spacing_m[0], along * grid.spacing_m[1]),
        center_m=(
            grid.center_m[0] - grid.spacing_m[0] * cut_off[0] / 2,
            grid.center_m[1] - grid.spacing_m[1] * cut_off[1] / 2,
        ),
    )
    return coarse, made


def _least_alike(scene: _OnGround, fits: Sequence[Fit]) -> list[int]:
    """Images that are less like their neighbours than these are like theirs, the worst first."""
    lacks = {}
    for k, fit in enumerate(fits):
        if fit.correlation > -1:
            theirs = [fits[j].correlation for j in scene.neighbours(scene.views[k], k) if fits[j].correlation > -1]
            lacks[k] = (float(np.median(theirs)) if theirs else 1.0) - fit.correlation
    return sorted(lacks, key=lambda k: -lacks[k])[:_CANDIDATES]


def _usual(fits: Sequence[Fit]) -> float:
    """Correlation that three quarters of all images have with their neighbours."""
    return float(np.quantile([fit.correlation for fit in fits if fit.correlation > -1] or [1.0], 0.25))


def _swaps(scene: _OnGround, fits: Sequence[Fit]) -> list[tuple[float, int, int]]:
    """Pairs of images that match better in each other's place, with their gain in correlation; they are exchanged."""
    usual = _usual(fits)
    pairs: list[tuple[float, int, int]] = []
    while len(pairs) <= _MOST_PAIRS and (best := _best_swap(scene, fits, usual)):
        pairs.append(best)
        _, i, j = best
        scene.swap(i, j)
        fits = scene.fits()
    return pairs


def _said_of_swaps(dataset: Dataset, pairs: Sequence[tuple[float, int, int]]) -> tuple[float, str]:
    """Gain in correlation of all together, and a sentence that names them."""
    gain = sum(more for more, _, _ in pairs)
    swaps = [f"{named(dataset, i)} and {named(dataset, j)}" for _, i, j in pairs]
    higher = f"(correlation higher by {pairs[0][0] / 2:.2f})"
    if len(pairs) > _MOST_PAIRS:
        return gain, (
            f"many images match their neighbours better in another's place, such as {swaps[0]} in each other's {higher}"
            "; check the azimuths, and the order of the files"
        )
    return gain, (
        f"{', and so do '.join(swaps)} match their neighbours better in each other's place {higher}, so they seem to "
        "be swapped; exchange the files, or their angles"
    )


def _best_swap(scene: _OnGround, fits: Sequence[Fit], usual: float) -> tuple[float, int, int] | None:
    """Gain of both together if two images are exchanged, and which."""
    found = []
    for i in _least_alike(scene, fits):
        there = {k: scene.exchanged(i, k) for k, fit in enumerate(fits) if k != i and fit.correlation > -1}
        for j in sorted(there, key=lambda k: -there[k].correlation)[:_MOST_PAIRS]:
            here = scene.exchanged(j, i)
            both = there[j].correlation - fits[i].correlation, here.correlation - fits[j].correlation
            least = fits[i].least_gain + fits[j].least_gain
            like = there[j].is_like(usual) and here.is_like(usual)
            if like and sum(both) > least and min(both) > least / 4:
                # what fits images farther away, without being turned, is no better elsewhere
                kept = there[j].correlation - scene.around(i) + here.correlation - scene.around(j)
                if kept > least / 2:
                    found.append((sum(both), min(i, j), max(i, j)))
    return max(found, default=None)


def _elsewhere(dataset: Dataset, scene: _OnGround, fits: Sequence[Fit]) -> tuple[float, str] | None:
    """Gain in correlation of all images that match far better elsewhere, and a sentence that names the worst."""
    usual = _usual(fits)
    found = []
    for k in _least_alike(scene, fits):
        if fits[k].apart_deg > _FARTHEST_ALONE_DEG:
            continue
        tried = [replace(scene.views[k], azimuth_deg=float(azimuth)) for azimuth in np.arange(0, 360, _STEP_DEG)]
        there = [scene.fit(k, view) for view in tried]
        best = max(range(len(tried)), key=lambda n: there[n].correlation)
        gain = there[best].correlation - fits[k].correlation
        least = _ALONE * max(fits[k].least_gain, there[best].least_gain)
        if there[best].is_like(usual) and gain > least and there[best].correlation - scene.around(k) > least / 2:
            found.append((gain, k, tried[best].azimuth_deg))
    if not found:
        return None
    gain, k, azimuth = max(found)
    others = f" (and so do {counted(len(found) - 1, 'other image')})" if len(found) > 1 else ""
    return sum(gain for gain, _, _ in found), (
        f"{named(dataset, k)} matches images around azimuth {azimuth % 360:g}° better than its neighbours "
        f"(correlation higher by {gain:.2f}){others}; correct its azimuth, or the file, or remove it"
    )


def _flipped(dataset: Dataset, scene: _OnGround, fits: Sequence[Fit]) -> tuple[float, str] | None:
    """Gain in correlation if some images, not more than half, are mirrored or turned, and a sentence that names one."""
    usual = _usual(fits)
    found: dict[str, list[tuple[float, int]]] = {what: [] for what in _FLIPS}
    for k, (fit, view) in enumerate(zip(fits, scene.views, strict=True)):
        if fit.correlation == -1 or fit.apart_deg > _FARTHEST_ALONE_DEG:
            continue
        best, what = max((scene.fit(k, view, flip).correlation, what) for what, flip in _FLIPS.items())
        gain = best - fit.correlation
        if replace(fit, correlation=best).is_like(usual) and gain > _ALONE * fit.least_gain:
            found[what].append((gain, k))
    what = max(found, key=lambda key: len(found[key]))
    many = len(found[what])
    if not 0 < many <= len(scene.views) / 2:
        return None
    gain, k = max(found[what])
    others = f" (and {counted(many - 1, 'other image')} of {len(scene.views)})" if many > 1 else ""
    return sum(gain for gain, _ in found[what]), (
        f"{named(dataset, k)}{others} matches its neighbours better {what} (correlation higher by {gain:.2f}); give "
        "all images the same way round"
    )


def _parted(dataset: Dataset, scene: _OnGround, fits: Sequence[Fit]) -> tuple[float, str] | None:
    """Gain in correlation if images on one side of an azimuth are mirrored or turned, and a sentence that names it."""
    given = [scene.across(k) for k in range(len(dataset))]
    usual = _usual(given)
    found = []
    for k, fit in enumerate(given):
        if not -1 < fit.correlation < usual or fits[k].apart_deg > _FARTHEST_ALONE_DEG:
            continue
        if scene.beside(k, given) - fit.correlation < fits[k].least_gain:  # all around, images are as unlike
            continue
        for what, flip in _FLIPS.items():
            better = scene.across(k, flip)
            gain = better.correlation - fit.correlation
            if better.is_like(usual) and gain > _ALONE * fits[k].least_gain:
                found.append((gain, k, what))
    if not found:
        return None
    gain, k, what = max(found)
    return gain, (
        f"images on either side of {named(dataset, k)} match better if those beyond it, clockwise, are {what} "
        f"(correlation higher by {gain:.2f}); give all images the same way round"
    )
