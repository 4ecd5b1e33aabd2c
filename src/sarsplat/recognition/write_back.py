"""Datasets with the azimuths that were found for their images without azimuth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sarsplat.data import Dataset, DatasetEntry, read_dataset, write_dataset
from sarsplat.data.sidecar import UNPLACED, read_unplaced, unplaced_in
from sarsplat.errors import SarsplatError, counted
from sarsplat.geometry.view import seen_alike
from sarsplat.recognition.located import Located


def write_back(located: Located, dataset: str | Path, out: str | Path, *, overwrite: bool = False) -> Dataset:
    """Write a copy of a dataset that includes its images without azimuth, seen from where they were located.

    Each has the azimuth of its labelled class, or of the class found if it has no label, with its standard deviation,
    by which training refines azimuths of training images. Azimuths in the dataset stay. Images whose azimuth is too
    uncertain, that may be reversed, or whose class no run has, stay without. The copy has no phases.

    Parameters
    ----------
    located : Located
        Result for this dataset, or others with it.
    dataset, out : path
        Folder of the dataset, and that of the copy.
    overwrite : bool
        Replace an existing dataset.

    Returns
    -------
    Dataset
        The copy; the added images are its last.

    Raises
    ------
    SarsplatError
        If no image of the dataset gets an azimuth, or the copy exists.
    """
    before = read_dataset(dataset)
    found = {chip.name: k for k, chip in enumerate(located.chips) if np.isnan(chip.azimuth_deg)}
    azimuth_deg, std_deg = (located.of_class(one) for one in (located.azimuth_deg, located.azimuth_std_deg))
    certain = located.certain
    entries, images, chips, left = [], [], [], []
    for one in unplaced_in(before.source, before):
        power, index = read_unplaced(before, Path(dataset), one["file"]), found.get(one["name"])
        if index is None or not np.array_equal(power, located.chips[index].power) or not certain[index]:
            left.append(one)
            continue
        view = seen_alike(before.views, float(azimuth_deg[index]), one["grazing_deg"])
        entries.append(DatasetEntry(view, one["set"], one["name"], max(float(std_deg[index]), 0.01)))
        images.append(power)
        chips.append({name: one[name] for name in ("name", "serial", "depression_deg") if name in one})
    if not entries:
        raise SarsplatError(
            f"no image of {dataset} gets an azimuth: none of those without was located with certainty as "
            f"{' or '.join(located.classes)}, the classes of the runs"
        )
    source = {name: value for name, value in before.source.items() if name != UNPLACED}
    source["assumptions"] = [
        *source.get("assumptions", []),
        f"the azimuths of {counted(len(entries), 'image')} are estimates by locate",
        *["phases are left out, as images without azimuth have none"] * (before.signal is not None),
    ]
    if "chips" in source:
        source["chips"] = [*source["chips"], *chips]
    if left:
        source[UNPLACED] = left
    power = np.concatenate([before.power, images])
    after = replace(before, entries=(*before.entries, *entries), power=power, signal=None, source=source)
    return write_dataset(out, after, overwrite=overwrite)
