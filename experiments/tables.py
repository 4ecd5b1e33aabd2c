"""Every table of the results: run what is missing, then write it to docs/results.

Finished cells are kept in runs/tables and never done twice by the same code: end it at any time and start it again.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

from catalogue import EXPERIMENTS, Experiment
from code_version import code_version
from runner import Runner
from write import write, write_index

from sarsplat.errors import SarsplatError

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    """Read the command line."""
    names = ", ".join(experiment.name for experiment in EXPERIMENTS)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help=f"some of {names}")
    parser.add_argument("--quick", action="store_true", help="everything in small, in minutes, to runs/tables/quick")
    parser.add_argument("--write", action="store_true", help="write what is finished, run nothing")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N", help="cells at a time")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "tables", metavar="FOLDER", help="finished cells")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="results (default: docs/results)")
    arguments = parser.parse_args()
    if unknown := set(arguments.only) - {experiment.name for experiment in EXPERIMENTS}:
        parser.error(f"there is no experiment {min(unknown)!r}; choose from {names}")
    if arguments.processes < 1:
        parser.error("--processes must be at least 1")
    chosen = [experiment for experiment in EXPERIMENTS if experiment.name in arguments.only or not arguments.only]
    if arguments.quick:
        chosen = [experiment.in_small() for experiment in chosen]
    out = arguments.out or (arguments.work / "quick" if arguments.quick else ROOT / "docs" / "results")
    try:
        return run(chosen, Runner(arguments.work, code_version("sar-gs"), arguments.processes), out, arguments.write)
    except (SarsplatError, KeyboardInterrupt) as stopped:
        print(f"{str(stopped) or 'stopped'}; what is finished is kept", file=sys.stderr)
        return 2


def run(chosen: list[Experiment], runner: Runner, out: Path, only_write: bool) -> int:
    """Experiment after experiment; 1 if a cell failed."""
    todo = runner.plan([cell for experiment in chosen for cell in experiment.every_cell()])
    print(f"code version {runner.code}: {todo} cells are not finished", flush=True)
    for experiment in chosen:
        if not only_write:
            runner.run(experiment.name, list(experiment.every_cell()), experiment.alone)
        write(experiment, runner.work, out, runner.code)
        write_index(out, experiment.quick)
    print(f"tables: {out}")
    for failure in runner.failed:
        print(f"failed: {failure}", file=sys.stderr)
    return 1 if runner.failed else 0


if __name__ == "__main__":
    sys.exit(main())
