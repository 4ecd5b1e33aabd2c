"""Images to be located: of datasets, with those that have no azimuth, or of folders of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from sarsplat.data import Dataset, read_dataset
from sarsplat.data.dataset_folder import HEADER
from sarsplat.data.image import power_of
from sarsplat.data.orientation import oriented
from sarsplat.data.sidecar import read_unplaced, unplaced_in
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.azimuths import without_azimuth
from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.view import seen_alike
from sarsplat.importers.pictures import PICTURE_ENDINGS, read_values
from sarsplat.names import Quantity, Side
from sarsplat.runs import Run
from sarsplat.samples.chip_set import folder_name
from sarsplat.samples.measured import datasets_in


@dataclass(frozen=True, eq=False)
class Chip:
    """Image of unknown or distrusted azimuth, with its labels."""

    name: str
    """Name in its dataset, or of its file."""
    power: Float32[np.ndarray, "rows columns"]
    """Linear power in any unit, row 0 near range."""
    grid: ImageGrid
    view: View
    """Its view at azimuth 0."""
    target: str = ""
    """Labelled class; "" if unknown."""
    azimuth_deg: float = np.nan
    """Labelled azimuth, degrees; NaN if unknown."""


def chips_of(
    images: Iterable[Dataset | str | Path],
    split: str | None,
    grazing_deg: float | None,
    near: Side,
    quantity: Quantity | None,
    runs: Sequence[Run],
) -> list[Chip]:
    """Read the images of datasets, of folders of datasets, or of folders of pictures.

    Without `split`, training images are left out of datasets that have others. Grazing angles are whole degrees unless
    given, so that images share renderings. Pictures have the runs' pixels, and side and tilt of the first.
    """
    found: list[Chip] = []
    for one in images:
        if isinstance(one, Dataset):
            found += _of_dataset(one, split, grazing_deg)
        elif (Path(one) / HEADER).is_file() or any(Path(one).glob(f"*/{HEADER}")):
            for path in datasets_in([Path(one)]):
                found += _of_dataset(read_dataset(path), split, grazing_deg)
        else:
            found += _of_pictures(Path(one), grazing_deg, near, quantity, runs)
    if not found:
        raise SarsplatError(f"there are no images of the set {split or 'test'} to locate; give others, or another set")
    return found


def _of_dataset(dataset: Dataset, split: str | None, grazing_deg: float | None) -> Iterator[Chip]:
    """Yield the images of a dataset, those without azimuth last."""
    chosen = {split} if split else {*dataset.splits()} - {"train"} or {"train"}
    grid, target = dataset.grid, folder_name(dataset.target)
    for entry, power in zip(dataset.entries, dataset.power, strict=True):
        if entry.split in chosen:
            view = without_azimuth(entry.view, grazing_deg)
            yield Chip(entry.name, power, grid, view, target, entry.view.azimuth_deg)
    for one in unplaced_in(dataset.source, dataset):
        if one["set"] in chosen and dataset.path is not None:
            view = without_azimuth(seen_alike(dataset.views, 0.0, one["grazing_deg"]), grazing_deg)
            yield Chip(one["name"], read_unplaced(dataset, dataset.path, one["file"]), grid, view, target)


def _of_pictures(
    folder: Path, grazing_deg: float | None, near: Side, quantity: Quantity | None, runs: Sequence[Run]
) -> Iterator[Chip]:
    """Yield the pictures in a folder."""
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in PICTURE_ENDINGS)
    if not paths:
        raise SarsplatError(f"{folder} contains neither datasets nor pictures; give a folder that does")
    if grazing_deg is None:
        raise SarsplatError(f"the pictures in {folder} have no grazing angle; give it as `grazing_deg`")
    if len({(run.grid.spacing_m, run.grid.resolution_m) for run in runs}) > 1:
        raise SarsplatError(f"pictures have the runs' pixels, but these differ; import {folder} as a dataset")
    view = seen_alike(runs[0].snapshot.views, 0.0, grazing_deg)
    for path in paths:
        values = read_values(path, quantity, 1.0, 0.0)
        power = oriented(power_of(values.image) * np.float32(values.power_factor), near)
        yield Chip(path.name, power, replace(runs[0].grid, rows=power.shape[0], columns=power.shape[1]), view)


def require_comparable(chips: Sequence[Chip]) -> None:
    """Raise if an image is black, or its pixels differ from those of the others."""
    for chip in chips:
        if (chip.grid.spacing_m, chip.grid.resolution_m) != (chips[0].grid.spacing_m, chips[0].grid.resolution_m):
            raise SarsplatError(f"{chip.name} has pixels of another size than {chips[0].name}; locate them separately")
        if not chip.power.any():
            raise SarsplatError(f"{chip.name} is black; leave it out")
