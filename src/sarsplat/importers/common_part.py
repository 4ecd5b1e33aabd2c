"""Part of the scene that all images show, without corners that hold no data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64, Shaped

from sarsplat.errors import SarsplatError, counted
from sarsplat.examination.scaling import MIN_CLIPPED_REPORTED, share_at_top
from sarsplat.geometry import ImageGrid
from sarsplat.importers.measured_image import MeasuredImage

_CHANCE = 1e-4  # probability at which dark pixels form a square of zeros by chance
_THICK = 5  # minimum side, pixels, of a square of zeros that counts as no data: single zeros are dark pixels

_LEAST_SHARE, _MOST_SHARE = 0.003, 0.6
"""Shares of an image: fewer zeros in its corners are ignored, more are rejected."""

_LOSS = 0.5  # maximum share of the common part that a few images cut off: one of another size is probably a wrong file
_MOST_UNLIKE = 10.0  # maximum ratio of the largest to the smallest pixel spacing

_FEW, _FEWEST_IMAGES = 1 / 8, 3
"""Maximum share of images that are suspected, and minimum number of images for that."""


def with_data(images: Sequence[MeasuredImage], ground: bool) -> tuple[list[MeasuredImage], list[str]]:
    """Cut corners without data from images that show `ground`; also return sentences on cut corners and cut values."""
    _refuse_other_spacing(images)
    shares = [share_at_top(part) for image in images for part in _numbers(image)]
    told = []
    if (share := float(np.mean(shares))) >= MIN_CLIPPED_REPORTED:
        told.append(
            f"{share:.2%} of the pixels hold the largest value of their image, {max(shares):.2%} at most: what is "
            "brighter was cut off"
        )
    if not ground:
        return [*images], told
    cut = [_without_empty_corners(image) for image in images]
    if changed := [image.name for image, part in zip(images, cut, strict=True) if part is not image]:
        told.append(
            f"{counted(len(changed), 'image')} of {len(images)}, the first {changed[0]}, "
            f"{'has' if len(changed) == 1 else 'have'} zeros that reach from the corners, where there are no data; cut "
            "to a rectangle without them"
        )
    return cut, told


def _numbers(image: MeasuredImage) -> list[Shaped[np.ndarray, "rows columns"]]:
    """Return power, or both parts of complex amplitudes; of stacks those of the first channel."""
    pixels = image.pixels if image.pixels.ndim == 2 else image.pixels[0]
    return [np.abs(pixels.real), np.abs(pixels.imag)] if pixels.dtype.kind == "c" else [pixels]


def _without_empty_corners(image: MeasuredImage) -> MeasuredImage:
    """Cut an image to a rectangle without zeros that reach from a corner; return the image itself without such.

    Raises if they are most of it: then it is probably the target that was cut out.
    """
    empty = _empty_corners((image.pixels == 0).reshape(-1, *image.pixels.shape[-2:]).all(axis=0))
    share = float(empty.mean())
    if share > _MOST_SHARE:
        raise SarsplatError(
            f"{share:.0%} of the pixels of {image.name} are zeros that reach from its corners; cut these off, or, "
            "if it shows nothing around the target, give `ground=False`"
        )
    if share < _LEAST_SHARE:
        return image
    rows, columns = _filled_rectangle(~empty)
    center = float(image.grid.azimuth_m[columns].mean()), float(image.grid.range_m[rows].mean())
    return replace(image, pixels=image.pixels[..., rows, columns], center_m=center)


def _empty_corners(zeros: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """Return zeros connected with a corner, in pieces thicker than single dark pixels."""
    # here: whoever asks for a file's facts need not load SciPy
    from scipy.ndimage import label, maximum_filter, minimum_filter

    share = float(zeros.mean())
    if not 0 < share < 1:
        return np.zeros_like(zeros)
    by_chance = math.sqrt(math.log(zeros.size / _CHANCE) / -math.log(share))  # side of squares of dark pixels
    side = max(_THICK, math.ceil(by_chance)) | 1
    squares = minimum_filter(zeros, side, mode="constant")  # filters take a time that does not depend on the side
    pieces, _ = label(maximum_filter(squares, side, mode="constant"))
    at = {int(pieces[corner]) for corner in ((0, 0), (0, -1), (-1, 0), (-1, -1))} - {0}
    empty = np.isin(pieces, list(at)) if at else np.zeros_like(zeros)
    rows, columns = (np.flatnonzero(~zeros.all(axis=axis)) for axis in (1, 0))
    empty[: rows[0]] = empty[rows[-1] + 1 :] = True  # whole lines at an edge, however thin
    empty[:, : columns[0]] = empty[:, columns[-1] + 1 :] = True
    return empty


def _filled_rectangle(filled: Bool[np.ndarray, "rows columns"]) -> tuple[slice, slice]:
    """Return a large rectangle without empty pixels: lines at its sides are taken off, the emptiest first."""
    ends = [0, filled.shape[0], 0, filled.shape[1]]  # top and bottom, left and right
    while not (inside := filled[slice(*ends[:2]), slice(*ends[2:])]).all():
        lines = inside[0].mean(), inside[-1].mean(), inside[:, 0].mean(), inside[:, -1].mean()
        emptiest = int(np.argmin(lines))
        ends[emptiest] += 1 if emptiest in (0, 2) else -1
    return slice(*ends[:2]), slice(*ends[2:])


def common_part(
    images: Sequence[MeasuredImage],
) -> tuple[Float64[np.ndarray, " 2"], Float64[np.ndarray, " 2"], list[str]]:
    """Return begin and end of the part that all images show (azimuth, range), m, and the images that limit it.

    Raises if it is empty, or if without a few images it would be at least twice as large.
    """
    sides = [(image.grid.azimuth_m, image.grid.range_m) for image in images]
    ends = np.array([(-azimuth[0], -distance[0], azimuth[-1], distance[-1]) for azimuth, distance in sides])
    common = ends.min(axis=0)
    indices = np.arange(len(images))
    most = max(1, int(_FEW * len(images))) if len(images) >= _FEWEST_IMAGES else 0
    for _ in range(most):
        rest = [indices[indices != out] for out in _at_its_ends(ends, indices)]
        indices = max(rest, key=lambda subset: _area(ends[subset].min(axis=0)))
        if (1 - _LOSS) * (larger := _area(ends[indices].min(axis=0))) >= max(_area(common), 1e-30):
            without = np.delete(np.arange(len(images)), indices)
            names = ", ".join(f"{images[k].name} ({_size(images[k].grid)})" for k in without[:3])
            raise SarsplatError(
                f"all images would be cut to {_area(common) / larger:.0%} of what the others have in common, for "
                f"{names}{' and others' if len(without) > 3 else ''} where {images[indices[0]].name} has "
                f"{_size(images[indices[0]].grid)}; remove {'this image' if len(without) == 1 else 'these images'}, or "
                "cut the others to that size yourself"
            )
    low, high = -common[:2], common[2:]
    if (high < low).any():
        raise SarsplatError("the images have no part in common; give images around one spot")
    return low, high, [images[k].name for k in _at_its_ends(ends, np.arange(len(images)))]


def _refuse_other_spacing(images: Sequence[MeasuredImage]) -> None:
    """Raise if pixels are so much larger than others that their spacing is probably of another unit."""
    spacing = np.array([image.grid.spacing_m for image in images])
    usual = np.median(spacing, axis=0)
    if (spacing.max(axis=0) > _MOST_UNLIKE * spacing.min(axis=0)).any():
        off = int(np.abs(np.log(spacing / usual)).max(axis=1).argmax())
        own, others = (f"{pair[0]:.4g} m × {pair[1]:.4g} m" for pair in (spacing[off], usual))
        raise SarsplatError(
            f"{images[off].name} has pixels of {own} (azimuth × range), and others of {others}; correct its spacing, "
            "or leave it out"
        )


def _at_its_ends(ends: Float64[np.ndarray, "n 4"], indices: Int64[np.ndarray, " k"]) -> list[int]:
    """Return the first of some images that ends where their common part ends, for each of its four ends."""
    return np.unique(indices[ends[indices].argmin(axis=0)]).tolist()


def _area(ends: Float64[np.ndarray, " 4"]) -> float:
    return float(np.prod(np.maximum(ends[2:] + ends[:2], 0)))


def _size(grid: ImageGrid) -> str:
    return f"{grid.rows} × {grid.columns} pixels"
