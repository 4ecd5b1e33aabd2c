"""Which chips of ten classes are trained on, and what is reconstructed from them."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sarsplat import Dataset, Run, import_mstar, read_dataset, reconstruct
from sarsplat.data.orientation import oriented
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.importers.pictures import read_pixels
from sarsplat.settings.config import DEFAULT_METHOD

TRAINING, TEST = 17, 15
"""Depressions, degrees: nothing of the second is looked at before a network is trained."""

SIDE = 96
"""Pixels of the square in the middle that is kept of every chip: no class is told by its size."""


@dataclass(frozen=True)
class Draw:
    """Which training chips there are of each class."""

    each: int | None
    """How many; None is all."""
    seed: int | None = None
    """Of those at random; None is evenly spaced in azimuth."""

    @property
    def name(self) -> str:
        """As in the table and in the names of folders."""
        if self.each is None:
            return "all"
        return f"{self.each} evenly" if self.seed is None else f"{self.each} at random {self.seed}"


@dataclass(frozen=True)
class Measured:
    """All chips of the table."""

    folder: Path
    labels: Path
    classes: tuple[str, ...]
    names: tuple[str, ...]
    """Paths below the folder."""
    of_class: np.ndarray
    """int64 [n], places in `classes`."""
    depression: np.ndarray
    azimuth_deg: np.ndarray
    """TargetAz; NaN where it is unknown."""
    grazing_deg: np.ndarray
    pixels: np.ndarray
    """uint8 [n, SIDE, SIDE], digital numbers with near range at the top."""

    @classmethod
    def read(cls, folder: Path, labels: Path) -> Measured:
        """From the published JPEGs and their table."""
        with labels.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        classes = tuple(dict.fromkeys(row["class"] for row in rows))
        pixels = np.stack([middle(oriented(read_pixels(folder / row["path"]), "bottom")) for row in rows])
        return cls(
            folder,
            labels,
            classes,
            tuple(row["path"] for row in rows),
            np.array([classes.index(row["class"]) for row in rows]),
            np.array([round(float(row["desired_depression_deg"])) for row in rows]),
            np.array([float(row["target_az_deg"] or "nan") for row in rows]),
            np.array([float(row["measured_depression_deg"] or row["desired_depression_deg"]) for row in rows]),
            pixels.astype(np.uint8),
        )

    def chosen(self, draw: Draw, work: Path) -> np.ndarray:
        """Numbers of the training chips of a draw."""
        if draw.each is None:  # those whose azimuth is unknown as well
            return np.flatnonzero(self.depression == TRAINING)
        place = {name: number for number, name in enumerate(self.names)}
        entries = [entry for each in datasets(self, draw, work) for entry in each.select("train").entries]
        return np.array([place[entry.name] for entry in entries])


def middle(chips: np.ndarray, side: int = SIDE) -> np.ndarray:
    """The square in the middle of images [..., rows, columns]."""
    top, left = ((size - side) // 2 for size in chips.shape[-2:])
    return chips[..., top : top + side, left : left + side]


def datasets(measured: Measured, draw: Draw, work: Path) -> list[Dataset]:
    """Of each class the chips of a draw, imported where they are not yet."""
    return [read_dataset(_imported(measured, draw, target, work)) for target in measured.classes]


def run_folder(draw: Draw, target: str, method: str, work: Path) -> Path:
    """Where a reconstruction is."""
    return work / draw.name.replace(" ", "-") / method / target


def reconstructed(dataset: Path, method: str, out: Path) -> Path:
    """Reconstruct a class, or go on with it, by the settings that the method itself chooses."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SarsplatWarning)  # few views determine little: known
        begun = (out / "config.json").is_file()
        reconstruct(dataset, "auto", out, method=method, quiet=True, resume=begun)
    return out


def runs(measured: Measured, draw: Draw, work: Path, method: str = DEFAULT_METHOD) -> list[Run]:
    """Of each class, in their order."""
    return [Run.load(run_folder(draw, target, method, work)) for target in measured.classes]


def _imported(measured: Measured, draw: Draw, target: str, work: Path) -> Path:
    folder = run_folder(draw, target, "chips", work)
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        number = measured.classes.index(target)
        known = (measured.of_class == number) & (measured.depression == TRAINING) & np.isfinite(measured.azimuth_deg)
        each = int(known.sum()) if draw.each is None else draw.each
        if each > known.sum():
            raise SarsplatError(f"{each} chips of {target} are asked for, but there are {known.sum()}; ask for fewer")
        labels = measured.labels
        if draw.seed is not None:
            which = np.random.default_rng([draw.seed, number, each]).choice(np.flatnonzero(known), each, replace=False)
            labels = _table_of(measured.labels, {measured.names[k] for k in which}, folder.with_suffix(".csv"))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SarsplatWarning)
            import_mstar(
                measured.folder,
                folder,
                labels=labels,
                target_class=target,
                train_views=each,
                train_depression=TRAINING,
                test=False,
            )
    return folder


def _table_of(labels: Path, names: set[str], out: Path) -> Path:
    """The lines of a table that are about these chips."""
    with labels.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["path"] in names]
    return write_table(rows, out)


def write_table(rows: Sequence[Mapping[str, str]], out: Path) -> Path:
    """Write rows of the same columns as CSV."""
    with out.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return out


def jobs(measured: Measured, draw: Draw, methods: Sequence[str], work: Path) -> list[tuple[Path, str, Path]]:
    """Arguments of `reconstructed` for what is to be reconstructed of a draw."""
    return [
        (_imported(measured, draw, target, work), method, run_folder(draw, target, method, work))
        for method in methods
        for target in measured.classes
    ]
