"""Last step of every import: images with their views become a dataset on one grid and one scale."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32, Shaped

from sarsplat.arguments import checks_arguments
from sarsplat.data.coverage import evenly_chosen, largest_gap
from sarsplat.data.dataset import Dataset, DatasetEntry
from sarsplat.data.dataset_folder import write_dataset
from sarsplat.data.geotiff import LEVELS, UNCONVERTED
from sarsplat.data.header import Calibration
from sarsplat.data.image import power_of
from sarsplat.data.sidecar import UNPLACED
from sarsplat.errors import AssumptionWarning, SarsplatError, counted
from sarsplat.examination.plausible import suspicions, warn
from sarsplat.geometry import ImageGrid, Place, Terrain
from sarsplat.geometry.responses import GAUSSIAN
from sarsplat.geometry.view import ground_radius_m
from sarsplat.importers.about import AboutImages
from sarsplat.importers.band_limited import resample
from sarsplat.importers.common_part import common_part, with_data
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.radiometry import to_db

if TYPE_CHECKING:
    from sarsplat.examination.outcome import Examination

_SAME = 1e-3  # relative difference of lengths that are meant to be the same
_SAME_PLACE = 1e-2  # maximum offset of images that are not resampled, share of a pixel

_LEAST_POWER = 1e-3
"""Power to which zeros are raised, relative to the median: zero has no logarithm, and no radar measures it."""

_FAINTEST = 1e-30  # minimum mean power, and reciprocal of the maximum; beyond them float32 loses digits
_MARGIN = 3 / 16  # margin left out of scores of images with ground, share of a side

_LARGEST_SIZE_M = 1e6
_PIXELS = (8, 4096)  # minimum and maximum number of pixels on a side of an image that is cut out or focused

EXAMINATIONS: WeakKeyDictionary[Dataset, Examination] = WeakKeyDictionary()
"""Examinations of imported datasets, of which the command line shows more than warnings."""


@checks_arguments
def dataset_of(
    images: Sequence[MeasuredImage],
    *,
    target: str,
    source: dict[str, Any],
    train_views: int | None = None,
    calibration: Calibration = "relative",
    place: Place | None = None,
    **about: Unpack[AboutImages],
) -> Dataset:
    """Make a dataset in memory: images on one grid, assigned to sets, on one scale.

    Parameters
    ----------
    images : sequence of MeasuredImage
        All complex, or all power. If their spacings differ, all are resampled to the finest; if their sizes or centres
        differ, all are cut to their common part. Either none or all of them are stacks, of as many channels. Those of
        unknown azimuth are left out.
    target : str
        Name of the target.
    source : dict
        Origin of the images and the `assumptions` made (a list of sentences), to which those made here are added.
    train_views : int, optional
        Number K of training views: those nearest to azimuths k·360°/K or, where images are missing on one side, to K
        azimuths evenly spaced over the rest; of several grazing angles, each gets the next azimuth in turn. The others
        are test views. Not if the images name their sets.
    calibration : {"absolute", "relative"}
        See `Dataset`. Relative power has mean 1 over the training views; that of noise is in the same unit.
    place : Place, optional
        Place on earth of the origin; by default that of the terrain, if it has one. With both, the terrain is laid out
        around this place.
    **about
        Looks, ground, terrain and the target's box: see `AboutImages`.

    Raises
    ------
    SarsplatError
        If there are no images or fewer than `train_views`, some are complex and some not, stacks differ in their
        numbers of channels, the sets are given twice, they have no common part, or all training images are black.

    Warns
    -----
    SarsplatWarning
        If images are resampled, cut, have different resolutions or pixels that are zero.
    """
    about = {"looks": 1.0, "ground": True, **about}
    if not (images := [image for image in images if image.placed]):
        raise SarsplatError("no image with an azimuth was given; give at least one")
    _require_one_kind(images)
    assumptions = [*source.get("assumptions", ())]
    place, about["terrain"] = _on_earth(place, about.get("terrain"), images, assumptions)
    images = _with_sets(images, train_views)
    images, told = with_data(images, about["ground"])
    for sentence in told:
        assume(assumptions, sentence)
    grid = _common_grid(images, assumptions)
    pixels = np.stack([_on(image, grid) for image in images])
    power = power_of(pixels)
    zeros = power == 0
    if zeros.all():
        black = "the image is" if len(images) == 1 else f"all {len(images)} images are"
        raise SarsplatError(f"{black} black; give images of something")
    if zeros.any():
        least = _LEAST_POWER * float(np.median(power[~zeros]))
        pixels[zeros] = math.sqrt(least) if pixels.dtype.kind == "c" else least
        assume(
            assumptions,
            f"{counted(int(zeros.sum()), 'pixel')} of {zeros.size:,} held zero, which no radar measures; raised "
            f"to {to_db(_LEAST_POWER):g} dB of the median power",
        )
    if calibration == "relative":
        trained = power_of(pixels[[image.split == "train" for image in images]])
        scale = float(trained.mean(dtype=np.float64)) if trained.size else 1.0
        if not _FAINTEST < scale < 1 / _FAINTEST:  # also catches what is not finite
            raise SarsplatError(
                f"the training images have a mean power of {scale:.3g}, implausible in any unit; scale them"
            )
        with np.errstate(over="ignore"):  # the dataset rejects infinite values
            pixels /= np.sqrt(scale, dtype=np.float32) if pixels.dtype.kind == "c" else np.float32(scale)
        images = [
            replace(image, stack=replace(image.stack, noise=tuple(noise / scale for noise in image.stack.noise)))
            if image.stack and image.stack.noise
            else image
            for image in images
        ]
        source = {**source, "mean_power": scale}
    entries = tuple(
        DatasetEntry(image.view, image.split or "train", image.name, image.azimuth_std_deg, image.stack)
        for image in images
    )
    return (Dataset.of_complex if pixels.dtype.kind == "c" else Dataset)(
        grid,
        entries,
        pixels,
        target=target,
        calibration=calibration,
        place=place,
        score_margin=round(_MARGIN * min(grid.rows, grid.columns)) if about["ground"] else 0,
        **about,
        source={**source, "assumptions": assumptions},
    )


def _on_earth(
    place: Place | None, terrain: Terrain | None, images: Sequence[MeasuredImage], assumptions: list[str]
) -> tuple[Place | None, Terrain | None]:
    """Return the place of the origin, and the terrain around it."""
    if terrain is None or terrain.place is None:
        return place, terrain
    if place is None:
        level = terrain.place.height_above
        if level != "ellipsoid":
            assumptions.append(f"heights are those of the terrain, above {LEVELS[level]}, also on maps: {UNCONVERTED}")
        return terrain.place, terrain
    reach = max(ground_radius_m([image.view], image.grid) for image in images)
    around = terrain.around(place, reach).centred()
    ground = around.place
    assert ground is not None  # of `around`
    if place.height_above == "unknown":  # as of pictures on a map
        place = replace(place, height_m=ground.height_m, height_above=ground.height_above)
    said = f"the terrain is laid out around the place of the images; there it is {ground.height_m:.1f} m above "
    said += f"{LEVELS[ground.height_above]}, and the place {place.height_m:.1f} m above {LEVELS[place.height_above]}"
    if ground.height_above != place.height_above or ground.height_above == "unknown":
        said += f"; of the terrain only differences of heights are used, and {UNCONVERTED}"
    assumptions.append(said)
    return place, around


def write_imported(
    out: str | Path,
    dataset: Dataset,
    *,
    overwrite: bool,
    pictures: Mapping[str, Float32[np.ndarray, "rows columns"]] | None = None,
) -> Dataset:
    """Examine and write a dataset, and warn of contradictions and probable mistakes.

    Its `source` holds the `contradictions`, if any. `pictures` are further images: power, by the names of their files.
    """
    from sarsplat.examination.contradictions import examine  # here, for it needs scipy: see `sarsplat info`

    examined = examine(dataset)
    wrong = examined.contradictions
    if wrong:  # for `reconstruct`, which does not look again
        dataset = replace(dataset, source={**dataset.source, "contradictions": wrong})
    dataset = write_dataset(out, dataset, pictures=pictures, overwrite=overwrite)
    EXAMINATIONS[dataset] = examined
    warn([*wrong, *(odd for odd in suspicions(dataset) if odd not in wrong)], anew=True)
    return dataset


def with_unplaced(
    dataset: Dataset, images: Sequence[MeasuredImage]
) -> tuple[Dataset, dict[str, Float32[np.ndarray, "rows columns"]]]:
    """List images of unknown azimuth in the dataset's source; also return their power on its grid and scale, by file.

    Raises if one does not show the whole grid.
    """
    pictures: dict[str, Float32[np.ndarray, "rows columns"]] = {}
    listed, grid = [], dataset.grid
    for image in (one for one in images if not one.placed):
        for own, shown in ((image.grid.azimuth_m, grid.azimuth_m), (image.grid.range_m, grid.range_m)):
            if max(own[0] - shown[0], shown[-1] - own[-1]) > _SAME_PLACE * (shown[1] - shown[0]):
                raise SarsplatError(f"{image.name}, without azimuth, shows less than the others; remove it")
        power = power_of(_on(image, grid)) / np.float32(dataset.source.get("mean_power", 1))
        file = f"{UNPLACED}/{len(pictures):04}.tif"
        pictures[file] = np.where(power > 0, power, np.float32(_LEAST_POWER * np.median(dataset.power)))
        listed.append({"name": image.name, "file": file, "set": image.split, "grazing_deg": image.view.grazing_deg})
    return (replace(dataset, source={**dataset.source, UNPLACED: listed}) if listed else dataset), pictures


def sides_of(size_m: float, spacing_m: tuple[float, float]) -> tuple[int, int]:
    """Return rows and columns of an image of a size, in pixels of a spacing (azimuth, range); raise if out of range."""
    check_size(size_m)
    fewest, most = _PIXELS
    columns, rows = (round(min(size_m / step, 1e9)) if step > 0 else 0 for step in spacing_m)  # 0 also of NaN
    if not fewest <= min(rows, columns) <= max(rows, columns) <= most:
        raise SarsplatError(
            f"`size_m={size_m:g}` makes {columns} × {rows} pixels of {spacing_m[0]:.3g} m × {spacing_m[1]:.3g} m "
            f"(azimuth × range); give a size that makes {fewest} to {most} a side"
        )
    return rows, columns


def check_train_views(train_views: int | None, images: int) -> None:
    """Raise unless there are enough images for the training views."""
    if train_views is not None and not 1 <= train_views <= images:
        raise SarsplatError(
            f"{counted(train_views, 'training view')} asked for, but there are {counted(images, 'image')}; ask for 1 "
            f"to {images}"
        )


def check_size(size_m: float) -> None:
    """Raise if a length is no side of images."""
    if not 0 < size_m <= _LARGEST_SIZE_M:  # also catches NaN
        raise SarsplatError(f"the size {size_m:g} m must be positive and at most {_LARGEST_SIZE_M:g} m")


def place_of(numbers: Sequence[float], height_m: float, heading_deg: float = 90.0) -> Place:
    """Return the place of latitude, longitude and perhaps height, which is `height_m` without one."""
    if len(numbers) not in (2, 3):
        raise SarsplatError(f"the place {numbers} must be a latitude, a longitude and, if need be, a height")
    return Place(numbers[0], numbers[1], numbers[2] if len(numbers) == 3 else height_m, heading_deg)


def said_of_heading(heading_deg: float) -> str:
    """Return a sentence on azimuths in a scene whose x axis has this heading."""
    return (
        f"the x axis points to the compass heading {heading_deg:g}°, so azimuth = compass bearing of the radar − "
        f"{heading_deg:g}°"
    )


def assume(assumptions: list[str], text: str) -> None:
    """Add an assumption that is worth a warning."""
    assumptions.append(text)
    warnings.warn(text, AssumptionWarning, stacklevel=5)


def summary(dataset: Dataset) -> str:
    """Describe a dataset: "36 views (24 train, 12 test) of 26 m × 26 m, largest gap of the training views 14°".

    Stacks have their number of channels as well: "4 views of 3 channels, 26 m × 26 m, …".
    """
    sets = [f"{len(dataset.images(split))} {split}" for split in dataset.splits()]
    training = [entry.view.azimuth_deg for entry in dataset.entries if entry.split == "train"]
    shares, whose = (f" ({', '.join(sets)})", " of the training views") if len(sets) > 1 else ("", "")
    gap = largest_gap(training).width_deg
    sides = (dataset.grid.columns * dataset.grid.spacing_m[0], dataset.grid.rows * dataset.grid.spacing_m[1])
    size = " × ".join(f"{side:.3g} m" for side in sides)
    channels = f"{counted(dataset.passes, 'channel')}, " if dataset.passes else ""
    return f"{counted(len(dataset), 'view')}{shares} of {channels}{size}, largest gap{whose} {gap:.3g}°"


def _with_sets(images: Sequence[MeasuredImage], train_views: int | None) -> list[MeasuredImage]:
    """Assign each image to a set, and sort training images first."""
    if any(image.split for image in images):
        if train_views is not None:
            raise SarsplatError(
                f"{counted(train_views, 'training view')} asked for, but the images name their sets; give one or "
                "the other"
            )
        sets = [image.split or "train" for image in images]
    elif train_views is None:
        sets = ["train"] * len(images)
    else:
        check_train_views(train_views, len(images))
        chosen = evenly_chosen([image.view for image in images], train_views)
        sets = ["train" if index in chosen else "test" for index in range(len(images))]
    named = [replace(image, split=split) for image, split in zip(images, sets, strict=True)]
    return sorted(named, key=lambda image: image.split != "train")  # stable


def _common_grid(images: Sequence[MeasuredImage], assumptions: list[str]) -> ImageGrid:
    grids = [image.grid for image in images]
    spacing = np.array([grid.spacing_m for grid in grids])
    resolution = np.array([grid.resolution_m for grid in grids])
    finest = spacing.min(axis=0)
    if np.ptp(spacing, axis=0).max() > _SAME * finest.min():
        assume(assumptions, f"pixel spacings differ; all images are resampled to the finest, {_metres(finest)}")
    else:
        finest = spacing[0]
    typical = np.median(resolution, axis=0)
    if (np.abs(resolution / typical - 1) > 0.05).any():
        assume(
            assumptions,
            f"resolutions differ, from {_metres(resolution.min(axis=0))} to {_metres(resolution.max(axis=0))}; "
            f"{_metres(typical)} is used for all",
        )
    response = grids[0].response
    if any(grid.response != response for grid in grids):
        assume(assumptions, "responses differ in their shape, which is taken for that of a Gaussian")
        response = GAUSSIAN
    low, high, deciding = common_part(images)
    columns, rows = np.floor((high - low) / finest + _SAME_PLACE).astype(int) + 1
    if len({(grid.rows, grid.columns) for grid in grids}) > 1 or (rows, columns) < (grids[0].rows, grids[0].columns):
        part = f"{rows} × {columns} pixels, by {', '.join(deciding)}"  # of at most four
        assume(assumptions, f"all images are cut to what they have in common, {part}")
    return ImageGrid(int(rows), int(columns), tuple(finest), tuple(typical), tuple((low + high) / 2), response)


def _on(image: MeasuredImage, grid: ImageGrid) -> Shaped[np.ndarray, "*channels {grid.rows} {grid.columns}"]:
    """Resample an image to a grid."""
    own = image.grid
    rows = (grid.range_m - own.range_m[0]) / own.spacing_m[1]
    columns = (grid.azimuth_m - own.azimuth_m[0]) / own.spacing_m[0]
    top, left = round(rows[0]), round(columns[0])
    whole_rows, whole_columns = top + np.arange(grid.rows), left + np.arange(grid.columns)
    if max(np.abs(rows - whole_rows).max(), np.abs(columns - whole_columns).max()) < _SAME_PLACE:
        return image.pixels[..., top : top + grid.rows, left : left + grid.columns]
    if image.stack is not None:
        # the ramp of a level plane moves the band away from zero, so it is taken out while resampling
        before, after = (np.exp(1j * image.stack.plane_phases(image.view, one)) for one in (own, grid))
        level = image.pixels * before.conj()
        moved = np.stack([resample(channel, rows, columns) for channel in level]) * after
        return moved.astype(image.pixels.dtype)
    resampled = resample(image.pixels, rows, columns)
    # a sinc undershoots beside what is bright
    return resampled if resampled.dtype.kind == "c" else np.maximum(resampled, 0)


def _require_one_kind(images: Sequence[MeasuredImage]) -> None:
    """Raise if some images are complex or stacks and others are not, or numbers of channels differ."""
    single = {"c": "complex amplitudes", "f": "power"}
    kinds = [counted(len(one.stack), "channel") if one.stack else single[one.pixels.dtype.kind] for one in images]
    for image, kind in zip(images, kinds, strict=True):
        if kind != kinds[0]:
            raise SarsplatError(
                f"{images[0].name} has {kinds[0]} and {image.name} has {kind}; import images of one kind together"
            )


def _metres(pair: np.ndarray) -> str:
    return f"{pair[0]:.4g} m × {pair[1]:.4g} m (azimuth × range)"
