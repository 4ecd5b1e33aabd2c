"""Plausibility of a dataset: warnings of what looks like a mistake but may be intended.

`read_dataset` raises for values that make a result meaningless: no views, pixels that are not finite or negative.

Coverage: an image fixes a position in azimuth x_r and slant range z_r, but not in the view's elevation y_r. All views
together fix it by the mean of x_r x_rᵀ + z_r z_rᵀ = 1 − y_r y_rᵀ, whose smallest eigenvalue is 1 if every image fixes
every direction, and 0 if none fixes one of them. The mean is over the views in front of a side of the target, weighted
by the area that they see of it: otherwise two views from opposite sides would count as a stereo pair, although no
surface but the roof is in both.
"""

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

_MIN_ANGLES = 3  # of a test for radians
_SAME_DIRECTION_DEG = 0.01
_HALF_CIRCLE_DEG = 180.0
_MAX_RESOLUTION = 100.0  # in elevation, relative to an image's extent: phases change by 4 degrees across it
_MAX_NOISE = 1.2  # relative to the power that includes it
_MAX_SKIRT = 3.0  # pixels of skirts per pixel of echoes: 1 for a Gaussian, less for targets
_FROM_ABOVE_DEG = 80.0  # minimum grazing angle of a view that favours no side

_SYMMETRY_STEP_DEG = 30.0  # rotations that may be symmetries of a target without speckle
_LEAST = 1e-30
_SYMMETRY_TOLERANCE = 0.02
"""Maximum difference between images equal by symmetry, relative to the brightest pixel: rounding and ray sampling."""

_SIDES, _RINGS = 72, 24
_UNDETERMINED, _UNCERTAIN = 10.0, 3.0
"""Conditioning above which a shape is undetermined, and uncertain; calibrated in docs/reference/checks.md."""

_GRAZINGS_DEG = (15.0, 30.0, 45.0, 60.0, 75.0)  # that may be proposed


def suspicions(dataset: Dataset) -> list[str]:
    """Describe suspicious views and images of a dataset, each in a sentence with its remedy.

    Angles in radians; a single training view, identical views, views that leave out more than half of the circle or do
    not determine positions along some direction; stacks whose baselines do not resolve heights, or with more noise than
    power; echoes that outshine all others; constant or duplicate images; test images among the training images; zeros
    in measured power; terrain smaller than the images.
    """
    train = dataset.select("train")
    texts = suspicious_angles(train.views)  # coverage by wrong angles means nothing
    if not texts:
        texts = left_open(train)
    return [*texts, *_noise(train), *_outshone(train), *suspicious_images(dataset), *suspicious_terrain(dataset)]


def left_open(train: Dataset) -> list[str]:
    """Describe training images that do not determine the shape, by their directions or by baselines of stacks."""
    return _baselines(train) if train.interferometric else suspicious_coverage(train.views)


def suspicious_terrain(dataset: Dataset) -> list[str]:
    """Describe terrain that is smaller than the ground in images; empty if it is not."""
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
    """Describe angles that look like radians; empty if they do not, or the target is aloft.

    With `by_incidence`, incidence angles were given; from grazing angles, steep ones alone are plausible.
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
    """Issue each sentence as a `SarsplatWarning`; repetitions are suppressed unless `anew`, for other data."""
    if anew:
        globals().get("__warningregistry__", {}).clear()
    for text in texts:
        warnings.warn(text, SarsplatWarning, stacklevel=1)  # one place, so that Python knows repetitions


def _radian_azimuths(azimuths: np.ndarray, elevations_too: bool) -> bool:
    """Return whether azimuths look like radians: three or more within ±2π, spread over π/2, not rounded like degrees.

    Degrees are multiples of 0.05 or, unless the elevations look like radians too, evenly spaced multiples of 0.01;
    rounded radians are rarely either: 15°, 30°, 45° … are 0.26, 0.52, 0.79 …. Negative ones must go all around, since
    views from ahead have small azimuths of both signs.
    """
    if len(azimuths) < _MIN_ANGLES or not _within_2pi(azimuths) or np.ptp(azimuths) < math.pi / 2:
        return False
    if azimuths[0] < 0 and largest_gap(np.degrees(azimuths)).width_deg > 90:
        return False
    even = not elevations_too and np.ptp(np.diff(azimuths)) < 1e-6 and _multiples(azimuths, 0.01)
    return not even and not _multiples(azimuths, 0.05)


def _radian_elevations(elevations: np.ndarray) -> bool:
    """Return whether grazing or incidence angles are at most π/2 and not all multiples of 0.25.

    No target is imaged at such angles: its shadow, or its layover, would be 36 times its height.
    """
    return bool(elevations.max() <= math.pi / 2) and not _multiples(elevations, 0.25)


def _within_2pi(azimuths: np.ndarray) -> bool:
    return bool(np.abs(azimuths).max() <= 2 * math.pi + 1e-3)


def _multiples(values: np.ndarray, step: float) -> bool:
    return bool((np.abs(values - step * np.round(values / step)) <= 1e-6).all())


def suspicious_images(dataset: Dataset) -> list[str]:
    """Describe images that are constant, duplicates, zero though measured, or both trained and tested on."""
    return [*_images(dataset), *repeated_images(dataset), *_tested_on_training(dataset)]


def suspicious_coverage(views: Sequence[View]) -> list[str]:
    """Describe gaps and undetermined directions of the training views."""
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
    """Describe few echoes that outshine all others; else empty.

    Echoes up to 60 dB weaker are handled by `usual_peak`; weaker ones would be lost. The skirt of an echo has about as
    many pixels between 60 dB and 120 dB below its peak as it has above.
    """
    peaks = train.power.max(axis=(1, 2))
    faintest = 1e-6 * float(peaks.max())
    visible = sum(int((image > faintest).sum()) for image in train.power)
    fainter = sum(int((image > 1e-6 * faintest).sum()) for image in train.power) - visible
    if fainter <= _MAX_SKIRT * visible or usual_peak(train.power) < float(peaks.max()):
        return []
    worst = train.entries[int(peaks.argmax())].name
    return [
        f"the brightest echoes, such as in {worst}, are more than 60 dB above nearly all that images show, as a corner "
        "reflector or a hot pixel may be, so a target beside them is not found; mask them in the images, or leave them "
        "outside"
    ]


def _noise(train: Dataset) -> list[str]:
    """Describe stacks that state more noise than they have power; else empty."""
    for entry, image in zip(train.entries, train.power, strict=True):
        noise = () if entry.stack is None else entry.stack.noise or ()
        if noise and float(np.mean(noise)) > _MAX_NOISE * (mean := float(image.mean(dtype=np.float64))):
            return [
                f"the stack {entry.name} states noise of {float(np.mean(noise)):.3g} and has a mean power of "
                f"{mean:.3g} with it; give the noise in the unit of the images, as power"
            ]
    return []


def _baselines(train: Dataset) -> list[str]:
    """Describe stacks whose phases hardly change within an image, or repeat; else empty."""
    across_m = max(train.grid.rows * train.grid.spacing_m[1], train.grid.columns * train.grid.spacing_m[0])
    finest_m = min(stack.resolution_m for stack in train.stacks)
    if finest_m <= _MAX_RESOLUTION * across_m:
        return _ambiguity(train)
    first = train.stacks[0]
    return [
        f"the passes resolve elevations of {finest_m:.3g} m at best, and images show {across_m:.3g} m, so phases tell "
        f"hardly any heights; check the wavelength, {first.wavelength_m:g} m, and the baselines, b/R from "
        f"{min(first.offsets_rad):g} to {max(first.offsets_rad):g} rad"
    ]


def _ambiguity(train: Dataset) -> list[str]:
    """Describe stacks whose phases repeat within the target's box; else empty."""
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
    """Describe a gap in azimuth above half a circle; none for a target aloft, which turns about any axis."""
    if views[0].aloft:
        return []
    given = np.array([view.azimuth_deg for view in views if view.grazing_deg < _FROM_ABOVE_DEG])
    if len(given) == 0:
        return []
    gap = largest_gap(given)
    if gap.width_deg <= _HALF_CIRCLE_DEG + 1e-6:
        return []
    question = " (or are the azimuths radians?)" if _within_2pi(given) else ""
    return [
        f"the training views leave a gap of {gap.width_deg:.4g}° in azimuth, from {gap.first_deg:.4g}° clockwise to "
        f"{gap.last_deg:.4g}°, where the shape is a guess; add views there{question}"
    ]


def _images(dataset: Dataset) -> list[str]:
    """Describe constant images, identical training images, and zeros in measured power."""
    texts: list[str] = []
    constant, first = 0, ""
    for split in dataset.splits():
        images = dataset.images(split)
        flat = np.ptp(images, axis=(1, 2)) == 0 if images[0].size > 1 else np.zeros(len(images), dtype=bool)
        if flat.any() and not constant:
            index = int(flat.argmax())
            first = f"image {dataset.select(split).entries[index].name} is {images[index, 0, 0]:g} everywhere"
        constant += int(flat.sum())
        if split == "train" and len(images) > 1 and not flat.all() and bool((images == images[0]).all()):
            texts.append(f"all {len(images)} training images are the same, pixel by pixel; check the files")
        zeros = int(np.count_nonzero(images == 0)) if dataset.calibration == "relative" else 0
        if zeros and not flat.all():
            texts.append(
                f"{counted(zeros, 'pixel')} of {images.size} in set {split} are zero, which measured power never is; "
                "raise them to the smallest power that the sensor resolves"
            )
    if constant:
        are = "is" if constant == 1 else "are"
        texts.append(f"{constant} of {counted(len(dataset), 'image')} {are} constant ({first}); check the files")
    return texts


def _tested_on_training(dataset: Dataset) -> list[str]:
    """Describe test images that repeat a training image of the same direction."""

    def key(entry: DatasetEntry, image: Real[np.ndarray, "rows columns"]) -> tuple[tuple[float, ...], bytes]:
        return tuple(entry.view.direction.round(9).tolist()), image.tobytes()  # the same for −30° and 330°

    both = list(zip(dataset.entries, dataset.power, strict=True))
    trained = {key(entry, image): entry.name for entry, image in both if entry.split == "train"}
    tested = [(entry, image) for entry, image in both if entry.split != "train"]
    texts = [(entry.name, trained[key(entry, image)]) for entry, image in tested if key(entry, image) in trained]
    if not texts:
        return []
    return [
        f"{counted(len(texts), 'test image')} can be found among the training images ({texts[0][0]} is {texts[0][1]}), "
        "so their scores only measure memorisation; remove them from one set"
    ]


@dataclass(frozen=True)
class WeakestDirection:
    """Direction along which the views determine positions worst."""

    conditioning: float
    """Position uncertainty along it relative to that within an image: inverse root of the smallest eigenvalue, averaged
    over the visible sides of the target; may be infinite."""
    above_horizon_deg: float
    """Elevation of the direction, degrees, for the side where it is weakest."""

    @property
    def uncertain(self) -> bool:
        """True if the views determine the shape badly or not at all."""
        return self.conditioning > _UNCERTAIN

    @property
    def undetermined(self) -> bool:
        """True if the views cannot determine the shape."""
        return self.conditioning > _UNDETERMINED

    def __str__(self) -> str:
        where = f"{self.above_horizon_deg:.0f}° above the horizon"
        if self.undetermined:
            return f"{where}; positions are not determined along it"
        return (
            f"{where}; positions are {self.conditioning:.1f} times less well determined along it than within an image"
        )


def weakest_direction(views: Sequence[View]) -> WeakestDirection:
    """Find the direction of least determined positions, for sides that face all azimuths; aloft, all directions."""
    frames = np.array([view.look.frame for view in views])
    azimuths = np.arange(_SIDES) * (2 * math.pi / _SIDES)
    normals = np.stack([np.cos(azimuths), -np.sin(azimuths), np.zeros(_SIDES)], axis=1)
    if views[0].aloft:
        rings = np.arcsin(np.linspace(-1, 1, _RINGS + 1)[1:] - 1 / _RINGS)  # equal areas
        level, upright = np.cos(rings)[:, None, None] * normals, np.sin(rings)[:, None] * np.ones(_SIDES)
        normals = np.concatenate(level + upright[..., None] * np.array([0.0, 0.0, 1.0]))
    visible = np.maximum(normals @ -frames[:, 2].T, 0.0)  # [sides, views]
    visible[visible < 1e-6] = 0.0  # rounding of views along a side
    visible = visible[visible.any(axis=1)]
    weights = visible / visible.sum(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("sv,vi,vj->sij", weights, frames[:, 1], frames[:, 1]))
    fixed = np.maximum(1 - values[:, -1], 0.0)
    direction = vectors[fixed.argmin(), :, -1]
    conditioning = 1 / math.sqrt(fixed.mean()) if fixed.mean() > 1e-9 else math.inf
    return WeakestDirection(conditioning, math.degrees(math.asin(min(abs(direction[2]), 1.0))))


def weak_directions(views: Sequence[View]) -> list[str]:
    """Describe the direction that the views leave (nearly) undetermined, with views to add; else empty."""
    weakest = weakest_direction(views)
    if not weakest.uncertain:
        return []
    where = f"along directions {weakest.above_horizon_deg:.0f}° above the horizon"
    if weakest.undetermined:
        verdict = f"do not determine positions {where}, and so not the shape"
    else:
        less = f"{weakest.conditioning:.1f} times less well {where} than within an image"
        verdict = f"determine positions {less}, so the shape is uncertain"
    add = "frames of a rotation about another axis"
    if not views[0].aloft:
        added = {angle: [replace(view, grazing_deg=angle) for view in views] for angle in _GRAZINGS_DEG}
        best = min(added, key=lambda angle: weakest_direction([*views, *added[angle]]).conditioning)
        add = f"views at other grazing angles, such as {best:g}°"
    return [f"the {len(views)} training views {verdict}; add {add}"]


def repeated_images(dataset: Dataset) -> list[str]:
    """Describe identical images of different directions, or twice in one set.

    Images without speckle may be identical by the target's symmetry: then so are all others at the same angle.
    """
    first: dict[bytes, int] = {}
    pairs = []
    for index, image in enumerate(dataset.power):
        if (original := first.setdefault(image.tobytes(), index)) != index and np.ptp(image) > 0:
            pairs.append((original, index))
    misplaced = [(i, j) for i, j in pairs if _angle_deg(dataset.views[i], dataset.views[j]) > _SAME_DIRECTION_DEG]
    duplicates = [
        (i, j) for i, j in pairs if (i, j) not in misplaced and dataset.entries[i].split == dataset.entries[j].split
    ]
    misplaced = [pair for pair in misplaced if not _symmetric(dataset, *pair)]
    texts = []
    if misplaced:
        one, other = (
            f"{entry.name} (azimuth {entry.view.azimuth_deg:g}°, grazing {entry.view.grazing_deg:g}°)"
            for entry in (dataset.entries[k] for k in misplaced[0])
        )
        texts.append(
            f"{one} and {other} are one and the same picture{_more(misplaced)}, so the file or the angles of one are "
            "wrong: correct them, or remove one"
        )
    if duplicates:
        one, other = (dataset.entries[k].name for k in duplicates[0])
        texts.append(
            f"{one} and {other} are one and the same picture from one direction{_more(duplicates)}, which counts "
            "twice; remove one"
        )
    return texts


def _angle_deg(one: View, other: View) -> float:
    """Return the angle between two views, degrees."""
    return math.degrees(math.acos(min(max(float(one.direction @ other.direction), -1.0), 1.0)))


def _symmetric(dataset: Dataset, i: int, j: int) -> bool:
    """Return whether most other pairs with the same difference in azimuth are equal up to rounding, too.

    Without other pairs, multiples of 30° count as symmetries of targets without speckle.
    """
    views = dataset.views
    if abs(views[i].grazing_deg - views[j].grazing_deg) > 1e-6:
        return False
    turn = views[j].azimuth_deg - views[i].azimuth_deg
    index_at = {(round(view.azimuth_deg % 360, 4) % 360, round(view.grazing_deg, 4)): k for k, view in enumerate(views)}
    others = [
        (k, other)
        for (azimuth, grazing), k in index_at.items()
        if (other := index_at.get((round((azimuth + turn) % 360, 4) % 360, grazing))) is not None
        and {k, other} != {i, j}
    ]
    if not others:
        return dataset.looks is None and abs(turn / _SYMMETRY_STEP_DEG - round(turn / _SYMMETRY_STEP_DEG)) < 1e-6
    pairs = ((dataset.power[k], dataset.power[other]) for k, other in others)
    return bool(
        np.median([np.abs(one - two).max() / max(one.max(), two.max(), _LEAST) for one, two in pairs])
        < _SYMMETRY_TOLERANCE
    )


def _more(pairs: Sequence[tuple[int, int]]) -> str:
    return f" (and {counted(len(pairs) - 1, 'other pair')})" if len(pairs) > 1 else ""
