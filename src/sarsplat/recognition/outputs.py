"""Inputs and files of `sarsplat locate` by their paths."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sarsplat.data.dataset_folder import HEADER as DATASET_HEADER
from sarsplat.errors import SarsplatError
from sarsplat.recognition.located import Located
from sarsplat.recognition.page import write_page
from sarsplat.runs.run_folder import HEADER


def runs_and_images(paths: Sequence[Path], *, one_dataset: bool) -> tuple[list[Path], list[Path]]:
    """Separate the folders of runs from those of images, which must be `one_dataset` if its copy is written."""
    runs = [path for path in paths if (path / HEADER).is_file()]
    images = [path for path in paths if path not in runs]
    if one_dataset and (len(images) != 1 or not (images[0] / DATASET_HEADER).is_file()):
        raise SarsplatError("`write_back` copies one dataset; give that alone, or leave `write_back` out")
    return runs, images


def files_of(table: Path, calibrate: Sequence[Path]) -> list[Path]:
    """Return the table (CSV), the page beside it, and, if labelled images calibrate, the file of the calibration."""
    made = any(path.suffix != ".json" for path in calibrate)
    return [table, table.with_suffix(".html"), *([table.with_suffix(".json")] * made)]


def write_files(located: Located, files: Sequence[Path]) -> None:
    """Write these files."""
    writers = {".csv": located.write_csv, ".json": located.calibration.write}
    for path in files:
        writers.get(path.suffix, lambda page: write_page(located, page))(path)
