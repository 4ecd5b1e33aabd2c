"""What generated chips are worth to a classifier of ten classes, beside others that are made of the same few chips.

Writes docs/results/chips.md, with a line for every trained network in chips-runs.csv. Reconstructions and generated
chips stay in runs/chips; nothing is done twice, so end it at any time and start it again.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch is loaded

import numpy as np
import torch
from chip_arms import AVERAGE, OURS, OURS_AT_17, OURS_SPECKLE, SAR_NERF, TURNED, Arm, pool
from chip_controls import new_clutter
from chip_draws import TEST, TRAINING, Draw, Measured, jobs, reconstructed
from chips_page import Line, read_lines, write_line, write_page
from classifier import Source, predicted, trained

from sarsplat.errors import SarsplatError

ROOT = Path(__file__).resolve().parent.parent

STEPS = 2000
"""Of training: twice as many raise no arm by more than a point, on training chips that were left out."""

TRIED_STEPS = (500, 1000, 2000, 4000)

EVENLY = Draw(12)
DRAWS = (
    *(Draw(each) for each in (12, 5)),
    *(Draw(12, seed) for seed in (1, 2, 3, 4)),
    *(Draw(each) for each in (40, 8, 20)),
    *(Draw(each, seed) for seed in (1, 2) for each in (5, 40)),
)
ALL = Draw(None)
SEEDS = (0, 1)

ARMS = {
    "measured": Arm("measured, displaced"),
    "turned": Arm("+ turned", 0.5, {TURNED: 0.5}),
    "average": Arm("+ rotated average", 0.5, {AVERAGE: 0.5}),
    "average-turned": Arm("+ rotated average, turned", 0.25, {TURNED: 0.25, AVERAGE: 0.5}),
    "ours": Arm("+ sarsplat", 0.5, {OURS: 0.5}),
    "ours-turned": Arm("+ sarsplat, turned", 0.25, {TURNED: 0.25, OURS: 0.5}),
    "ours-17": Arm("+ sarsplat of 17° alone, turned", 0.25, {TURNED: 0.25, OURS_AT_17: 0.5}),
    "ours-speckle": Arm("+ sarsplat with speckle alone, turned", 0.25, {TURNED: 0.25, OURS_SPECKLE: 0.5}),
    "only-average": Arm("rotated average alone", 0.0, {AVERAGE: 1.0}),
    "only-ours": Arm("sarsplat alone", 0.0, {OURS: 1.0}),
    "sar-nerf": Arm("+ SAR-NeRF", 0.5, {SAR_NERF: 0.5}),
    "sar-nerf-turned": Arm("+ SAR-NeRF, turned", 0.25, {TURNED: 0.25, SAR_NERF: 0.5}),
}
EVERYWHERE = ("measured", "turned", "average-turned", "ours-turned")
WITH_SAR_NERF = (EVENLY, Draw(12, 1))


Wanted = tuple[Draw, str, int, int]
"""A network: draw, arm, seed and steps."""


def of_steps() -> list[Wanted]:
    """Networks that say how many steps are enough."""
    return [(EVENLY, arm, 0, steps) for steps in TRIED_STEPS for arm in EVERYWHERE]


def of_arms(draws: Sequence[Draw]) -> Iterator[list[Wanted]]:
    """Those of the tables, draw by draw; what waits for SAR-NeRF, which takes hours, comes last."""
    for slow in (False, True):
        for draw in draws:
            arms = [arm for arm in arms_of(draw) if (SAR_NERF in ARMS[arm].methods) == slow]
            yield [(draw, arm, seed, STEPS) for seed in SEEDS for arm in arms]


def arms_of(draw: Draw) -> tuple[str, ...]:
    """Which are trained with a draw."""
    if draw == ALL:
        return ("measured",)
    if draw == EVENLY:
        return tuple(ARMS)
    return EVERYWHERE + (("sar-nerf-turned",) if draw in WITH_SAR_NERF else ())


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chips", type=Path, required=True, metavar="FOLDER", help="folder of the ten classes' JPEGs")
    parser.add_argument("--labels", type=Path, required=True, metavar="TABLE", help="their table")
    parser.add_argument("--only", nargs="+", default=[], metavar="DRAW", help="some, as '12 evenly' or all")
    parser.add_argument("--steps", action="store_true", help="instead: how many steps are enough")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "chips", metavar="FOLDER")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results", metavar="FOLDER")
    arguments = parser.parse_args()
    known = {draw.name: draw for draw in (*DRAWS, ALL)}
    if unknown := set(arguments.only) - known.keys():
        parser.error(f"there is no draw {min(unknown)!r}; choose from {', '.join(known)}")
    draws = [draw for name, draw in known.items() if name in arguments.only or not arguments.only]
    where = (arguments.chips.resolve(), arguments.labels.resolve(), arguments.work.resolve())
    try:
        with ProcessPoolExecutor(arguments.processes, get_context("spawn"), _alone) as workers:
            for wanted in [of_steps()] if arguments.steps else of_arms(draws):
                train(wanted, where, arguments.out, workers)
    except (SarsplatError, KeyboardInterrupt) as stopped:
        print(f"{str(stopped) or 'stopped'}; what is finished is kept", file=sys.stderr)
        return 2
    return 0


def train(wanted: Sequence[Wanted], where: tuple[Path, Path, Path], out: Path, workers: ProcessPoolExecutor) -> None:
    """Train the networks that are not there yet, after what they need of reconstructions and generated chips."""
    done = {line.key for line in read_lines(out)}
    missing = [one for one in wanted if (one[0].name, *one[1:]) not in done]
    draws = dict.fromkeys(draw for draw, *_ in missing)
    measured = _measured(*where[:2])
    for draw in draws:
        arms = [ARMS[arm] for each, arm, *_ in missing if each == draw]
        methods = list(dict.fromkeys(method for arm in arms for method in arm.methods))
        kinds = list(dict.fromkeys(kind for arm in arms for kind in arm.others))
        todo = jobs(measured, draw, methods, where[2])
        for folder in workers.map(_reconstructed, todo):
            print(f"{draw.name}: {folder.parent.name} of {folder.name}", flush=True)
        for kind in workers.map(_pooled, *zip(*((kind, draw, where) for kind in kinds), strict=True)) if kinds else ():
            print(f"{draw.name}: chips, {kind}", flush=True)
    if missing:
        workers.submit(_replace_clutter, where).result()
    running = [workers.submit(_network, *one, where) for one in missing]
    for one in running:
        line = one.result()
        write_line(out, line)
        print(f"{line}", flush=True)
        write_page(out, {name: arm.title for name, arm in ARMS.items()})


def _alone() -> None:
    torch.set_num_threads(1)


@cache
def _measured(folder: Path, labels: Path) -> Measured:
    return Measured.read(folder, labels)


def _reconstructed(job: tuple[Path, str, Path]) -> Path:
    return reconstructed(*job)


def _pooled(kind: str, draw: Draw, where: tuple[Path, Path, Path]) -> str:
    pool(kind, draw, _measured(*where[:2]), where[2])
    return kind


def _network(draw: Draw, arm: str, seed: int, steps: int, where: tuple[Path, Path, Path]) -> Line:
    """Train one and ask it; about test chips only if its steps are those that were chosen."""
    measured, work, begun = _measured(*where[:2]), where[2], time.monotonic()
    chosen, how, classes = measured.chosen(draw, work), ARMS[arm], len(measured.classes)
    own = Source(measured.pixels[chosen], measured.of_class[chosen], how.measured)
    others = []
    for kind, share in how.others.items():
        made = pool(kind, draw, measured, work)
        others.append(Source(made, np.repeat(np.arange(classes), len(made) // classes), share))
    network, loss = trained(own, others, classes, seed, steps)

    def right(which: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        return predicted(network, pixels) == measured.of_class[which]

    left_out = np.setdiff1d(np.flatnonzero(measured.depression == TRAINING), chosen)
    kept = right(left_out, measured.pixels[left_out]).mean() if len(left_out) else float("nan")
    test, other, by_class = float("nan"), float("nan"), ""
    if steps == STEPS:
        which = np.flatnonzero(measured.depression == TEST)
        found = right(which, measured.pixels[which])
        test, of_class = float(found.mean()), measured.of_class[which]
        by_class = " ".join(f"{found[of_class == number].mean():.3f}" for number in range(classes))
        other = float(right(which, new_clutter(measured, which, EVENLY, work)).mean())
    took_s = time.monotonic() - begun
    return Line(draw.name, arm, seed, steps, STEPS, loss, float(kept), test, other, took_s, by_class)


def _replace_clutter(where: tuple[Path, Path, Path]) -> None:
    measured = _measured(*where[:2])
    new_clutter(measured, np.flatnonzero(measured.depression == TEST), EVENLY, where[2])


if __name__ == "__main__":
    sys.exit(main())
