"""Masks of target and shadow: true ones from a folder of pictures, and how well predicted ones agree with them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Protocol

import numpy as np
from jaxtyping import Int64, UInt8

from sarsplat.data import Dataset
from sarsplat.data.files import plain_os_errors
from sarsplat.data.mstar import as_imported
from sarsplat.errors import SarsplatError, shown
from sarsplat.evaluation.images import Stack, UndefinedScore
from sarsplat.evaluation.registered import register
from sarsplat.geometry import View

Mask = UInt8[np.ndarray, "rows columns"]
Masks = UInt8[np.ndarray, "v rows columns"]
"""Of V images: 0 clutter, 1 target, 2 shadow."""

TARGET, SHADOW = 1, 2
"""What a pixel of a mask may be, besides 0 for clutter: the numbers of SARBake, and of `Run.masks`."""


@dataclass(frozen=True)
class MaskPair:
    """Masks of some images of one test set.

    Attributes
    ----------
    truth, predicted : numpy.ndarray, uint8 [V, rows, columns]
        0 clutter, 1 target, 2 shadow; the predicted ones where their images fit the chips best.
    """

    truth: Masks
    predicted: Masks

    def iou(self, kind: int) -> float:
        """Intersection over union of one kind of pixels, averaged over the images where truth or prediction has any.

        Raises
        ------
        UndefinedScore
            If there are none.
        """
        truth, predicted = self.truth == kind, self.predicted == kind
        both, either = ((one.sum(axis=(1, 2))) for one in (truth & predicted, truth | predicted))
        if not either.any():
            raise UndefinedScore("neither the true nor the predicted masks have such pixels")
        return float(np.mean(both[either > 0] / either[either > 0]))


def read_masks(folder: Path, dataset: Dataset) -> dict[int, Mask]:
    """True masks of a dataset's test images, as far as the folder has them.

    Parameters
    ----------
    folder : Path
        For each image, a grey 8-bit PNG with the image's name (`T72/17deg/hb03333.png` for the chip
        `T72/17deg/hb03333.jpeg`): 0 clutter, 1 target, 2 shadow. Masks of MSTAR chips lie as the chips were published,
        and are turned and cut as these were on import; those of other datasets lie as the images do, row 0 near.
    dataset : Dataset
        Whose images.

    Returns
    -------
    dict of int to numpy.ndarray, uint8 [rows, columns]
        By the index of the image in the dataset, row 0 near.

    Raises
    ------
    SarsplatError
        If no test image has a mask, or one is damaged, of another size or holds other numbers.
    """
    masks: dict[int, Mask] = {}
    asked = folder
    for index, entry in enumerate(dataset.entries):
        if entry.split == "train":
            continue
        name = PurePosixPath(entry.name)
        if not name.name or name.is_absolute() or ".." in name.parts or not entry.name.isprintable():
            raise SarsplatError(f"no mask can be named after the image {shown(entry.name)}; import the chips again")
        asked = folder / name.with_suffix(".png")
        with plain_os_errors("read", folder):
            if asked.is_file():
                masks[index] = _read(asked, dataset)
    if not masks:
        raise SarsplatError(
            f"{folder} has no mask of any test image of {dataset}; name them after the images, the last {asked}"
        )
    return masks


def _read(path: Path, dataset: Dataset) -> Mask:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise SarsplatError("reading masks needs Pillow; install it with pip install 'sarsplat[mstar]'") from error
    grid = dataset.grid
    with plain_os_errors("read", path):
        data = path.read_bytes()
    try:
        picture = Image.open(io.BytesIO(data), formats=("PNG",))
        if picture.mode != "L":
            raise SarsplatError(f"{path} is a picture of mode {picture.mode}; give masks as grey 8-bit PNGs")
        mask = np.asarray(picture)
    except UnidentifiedImageError as error:
        raise SarsplatError(f"{path} is not a PNG; give masks as grey 8-bit PNGs") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:  # what Pillow says of damage
        raise SarsplatError(f"{path} is a damaged PNG ({error}); write it again") from error
    size = mask.shape
    cut = dataset.source.get("cut_to_common_size") is True and size[0] >= grid.rows and size[1] >= grid.columns
    if cut or size == (grid.rows, grid.columns):
        mask = as_imported(mask, dataset)
    if mask.shape != (grid.rows, grid.columns):
        raise SarsplatError(
            f"{path} has {size[0]} × {size[1]} pixels, its image {grid.rows} × {grid.columns}; "
            "give masks of the images' size"
        )
    if mask.max() > SHADOW:
        raise SarsplatError(f"{path} holds the number {mask.max()}; masks are 0 clutter, 1 target and 2 shadow")
    return mask


class _Masking(Protocol):
    """A run, for what is asked of it here."""

    def masks(self, views: Sequence[View], /) -> Masks: ...


def predicted_masks(run: _Masking, images: Dataset, rendered: Stack) -> Masks:
    """Masks of a run for the images of one set, moved as `register` moves the rendered images if they are speckled.

    Where a chip lies in its frame is thus found from its likelihood, never from true masks.

    Raises
    ------
    UndefinedScore
        As in `register`.
    """
    masks = run.masks(images.views)
    if images.looks is None:
        return masks
    return _displaced(masks, register(images.power, rendered, images.score_margin).shift)


def _displaced(masks: Masks, shifts: Int64[np.ndarray, "v 2"]) -> Masks:
    """Each moved by whole pixels (range, azimuth); clutter comes in at the edges."""
    rows, columns = masks.shape[1:]
    found = np.zeros_like(masks)
    for mask, moved, (down, right) in zip(masks, found, shifts.tolist(), strict=True):
        moved[max(down, 0) : rows + min(down, 0), max(right, 0) : columns + min(right, 0)] = mask[
            max(-down, 0) : rows + min(-down, 0), max(-right, 0) : columns + min(-right, 0)
        ]
    return found
