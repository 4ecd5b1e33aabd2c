"""Files of true masks of target and shadow: a grey 8-bit PNG for each image, with its name."""

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
"""Mask of an image: 0 clutter, 1 target, 2 shadow."""

Masks = UInt8[np.ndarray, "v rows columns"]
"""Masks of V images: 0 clutter, 1 target, 2 shadow."""

_NUMBERS = "masks are 0 clutter, 1 target and 2 shadow"


def read_masks(folder: Path, dataset: Dataset, splits: Collection[str] | None = None) -> dict[int, Mask]:
    """Read true masks of sets of a dataset; test images may lack theirs, training images may not.

    Parameters
    ----------
    folder : Path
        Grey 8-bit PNGs with the images' names (`T72/17deg/hb03333.png` for the chip `T72/17deg/hb03333.jpeg`):
        0 clutter, 1 target, 2 shadow. Masks of MSTAR chips are oriented like the published chips, and are turned and
        cut like them; masks of other datasets have row 0 near, like the images.
    dataset : Dataset
        Dataset with these images.
    splits : collection of str, optional
        Names of the sets; every test set unless given.

    Returns
    -------
    dict of int to numpy.ndarray, uint8 [rows, columns]
        Masks by the index of the image in the dataset, in its order; row 0 near.

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
    file = folder
    for index, name in mask_names(dataset, chosen).items():
        file = folder / name
        with plain_os_errors("read", folder):
            if file.is_file():
                masks[index] = _read(file, dataset)
            elif dataset.entries[index].split == "train":
                missing.append(file)
    if not folder.is_dir():
        raise SarsplatError(f"{folder} is not a folder; give one that holds a mask for each image, as grey 8-bit PNGs")
    if missing:
        raise SarsplatError(
            f"{folder} has no mask of {len(missing)} of {len(dataset.images('train'))} training images, the first "
            f"{missing[0]}; give one for each, which `sarsplat simulate --masks` makes for simulated images"
        )
    if not masks:
        raise SarsplatError(
            f"{folder} has no mask of any test image of {dataset}; name them after the images, the last {file}"
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
    except (OSError, SyntaxError, ValueError, image.DecompressionBombError) as error:  # Pillow's errors for damage
        raise SarsplatError(f"{path} is a damaged PNG ({error}); write it again") from error
    size = mask.shape
    if dataset.source.get("kind") == "mstar":  # oriented like the published chips
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
    """Return PNG files for `read_masks`, by their paths in its folder; raise for measured chips."""
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
        reason = "these are measured chips" if nested is None else f"the name {shown(str(nested))} has a folder in it"
        raise SarsplatError(f"masks are written for simulated images only, but {reason}; write them yourself")
    image = pillow()
    files = {}
    for index, name in names.items():
        buffer = io.BytesIO()
        image.fromarray(masks[index]).save(buffer, format="PNG")
        files[name] = buffer.getvalue()
    return files


def pillow() -> ModuleType:
    """Return Pillow's `Image`, or raise with the command that installs it."""
    try:
        from PIL import Image
    except ImportError as error:
        raise SarsplatError(f"masks need Pillow; {install_command('mstar')}") from error
    return Image


def mask_names(dataset: Dataset, splits: Collection[str]) -> dict[int, PurePosixPath]:
    """Return a distinct file name for the mask of each image of these sets, by the image's index in the dataset."""
    images: dict[PurePosixPath, str] = {}
    names = {}
    for index, entry in enumerate(dataset.entries):
        if entry.split not in splits:
            continue
        names[index] = name = _mask_name(entry)
        if name in images:
            raise SarsplatError(
                f"the images {shown(images[name])} and {shown(entry.name)} would share the mask {shown(str(name))}; "
                "give them different names"
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
