"""Sidecar files of datasets: chips of unknown azimuth, and masks.

Writing a dataset that was read from a folder copies them, as long as its images are unchanged.
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
"""Folder of chips without azimuth, and key of their list in a dataset's `source`."""
MASKS = "masks"
"""Folder of true masks."""
_FILE = re.compile(rf"{UNPLACED}/\d+\.tif")
_KINDS = {"name": str, "file": str, "set": str, "grazing_deg": int | float}


@dataclass(frozen=True)
class Sidecars:
    """Sidecar files of a dataset.

    Attributes
    ----------
    source : dict
        The dataset's `source` with a list of these chips.
    pictures : dict of str to numpy.ndarray, float32 [rows, columns]
        Linear power of chips without azimuth, by their paths in the dataset.
    masks : dict of PurePosixPath to bytes
        PNGs, by their paths in the folder of masks.
    """

    source: dict[str, Any]
    pictures: dict[str, Float32[np.ndarray, "rows columns"]]
    masks: dict[PurePosixPath, bytes]


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
    power: Float32[np.ndarray, "rows columns"] = read_tiff(
        inside(folder, file), (dataset.grid.rows, dataset.grid.columns)
    )
    return power


def sidecars_of(dataset: Dataset, unchanged: Callable[[Path], bool]) -> Sidecars:
    """Read the sidecar files of a dataset's sets from its folder.

    They are left out, with a warning, unless `unchanged(folder)`: images that differ from the folder's may have another
    scale or position. Chips without azimuth are also left out if there is no folder.
    """
    listed, folder = unplaced_in(dataset.source, dataset), dataset.path
    names = mask_names(dataset, set(dataset.splits())) if folder is not None and (folder / MASKS).is_dir() else {}
    if not listed and not names:
        return Sidecars(dataset.source, {}, {})
    source = {name: value for name, value in dataset.source.items() if name != UNPLACED}
    if folder is None or not unchanged(folder):
        lost = [counted(len(listed), "chip") + " without azimuth"] * bool(listed) + ["masks"] * bool(names)
        warnings.warn(
            f"left out {' and '.join(lost)} of {dataset.target}, because its images differ from those in its folder; "
            "copy the folder, or write them yourself",
            SarsplatWarning,
            stacklevel=4,
        )
        return Sidecars(source, {}, {})
    chips = [chip for chip in listed if chip["set"] in dataset.splits()]
    masks = {}
    for name in names.values():
        with plain_os_errors("read", folder):
            if (path := inside(folder, f"{MASKS}/{name}")).is_file():
                with open_file(path) as file:
                    masks[name] = file.read()
    pictures = {chip["file"]: read_unplaced(dataset, folder, chip["file"]) for chip in chips}
    return Sidecars(source | ({UNPLACED: chips} if chips else {}), pictures, masks)
