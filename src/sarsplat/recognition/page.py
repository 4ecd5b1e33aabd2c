"""Inputs and files of `sarsplat locate`: a table, and a page of chips beside the renderings that explain them.

The page also has the confusion of classes and the reliability of odds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sarsplat.colours import POWER
from sarsplat.data import write_bytes
from sarsplat.data.dataset_folder import HEADER as DATASET_HEADER
from sarsplat.errors import SarsplatError, counted
from sarsplat.radiometry import DYNAMIC_RANGE_DB, from_db, white_level
from sarsplat.recognition.located import Located
from sarsplat.report.figure import Block, Figure, axis, chart, colour_bar, polyline
from sarsplat.report.images import Part, view_name
from sarsplat.report.page import in_words, rendered
from sarsplat.report.views import evenly
from sarsplat.runs.run_folder import HEADER

_SHOWN, _DOUBTFUL = 12, 6
"""Number of images on the page, and of those that are chosen because they are wrong or least certain."""

_LARGEST = 160  # maximum number of pixels along a side that the page shows of an image
_BINS = 10  # number of bins of the reliability diagram


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
    """Write the files that `files_of` names."""
    located.write_csv(files[0])
    write_page(located, files[1])
    for path in files[2:]:
        located.calibration.write(path)


def write_page(located: Located, path: Path) -> None:
    """Write the result as one page that needs no network."""
    heads, calibration = ["labelled ↓ found →", *located.classes], located.calibration
    confusion = [[name, *map(str, row)] for name, row in zip(located.classes, located.confusion, strict=True)]
    known = bool((located.labels >= 0).any())
    bias = ", ".join(f"{name} {value:+.4f}" for name, value in calibration.bias.items())
    html = rendered(
        "located.html.j2",
        target=in_words(located.classes),
        lead=f"{counted(len(located), 'image')} compared with renderings of {counted(len(located.runs), 'run')}.",
        calibrated=calibration.images,
        odds=f"temperature {calibration.temperature:.3g}; biases, nats per pixel: {bias or 'none'}",
        settings=", ".join(f"{name} {value}" for name, value in calibration.settings.items() if value is not None),
        scores=located.scores_in_words(),
        heads=heads,
        confusion=confusion if known and len(located.classes) > 1 else [],
        figures=[_explained(located), *([_reliability(located)] if known and len(located.classes) > 1 else [])],
    )
    write_bytes(path, html.encode())


def _explained(located: Located) -> Figure:
    """Chips beside their renderings: wrong or uncertain ones first, then others, evenly chosen."""
    wrong = (located.labels >= 0) & (located.found != located.labels)
    doubtful = np.lexsort((located.odds.max(axis=1), ~wrong))[:_DOUBTFUL]
    others = np.setdiff1d(np.arange(len(located)), doubtful)
    chosen = [*doubtful, *(others[k] for k in evenly(len(others), _SHOWN - len(doubtful)) if len(others))]
    blocks = [_block(located, int(index)) for index in chosen]
    text = (
        f"{counted(len(blocks), 'image')}, first wrong and doubtful ones, then others, evenly chosen; beside each, the "
        "rendering of the class and azimuth that were found, displaced and scaled as found, on the learned ground. The "
        "radar is above."
    )
    bar = colour_bar("power, dB relative to the brightest pixels of the image", POWER, -DYNAMIC_RANGE_DB, 0)
    return Figure("Images and what explains them", text, tuple(blocks), (bar,), layout="beside")


def _block(located: Located, index: int) -> Block:
    chip, best = located.chips[index], located.found[index]
    run, peak = located.runs[located.run_index[index, best]], white_level(chip.power[None])
    azimuth, std = located.azimuth_deg[index, best], located.azimuth_std_deg[index, best]
    view, grid = replace(chip.view, azimuth_deg=float(azimuth)), run.grid if run.model is None else chip.grid
    across_m, away_m = located.shift_m[index, best]
    shift = round(away_m / chip.grid.spacing_m[1]), round(across_m / chip.grid.spacing_m[0])
    image = np.roll(run.render([view], grid)[0], shift, (0, 1)) * from_db(located.gain_db[index, best])
    name, odds = located.classes[best], located.odds[index, best]
    labels = [chip.target] * (chip.target != name) + [f"{chip.azimuth_deg:.1f}°"] * (not np.isnan(chip.azimuth_deg))
    label = f"; labelled {', '.join(filter(None, labels))}" if any(labels) else ""
    panels = []
    for title, power, pixels in ((chip.name, chip.power, chip.grid), (f"{name}, {view_name(view)}", image, grid)):
        part = Part.of(pixels, (slice(0, pixels.rows), slice(0, pixels.columns)), _LARGEST)
        panels.append(part.power(title, title, power, peak))
    return Block(f"{name} ({odds:.1%}), azimuth {azimuth:.1f}° ± {std:.1f}°{label}", tuple(panels), across=2)


def _reliability(located: Located) -> Figure:
    """Share of right classes against the claimed odds, in ten bins."""
    known = located.labels >= 0
    claimed, right = located.odds.max(axis=1)[known], (located.found == located.labels)[known]
    bins = np.minimum((claimed * _BINS).astype(int), _BINS - 1)
    used = np.unique(bins)
    x, y = (np.array([values[bins == one].mean() for one in used]) for values in (claimed, right))
    dots = [polyline(np.array([a, a]), np.array([b, b]), "dot accent") for a, b in zip(x, y, strict=True)]
    diagonal = polyline(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "line")
    title = "share that is right against the claimed odds"
    panel = chart(title, title, axis("claimed", 0, 1), axis("right", 1, 0), [diagonal, *dots])
    parts = (f"{(bins == one).sum()} at {a:.3f}: {b:.3f} right" for one, a, b in zip(used, x, y, strict=True))
    return Figure(
        "Reliability", f"Mean odds of the classes found, in ten bins. {'; '.join(parts)}.", (Block("", (panel,)),)
    )
