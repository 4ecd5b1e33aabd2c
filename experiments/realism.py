"""How much generated chips are like measured ones: training chips, and others of their depression, left out of it.

Every generated chip has the view of a measured one. No test chip is looked at. Writes docs/results/chips-realism.md.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from chip_statistics import COLUMNS, apart
from tell_apart import area_under_curve

from sarsplat import Dataset, Run, View, add_speckle
from sarsplat.data import write_bytes
from sarsplat.data.orientation import oriented
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.baselines import rotated_average
from sarsplat.importers.mstar_chips import Chip, read_chips
from sarsplat.samples import Encoding
from sarsplat.scenes.scattering import ResponseSpeckle
from sarsplat.settings.config import SCATTERERS

ROOT = Path(__file__).resolve().parent.parent
TRAINING, LEFT_OUT = "measured, trained on", "measured, left out"
NAME = "chips-realism"
ENCODING = Encoding(near="top")

Draws = Callable[[View, int], np.ndarray]
"""Complex amplitudes of one image from a view and a seed."""


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="of single classes, on their datasets")
    parser.add_argument("--chips", type=Path, required=True, metavar="FOLDER", help="folder of MSTAR chips (JPEG)")
    parser.add_argument("--labels", type=Path, required=True, metavar="TABLE", help="their table")
    parser.add_argument("--most", type=int, default=80, metavar="N", help="chips of a class left out of training")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results", metavar="FOLDER")
    arguments = parser.parse_args()
    try:
        sets = [sets_of(Run.load(run), arguments.chips, arguments.labels, arguments.most) for run in arguments.runs]
    except SarsplatError as error:
        print(error, file=sys.stderr)
        return 2
    lines = {name: line(name, sets) for name in sets[0]}
    write(lines, len(sets), arguments.out)
    return 0


def sets_of(run: Run, folder: Path, labels: Path, most: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Measured and generated chips of one run with their masks: uint8 [n, rows, columns], near range at the top."""
    dataset = run.dataset
    train = dataset.select("train")
    depressions = dataset.source["train_depression_deg"]
    chips = [chip for chip in read_chips(folder, labels, dataset.target) if chip.depression in depressions]
    names = {entry.name for entry in train.entries}
    left_out = [chip for chip in chips if chip.name not in names]
    step = max(1, len(left_out) // most)
    left_out = sorted(left_out, key=lambda chip: chip.target_az_deg)[::step][:most]
    views = [View(-chip.target_az_deg % 360, chip.grazing_deg) for chip in left_out]
    masks = apart(run.masks(views))
    sets = {
        TRAINING: (_pixels([chip for chip in chips if chip.name in names], run), apart(run.masks(train.views))),
        LEFT_OUT: (_pixels(left_out, run), masks),
    }
    for name, draw in ways(run, train, views).items():
        samples = [draw(view, seed) for seed, view in enumerate(views)]
        sets[name] = (np.stack([ENCODING.stored(sample, 1.0) for sample in samples]), masks)
    print(
        f"{dataset.target}: {len(left_out)} chips left out of training, generated in {len(sets) - 2} ways", flush=True
    )
    return sets


def ways(run: Run, train: Dataset, views: list[View]) -> dict[str, Draws]:
    """How chips are made: ours, without the response, as before there were samples, and without a third dimension."""
    response = ResponseSpeckle(run.grid)
    expected = dict(zip(views, run.render(views), strict=True))
    level = np.median(train.power, axis=(1, 2), keepdims=True)  # each chip has a scale of its own
    flat = rotated_average((train.power / level).astype(np.float64), train.views, views, run.grid)
    averages = dict(zip(views, flat, strict=True))

    def white(view: View, seed: int) -> np.ndarray:
        return np.sqrt(add_speckle(expected[view], 1, np.random.default_rng(seed))).astype(np.complex64)

    def average(view: View, seed: int) -> np.ndarray:
        return np.sqrt(averages[view]).astype(np.float32) * response.draw(np.random.default_rng(seed))

    return {
        "sarsplat chips": run.reconstruction.sampler("learned", "response", SCATTERERS),
        "with uniform ground": run.reconstruction.sampler("uniform", "response", SCATTERERS),
        "speckle alone": run.reconstruction.sampler("learned", "response", math.inf),
        "render and white speckle": white,
        "rotated average, same speckle": average,
    }


def _pixels(chips: list[Chip], run: Run) -> np.ndarray:
    """Digital numbers as they were published, with near range at the top, cut as the run's images were."""
    rows, columns = run.grid.rows, run.grid.columns
    turned = [oriented(chip.magnitude / chip.step, "bottom") for chip in chips]
    starts = [((t.shape[0] - rows) // 2, (t.shape[1] - columns) // 2) for t in turned]
    cut = [t[top : top + rows, left : left + columns] for t, (top, left) in zip(turned, starts, strict=True)]
    return np.stack(cut).astype(np.uint8)


def line(name: str, sets: list[dict[str, tuple[np.ndarray, np.ndarray]]]) -> dict[str, float | None]:
    """Statistics of one kind of chips, means over the runs, and how well they are told from those left out."""
    found: dict[str, float | None] = {
        column: float(np.mean([statistic(*one[name], *one[LEFT_OUT]) for one in sets]))
        for column, statistic in COLUMNS.items()
    }
    found["AUC"] = None
    if name not in (TRAINING, LEFT_OUT):
        side = min(min(one[LEFT_OUT][0].shape[1:]) for one in sets)
        own, others = (np.concatenate([_middle(one[kind][0], side) for one in sets]) for kind in (name, LEFT_OUT))
        found["AUC"] = area_under_curve(own, others)
    print(name, found, flush=True)
    return found


def _middle(chips: np.ndarray, side: int) -> np.ndarray:
    top, left = ((size - side) // 2 for size in chips.shape[1:])
    return chips[:, top : top + side, left : left + side]


def write(lines: dict[str, dict[str, float | None]], runs: int, out: Path) -> None:
    """The page and its numbers."""
    columns = list(next(iter(lines.values())))
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["chips", *columns])
    table.writerows([name, *("" if v is None else f"{v:.4g}" for v in found.values())] for name, found in lines.items())
    write_bytes(out / f"{NAME}.csv", text.getvalue().encode())
    rows = [f"| | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    for name, found in lines.items():
        cells = ("–" if value is None else f"{value:.3g}" for value in found.values())
        rows.append(f"| {name} | {' | '.join(cells)} |")
    write_bytes(out / f"{NAME}.md", PAGE.format(runs=runs, table="\n".join(rows)).encode())


PAGE = """# How real generated chips look

Written by `experiments/realism.py` from {runs} classes; do not edit. Generated chips have the views of measured ones of the
training's depression that were left out of training; no test chip was looked at. All are magnitudes of 8 bits, each chip
scaled by its own maximum, JPEG of quality 75. A column is good where it is as in the second row; distances of histograms
are good where they are small, and the AUC where it is near 0.5. Means over the classes.

{table}

*Alike*: correlation of the power of neighbouring pixels of clutter. *Histogram*: by how many dB pixels' levels have to be
moved on average to have the distribution of the chips left out. *AUC*: area under the ROC curve of a small network that
distinguishes them from these, 0.5 if it cannot; it was trained on every other view and tested on the rest. Target and shadow
are those of the runs' own masks, and clutter is at least eight pixels away from both.
"""  # noqa: E501


if __name__ == "__main__":
    sys.exit(main())
