"""Every benchmark, or those named: ratios first, absolute times second.

With --out the results of all parts are written to FOLDER/cpu.json and, where there is a GPU, those of cuda_suite.py
beside it; `make bench` does that and fills docs/reference/performance.md from them.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

import against_naive
import degenerate
import determinism
import floor
import growth
import iteration
import paper_run
import steps
import torch
import twins
from results import machine, save
from rich.console import Console
from rich.table import Table

from sarsplat.errors import SarsplatError
from sarsplat.renderer.engines import cpu
from sarsplat.renderer.engines.cuda_device import require_cuda

PARTS: dict[str, tuple[ModuleType, str]] = {
    "determinism": (determinism, "1 s"),
    "iteration": (iteration, "10 s"),
    "floor": (floor, "2 s"),
    "naive": (against_naive, "7 s"),
    "twins": (twins, "8 s"),
    "steps": (steps, "10 s"),
    "degenerate": (degenerate, "7 s"),
    "growth": (growth, "1 minute"),
    "paper": (paper_run, "2 minutes"),
}
"""Who measures, and how long that takes on two cores."""
BUSY = 0.5  # processes running, in the mean of the last minute
SECONDS = (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6))
BYTES = (("GiB", 2.0**30), ("MiB", 2.0**20), ("B", 1.0))


def in_units(units: tuple[tuple[str, float], ...], value: float) -> str:
    """With three digits, in the unit that suits."""
    unit, size = next(((unit, size) for unit, size in units if value >= size), units[-1])
    return f"{value / size:.3g} {unit}"


SHOWN: dict[str, Callable[[float], str]] = {
    "ratios": "{:.3g}".format,
    "times": partial(in_units, SECONDS),
    "bytes": partial(in_units, BYTES),
}
"""What a part may find, in the order of its importance."""
NOTES = (
    "A ratio's median is the ratio of the medians; its spread is that of the ratios of neighbours in time. Unseen: the "
    "same Gaussians out of sight, which leaves all of the engine's work but its pairs. Floor: the arithmetic of all "
    "blocks that the loops visit, at the rate at which these cores multiply matrices now. Live lanes: the share of "
    "these blocks' pairs that count."
)


def table(kind: str, parts: dict[str, dict[str, Any]], shown: Callable[[float], str]) -> Table:
    """One kind of finding of all parts."""
    printed = Table(title=kind, title_justify="left", header_style="bold")
    for name in ("part", "what"):
        printed.add_column(name)
    for name in ("median", "10 … 90 %"):
        printed.add_column(name, justify="right", no_wrap=True)
    for part, result in parts.items():
        for k, (what, value) in enumerate(result.get(kind, {}).items()):
            first = part if k == 0 else ""
            if isinstance(value, dict):
                cells = (shown(value["median"]), f"{shown(value['p10'])} … {shown(value['p90'])}")
            else:
                cells = (value if isinstance(value, str) else shown(value), "")
            printed.add_row(first, what, *cells)
    return printed


def about_parts() -> str:
    """A line for every part: what its module is about, and how long it takes."""
    rows = [(name, takes, (module.__doc__ or "").splitlines()[0]) for name, (module, takes) in PARTS.items()]
    lines = [f"  {name:12} {takes:10} {line}" for name, takes, line in rows]
    return "\n".join(["parts, and how long they take on two cores:", *lines])


def gpu() -> bool:
    """Whether torch can reach one."""
    try:
        require_cuda()
    except SarsplatError as missing:
        print(f"CUDA: not run on a GPU; {missing}")
        return False
    return True


def main() -> None:
    """Run, print, and write if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=about_parts(), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help="see below; all unless given")
    parser.add_argument("--quick", action="store_true", help="small scenes, few repeats, no training: a smoke test")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of torch and of the engine")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write the results there; needs all parts")
    arguments = parser.parse_args()
    if unknown := set(arguments.parts) - set(PARTS):
        parser.error(f"there is no part {min(unknown)!r}; choose from {', '.join(PARTS)}")
    if arguments.out and arguments.parts:
        parser.error("--out is for results of one whole run; leave out the names of parts")
    if arguments.threads < 1:
        parser.error("--threads must be at least 1")
    torch.set_num_threads(arguments.threads)
    about = machine() | {"instruction_set": cpu.best_instruction_set(), "quick": arguments.quick}
    if about["load"] > BUSY:
        print(f"This machine is busy (load {about['load']:.1f}): neither times nor ratios are to be trusted.")
    console, results = Console(width=None if sys.stdout.isatty() else 120), {}
    for name in arguments.parts or [name for name in PARTS if not (arguments.quick and name == "paper")]:
        begun = time.monotonic()
        console.print(f"{name} … ", end="")
        results[name] = PARTS[name][0].measure(arguments.quick)
        console.print(f"{time.monotonic() - begun:.0f} s")
    for kind, shown in SHOWN.items():
        if any(result.get(kind) for result in results.values()):
            console.print(table(kind, results, shown))
    console.print(NOTES, highlight=False)
    if arguments.quick:
        print("Quick run: it shows that everything works; the numbers mean nothing.")
    if arguments.out:
        save(arguments.out / "cpu.json", {"machine": about, "parts": results})
        if not arguments.quick and gpu():
            import cuda_suite

            cuda_suite.on_this_gpu(arguments.out)


if __name__ == "__main__":
    main()
