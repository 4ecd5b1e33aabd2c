"""Class and azimuth of MSTAR's chips by runs of a few chips a class, beside their rotated average, and with a network.

`make tables ONLY=recognise` does all; this program does it for fewer classes, test chips or trainings. Writes
docs/results/recognise.md, recognise-runs.csv with a line for every seed and arm, and the table of
docs/how-to/recognise.md.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch is loaded

import numpy as np
from experiment import Experiment, Row
from jaxtyping import Float64
from measured import chips
from scipy.ndimage import shift
from with_network import network_log_odds, product

from sarsplat import Dataset, ImageGrid, Run, View, locate
from sarsplat.data import write_bytes
from sarsplat.evaluation.baselines import levelled_average
from sarsplat.executors import Means
from sarsplat.recognition import Located
from sarsplat.samples.chip_set import target_of
from sarsplat.sweeps.results import Result
from sarsplat.sweeps.work import RUNS

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "docs"))

from fill_block import fill_block

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results"
HOW_TO = ROOT / "docs" / "how-to" / "recognise.md"

RUNS_FILE = "recognise-runs.csv"
TRAINING, TEST = 17, 15
CLASSES = ("T72", "BMP2", "BTR70", "2S1", "ZSU234", "BTR60", "BRDM2", "D7", "T62", "ZIL131")
VIEWS = (40, 20, 12, 8, 5)
"""Numbers of training chips of a class, evenly spaced in azimuth."""
DRAWN = (12, 5)
"""Numbers of training chips of a class in other trainings, drawn at random."""

COLUMNS = {
    "accuracy": "accuracy",
    "median azimuth error, °": "azimuth error, median",
    "azimuth within 5°": "within 5°",
    "reversed": "reversed",
    "claimed at 95% or more": "claimed at ≥ 95 %",
    "odds of these": "odds of these, mean",
    "right of these": "right of these",
}
"""Scores, and heads of the table."""
OF_CLASS = ("accuracy", "claimed at 95% or more", "odds of these", "right of these")
_SURE, _LEAST = 0.95, 1e-30

LOCATED = {
    "learned": "learned ground",
    "flat": "flat ground",
    "average": "rotated average of the same chips, same procedure, with its ground",
}
WITH_NETWORK = {
    "network": ("network", ()),
    "network × learned": ("network × learned ground", ("learned",)),
    "network × flat": ("network × flat ground", ("flat",)),
    "network × average": ("network × rotated average", ("average",)),
}
"""Titles, and arms by whose odds the network's are multiplied."""

ARMS = LOCATED | {arm: title for arm, (title, _) in WITH_NETWORK.items()}
LABELLED = 24
"""Chips of a class that choose the powers in products; `locate` calibrates with as many others."""


class Averaged(Run):
    """A run that gives the rotated average of its training chips, which have a scale of their own, as its images."""

    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float64[np.ndarray, "v rows columns"]:
        """On its own grid, or that grid displaced by parts of a pixel."""
        train = self.dataset.select("train")
        images = levelled_average(train, views)
        if grid is None:
            return images
        across, away = (np.subtract(train.grid.center_m, grid.center_m) / grid.spacing_m).tolist()
        moved: np.ndarray = shift(images, (0, away, across), order=1, mode="nearest")
        return moved


def report(experiment: Experiment, results: Sequence[Result], work: Path, out: Path, each: int | None = None) -> None:
    """Locate the test chips by the finished trainings of a row and seed, and write what there is so far.

    `each` is the number of test chips of a class, evenly chosen in azimuth; None: all.
    """
    for row in experiment.rows:
        for seed in experiment.seeds:
            own = [one for one in results if (one.cell.labels["part"], one.cell.seed) == (row.name, seed)]
            if own and all(one.finished for one in own):
                folders = [work / RUNS / one.row.address for one in own if one.row is not None]
                code = own[0].row.code if own[0].row else ""
                for arm, scores in scores_of(folders, seed, each, work.parent / "networks"):
                    line = {"chips": row.label, "seed": seed, "arm": arm, "classes": len(own), **scores, "code": code}
                    _keep(out, line)
                    print(line, flush=True)
    if lines := read_lines(out):
        write_bytes(out / f"{experiment.name}.md", page(experiment, lines).encode())
        if out == RESULTS:
            fill_block(HOW_TO, "measured", f"{about(lines)}\n{table(lines)}")


def scores_of(
    folders: Sequence[Path], seed: int, each: int | None, networks: Path
) -> Iterator[tuple[str, dict[str, float]]]:
    """Recognise and locate chips at 15° by these runs, arm by arm; others at 17° make odds true."""
    learned = sorted((Run.load(folder) for folder in folders), key=target_of)
    tests = [evenly(run.dataset.select(f"test-{TEST}"), each) for run in learned]
    others = [run.dataset.select(f"test-{TRAINING}") for run in learned]
    chance = np.random.default_rng(seed)  # even choices meet even training chips; `locate` calibrates with the rest
    helping = [one.take(chance.permutation(len(one))[:LABELLED].tolist()) for one in others]
    count = sum(map(len, tests))
    log_odds: dict[str, np.ndarray] = {}
    for arm in LOCATED:
        runs = [Averaged.load(folder) for folder in folders] if arm == "average" else learned
        ground: Literal["learned", "flat"] = "flat" if arm == "flat" else "learned"
        found = locate(runs, [*tests, *helping], calibrate=others, ground=ground)
        yield arm, _scores(found, count, *COLUMNS)
        log_odds[arm] = np.log(np.maximum(found.odds, _LEAST))
    log_odds["network"] = network_log_odds(learned, seed, found.chips, networks)
    for arm, (_, factors) in WITH_NETWORK.items():
        odds = product([log_odds[one] for one in ("network", *factors)], found.labels, count)
        yield arm, _scores(replace(found, odds=odds), count, *OF_CLASS)


def _scores(found: Located, count: int, *names: str) -> dict[str, float]:
    """Round some of the scores of the first images."""
    arrays: dict[str, Any] = {
        name: value[:count] for name, value in vars(found).items() if isinstance(value, np.ndarray)
    }
    arrays.pop("labels", None)  # made of the others
    first = replace(found, chips=found.chips[:count], **arrays)
    scores, claimed = first.scores(), first.odds.max(axis=1)
    if (sure := claimed >= _SURE).any():
        scores["odds of these"] = float(claimed[sure].mean())
    chosen = {name: round(value, 4) for name, value in scores.items() if name in names}
    return {**chosen, "images": count, "calibrated by": found.calibration.images}


def evenly(dataset: Dataset, each: int | None) -> Dataset:
    """So many images, evenly chosen in azimuth; None: all."""
    order = np.argsort([view.azimuth_deg for view in dataset.views], kind="stable")
    count = len(order) if each is None else min(each, len(order))
    return dataset.take([int(order[k * len(order) // count]) for k in range(count)])


def read_lines(out: Path) -> list[dict[str, str]]:
    """What is there so far."""
    path = out / RUNS_FILE
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _keep(out: Path, line: Mapping[str, Any]) -> None:
    """Add a line in place of an older one."""
    named = {name: str(value) for name, value in line.items()}
    key = ("chips", "seed", "arm")
    others = [one for one in read_lines(out) if any(one[name] != named[name] for name in key)]
    file = io.StringIO()
    writer = csv.DictWriter(file, list(dict.fromkeys(name for row in (named, *others) for name in row)))
    writer.writeheader()
    writer.writerows([*others, named])
    out.mkdir(parents=True, exist_ok=True)
    write_bytes(out / RUNS_FILE, file.getvalue().replace("\r\n", "\n").encode())


def table(lines: Sequence[Mapping[str, str]]) -> str:
    """What was located and how well, as Markdown: the mean over seeds of each number of chips and arm."""
    rows = [
        ["chips of a class", "", *COLUMNS.values(), "images", "seeds"],
        ["---", "---", *["---:"] * (len(COLUMNS) + 2)],
    ]
    for label in sorted({line["chips"] for line in lines}, key=lambda label: (_number(label), label)):
        for arm, title in ARMS.items():
            own = [line for line in lines if (line["chips"], line["arm"]) == (label, arm)]
            if own:
                scores = (_text(name, own) for name in COLUMNS)
                rows.append([label.replace(" chips", ""), title, *scores, own[0]["images"], str(len(own))])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def about(lines: Sequence[Mapping[str, str]]) -> str:
    """What was done, as one paragraph."""
    classes, images = lines[0]["classes"], lines[0]["images"]
    calibrated = sorted({int(line["calibrated by"]) for line in lines})
    return (
        f"{classes} classes of MSTAR, each learned from a few chips at {TRAINING}°, evenly spaced in azimuth or drawn "
        f"at random by the seed, by the preset `measured`; {images} chips at {TEST}°, located as if their azimuth were "
        f"unknown; means over seeds. Odds are calibrated by {calibrated[0]} to {calibrated[-1]} other chips at "
        f"{TRAINING}°; azimuth errors are of the labelled class. An image is {100 / int(images):.2g} %.\n"
    )


def page(experiment: Experiment, lines: Sequence[Mapping[str, str]]) -> str:
    """The page: what was done, what it says, the table."""
    most = max((line["chips"] for line in lines), key=lambda label: (label.endswith("chips"), _number(label)))
    best, control, network, both = (
        [line for line in lines if (line["chips"], line["arm"]) == (most, arm)]
        for arm in ("learned", "average", "network", "network × learned")
    )
    by_network = f", network {_text('accuracy', network)}, its odds times these {_text('accuracy', both)}" * bool(both)
    codes = " and ".join(dict.fromkeys(line["code"] for line in lines))
    found = (
        f"From {_number(most)} chips of a class, {_text('accuracy', best)} of chips are recognised (rotated average "
        f"{_text('accuracy', control)}{by_network}), and the azimuth is found to "
        f"{_text('median azimuth error, °', best)} in the median ({_text('median azimuth error, °', control)})."
    )
    return (
        f"# {experiment.title}\n\n{about(lines)}\n{experiment.about}\n\n**Found.** {found}\n\n{table(lines)}\n"
        f"Figures: [{RUNS_FILE}]({RUNS_FILE}). Written by `experiments/recognise.py` from code version {codes}.\n"
    )


def _number(label: str) -> int:
    return int(label.split()[0])


def _text(name: str, lines: Sequence[Mapping[str, str]]) -> str:
    values = [float(line[name]) for line in lines if line.get(name)]
    if not values:
        return "–"
    return f"{statistics.fmean(values):.2f}°" if ", °" in name else f"{statistics.fmean(values):.1%}".replace("%", " %")


def rows(
    views: Sequence[int] = VIEWS, at_random: Sequence[int] = DRAWN, classes: int = len(CLASSES)
) -> tuple[Row, ...]:
    """Trainings of so many chips of the first so many classes."""
    labels = {f"{count} chips": count for count in views} | {f"{count} chips at random": count for count in at_random}
    return tuple(
        Row(
            label,
            tuple(chips(target, count, TRAINING) for target in CLASSES[:classes]),
            "measured",
            random=label.endswith("random"),
        )
        for label, count in labels.items()
    )


RECOGNISE = Experiment(
    "recognise",
    "Class and azimuth of measured chips",
    "*Flat ground* is uniform, of the same mean: learned ground knows the field where the chips were recorded. "
    "*Rotated average*: the training chips, turned to each azimuth and averaged, in place of renderings. "
    "*Network*: that of [the benchmark](chips.md), trained on the same chips, these turned, and chips that the "
    "reconstructions generate; it sees the field, too. Powers of odds in products are chosen by other chips at "
    f"{TRAINING}°, at most {LABELLED} of a class. Odds in products are calibrated by the fewest.",
    rows(),
    (),
    judged=(),
    seeds=(0, 1, 2),
    report=report,
)


def main() -> int:
    """Read the command line."""
    from plans import Chips
    from tables import run

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chips", type=Path, required=True, metavar="FOLDER", help="folder of the ten classes' chips")
    parser.add_argument("--labels", type=Path, required=True, metavar="TABLE", help="their table")
    parser.add_argument("--views", type=int, nargs="*", default=VIEWS, metavar="K", help="training chips of a class")
    parser.add_argument("--drawn", type=int, nargs="*", default=DRAWN, metavar="K", help="of others, drawn at random")
    parser.add_argument("--classes", type=int, default=len(CLASSES), metavar="N", help="the first of " + str(CLASSES))
    parser.add_argument("--each", type=int, metavar="N", help="test chips of a class (default: all)")
    parser.add_argument("--quick", action="store_true", help="short trainings")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "tables", metavar="FOLDER")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FOLDER")
    given = parser.parse_args()
    fewer = replace(
        RECOGNISE,
        rows=rows(given.views, given.drawn, given.classes),
        report=partial(report, each=given.each),
        quick=given.quick,
    )
    return run([fewer], given.work, given.out, Means(given.processes), False, Chips(given.chips, given.labels))


if __name__ == "__main__":
    sys.exit(main())
