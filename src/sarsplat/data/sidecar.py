"""Sidecar files of datasets: true masks of target and shadow, and chips of unknown azimuth.

Writing a dataset that was read from a folder copies chips while its images are unchanged, and masks also where these
have another scale.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Collection
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, UInt8

from sarsplat.data.dataset import Dataset
from sarsplat.data.files import inside, plain_os_errors, read_bytes
from sarsplat.data.header import SPLIT
from sarsplat.data.orientation import oriented
from sarsplat.data.tiff import read_tiff
from sarsplat.errors import SarsplatError, SarsplatWarning, counted, shown
from sarsplat.extras import needed
from sarsplat.geometry import SHADOW

if TYPE_CHECKING:
    from types import ModuleType

Mask = UInt8[np.ndarray, "rows columns"]
"""Mask of an image: 0 clutter, 1 target, 2 shadow."""

Masks = UInt8[np.ndarray, "v rows columns"]
"""Masks of V images: 0 clutter, 1 target, 2 shadow."""

UNPLACED = "unplaced"
"""Folder of chips without azimuth, and key of their list in a dataset's `source`."""
MASKS = "masks"
"""Folder of true masks."""
_FILE = re.compile(rf"{UNPLACED}/\d+\.tif")
_KINDS = {"name": str, "file": str, "set": str, "grazing_deg": int | float}


def read_masks(folder: Path, dataset: Dataset, splits: Collection[str] | None = None) -> dict[int, Mask]:
    """Read true masks of sets of a dataset, every test set unless given, by the index of the image, row 0 near.

    The folder has grey 8-bit PNGs with the images' names (`T72/17deg/hb03333.png` for the chip
    `T72/17deg/hb03333.jpeg`): 0 clutter, 1 target, 2 shadow. Masks of MSTAR chips are oriented like the published
    chips, and are turned and cut like them; masks of other datasets have row 0 near, like the images. Test images may
    lack theirs. Raise SarsplatError if there is no such set, a training image or every image lacks its mask, two images
    would share one, or a mask is damaged, of another size or holds other numbers.
    """
    chosen = {split for split in dataset.splits() if split != "train"} if splits is None else set(splits)
    for split in chosen:
        dataset.indices(split)  # raises if there is no such set
    masks: dict[int, Mask] = {}
    missing: list[Path] = []
    file = folder
    for index, name in mask_names(dataset, chosen).items():
        file = folder / name
        with plain_os_errors("read", folder):
            if file.is_file():
                masks[index] = _read_mask(file, dataset)
            elif dataset.entries[index].split == "train":
                missing.append(file)
    if missing:
        raise SarsplatError(
            f"{folder} has no mask of {len(missing)} of {len(dataset.images('train'))} training images, the first "
            f"{missing[0]}; give one for each, which `sarsplat simulate --masks` makes for simulated images"
        )
    if not masks:
        raise SarsplatError(
            f"{folder} has no mask of any test image of {dataset}; give grey 8-bit PNGs named after the images, the "
            f"last {file}"
        )
    return masks


def _read_mask(path: Path, dataset: Dataset) -> Mask:
    image, grid = pillow(), dataset.grid
    data = read_bytes(path)
    try:
        picture = image.open(io.BytesIO(data), formats=("PNG",))
        mask, grey = np.asarray(picture), picture.mode == "L"
    except (OSError, SyntaxError, ValueError, image.DecompressionBombError):  # Pillow's errors for damage
        grey = False
    if not grey:
        raise SarsplatError(f"{path} is not a readable grey 8-bit PNG; write the mask again as such a file")
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
    _check_labels(mask, str(path))
    return mask


def _check_labels(mask: UInt8[np.ndarray, "*shape"], name: str) -> None:
    if mask.max() > SHADOW:
        raise SarsplatError(f"{name} holds the number {mask.max()}; masks are 0 clutter, 1 target and 2 shadow")


def encode_masks(masks: Masks, dataset: Dataset) -> dict[PurePosixPath, bytes]:
    """Return PNG files for `read_masks`, by their paths in its folder; raise for measured chips."""
    if masks.shape != dataset.power.shape or masks.dtype != np.uint8:
        raise SarsplatError(
            f"the masks are {masks.dtype} of shape {masks.shape}; for the images of {dataset.target} they must be "
            f"uint8 {dataset.power.shape}"
        )
    _check_labels(masks, "a mask")
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
    with needed("mstar", "a mask"):
        from PIL import Image
    return Image


def mask_names(dataset: Dataset, splits: Collection[str]) -> dict[int, PurePosixPath]:
    """Return a distinct file name for the mask of each image of these sets, by the image's index in the dataset."""
    images: dict[PurePosixPath, str] = {}
    names = {}
    for index, entry in enumerate(dataset.entries):
        if entry.split not in splits:
            continue
        name = PurePosixPath(entry.name)
        if not name.name or name.is_absolute() or ".." in name.parts or not entry.name.isprintable():
            raise SarsplatError(
                f"no mask can be named after the image {shown(entry.name)}; give it the name of a file, such as 007"
            )
        names[index] = name = name.with_suffix(".png")
        if name in images:
            raise SarsplatError(
                f"the images {shown(images[name])} and {shown(entry.name)} would share the mask {shown(str(name))}; "
                "give them different names"
            )
        images[name] = entry.name
    return names


def unplaced_in(source: dict[str, Any], where: object) -> list[dict[str, Any]]:
    """Return the list of chips without azimuth in a dataset's source; raise if an entry is invalid."""
    listed: list[Any] = source.get(UNPLACED, [])
    for chip in listed if isinstance(listed, list) else [listed]:
        complete = isinstance(chip, dict) and all(isinstance(chip.get(key), kind) for key, kind in _KINDS.items())
        if not complete or not _FILE.fullmatch(chip["file"]) or not re.fullmatch(SPLIT, chip["set"]):
            raise SarsplatError(f"{where} lists an invalid chip without azimuth ({shown(chip)}); import it again")
    return listed


def read_unplaced(dataset: Dataset, folder: Path, file: str) -> Float32[np.ndarray, "rows columns"]:
    """Read the linear power of a chip without azimuth."""
    power: Float32[np.ndarray, "rows columns"] = read_tiff(inside(folder, file), dataset.power.shape[1:])
    return power


def sidecars_of(
    dataset: Dataset, unchanged: Callable[[Path], tuple[bool, bool]]
) -> tuple[dict[str, Any], dict[str, Float32[np.ndarray, "rows columns"]], dict[PurePosixPath, bytes]]:
    """Read the sidecar files of a dataset's sets from its folder: its `source` with a list of chips, chips, masks.

    They are power by path in the dataset, and PNGs by path in the folder of masks. They are left out, with a warning,
    unless images are `unchanged(folder)`: chips if these are the same, masks if they are the same but for a factor.
    """
    listed, folder = unplaced_in(dataset.source, dataset), dataset.path
    names = mask_names(dataset, set(dataset.splits())) if folder is not None and (folder / MASKS).is_dir() else {}
    if not listed and not names:
        return dataset.source, {}, {}
    source = {name: value for name, value in dataset.source.items() if name != UNPLACED}
    same, alike = (False, False) if folder is None else unchanged(folder)
    lost = [counted(len(listed), "chip") + " without azimuth"] * bool(listed and not same)
    if lost := lost + ["masks"] * bool(names and not alike):
        warnings.warn(
            f"left out {' and '.join(lost)} of {dataset.target}, because its images differ from those in its folder; "
            "copy the folder, or write them yourself",
            SarsplatWarning,
            stacklevel=4,
        )
    if folder is None or not alike:
        return source, {}, {}
    chips = [chip for chip in listed if same and chip["set"] in dataset.splits()]
    masks = {}
    for name in names.values():
        with plain_os_errors("read", folder):
            if (path := inside(folder, f"{MASKS}/{name}")).is_file():
                masks[name] = read_bytes(path)
    pictures = {chip["file"]: read_unplaced(dataset, folder, chip["file"]) for chip in chips}
    return source | ({UNPLACED: chips} if chips else {}), pictures, masks
