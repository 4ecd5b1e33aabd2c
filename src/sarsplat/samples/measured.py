"""Measured chips of datasets as files, written as generated ones are, so that a classifier can be trained on both."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex64

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset, new_folder, read_dataset
from sarsplat.data.dataset_folder import HEADER
from sarsplat.data.files import write_bytes, write_json
from sarsplat.data.sidecar import UNPLACED, read_unplaced, unplaced_in
from sarsplat.errors import SarsplatError, SarsplatWarning, counted, shown
from sarsplat.geometry import ImageGrid, View
from sarsplat.progress import progress
from sarsplat.samples.chip_set import one_serial
from sarsplat.samples.encoding import ENDINGS, Encoding
from sarsplat.samples.write import UNUSUAL_COLUMNS, unusual_columns, unusual_values
from sarsplat.version import program_version

LABELS = "labels.csv"
MARKER = "measured-chips.json"
"""The file that marks a folder of them."""
_SCHEMA, _SCHEMA_VERSION = "sarsplat-measured-chips", 1

_COLUMNS = (
    *("path", "class", "split", "name", "azimuth_deg", "grazing_deg"),
    *("serial", "desired_depression_deg", "measured_depression_deg", "target_az_deg"),  # what `import mstar` asks for
    *("azimuth_spacing_m", "range_spacing_m", "azimuth_resolution_m", "range_resolution_m"),  # and `import folder`
)


@dataclass(frozen=True)
class _Measured:
    """One measured chip: its amplitude, row 0 near, complex if its phase is known."""

    split: str
    name: str
    view: View | None
    """None if its azimuth is not known."""
    grazing_deg: float
    amplitude: Complex64[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class MeasuredChips:
    """What was written.

    Attributes
    ----------
    counts : dict of (str, str) to int
        Number of chips by split and class.
    size : (int, int)
        Rows and columns of each.
    """

    counts: dict[tuple[str, str], int]
    size: tuple[int, int]


def datasets_in(paths: Sequence[Path]) -> list[Path]:
    """The datasets that are named, and those in named folders that are none themselves, such as those of a split.

    Refused if there are none, or one is there twice.
    """
    found: list[Path] = []
    for path in paths:
        own = [path] if (path / HEADER).is_file() else sorted(header.parent for header in path.glob(f"*/{HEADER}"))
        if not own:
            raise SarsplatError(
                f"{path} is no dataset, and has none in it; give one, such as by `sarsplat import mstar`"
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
    """Write the measured chips of datasets as a folder that is whole or absent.

    Parameters
    ----------
    datasets : sequence of str or Path
        Datasets, or folders of datasets. A class is what a dataset says that it shows.
    out : str or Path
        The folder: in it one of each set ("train", "test-15", …), in these a folder of each class, as
        `torchvision.datasets.ImageFolder` reads them, empty where a set has none of a class; `labels.csv`; and
        `measured-chips.json`, how they were made.
    encoding : Encoding
        How they are stored: as the generated ones that they are mixed with.
    overwrite : bool
        Replace an existing folder of measured chips.
    quiet : bool
        Show no progress.

    Raises
    ------
    SarsplatError
        If there is no dataset, one cannot be read or is of stacks, two show classes whose folders would have one name,
        their pixels differ, they differ in size and are not cut, phases are asked for and not known, or the folder
        exists or cannot be written.
    """
    out, folders = Path(out), datasets_in([Path(path) for path in datasets])
    read: dict[Path, tuple[ImageGrid, str]] = {}
    brightest = 0.0
    for path in folders:  # one after the other: only what is asked of all of them is kept
        dataset = read_dataset(path)
        _require_fit(path, dataset, encoding, read)
        read[path] = dataset.grid, dataset.target
        brightest = max(brightest, float(dataset.select("train").power.max()))
    _require_one_name_each(read)
    counts: dict[tuple[str, str], int] = {}
    rows: list[dict[str, Any]] = []
    views: list[View] = []
    size = encoding.size(next(iter(read.values()))[0])
    with new_folder(out, overwrite, marker=MARKER) as folder, progress(f"chips to {out}", len(folders), quiet) as shows:
        record = {"schema": _SCHEMA, "schema_version": _SCHEMA_VERSION, "program": program_version()}
        write_json(folder / MARKER, {**record, "datasets": list(map(str, folders)), **vars(encoding)})
        for path in folders:
            dataset = read_dataset(path)
            planned, serial = _planned(dataset), one_serial(dataset.source)
            for chip in _chips_of(path, dataset):
                at = chip.split, _plain(dataset.target)
                number = counts.get(at, 0)
                counts[at] = number + 1
                file = Path(*at) / f"{number:08d}{ENDINGS[encoding.format]}"
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_bytes(encoding.encoded(chip.amplitude, brightest))
                scale = encoding.numbers_per_unit(chip.amplitude, brightest)
                known = planned.get(chip.name, (serial, round(chip.grazing_deg)))
                written = {"near_side": encoding.near, encoding.scale_column: scale}
                rows.append({**_row(file, dataset, chip, known), **written})
            views += dataset.views
            shows.advance(1, dataset.target)
        lacking = _lacking(counts)
        for split, target in lacking:
            (folder / split / target).mkdir()
        write_bytes(
            folder / LABELS, _table(rows, (*_COLUMNS, *unusual_columns(views), "near_side", encoding.scale_column))
        )
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


def _lacking(counts: dict[tuple[str, str], int]) -> list[tuple[str, str]]:
    """Sets and classes of which there is no chip: readers of folders number the classes that a set has."""
    splits, targets = (dict.fromkeys(names) for names in zip(*counts, strict=True))
    return [(split, target) for split in splits for target in targets if (split, target) not in counts]


def _require_fit(path: Path, dataset: Dataset, encoding: Encoding, before: dict[Path, tuple[ImageGrid, str]]) -> None:
    """Refuse what cannot be stored like that, or is not like the datasets before."""
    grid = dataset.grid
    if any(entry.stack is not None for entry in dataset.entries):
        raise SarsplatError(f"{path} holds stacks, of which there are no chips; give datasets of single images")
    if not dataset.target:
        raise SarsplatError(f"{path} does not say what it shows; import it with --class NAME")
    if encoding.quantity == "complex" and dataset.signal is None:
        raise SarsplatError(f"{path} has no phases, so its chips cannot be complex; choose magnitude or power")
    if encoding.crop is not None and encoding.crop > min(grid.rows, grid.columns):
        raise SarsplatError(
            f"crop is {encoding.crop}, but the images of {path} have {grid.rows} × {grid.columns} pixels; give at most "
            f"{min(grid.rows, grid.columns)}"
        )
    if before:
        first, (one, _) = next(iter(before.items()))
        if (one.spacing_m, one.resolution_m) != (grid.spacing_m, grid.resolution_m):
            raise SarsplatError(f"{path} has pixels of another size than {first}; make a set of each")
        if encoding.crop is None and (one.rows, one.columns) != (grid.rows, grid.columns):
            least = min(one.rows, one.columns, grid.rows, grid.columns)
            raise SarsplatError(
                f"{path} has images of {grid.rows} × {grid.columns} pixels, but {first} of {one.rows} × {one.columns}; "
                f"cut all to one size, by a crop of at most {least}"
            )


def _require_one_name_each(read: dict[Path, tuple[ImageGrid, str]]) -> None:
    first: dict[str, str] = {}
    for _, target in read.values():
        if (one := first.setdefault(_plain(target), target)) != target:
            raise SarsplatError(
                f"{shown(one)} and {shown(target)} are two classes whose folders would both be called {_plain(one)}; "
                "make a set of each"
            )


def _chips_of(path: Path, dataset: Dataset) -> Iterator[_Measured]:
    """Every chip of a dataset, those without azimuth last, in the set that it names."""
    amplitudes = np.sqrt(dataset.power) if dataset.signal is None else dataset.signal
    for entry, amplitude in zip(dataset.entries, amplitudes, strict=True):
        yield _Measured(entry.split, entry.name, entry.view, entry.view.grazing_deg, amplitude.astype(np.complex64))
    for one in unplaced_in(dataset.source, path):
        power = read_unplaced(dataset, path, one["file"])
        yield _Measured(one["set"], one["name"], None, one["grazing_deg"], np.sqrt(power).astype(np.complex64))


def _planned(dataset: Dataset) -> dict[str, tuple[str, int]]:
    """Serial number and planned depression angle, degrees, by the names of those chips of which they are known."""
    known = {}
    for key in ("chips", UNPLACED):
        listed: Any = dataset.source.get(key, [])
        for one in listed if isinstance(listed, list) else []:
            if isinstance(one, dict) and isinstance(one.get("serial"), str) and type(one.get("depression_deg")) is int:
                known[str(one.get("name"))] = one["serial"], one["depression_deg"]
    return known


def _row(file: Path, dataset: Dataset, chip: _Measured, planned: tuple[str, int]) -> dict[str, Any]:
    azimuth = None if chip.view is None else chip.view.azimuth_deg
    placed = ("", "") if azimuth is None else (azimuth, round(-azimuth % 360, 6))
    unusual = () if chip.view is None else unusual_values(chip.view)
    named = (file.as_posix(), dataset.target, chip.split, chip.name, placed[0], chip.grazing_deg)
    labels = (*planned, chip.grazing_deg, placed[1])
    lengths = (*dataset.grid.spacing_m, *dataset.grid.resolution_m)
    return dict(zip((*_COLUMNS, *UNUSUAL_COLUMNS), (*named, *labels, *lengths, *unusual), strict=False))


def _table(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> bytes:
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue().encode()


def _plain(target: str) -> str:
    """A class as a folder may be named, as of generated chips."""
    return re.sub(r"[^\w+-]", "_", target)


def in_words(written: MeasuredChips) -> str:
    """How many there are: "5,172 chips of 10 classes (2,747 train, 2,425 test-15), 88 × 88 pixels"."""
    splits: dict[str, int] = {}
    for (split, _), number in written.counts.items():
        splits[split] = splits.get(split, 0) + number
    classes = len({target for _, target in written.counts})
    each = ", ".join(f"{number:,} {split}" for split, number in splits.items())
    rows, columns = written.size
    kinds = "1 class" if classes == 1 else f"{classes} classes"
    return f"{counted(sum(splits.values()), 'chip')} of {kinds} ({each}), {rows} × {columns} pixels"
