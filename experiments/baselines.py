"""Our method and its baselines on the same data: the same images, the same scores, this machine.

    python experiments/baselines.py [--quick] [--chips CHIPS --labels LABELS --masks MASKS] [--seeds 0 1] [--only WORDS]

Vehicles are simulated; measured chips are taken if their folders are given. Every training has one thread, and its time
is that of one core, so that times compare whatever else runs. Tables and pictures go to docs/results/baselines.md, or
with --quick, which only shows that everything works, to runs/baselines/quick. Finished trainings stay in
runs/baselines and beside the page, in baselines-runs.csv: end it at any time and start it again, here or, with the same
code, on another machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

from baseline_cell import BaselineCell, Bench, Images
from baseline_page import write
from baseline_runs import read_runs
from code_version import code_version

from sarsplat.errors import SarsplatError

HERE = Path(__file__).resolve().parent.parent
VEHICLES = ("t72", "btr70", "kraz")
SOURCES = {"raycast": "by ray casting", "splat": "by our own renderer"}
CHIPS = ("T72:8", "T72:36")

_CURVE = tuple(2.0**k for k in range(0, 12))
"""Seconds of training after which the first seed of some sets is scored on the way."""

_PERCEPTRON_S = 600.0
"""How long the perceptron may learn, whose whole training would take months."""


@dataclass(frozen=True)
class Contender:
    """A line of the tables.

    Attributes
    ----------
    title : str
        For readers.
    method : str
        Its name.
    changes : mapping
        Settings that differ from its defaults.
    few : mapping
        Settings that only show that everything works.
    seconds : float or None
        All it is given; None: as long as its settings say.
    everywhere : bool
        Whether it is done on all sets, or only where curves are drawn.
    slow : bool
        Whether an image takes it seconds: it is done last, once, and on simulated images, of which there are few.
    reference : bool
        Whether the others are also done in its time.
    """

    title: str
    method: str
    few: Mapping[str, Any]
    changes: Mapping[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    everywhere: bool = True
    slow: bool = False
    reference: bool = False


_FEW = {"iterations": 3, "surface_voxels": 24}

CONTENDERS = (
    Contender("sarsplat", "sar-gs", {"iterations": 60, "gaussians": 500}, reference=True),
    Contender("SAR-NeRF on a grid, sound", "sar-nerf-grid", _FEW),
    Contender(
        "SAR-NeRF on a grid, published equations", "sar-nerf-grid", _FEW, {"mode": "published"}, everywhere=False
    ),
    Contender("DSR", "dsr", {"iterations": 3}),
    Contender("SAR-NeRF, published", "sar-nerf", _FEW, {}, _PERCEPTRON_S, everywhere=False, slow=True),
    Contender("SAR-NeRF, sound", "sar-nerf", _FEW, {"mode": "sound"}, _PERCEPTRON_S, everywhere=False, slow=True),
)


@dataclass(frozen=True)
class Bout:
    """What was done on one set: a contender, at its full budget or in our time; for each seed a cell."""

    images: Images
    contender: Contender
    equal: bool
    cells: tuple[BaselineCell, ...]


class Comparison:
    """All cells of all sets; those in our time once the first contender's are finished."""

    def __init__(
        self, sets: Sequence[Images], curves: Sequence[str], seeds: Sequence[int], work: Path, out: Path, small: bool
    ):
        self.sets, self.seeds, self.work, self.out = sets, seeds, work, out
        self._curves, self._small, self.code = curves, small, code_version()
        self._codes = {contender.method: code_version(contender.method) for contender in CONTENDERS}
        self._elsewhere = read_runs(out)

    def bouts(self, images: Images) -> Iterator[Bout]:
        """Of one set: ours, then each baseline in our time and at its own budget."""
        for contender in CONTENDERS:
            if (images.chips and contender.slow) or (images.name not in self._curves and not contender.everywhere):
                continue
            seeds = self.seeds[:1] if contender.slow else self.seeds
            full = tuple(self._cell(images, contender, seed) for seed in seeds)
            if contender.reference:
                first = self.read(full[0])
            elif first is not None:
                cells = tuple(replace(cell, seconds=round(first["time_s"], 1), curve=()) for cell in full)
                yield Bout(images, contender, True, cells)
            yield Bout(images, contender, False, full)

    def _cell(self, images: Images, contender: Contender, seed: int) -> BaselineCell:
        curve = _CURVE if images.name in self._curves and seed == self.seeds[0] and not contender.slow else ()
        if self._small:  # it only shows that everything works
            return BaselineCell(images, contender.method, {**contender.changes, **contender.few}, None, seed, curve[:1])
        return BaselineCell(images, contender.method, contender.changes, contender.seconds, seed, curve)

    def path(self, cell: BaselineCell) -> Path:
        """Where the scores of a cell are kept: a change of one method concerns its own cells alone."""
        return cell.path(self.work, self._codes[cell.method])

    def read(self, cell: BaselineCell) -> dict[str, Any] | None:
        """What came of a cell, if it is finished; done on another machine, it lacks what only pictures need."""
        path = self.path(cell)
        return json.loads(path.read_bytes()) if path.is_file() else self._elsewhere.get(path.stem)

    def is_here(self, cell: BaselineCell) -> bool:
        """Whether all that came of a cell is on this machine."""
        return self.path(cell).is_file()

    def run(self, processes: int) -> list[str]:
        """Do what is missing, seed after seed, so that every table is there early; returns what failed."""
        failed: list[str] = []
        for images in self.sets:
            _ = Bench(images, self.work, self.code).masks  # made here: no cell's memory is that of making them
        with ThreadPoolExecutor(processes) as pool:
            turns = [(seed, ours, False) for seed in self.seeds for ours in (True, False)]
            for seed, ours, slow in [*turns, (self.seeds[0], False, True)]:  # those in our time need ours finished
                todo = [
                    (cell, f"{bout.images.name}, {bout.contender.title}{', in our time' * bout.equal}, seed {seed}")
                    for images in self.sets
                    for bout in self.bouts(images)
                    for cell in bout.cells
                    if (cell.seed, bout.contender.reference, bout.contender.slow) == (seed, ours, slow)
                    and self.read(cell) is None
                ]
                futures = [pool.submit(self._run, cell, what, failed) for cell, what in todo]
                try:
                    for future in futures:
                        future.result()
                except BaseException:
                    pool.shutdown(cancel_futures=True)
                    raise
        return failed

    def _run(self, cell: BaselineCell, what: str, failed: list[str]) -> None:
        done = subprocess.run(
            [sys.executable, str(HERE / "experiments" / "baseline_cell.py"), str(self.work)],
            input=json.dumps(asdict(cell)),
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
            if reason == "KeyboardInterrupt":  # it is done next time
                return
            what += f" FAILED: {reason}"
            failed.append(what)
        print(what, flush=True)


def simulated(target: str, source: str, small: bool) -> Images:
    """A vehicle as the paper has it; `small` is a few views."""
    few = {"azimuth": ("0:360:90",), "grazing": ("40",), "test_azimuth": ("45", "200"), "test_grazing": ("40",)}
    options = {"target": target, "source": source, "protocol": "paper", **({"pixels": (40,), **few} if small else {})}
    return Images(f"{target}, {SOURCES[source]}", options)


def measured(name: str, chips: Path, labels: Path, masks: Path) -> Images:
    """Chips of CLASS:VIEWS at 17°."""
    target, views = name.split(":")
    options = {"chips": str(chips), "labels": str(labels), "masks": str(masks), "target_class": target}
    return Images(f"{target}, {views} measured chips", {}, {**options, "train_views": int(views)})


def main() -> int:
    """See the head of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, what in (("chips", "folder of MSTAR chips"), ("labels", "their table"), ("masks", "their masks")):
        parser.add_argument(f"--{name}", type=Path, help=what)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default="", help="sets whose names contain this")
    parser.add_argument("--write", action="store_true", help="write what is finished, run nothing")
    parser.add_argument(
        "--work", type=Path, default=HERE / "runs" / "baselines", metavar="FOLDER", help="finished cells"
    )
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N", help="trainings at a time")
    options = parser.parse_args()
    quick, measured_from = options.quick, (options.chips, options.labels, options.masks)
    if any(measured_from) and not all(measured_from):
        parser.error("measured chips need --chips, --labels and --masks together")
    kinds = [(target, source) for source in SOURCES for target in VEHICLES]
    sets = [simulated(target, source, quick) for target, source in (kinds[:1] if quick else kinds)]
    if all(measured_from):
        sets += [measured(name, *measured_from) for name in CHIPS]
    else:
        print("measured chips are left out: give --chips, --labels and --masks")
    curves = [images.name for images in sets if images.name.startswith(("t72, by ray", "T72, 36"))]
    work = options.work
    out = work / "quick" if quick else HERE / "docs" / "results"
    comparison = Comparison(sets, curves, options.seeds[:1] if quick else options.seeds, work, out, quick)
    chosen = [images for images in sets if options.only in images.name]
    failed: list[str] = []
    try:
        if not options.write:
            comparison.sets = chosen
            failed = comparison.run(options.processes)
            comparison.sets = sets
        page = write(comparison)
    except (SarsplatError, KeyboardInterrupt) as stopped:
        print(f"{str(stopped) or 'stopped'}; what is finished is kept", file=sys.stderr)
        return 2
    print(page)
    for failure in failed:
        print(f"failed: {failure}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
