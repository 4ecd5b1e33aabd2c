"""Every benchmark, or those named: `python benchmarks/bench.py [PART …] [--quick] [--out FOLDER]`.

Prints ratios first, absolute times second. With `--out` the results of all parts are written to FOLDER/cpu.json and,
where there is a GPU, those of `cuda_check.py` beside it; `make bench` does that and fills the README from them.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

import against_naive
import degenerate
import determinism
import floor
import growth
import iteration
import paper_run
import torch
import twins
from results import machine, save
from rich.console import Console
from rich.table import Table

from sarsplat.errors import SarsplatError
from sarsplat.render import cpu
from sarsplat.render.cuda_device import require_cuda

PARTS: dict[str, Callable[[bool], dict[str, Any]]] = {
    "determinism": determinism.measure,
    "iteration": iteration.measure,
    "floor": floor.measure,
    "naive": against_naive.measure,
    "twins": twins.measure,
    "degenerate": degenerate.measure,
    "growth": growth.measure,
    "paper": paper_run.measure,
}
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


def table(kind: str, parts: dict[str, dict[str, Any]], shown: Callable[[float], str]) -> Table:
    """One kind of finding of all parts."""
    found = Table(title=kind, title_justify="left", header_style="bold")
    for name in ("part", "what"):
        found.add_column(name)
    for name in ("median", "fastest" if kind == "times" else "least", "10 … 90 %"):
        found.add_column(name, justify="right", no_wrap=True)
    for part, result in parts.items():
        for k, (what, value) in enumerate(result.get(kind, {}).items()):
            first = part if k == 0 else ""
            if isinstance(value, dict):
                cells = (
                    shown(value["median"]),
                    shown(value["least"]),
                    f"{shown(value['p10'])} … {shown(value['p90'])}",
                )
            else:
                cells = (value if isinstance(value, str) else shown(value), "", "")
            found.add_row(first, what, *cells)
    return found


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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all unless given")
    parser.add_argument("--quick", action="store_true", help="small scenes, few repeats, no training: a smoke test")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of torch and of the engine")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write the results there; needs all parts")
    arguments = parser.parse_args()
    if unknown := set(arguments.parts) - set(PARTS):
        parser.error(f"{sorted(unknown)[0]!r} is no part; take of {', '.join(PARTS)}")
    if arguments.out and arguments.parts:
        parser.error("--out is for results of one whole run; leave out the names of parts")
    torch.set_num_threads(arguments.threads)
    about = machine() | {"instruction_set": cpu.best_instruction_set(), "quick": arguments.quick}
    if about["load"] > BUSY:
        print(f"This machine is busy (load {about['load']:.1f}): its times will scatter, its ratios less so.")
    console, results = Console(width=None if sys.stdout.isatty() else 120), {}
    for name in arguments.parts or [name for name in PARTS if not (arguments.quick and name == "paper")]:
        begun = time.monotonic()
        console.print(f"{name} … ", end="")
        results[name] = PARTS[name](arguments.quick)
        console.print(f"{time.monotonic() - begun:.0f} s")
    for kind, shown in SHOWN.items():
        if any(result.get(kind) for result in results.values()):
            console.print(table(kind, results, shown))
    if arguments.out:
        save(arguments.out / "cpu.json", {"machine": about, "parts": results})
        if not arguments.quick and gpu():
            import cuda_check

            cuda_check.main(arguments.out)


if __name__ == "__main__":
    main()
