"""What lies in a dataset's folder beside its images: chips whose azimuth is not known, and masks.

They travel with a dataset that is read and written again, as long as its images are those that lie there.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float32

from sarsplat.data.dataset import Dataset
from sarsplat.data.files import inside, open_file, plain_os_errors
from sarsplat.data.header import SPLIT
from sarsplat.data.masks import mask_names
from sarsplat.data.tiff import read_tiff
from sarsplat.errors import SarsplatError, SarsplatWarning, counted, shown

UNPLACED = "unplaced"
"""Folder in a dataset of chips without azimuth, and where its `source` lists them."""
MASKS = "masks"
"""Folder in a dataset of true masks."""
_FILE = re.compile(rf"{UNPLACED}/\d+\.tif")
_KINDS = {"name": str, "file": str, "set": str, "grazing_deg": int | float}


@dataclass(frozen=True)
class Beside:
    """Files to be written beside the images of a dataset, by their names in its folder.

    Attributes
    ----------
    source : dict
        What the dataset then says of where it comes from.
    pictures : dict of str to numpy.ndarray, float32 [rows, columns]
        Linear power of chips without azimuth.
    masks : dict of PurePosixPath to bytes
        PNGs, by their names in the folder of masks.
    """

    source: dict[str, Any]
    pictures: dict[str, Float32[np.ndarray, "rows columns"]]
    masks: dict[PurePosixPath, bytes]


def unplaced_in(source: dict[str, Any], where: object) -> list[dict[str, Any]]:
    """What a dataset's source says of chips without azimuth; nothing in it is trusted, as it names files and sets."""
    listed: list[Any] = source.get(UNPLACED, [])
    for one in listed if isinstance(listed, list) else [listed]:
        whole = isinstance(one, dict) and all(isinstance(one.get(key), kind) for key, kind in _KINDS.items())
        if not whole or not _FILE.fullmatch(one["file"]) or not re.fullmatch(SPLIT, one["set"]):
            raise SarsplatError(f"{where} lists chips without azimuth that are none ({shown(one)}); import it again")
    return listed


def read_unplaced(dataset: Dataset, folder: Path, file: str) -> Float32[np.ndarray, "rows columns"]:
    """Linear power of a chip without azimuth."""
    power: Float32[np.ndarray, "rows columns"] = read_tiff(
        inside(folder, file), (dataset.grid.rows, dataset.grid.columns)
    )
    return power


def beside(dataset: Dataset, unchanged: Callable[[Path], bool]) -> Beside:
    """What lies beside a dataset in its folder, of the sets that it still has.

    It is left out, with a warning, if the images are not those in that folder, as `unchanged` says of it: nobody knows
    whether they still have their scale and their place. So are chips without azimuth if there is no folder.
    """
    listed, folder = unplaced_in(dataset.source, dataset), dataset.path
    names = mask_names(dataset, set(dataset.splits())) if folder is not None and (folder / MASKS).is_dir() else {}
    if not listed and not names:
        return Beside(dataset.source, {}, {})
    source = {name: value for name, value in dataset.source.items() if name != UNPLACED}
    if folder is None or not unchanged(folder):
        lost = [counted(len(listed), "chip") + " without azimuth"] * bool(listed) + ["masks"] * bool(names)
        warnings.warn(
            f"left out {' and '.join(lost)} beside the images of {dataset.target}, because its images are no "
            "longer those of a folder that was read; copy the folder, or write them yourself",
            SarsplatWarning,
            stacklevel=4,
        )
        return Beside(source, {}, {})
    kept = [one for one in listed if one["set"] in dataset.splits()]
    masks = {}
    for name in names.values():
        with plain_os_errors("read", folder):
            if (path := inside(folder, f"{MASKS}/{name}")).is_file():
                with open_file(path) as file:
                    masks[name] = file.read()
    pictures = {one["file"]: read_unplaced(dataset, folder, one["file"]) for one in kept}
    return Beside(source | ({UNPLACED: kept} if kept else {}), pictures, masks)
