"""Files of true masks of target and shadow: a grey 8-bit PNG for each image, named after it."""

from __future__ import annotations

import io
from collections.abc import Collection
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from sarsplat.data.dataset import Dataset, DatasetEntry
from sarsplat.data.files import plain_os_errors
from sarsplat.data.orientation import oriented
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import install_command
from sarsplat.geometry import SHADOW

if TYPE_CHECKING:
    from types import ModuleType

Mask = UInt8[np.ndarray, "rows columns"]
"""Of an image: 0 clutter, 1 target, 2 shadow."""

Masks = UInt8[np.ndarray, "v rows columns"]
"""Of V images: 0 clutter, 1 target, 2 shadow."""

_NUMBERS = "masks are 0 clutter, 1 target and 2 shadow"


def read_masks(folder: Path, dataset: Dataset, splits: Collection[str] | None = None) -> dict[int, Mask]:
    """True masks of some sets of a dataset: of every training image, of test images as far as the folder has them.

    Parameters
    ----------
    folder : Path
        For each image, a grey 8-bit PNG with the image's name (`T72/17deg/hb03333.png` for the chip
        `T72/17deg/hb03333.jpeg`): 0 clutter, 1 target, 2 shadow. Masks of MSTAR chips lie as the chips were published,
        and are turned and cut as these were on import; those of other datasets lie as the images do, row 0 near.
    dataset : Dataset
        Whose images.
    splits : collection of str, optional
        Names of the sets; every test set unless given.

    Returns
    -------
    dict of int to numpy.ndarray, uint8 [rows, columns]
        By the index of the image in the dataset, in its order; row 0 near.

    Raises
    ------
    SarsplatError
        If there is no such set, a training image or every image lacks its mask, two images would share one, or a mask
        is damaged, of another size or holds other numbers.
    """
    chosen = {split for split in dataset.splits() if split != "train"} if splits is None else set(splits)
    for split in chosen - set(dataset.splits()):
        raise SarsplatError(f"{dataset} has no set {split!r}; it has {', '.join(dataset.splits())}")
    masks: dict[int, Mask] = {}
    missing: list[Path] = []
    asked = folder
    for index, name in mask_names(dataset, chosen).items():
        asked = folder / name
        with plain_os_errors("read", folder):
            if asked.is_file():
                masks[index] = _read(asked, dataset)
            elif dataset.entries[index].split == "train":
                missing.append(asked)
    if not folder.is_dir():
        raise SarsplatError(f"{folder} is not a folder; give one that holds a mask for each image, as grey 8-bit PNGs")
    if missing:
        raise SarsplatError(
            f"{folder} has no mask of {len(missing)} of {len(dataset.images('train'))} training images, the first "
            f"{missing[0]}; give one for each, which `sarsplat simulate --masks` makes for simulated images"
        )
    if not masks:
        raise SarsplatError(
            f"{folder} has no mask of any test image of {dataset}; name them after the images, the last {asked}"
        )
    return masks


def _read(path: Path, dataset: Dataset) -> Mask:
    image, grid = pillow(), dataset.grid
    with plain_os_errors("read", path):
        data = path.read_bytes()
    try:
        picture = image.open(io.BytesIO(data), formats=("PNG",))
        if picture.mode != "L":
            raise SarsplatError(f"{path} is a picture of mode {picture.mode}; give masks as grey 8-bit PNGs")
        mask = np.asarray(picture)
    except image.UnidentifiedImageError as error:
        raise SarsplatError(f"{path} is not a PNG; give masks as grey 8-bit PNGs") from error
    except (OSError, SyntaxError, ValueError, image.DecompressionBombError) as error:  # what Pillow says of damage
        raise SarsplatError(f"{path} is a damaged PNG ({error}); write it again") from error
    size = mask.shape
    if dataset.source.get("kind") == "mstar":  # as published, and to be turned and cut as the chips were
        if dataset.source.get("cut_to_common_size") is True and size[0] >= grid.rows and size[1] >= grid.columns:
            top, left = (size[0] - grid.rows) // 2, (size[1] - grid.columns) // 2
            mask = mask[top : top + grid.rows, left : left + grid.columns]
        mask = oriented(mask, "bottom", dataset.source.get("mirrored") is True)
    if mask.shape != (grid.rows, grid.columns):
        raise SarsplatError(
            f"{path} has {size[0]} × {size[1]} pixels, its image {grid.rows} × {grid.columns}; "
            "give masks of the images' size"
        )
    if mask.max() > SHADOW:
        raise SarsplatError(f"{path} holds the number {mask.max()}; {_NUMBERS}")
    return mask


def encode_masks(masks: Masks, dataset: Dataset) -> dict[PurePosixPath, bytes]:
    """PNG files that `read_masks` finds again, by their names in its folder; refused for measured chips."""
    if masks.shape != dataset.power.shape or masks.dtype != np.uint8:
        raise SarsplatError(
            f"the masks are {masks.dtype} of shape {masks.shape}; for the images of {dataset.target} they must be "
            f"uint8 {dataset.power.shape}"
        )
    if masks.max() > SHADOW:
        raise SarsplatError(f"a mask holds the number {masks.max()}; {_NUMBERS}")
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
    """Pillow's `Image`, or a SarsplatError that says how to install it."""
    try:
        from PIL import Image
    except ImportError as error:
        raise SarsplatError(f"masks need Pillow; {install_command('mstar')}") from error
    return Image


def mask_names(dataset: Dataset, splits: Collection[str]) -> dict[int, PurePosixPath]:
    """Name of the mask of each image of some sets, by the image's index in the dataset; all names differ."""
    images: dict[PurePosixPath, str] = {}
    names = {}
    for index, entry in enumerate(dataset.entries):
        if entry.split not in splits:
            continue
        names[index] = name = _mask_name(entry)
        if name in images:
            raise SarsplatError(
                f"the images {shown(images[name])} and {shown(entry.name)} would share the mask {shown(str(name))}; "
                "give each image a name of its own"
            )
        images[name] = entry.name
    return names


def _mask_name(entry: DatasetEntry) -> PurePosixPath:
    name = PurePosixPath(entry.name)
    if not name.name or name.is_absolute() or ".." in name.parts or not entry.name.isprintable():
        raise SarsplatError(
            f"no mask can be named after the image {shown(entry.name)}; give it the name of a file, such as 007"
        )
    return name.with_suffix(".png")
