"""Whether `make demo` still scores what it did: `python benchmarks/guard.py [RUN]` exits 1 if a score is worse,
and 2 if the code has changed since.

`python benchmarks/guard.py --write RUN RUN RUN` makes the bands, results/demo.json, from runs of several seeds.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path

from results import REPOSITORY, RESULTS, save

BANDS = RESULTS / "demo.json"
WIDENED = 5.0
"""A band is the range over the seeds, about its middle, so many times as wide: three seeds show less than there is."""
_MOST = 1.0
"""Of shares: a band may reach beyond."""
_SURFACES = ("points.visible", "points.whole", "mesh.visible", "mesh.whole")
BETTER = {
    **dict.fromkeys(("images.test.psnr_db", "images.test.psnr_target_db", "images.test.ssim"), "more"),
    **{f"{surface}.cd_m": "less" for surface in _SURFACES},
    **{f"{surface}.{f1}": "more" for surface in _SURFACES for f1 in ("f1@0.3", "f1@0.1")},
    **dict.fromkeys(("points.visible.count", "gaussians"), "neither"),
}
"""Which way each score is better; of numbers of things neither: they are worse outside their band."""


def scores(run: Path) -> dict[str, float]:
    """What is judged of an evaluated run, and its time; without what it lacks."""
    found = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    found |= json.loads((run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()[-1])
    paths = {name: name.split(".", 2) for name in (*BETTER, "time_s")}
    values = {name: reduce(lambda part, key: (part or {}).get(key), path, found) for name, path in paths.items()}
    return {name: value for name, value in values.items() if value is not None}


def bands(runs: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Lowest and highest of each score that pass."""
    each = {name: sorted(run[name] for run in runs) for name in BETTER}
    more = {name: (WIDENED - 1) / 2 * (values[-1] - values[0]) for name, values in each.items()}
    return {name: [values[0] - more[name], values[-1] + more[name]] for name, values in each.items()}


def compare(now: Mapping[str, float], before: Mapping[str, Sequence[float]]) -> tuple[list[str], bool]:
    """A line for each score, and whether none is missing or left its band to the worse."""
    lines, fine = [f"{'':28}{'now':>12}{'from':>12}{'to':>12}"], True
    for name, (low, band) in before.items():
        high = min(band, _MOST) if "f1@" in name or name.endswith("ssim") else band
        value = now.get(name, math.nan)
        good = value > high if BETTER[name] == "more" else value < low and BETTER[name] == "less"
        verdict = ""
        if not low <= value <= high:
            past = f"{value - (high if value > high else low):+.3g} past its band"
            verdict = "missing" if name not in now else f"better, {past}" if good else f"WORSE, {past}"
            fine = fine and good
        lines.append(f"{name:28}{value:12.7g}{low:12.7g}{high:12.7g}  {verdict}".rstrip())
    return [*lines, f"{'time_s':28}{now.get('time_s', math.nan):12.4g}  not judged"], fine


def newer(run: Path, sources: Path) -> Path | None:
    """A source that has changed since a run was trained and evaluated; None if none has."""
    made = min(path.stat().st_mtime for path in (run / "metrics.json", *(run / "checkpoints").glob("*.safetensors")))
    files = (path for path in sources.rglob("*") if path.suffix in {".py", ".cpp", ".h", ".cu", ".cuh"})
    return next((path for path in files if path.stat().st_mtime > made), None)


def main() -> int:
    """Compare, or write the bands."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="*", type=Path, default=[REPOSITORY / "demo" / "run"])
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    for run in arguments.runs:
        if not (run / "metrics.json").is_file():
            print(f"guard: {run} is not an evaluated run; run `make demo` first", file=sys.stderr)
            return 2
    runs = [scores(run) for run in arguments.runs]
    if arguments.write:
        save(BANDS, {"widened": WIDENED, "runs": len(runs), "bands": bands(runs)})
        return 0
    if (changed := newer(arguments.runs[0], REPOSITORY / "src")) is not None:
        print(
            f"guard: {changed.relative_to(REPOSITORY)} has changed since {arguments.runs[0]} was made, so that shows "
            "nothing of it; run `make demo` first",
            file=sys.stderr,
        )
        return 2
    lines, fine = compare(runs[0], json.loads(BANDS.read_text(encoding="utf-8"))["bands"])
    print(*lines, sep="\n")
    print("guard: no score is worse" if fine else "guard: worse than before, or missing: see above")
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
