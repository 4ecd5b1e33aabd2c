"""Every table of the results: run what is missing, then write it to docs/results.

Each is a plan for `sarsplat.sweep`. Runs stay in runs/tables/sweep, and none is done twice by the same code: end it at
any time and start it again. Where there is no run, the results keep what they had of it, as of older code.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

from catalogue import EXPERIMENTS
from experiment import Experiment
from finished import runs_of
from pictures import draw_groups
from plans import Chips, in_our_time, make, missing, plan_of
from readme import fill_readme
from write import write, write_index

from sarsplat import sweep
from sarsplat.errors import SarsplatError
from sarsplat.executors import Means
from sarsplat.sweeps import Result

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    """Read the command line."""
    names = ", ".join(experiment.name for experiment in EXPERIMENTS)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help=f"some of {names}")
    parser.add_argument("--quick", action="store_true", help="everything in small, in minutes, to runs/tables/quick")
    parser.add_argument("--write", action="store_true", help="write what is finished, run nothing")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N", help="trainings at a time")
    parser.add_argument(
        "--work", type=Path, default=ROOT / "runs" / "tables", metavar="FOLDER", help="datasets and runs"
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="results (default: docs/results)")
    for name, what in (("chips", "folder of MSTAR chips"), ("labels", "their table"), ("masks", "their masks")):
        parser.add_argument(f"--{name}", type=Path, metavar="PATH", help=what)
    arguments = parser.parse_args()
    if (arguments.chips is None) != (arguments.labels is None):
        parser.error("measured chips need --chips and --labels together")
    if unknown := set(arguments.only) - {experiment.name for experiment in EXPERIMENTS}:
        parser.error(f"there is no experiment {min(unknown)!r}; choose from {names}")
    chosen = [experiment for experiment in EXPERIMENTS if experiment.name in arguments.only or not arguments.only]
    if arguments.quick:
        chosen = [experiment.in_small() for experiment in chosen]
    out = arguments.out or (arguments.work / "quick" if arguments.quick else ROOT / "docs" / "results")
    chips = None if arguments.chips is None else Chips(arguments.chips, arguments.labels, arguments.masks)
    try:
        return run(chosen, arguments.work, out, Means(arguments.processes), arguments.write, chips)
    except (SarsplatError, KeyboardInterrupt) as stopped:
        print(f"{str(stopped) or 'stopped'}; what is finished is kept", file=sys.stderr)
        return 2


def run(
    chosen: list[Experiment], work: Path, out: Path, means: Means, only_write: bool, chips: Chips | None = None
) -> int:
    """Experiment after experiment; 1 if a run failed."""
    failed = []
    for experiment in chosen:
        print(f"{experiment.name}:", flush=True)
        results: Sequence[Result] = ()
        kept = out / f"{experiment.name}-runs.csv"
        if experiment.measured and chips is None:
            print("needs measured chips: give --chips and --labels", flush=True)
        elif not only_write:
            make(experiment, work, chips)
        if not missing(experiment, work):
            alone = Means(1) if experiment.alone else means  # or times would depend on what else runs
            for _ in range(2 if any(row.full for row in experiment.rows) else 1):  # others' time depends on ours
                planned = in_our_time(experiment, runs_of(experiment, results, kept) if results else [])
                swept = sweep(plan_of(planned, work, chips), work / "sweep", means=alone, run=not only_write)
                results = swept.results
            failed += swept.failed
            if experiment.pictured:
                draw_groups(experiment, results, work / "sweep", out)
        if experiment.report is not None:
            experiment.report(experiment, results, work / "sweep", out)
        else:
            runs = runs_of(experiment, results, kept)
            write(experiment, runs, out)
            if not experiment.quick:
                fill_readme(experiment, runs)
        write_index(out, experiment.quick)
    print(f"tables: {out}")
    for one in failed:
        print(f"failed: {one.cell.words(one.cell.labels)}: {one.reason}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
