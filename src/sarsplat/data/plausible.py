"""What looks like a mistake in a dataset but may be meant: told by name, and the work goes on.

What would make a result meaningless (no views, pixels that are not finite or negative, paths out of the folder) is
refused where a dataset is read; see `read_dataset`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence

import numpy as np

from sarsplat.data.dataset import Dataset
from sarsplat.errors import SarsplatWarning, counted
from sarsplat.geometry import View

_FEW = 3  # angles: of fewer nothing can be said
_SAME_DIRECTION_DEG = 0.01
_HALF_CIRCLE_DEG = 180.0
_VERTICAL_DEG = 90 - math.pi / 2  # and above: incidence angles that might be radians


def suspicions(dataset: Dataset) -> list[str]:
    """What is odd about the views and images of a dataset.

    Parameters
    ----------
    dataset : Dataset
        Its images are read from the disk.

    Returns
    -------
    list of str
        One sentence each: what is odd, and what to do if it is not meant. Angles that look like radians; one training
        view, views that are all the same, or that leave out more than half of the circle; images that are constant or
        all the same; test images that are training images; zeros in measured power. Empty if nothing is odd.
    """
    train = dataset.select("train")
    views = [item.view for item in train]
    return [*suspicious_angles(views), *_coverage(views), *_images(dataset), *_tested_on_training(dataset)]


def suspicious_angles(views: Sequence[View]) -> list[str]:
    """Whether angles that should be degrees look like radians; a list of one sentence, or empty."""
    if not _look_like_radians(views):
        return []
    azimuths, name, elevations = [view.azimuth_deg for view in views], "grazing", [view.grazing_deg for view in views]
    if min(elevations) >= _VERTICAL_DEG:
        name, elevations = "incidence", [view.incidence_deg for view in views]
    return [
        f"the azimuths ({min(azimuths):.4g}° to {max(azimuths):.4g}°) and {name} angles ({min(elevations):.4g}° to "
        f"{max(elevations):.4g}°) look like radians; give degrees, 57.2958 times as many"
    ]


def warn(texts: Iterable[str]) -> None:
    """Each as a `SarsplatWarning`; what has just been said is not repeated."""
    for text in texts:
        warnings.warn(text, SarsplatWarning, stacklevel=1)  # one place, so that Python knows repetitions


def _look_like_radians(views: Sequence[View]) -> bool:
    """The rule: at least three azimuths, all within ±2π and spread over π/2 or more, and one of

    - all grazing (or all incidence) angles are at most π/2, and not every angle is a whole number. No target is imaged
      at 1.6° above the horizon or from the vertical: its shadow, or its layover, is 36 times as long as it is high;
    - read as radians at least four azimuths besides 0 are whole degrees, to within what four decimals carry, while as
      degrees they are no multiples of 0.01. A set such as 0°, 1°, 2°, 3° is neither, nor is any other that somebody
      would write down in degrees.
    """
    azimuths = np.unique([view.azimuth_deg for view in views])
    grazings = np.array([view.grazing_deg for view in views])
    few_or_wide = len(azimuths) < _FEW or np.abs(azimuths).max() > 2 * math.pi + 1e-3
    if few_or_wide or np.ptp(azimuths) < math.pi / 2:
        return False
    flat_or_vertical = grazings.max() <= math.pi / 2 or grazings.min() >= _VERTICAL_DEG
    if flat_or_vertical and not _multiples(np.concatenate([azimuths, grazings]), 1.0, 1e-6):
        return True
    turned = azimuths[azimuths != 0]
    return len(turned) > _FEW and _multiples(np.degrees(turned), 1.0, 4e-3) and not _multiples(turned, 0.01, 1e-6)


def _multiples(values: np.ndarray, of: float, within: float) -> bool:
    return bool((np.abs(values - of * np.round(values / of)) <= within).all())


def _coverage(views: Sequence[View]) -> list[str]:
    """What the training directions leave open."""
    first = views[0]
    if len(views) == 1:
        return [
            f"there is one training view (azimuth {first.azimuth_deg:g}°), from which no shape can be told; add views "
            "from other azimuths"
        ]
    cosines = np.array([view.direction for view in views]) @ first.direction
    if cosines.min() > math.cos(math.radians(_SAME_DIRECTION_DEG)):
        return [
            f"all {len(views)} training views are the same (azimuth {first.azimuth_deg:g}°, grazing "
            f"{first.grazing_deg:g}°), from which no shape can be told; check their angles"
        ]
    azimuths = np.unique(np.round([view.azimuth_deg % 360 for view in views], 6))
    gaps = np.diff([*azimuths, azimuths[0] + 360])
    widest = int(gaps.argmax())
    if gaps[widest] <= _HALF_CIRCLE_DEG + 1e-6:
        return []
    return [
        f"the training views leave {gaps[widest]:.4g}° of azimuth out, from {azimuths[widest]:.4g}° clockwise to "
        f"{(azimuths[widest] + gaps[widest]) % 360:.4g}°, where the shape is a guess; add views from there"
    ]


def _images(dataset: Dataset) -> list[str]:
    """Images that are constant or all the same, and zeros in measured power."""
    found: list[str] = []
    constant, first = 0, ""
    for split in dataset.splits():
        images = dataset.images(split)
        flat = np.ptp(images, axis=(1, 2)) == 0 if images[0].size > 1 else np.zeros(len(images), dtype=bool)
        if flat.any() and not constant:
            index = int(flat.argmax())
            first = f"{dataset.select(split)[index].image} is {images[index, 0, 0]:g} everywhere"
        constant += int(flat.sum())
        if split == "train" and len(images) > 1 and not flat.all() and bool((images == images[0]).all()):
            found.append(f"all {len(images)} training images are the same, pixel by pixel; check the files")
        zeros = int(np.count_nonzero(images == 0)) if dataset.domain == "measured" else 0
        if zeros and not flat.all():
            found.append(
                f"{counted(zeros, 'pixel')} of {images.size} in set {split} are zero, which measured power never is; "
                "raise them to the least power that the sensor resolves"
            )
    if constant:
        found.append(f"{constant} of {counted(len(dataset.views), 'image')} are constant ({first}); check the files")
    return found


def _tested_on_training(dataset: Dataset) -> list[str]:
    """Test images that are a training image, seen from the same direction, over again."""
    train = zip(dataset.select("train"), dataset.images("train"), strict=True)
    trained = {(item.view, image.tobytes()): item.image for item, image in train}
    found = []
    for split in dataset.splits():
        if split != "train":
            for item, image in zip(dataset.select(split), dataset.images(split), strict=True):
                same = trained.get((item.view, image.tobytes()))
                found += [] if same is None else [(item.image, same)]
    if not found:
        return []
    return [
        f"{counted(len(found), 'test image')} can be found among the training images ({found[0][0]} is {found[0][1]}), "
        "which scores nothing but memory; leave them out of one set"
    ]
