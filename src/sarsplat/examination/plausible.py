"""Plausibility of a dataset: warnings of what looks like a mistake but may be intended.

What would make a result meaningless (no views, pixels that are not finite or negative, paths out of the folder) is
refused where a dataset is read; see `read_dataset`.

Whether views determine a shape: an image fixes a position in azimuth and slant range, and says nothing of the third
direction, the view's elevation y_r. What all views together say of it is the mean of x_r x_rᵀ + z_r z_rᵀ, which is
1 − y_r y_rᵀ: its smallest eigenvalue is 1 where every direction is fixed by every image, and 0 where one is fixed by
none. A side of the target is seen by the views in front of it only, each weighted by the area it sees; without that,
two views from opposite sides would pass for a stereo pair, though no surface but the roof is in both.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Real

from sarsplat.data.coverage import largest_gap
from sarsplat.data.dataset import Dataset, DatasetEntry
from sarsplat.errors import SarsplatWarning, counted
from sarsplat.geometry import View
from sarsplat.geometry.view import ground_radius_m
from sarsplat.radiometry import usual_peak

_FEW = 3  # angles: of fewer nothing can be said
_SAME_DIRECTION_DEG = 0.01
_HALF_CIRCLE_DEG = 180.0
_BLIND = 100.0  # resolutions in elevation, of what images show: phases change by 4 degrees across them
_LOUDER = 1.2  # noise, of power that it is a part of: nothing but noise is not odd
_SKIRTS = 3.0  # pixels of echoes' skirts, for each pixel of the echoes: a Gaussian's are 1, those of targets less
_FROM_ABOVE_DEG = 80.0  # and above: a view that favours no side

_USUAL_TURN_DEG = 30.0  # of a target without speckle that is the same from other sides
_LEAST = 1e-30
_ROUNDED = 0.02
"""Of the brightest pixel: by how much images that are the same by symmetry differ, by rounding or by rays."""

_SIDES, _RINGS = 72, 24
_HARDLY, _WEAKLY = 10.0, 3.0
"""Conditioning above which a shape cannot be determined, and above which it is uncertain; see the calibration in
docs/reference/checks.md."""

_GRAZINGS = (15.0, 30.0, 45.0, 60.0, 75.0)  # degrees: what may be proposed


def suspicions(dataset: Dataset) -> list[str]:
    """Warnings about a dataset's views and images: what is odd, and what to do if it is not meant, a sentence each.

    Angles that look like radians; one training view, views that are all the same, that leave out more than half of the
    circle or do not determine positions along some direction; stacks with baselines that tell no heights, or with more
    noise than power; echoes that outshine all else; images that are constant or all the same; test images that are
    training images; zeros in measured power; terrain smaller than what images show. Empty if nothing is odd.
    """
    train = dataset.select("train")
    odd = suspicious_angles(train.views)  # of angles in another unit, nothing else follows
    if not odd:
        odd = left_open(train)
    return [*odd, *_noise(train), *_outshone(train), *suspicious_images(dataset), *suspicious_terrain(dataset)]


def left_open(train: Dataset) -> list[str]:
    """Whether the training images leave the shape undetermined: by their directions, or by baselines of stacks."""
    return _baselines(train) if train.interferometric else suspicious_coverage(train.views)


def suspicious_terrain(dataset: Dataset) -> list[str]:
    """Whether images show more ground than the terrain has; a list of one sentence, or empty."""
    if dataset.terrain is None:
        return []
    half, shown_m = min(dataset.terrain.half_m), ground_radius_m(dataset.views, dataset.grid)
    if half >= shown_m:
        return []
    return [
        f"the terrain ends {half:.4g} m from the scene's centre, and images show ground to {shown_m:.4g} m; beyond its "
        "end, heights are those at its edge: give a larger one if that matters"
    ]


def suspicious_angles(views: Sequence[View], by_incidence: bool = False) -> list[str]:
    """Whether angles that should be degrees look like radians; a list of one sentence, or empty.

    `by_incidence` says that incidence angles were given: alone, steep ones may well be meant where grazing angles were.

    A target aloft may be seen from any height, and from angles that followed from vectors.
    """
    if views[0].aloft:
        return []
    azimuths = np.unique([(view.azimuth_deg + 180) % 360 - 180 for view in views])
    grazings = np.unique([view.grazing_deg for view in views])
    incidences = 90 - grazings[::-1]
    low, steep = _radian_elevations(grazings), _radian_elevations(incidences)
    suspect = [("azimuths", azimuths)] if _radian_azimuths(azimuths, low or steep) else []
    if low:
        suspect.append(("grazing angles", grazings))
    elif steep and (suspect or by_incidence):
        suspect.append(("incidence angles", incidences))
    if not suspect:
        return []
    names = " and ".join(f"{name} ({values[0]:.4g}° to {values[-1]:.4g}°)" for name, values in suspect)
    return [f"the {names} look like radians; if they are, multiply them by 57.2958 to get degrees"]


def warn(texts: Iterable[str], *, anew: bool = False) -> None:
    """Issue each sentence as a `SarsplatWarning`, but do not repeat the last ones unless `anew`: of other data."""
    if anew:
        globals().get("__warningregistry__", {}).clear()
    for text in texts:
        warnings.warn(text, SarsplatWarning, stacklevel=1)  # one place, so that Python knows repetitions


def _radian_azimuths(azimuths: np.ndarray, elevations_too: bool) -> bool:
    """Whether azimuths look like radians: three or more within ±2π, spread over π/2, not rounded like degrees.

    Written as degrees are multiples of 0.05 and, unless the elevations look like radians too, evenly spaced
    multiples of 0.01. Rounded radians are neither as a rule: 15°, 30°, 45° … are 0.26, 0.52, 0.79 …. On both sides of
    zero, or below it, they must go all around: what is seen from ahead is seen from there.
    """
    if len(azimuths) < _FEW or not _within_a_turn(azimuths) or np.ptp(azimuths) < math.pi / 2:
        return False
    if azimuths[0] < 0 and largest_gap(np.degrees(azimuths)).width_deg > 90:
        return False
    even = not elevations_too and np.ptp(np.diff(azimuths)) < 1e-6 and _multiples(azimuths, 0.01)
    return not even and not _multiples(azimuths, 0.05)


def _radian_elevations(elevations: np.ndarray) -> bool:
    """Grazing or incidence angles at most π/2 and not all multiples of 0.25.

    So low or steep no target is imaged: its shadow, or its layover, is 36 times as long as it is high.
    """
    return bool(elevations.max() <= math.pi / 2) and not _multiples(elevations, 0.25)


def _within_a_turn(azimuths: np.ndarray) -> bool:
    return bool(np.abs(azimuths).max() <= 2 * math.pi + 1e-3)


def _multiples(values: np.ndarray, of: float) -> bool:
    return bool((np.abs(values - of * np.round(values / of)) <= 1e-6).all())


def suspicious_images(dataset: Dataset) -> list[str]:
    """What is odd about the images: constant, all the same, zero where they are measured, or trained and tested on."""
    return [*_images(dataset), *repeated_images(dataset), *_tested_on_training(dataset)]


def suspicious_coverage(views: Sequence[View]) -> list[str]:
    """What the training directions leave open; one sentence each."""
    first = views[0]
    if len(views) == 1:
        return [
            f"there is one training view (azimuth {first.azimuth_deg:g}°), which cannot determine the shape; add views "
            "from other azimuths"
        ]
    frames = np.array([view.look.frame for view in views])
    cosines = (frames[:, 1:] * frames[0, 1:]).sum(2)  # of elevation axes, too: tilts make a difference
    if cosines.min() > math.cos(math.radians(_SAME_DIRECTION_DEG)):
        return [
            f"all {len(views)} training views are the same (azimuth {first.azimuth_deg:g}°, grazing "
            f"{first.grazing_deg:g}°), which cannot determine the shape; check their angles"
        ]
    return [*_gap(views), *weak_directions(views)]


def _outshone(train: Dataset) -> list[str]:
    """Whether few echoes are so bright that nothing else is seen beside them; a list of one sentence, or empty.

    Echoes of at most 60 dB less are told from such a few (`usual_peak`); what is fainter is taken for nothing. The
    skirts of any echo are about as many pixels between 60 dB and 120 dB below it as above.
    """
    peaks = train.power.max(axis=(1, 2))
    faintest = 1e-6 * float(peaks.max())
    seen = sum(int((image > faintest).sum()) for image in train.power)
    fainter = sum(int((image > 1e-6 * faintest).sum()) for image in train.power) - seen
    if fainter <= _SKIRTS * seen or usual_peak(train.power) < float(peaks.max()):
        return []
    worst = train.entries[int(peaks.argmax())].name
    return [
        f"the brightest echoes, such as in {worst}, are more than 60 dB above nearly all that images show, as a corner "
        "reflector or a hot pixel may be, so a target beside them is not found; mask them in the images, or leave them "
        "outside"
    ]


def _noise(train: Dataset) -> list[str]:
    """Whether stacks state more noise than there is power; a list of one sentence, or empty."""
    for entry, image in zip(train.entries, train.power, strict=True):
        noise = () if entry.stack is None else entry.stack.noise or ()
        if noise and float(np.mean(noise)) > _LOUDER * (mean := float(image.mean(dtype=np.float64))):
            return [
                f"the stack {entry.name} states noise of {float(np.mean(noise)):.3g} and has a mean power of "
                f"{mean:.3g} with it; give the noise in the unit of the images, as power"
            ]
    return []


def _baselines(train: Dataset) -> list[str]:
    """Whether phases hardly change within what images show, or repeat; a list of one sentence, or empty."""
    across_m = max(train.grid.rows * train.grid.spacing_m[1], train.grid.columns * train.grid.spacing_m[0])
    finest_m = min(stack.resolution_m for stack in train.stacks)
    if finest_m <= _BLIND * across_m:
        return _ambiguity(train)
    first = train.stacks[0]
    return [
        f"the passes resolve elevations of {finest_m:.3g} m at best, and images show {across_m:.3g} m, so phases tell "
        f"hardly any heights; check the wavelength, {first.wavelength_m:g} m, and the baselines, b/R from "
        f"{min(first.offsets_rad):g} to {max(first.offsets_rad):g} rad"
    ]


def _ambiguity(train: Dataset) -> list[str]:
    """Whether the phases of stacks repeat within the box; a list of one sentence, or empty."""
    if train.target_box_m is None:
        return []
    (_, _, low), (_, _, high) = train.target_box_m
    repeats_m = min(
        stack.ambiguous_elevation_m * view.look.height_per_elevation
        for stack, view in zip(train.stacks, train.views, strict=True)
    )
    if repeats_m >= high - low:
        return []
    return [
        f"the phases of the stacks repeat every {repeats_m:.3g} m of height, and the target's box is {high - low:.3g} "
        "m high, so that heights are ambiguous; give a lower box, or passes with smaller or less even baselines"
    ]


def _gap(views: Sequence[View]) -> list[str]:
    """Sides that no training view shows; a target aloft turns about any axis, and azimuths say little of its sides."""
    if views[0].aloft:
        return []
    given = np.array([view.azimuth_deg for view in views if view.grazing_deg < _FROM_ABOVE_DEG])
    if len(given) == 0:
        return []
    gap = largest_gap(given)
    if gap.width_deg <= _HALF_CIRCLE_DEG + 1e-6:
        return []
    question = " (or are the azimuths radians?)" if _within_a_turn(given) else ""
    return [
        f"the training views leave a gap of {gap.width_deg:.4g}° in azimuth, from {gap.first_deg:.4g}° clockwise to "
        f"{gap.last_deg:.4g}°, where the shape is a guess; add views there{question}"
    ]


def _images(dataset: Dataset) -> list[str]:
    """Images that are constant or all the same, and zeros in measured power."""
    odd: list[str] = []
    constant, first = 0, ""
    for split in dataset.splits():
        images = dataset.images(split)
        flat = np.ptp(images, axis=(1, 2)) == 0 if images[0].size > 1 else np.zeros(len(images), dtype=bool)
        if flat.any() and not constant:
            index = int(flat.argmax())
            first = f"image {dataset.select(split).entries[index].name} is {images[index, 0, 0]:g} everywhere"
        constant += int(flat.sum())
        if split == "train" and len(images) > 1 and not flat.all() and bool((images == images[0]).all()):
            odd.append(f"all {len(images)} training images are the same, pixel by pixel; check the files")
        zeros = int(np.count_nonzero(images == 0)) if dataset.calibration == "relative" else 0
        if zeros and not flat.all():
            odd.append(
                f"{counted(zeros, 'pixel')} of {images.size} in set {split} are zero, which measured power never is; "
                "raise them to the smallest power that the sensor resolves"
            )
    if constant:
        are = "is" if constant == 1 else "are"
        odd.append(f"{constant} of {counted(len(dataset), 'image')} {are} constant ({first}); check the files")
    return odd


def _tested_on_training(dataset: Dataset) -> list[str]:
    """Test images that are a training image, seen from the same direction, over again."""

    def key(entry: DatasetEntry, image: Real[np.ndarray, "rows columns"]) -> tuple[tuple[float, ...], bytes]:
        return tuple(entry.view.direction.round(9).tolist()), image.tobytes()  # the same for −30° and 330°

    both = list(zip(dataset.entries, dataset.power, strict=True))
    trained = {key(entry, image): entry.name for entry, image in both if entry.split == "train"}
    tested = [(entry, image) for entry, image in both if entry.split != "train"]
    odd = [(entry.name, trained[key(entry, image)]) for entry, image in tested if key(entry, image) in trained]
    if not odd:
        return []
    return [
        f"{counted(len(odd), 'test image')} can be found among the training images ({odd[0][0]} is {odd[0][1]}), "
        "so their scores only measure memorisation; remove them from one set"
    ]


@dataclass(frozen=True)
class WeakestDirection:
    """The direction along which the views determine positions worst, and by how much."""

    conditioning: float
    """How many times less well a position is determined there than within an image: the inverse root of the smallest
    eigenvalue, averaged over the sides of the target that are seen; infinite if not at all."""
    above_horizon_deg: float
    """The direction's angle above the horizon; of the side for which it is weakest."""

    @property
    def uncertain(self) -> bool:
        """Whether the views determine the shape badly, if at all."""
        return self.conditioning > _WEAKLY

    @property
    def undetermined(self) -> bool:
        """Whether the views cannot determine the shape."""
        return self.conditioning > _HARDLY

    def __str__(self) -> str:
        where = f"{self.above_horizon_deg:.0f}° above the horizon"
        if self.undetermined:
            return f"{where}; positions are not determined along it"
        return (
            f"{where}; positions are {self.conditioning:.1f} times less well determined along it than within an image"
        )


def weakest_direction(views: Sequence[View]) -> WeakestDirection:
    """The direction along which positions are determined least, for sides of a target that face all azimuths.

    Of a target aloft, sides face all directions.
    """
    frames = np.array([view.look.frame for view in views])
    azimuths = np.arange(_SIDES) * (2 * math.pi / _SIDES)
    normals = np.stack([np.cos(azimuths), -np.sin(azimuths), np.zeros(_SIDES)], axis=1)
    if views[0].aloft:
        rings = np.arcsin(np.linspace(-1, 1, _RINGS + 1)[1:] - 1 / _RINGS)  # of equal areas
        level, upright = np.cos(rings)[:, None, None] * normals, np.sin(rings)[:, None] * np.ones(_SIDES)
        normals = np.concatenate(level + upright[..., None] * np.array([0.0, 0.0, 1.0]))
    seen = np.maximum(normals @ -frames[:, 2].T, 0.0)  # [sides, views]
    seen[seen < 1e-6] = 0.0  # rounding, of views along a side
    seen = seen[seen.any(axis=1)]
    weights = seen / seen.sum(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("sv,vi,vj->sij", weights, frames[:, 1], frames[:, 1]))
    fixed = np.maximum(1 - values[:, -1], 0.0)
    direction = vectors[fixed.argmin(), :, -1]
    conditioning = 1 / math.sqrt(fixed.mean()) if fixed.mean() > 1e-9 else math.inf
    return WeakestDirection(conditioning, math.degrees(math.asin(min(abs(direction[2]), 1.0))))


def weak_directions(views: Sequence[View]) -> list[str]:
    """Whether the views leave a direction (nearly) open: one sentence that says which and what to add, or none."""
    weakest = weakest_direction(views)
    if not weakest.uncertain:
        return []
    aloft = views[0].aloft
    lifted = (
        {}
        if aloft
        else {grazing: [*views, *(replace(view, grazing_deg=grazing) for view in views)] for grazing in _GRAZINGS}
    )
    best = 0.0 if aloft else min(_GRAZINGS, key=lambda grazing: weakest_direction(lifted[grazing]).conditioning)
    where = f"along directions {weakest.above_horizon_deg:.0f}° above the horizon"
    if weakest.undetermined:
        verdict = f"do not determine positions {where}, and so not the shape"
    else:
        less = f"{weakest.conditioning:.1f} times less well {where} than within an image"
        verdict = f"determine positions {less}, so the shape is uncertain"
    add = "frames of a rotation about another axis" if aloft else f"views at other grazing angles, such as {best:g}°"
    return [f"the {len(views)} training views {verdict}; add {add}"]


def repeated_images(dataset: Dataset) -> list[str]:
    """Whether images are the same, pixel by pixel, though of other directions, or twice in one set; a sentence each.

    Images without speckle may be the same by the target's symmetry: then all that are as far apart are.
    """
    first: dict[bytes, int] = {}
    pairs = []
    for index, image in enumerate(dataset.power):
        if (at := first.setdefault(image.tobytes(), index)) != index and np.ptp(image) > 0:
            pairs.append((at, index))
    apart = [(i, j) for i, j in pairs if _apart_deg(dataset.views[i], dataset.views[j]) > _SAME_DIRECTION_DEG]
    twice = [(i, j) for i, j in pairs if (i, j) not in apart and dataset.entries[i].split == dataset.entries[j].split]
    apart = [pair for pair in apart if not _symmetric(dataset, *pair)]
    return [*_said_of_pairs(dataset, apart), *_said_of_twice(dataset, twice)]


def _said_of_twice(dataset: Dataset, pairs: Sequence[tuple[int, int]]) -> list[str]:
    if not pairs:
        return []
    one, other = (dataset.entries[k].name for k in pairs[0])
    return [
        f"{one} and {other} are one and the same picture from one direction{_more(pairs)}, which counts twice; remove "
        "one"
    ]


def _apart_deg(one: View, other: View) -> float:
    """Angle between two directions, degrees."""
    return math.degrees(math.acos(min(max(float(one.direction @ other.direction), -1.0), 1.0)))


def _symmetric(dataset: Dataset, i: int, j: int) -> bool:
    """Whether most other pairs of images that are turned as far against each other are the same, too, but for rounding.

    If there are no others, a target without speckle may still be the same after turns by quarters or sixths.
    """
    views = dataset.views
    if abs(views[i].grazing_deg - views[j].grazing_deg) > 1e-6:
        return False
    turn = views[j].azimuth_deg - views[i].azimuth_deg
    at = {(round(view.azimuth_deg % 360, 4) % 360, round(view.grazing_deg, 4)): k for k, view in enumerate(views)}
    others = [
        (k, other)
        for (azimuth, grazing), k in at.items()
        if (other := at.get((round((azimuth + turn) % 360, 4) % 360, grazing))) is not None and {k, other} != {i, j}
    ]
    if not others:
        return dataset.looks is None and abs(turn / _USUAL_TURN_DEG - round(turn / _USUAL_TURN_DEG)) < 1e-6
    pairs = ((dataset.power[k], dataset.power[other]) for k, other in others)
    return bool(
        np.median([np.abs(one - two).max() / max(one.max(), two.max(), _LEAST) for one, two in pairs]) < _ROUNDED
    )


def _said_of_pairs(dataset: Dataset, pairs: Sequence[tuple[int, int]]) -> list[str]:
    if not pairs:
        return []
    entries = [dataset.entries[k] for k in pairs[0]]
    one, other = (f"{e.name} (azimuth {e.view.azimuth_deg:g}°, grazing {e.view.grazing_deg:g}°)" for e in entries)
    return [
        f"{one} and {other} are one and the same picture{_more(pairs)}, so the file or the angles of one are wrong: "
        "correct them, or remove one"
    ]


def _more(pairs: Sequence[tuple[int, int]]) -> str:
    return f" (and {counted(len(pairs) - 1, 'other pair')})" if len(pairs) > 1 else ""
