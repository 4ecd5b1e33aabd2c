"""Folders of pictures, passes, polarisations and chips, made up, and their imports into a folder `out` beside them."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from chip_files import ROWS, write_chips
from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid, View
from sarsplat.importers import import_folder, import_mstar, import_stack

AZIMUTHS = (0.0, 90.0, 180.0, 270.0)
POWER = np.random.default_rng(0).gamma(1.0, size=(4, 20, 26)).astype(np.float32) + 0.1
PHASE = np.random.default_rng(1).uniform(0, 2 * np.pi, POWER.shape)
LENGTHS = {"spacing_m": (0.1, 0.3), "resolution_m": (0.2, 0.4)}

GRID = ImageGrid(20, 16, (0.5, 0.4), (0.6, 0.5))
VIEWS = (View(0.0, 45.0), View(70.0, 40.0))
NOISY = (np.random.default_rng(0).standard_normal((2, 3, 20, 16, 2)) @ [1, 1j]).astype(np.complex64)
"""Signals of two views and three channels."""
THREE = {"baseline": [0.0, 1e-3, 2e-3]}


def write_pictures(
    folder: Path, pixels: np.ndarray, rows: list[list] | None = None, names="file,azimuth,grazing", ending="npy"
) -> Path:
    """The pictures and a table."""
    folder.mkdir(exist_ok=True)
    for index, image in enumerate(pixels):
        path = folder / f"{index}.{ending}"
        if ending == "npy":
            np.save(path, image)
        elif ending == "tif":
            tifffile.imwrite(path, image)
        else:
            Image.fromarray(image).save(path)
    with (folder / "angles.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(names.split(","))
        table.writerows(rows or [[f"{index}.{ending}", azimuth, 30] for index, azimuth in enumerate(AZIMUTHS)])
    return folder


def import_pictures(folder: Path, **options) -> Dataset:
    options = {"quantity": "power", "calibration": "absolute", "overwrite": True, **LENGTHS, **options}
    return import_folder(folder, folder.parent / "out", **options)


def write_passes(folder: Path, signals: np.ndarray, columns: dict[str, list], views=VIEWS) -> Path:
    """A file for each channel, and the table; `columns` has a value for each channel of a view."""
    folder.mkdir(exist_ok=True)
    with (folder / "passes.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["file", "view", "azimuth", "grazing", *columns])
        for number, (view, stack) in enumerate(zip(views, signals, strict=True)):
            for channel, image in enumerate(stack):
                np.save(folder / f"{number}-{channel}.npy", image)
                own = [values[channel] for values in columns.values()]
                table.writerow([f"{number}-{channel}", f"v{number}", view.azimuth_deg, view.grazing_deg, *own])
    return folder


def import_passes(folder: Path, **options) -> Dataset:
    fixed = {"spacing_m": GRID.spacing_m, "resolution_m": GRID.resolution_m, "calibration": "absolute"}
    options = {**fixed, "wavelength_m": 0.031, "overwrite": True, **options}
    return import_stack(folder, folder.parent / "out", **options)


def import_chips(chips: Path, train_views: int = 4, target_class: str = "T72", **options) -> Dataset:
    options = {"labels": chips / "labels.csv", "overwrite": True, **options}
    return import_mstar(chips, chips.parent / "out", target_class=target_class, train_views=train_views, **options)


def rewrite(labels: Path, change: Callable[[list[list[str]]], list[list[str]]]) -> None:
    with labels.open(newline="") as file:
        rows = list(csv.reader(file))
    with labels.open("w", newline="") as file:
        csv.writer(file).writerows(change(rows))


def scale_chips(chips: Path, scales: list[str]) -> None:
    """Give the T72 a scale each; the column of other classes stays empty."""
    column = ["dn_per_magnitude", *scales, ""]
    rewrite(write_chips(chips, ROWS), lambda rows: [[*row, cell] for row, cell in zip(rows, column, strict=True)])
