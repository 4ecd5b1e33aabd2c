"""Masks of target and shadow as files: a PNG for each image of a dataset, named after it."""

from __future__ import annotations

import io
from collections.abc import Collection
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from sarsplat.data.dataset import Dataset, DatasetEntry
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import SHADOW

if TYPE_CHECKING:
    from types import ModuleType

NUMBERS = "masks are 0 clutter, 1 target and 2 shadow"


def encode_masks(masks: UInt8[np.ndarray, "v rows columns"], dataset: Dataset) -> dict[PurePosixPath, bytes]:
    """Files that `sarsplat.data.masks.read_masks` finds again, by their names in its folder.

    Parameters
    ----------
    masks : numpy.ndarray, uint8 [V, rows, columns]
        Of every image: 0 clutter, 1 target, 2 shadow; row 0 near.
    dataset : Dataset
        Dataset of the images; not measured chips, whose masks are oriented as the chips were published.

    Raises
    ------
    SarsplatError
        If the masks are not those of the images, hold other numbers, two images would share one, an image's name has a
        folder in it, or Pillow is missing.
    """
    if masks.shape != dataset.power.shape or masks.dtype != np.uint8:
        raise SarsplatError(
            f"the masks are {masks.dtype} of shape {masks.shape}; for the images of {dataset.target} they must be "
            f"uint8 {dataset.power.shape}"
        )
    if masks.max() > SHADOW:
        raise SarsplatError(f"a mask holds the number {masks.max()}; {NUMBERS}")
    names = mask_names(dataset, dataset.splits())
    nested = next((name for name in names.values() if len(name.parts) > 1), None)
    if nested is not None or dataset.source.get("kind") == "mstar":
        what = "these are measured chips" if nested is None else f"the name {shown(str(nested))} has a folder in it"
        raise SarsplatError(f"masks are written beside simulated images only, but {what}; write them yourself")
    image = pillow()
    files = {}
    for index, name in names.items():
        buffer = io.BytesIO()
        image.fromarray(masks[index]).save(buffer, format="PNG")
        files[name] = buffer.getvalue()
    return files


def pillow() -> ModuleType:
    """Pillow's `Image`.

    Raises
    ------
    SarsplatError
        If Pillow is not installed.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise SarsplatError("masks need Pillow; install it with: pip install 'sarsplat[mstar]'") from error
    return Image


def mask_names(dataset: Dataset, splits: Collection[str]) -> dict[int, PurePosixPath]:
    """Name of the mask of each image of some sets, by the image's index in the dataset.

    Raises
    ------
    SarsplatError
        If an image's name cannot be that of a file inside a folder, or two images would share a mask.
    """
    images: dict[PurePosixPath, str] = {}
    names = {}
    for index, entry in enumerate(dataset.entries):
        if entry.split not in splits:
            continue
        names[index] = name = _name(entry)
        if name in images:
            raise SarsplatError(
                f"the images {shown(images[name])} and {shown(entry.name)} would share the mask {shown(str(name))}; "
                "give each image a name of its own"
            )
        images[name] = entry.name
    return names


def _name(entry: DatasetEntry) -> PurePosixPath:
    name = PurePosixPath(entry.name)
    if not name.name or name.is_absolute() or ".." in name.parts or not entry.name.isprintable():
        raise SarsplatError(
            f"no mask can be named after the image {shown(entry.name)}; give it the name of a file, such as 007"
        )
    return name.with_suffix(".png")
