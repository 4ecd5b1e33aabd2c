"""Measured chips of datasets, written as generated ones are, so that a classifier can be trained on both."""

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex64

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset, new_folder, read_dataset, write_bytes, write_json
from sarsplat.data.dataset_folder import HEADER
from sarsplat.data.sidecar import UNPLACED, read_unplaced, unplaced_in
from sarsplat.errors import SarsplatError, SarsplatWarning, counted
from sarsplat.extras import program_version
from sarsplat.geometry import ImageGrid, View
from sarsplat.progress import progress
from sarsplat.samples.chip_set import folder_name, one_serial, require_distinct_folders
from sarsplat.samples.encoding import (
    ENDINGS,
    IMPORT_COLUMNS,
    LABELS,
    UNUSUAL_COLUMNS,
    Encoding,
    encoded_table,
    unusual_columns,
    unusual_values,
)

MARKER = "measured-chips.json"
"""File that marks a folder of measured chips."""
_SCHEMA, _SCHEMA_VERSION = "sarsplat-measured-chips", 1

_COLUMNS = ("path", "class", "split", "name", "azimuth_deg", "grazing_deg", *IMPORT_COLUMNS)


@dataclass(frozen=True)
class MeasuredChips:
    """Numbers of written chips by split and class, and rows and columns of a chip."""

    counts: dict[tuple[str, str], int]
    size: tuple[int, int]


def datasets_in(paths: Sequence[Path]) -> list[Path]:
    """List datasets among paths, and those inside of other folders; raise without any, or for duplicates."""
    found: list[Path] = []
    for path in paths:
        own = [path] if (path / HEADER).is_file() else sorted(header.parent for header in path.glob(f"*/{HEADER}"))
        if not own:
            raise SarsplatError(
                f"{path} is not a dataset and contains none; give one, such as by `sarsplat import mstar`"
            )
        found += own
    if len({path.resolve() for path in found}) < len(found):
        twice = next(path for k, path in enumerate(found) if path.resolve() in {one.resolve() for one in found[:k]})
        raise SarsplatError(f"{twice} is named twice, so that its chips would count twice; name it once")
    return found


@checks_arguments
def write_measured_chips(
    datasets: Sequence[str | Path], out: str | Path, encoding: Encoding, *, overwrite: bool = False, quiet: bool = True
) -> MeasuredChips:
    """Write the measured chips of datasets as a folder; no partial folder is left.

    Parameters
    ----------
    datasets : sequence of str or Path
        Datasets, or folders of datasets. A class is the target that a dataset names.
    out : str or Path
        New folder: SET/CLASS/ with chips, for sets "train", "test-15", …, as `torchvision.datasets.ImageFolder` reads
        them (folders of missing classes are empty); `labels.csv`; and the settings, `measured-chips.json`.
    encoding : Encoding
        Pixels and format, as of the generated chips that they are mixed with.
    overwrite : bool
        Replace an existing folder of measured chips.
    quiet : bool
        Show no progress.

    Raises
    ------
    SarsplatError
        If there is no dataset, one cannot be read, has stacks or no phases for complex chips, two classes would share a
        folder, pixels or sizes (without crop) differ, or the folder exists or cannot be written.
    """
    out, folders = Path(out), datasets_in([Path(path) for path in datasets])
    read: dict[Path, tuple[ImageGrid, str]] = {}
    brightest = 0.0
    for path in folders:  # one in memory at a time
        dataset = read_dataset(path)
        _require_fit(path, dataset, encoding, read)
        read[path] = dataset.grid, dataset.target
        brightest = max(brightest, float(dataset.select("train").power.max()))
    require_distinct_folders(target for _, target in read.values())
    counts: Counter[tuple[str, str]] = Counter()
    rows: list[dict[str, Any]] = []
    views: list[View] = []
    stored_columns = "near_side", encoding.scale_column
    size = encoding.size(next(iter(read.values()))[0])
    with new_folder(out, overwrite, marker=MARKER) as folder, progress(f"chips to {out}", len(folders), quiet) as shows:
        record = {"schema": _SCHEMA, "schema_version": _SCHEMA_VERSION, "program": program_version()}
        write_json(folder / MARKER, {**record, "datasets": list(map(str, folders)), **vars(encoding)})
        for path in folders:
            dataset = read_dataset(path)
            planned, serial = _planned(dataset), one_serial(dataset.source)
            for split, name, grazing_deg, view, amplitude in _chips_of(path, dataset):
                at = split, folder_name(dataset.target)
                file = Path(*at) / f"{counts[at]:08d}{ENDINGS[encoding.format]}"
                counts[at] += 1
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_bytes(encoding.encoded(amplitude, brightest))
                named = file.as_posix(), dataset.target, split, name
                labels = planned.get(name, (serial, round(grazing_deg)))
                stored = encoding.near, encoding.numbers_per_unit(amplitude, brightest)
                rows.append(_row(named, labels, grazing_deg, view, dataset.grid) | dict(zip(stored_columns, stored)))
            views += dataset.views
            shows.advance(1, dataset.target)
        splits, targets = (dict.fromkeys(names) for names in zip(*counts, strict=True))
        # readers number the folders of a set as classes
        lacking = [(split, target) for split in splits for target in targets if (split, target) not in counts]
        for split, target in lacking:
            (folder / split / target).mkdir()
        write_bytes(folder / LABELS, encoded_table(rows, (*_COLUMNS, *unusual_columns(views), *stored_columns)))
    if lacking:
        split, target = lacking[0]
        warnings.warn(
            f"{out} has {counted(len(lacking), 'empty folder')}, the first {split}/{target}, so that classes have the "
            "same numbers in all sets; torchvision's ImageFolder reads such sets with allow_empty=True, and refuses "
            "them without",
            SarsplatWarning,
            stacklevel=3,
        )
    return MeasuredChips(counts, size)


def _require_fit(path: Path, dataset: Dataset, encoding: Encoding, before: dict[Path, tuple[ImageGrid, str]]) -> None:
    """Raise if a dataset cannot be encoded, or its pixels differ from those of the datasets before."""
    grid = dataset.grid
    if any(entry.stack is not None for entry in dataset.entries):
        raise SarsplatError(f"{path} holds stacks; give datasets of single images")
    if not dataset.target:
        raise SarsplatError(f"{path} does not name its target; import it with `target_class=NAME`")
    if encoding.quantity == "complex" and dataset.signal is None:
        raise SarsplatError(f"{path} has no phases, so its chips cannot be complex; choose magnitude or power")
    encoding.require_room(grid, str(path))
    if before:
        first, (one, _) = next(iter(before.items()))
        if (one.spacing_m, one.resolution_m) != (grid.spacing_m, grid.resolution_m):
            raise SarsplatError(f"{path} has pixels of another size than {first}; make a set of each")
        encoding.require_equal_sizes(grid, str(path), one, str(first))


def _chips_of(
    path: Path, dataset: Dataset
) -> Iterator[tuple[str, str, float, View | None, Complex64[np.ndarray, "rows columns"]]]:
    """Yield set, name, grazing angle, view and amplitude (row 0 near) of all chips; those without view come last."""
    amplitudes = np.sqrt(dataset.power) if dataset.signal is None else dataset.signal
    for entry, amplitude in zip(dataset.entries, amplitudes, strict=True):
        yield entry.split, entry.name, entry.view.grazing_deg, entry.view, amplitude.astype(np.complex64)
    for one in unplaced_in(dataset.source, path):
        amplitude = np.sqrt(read_unplaced(dataset, path, one["file"])).astype(np.complex64)
        yield one["set"], one["name"], one["grazing_deg"], None, amplitude


def _planned(dataset: Dataset) -> dict[str, tuple[str, int]]:
    """Serial number and planned depression angle, degrees, of chips that have both, by name."""
    known = {}
    for key in ("chips", UNPLACED):
        listed: Any = dataset.source.get(key, [])
        for one in listed if isinstance(listed, list) else []:
            if isinstance(one, dict) and isinstance(one.get("serial"), str) and type(one.get("depression_deg")) is int:
                known[str(one.get("name"))] = one["serial"], one["depression_deg"]
    return known


def _row(
    named: tuple[str, str, str, str], planned: tuple[str, int], grazing_deg: float, view: View | None, grid: ImageGrid
) -> dict[str, Any]:
    azimuth, target_az = ("", "") if view is None else (view.azimuth_deg, round(-view.azimuth_deg % 360, 6))
    angles = azimuth, grazing_deg, *planned, grazing_deg, target_az
    unusual = () if view is None else unusual_values(view)
    values = *named, *angles, *grid.spacing_m, *grid.resolution_m, *unusual
    return dict(zip((*_COLUMNS, *UNUSUAL_COLUMNS), values, strict=False))


def in_words(written: MeasuredChips) -> str:
    """Describe written chips: "5,172 chips of 10 classes (2,747 train, 2,425 test-15), 88 × 88 pixels"."""
    splits: Counter[str] = Counter()
    for (split, _), number in written.counts.items():
        splits[split] += number
    classes = len({target for _, target in written.counts})
    sets = ", ".join(f"{number:,} {split}" for split, number in splits.items())
    rows, columns = written.size
    kinds = "1 class" if classes == 1 else f"{classes} classes"
    return f"{counted(splits.total(), 'chip')} of {kinds} ({sets}), {rows} × {columns} pixels"
