"""Time and memory of the whole job on villages of 64² to 1024² pixels: simulate, train, extract points.

`python benchmarks/scenes.py PRESET [SIDE …]` adds to benchmarks/results/scenes-PRESET.json as sizes finish, and skips
those that it holds; `PRESET SIDE --alone` is one size, printed as JSON, in a process of its own. Pixels are .3 m wide,
and the village is .64 as wide as the images, so that all of it is seen from all sides.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

import numpy as np
from results import RESULTS, machine, save

SIDES = (64, 128, 256, 512, 1024)
PIXEL_M = 0.3


def one(preset: str, side: int) -> dict[str, Any]:
    """Seconds of every part, peak memory so far in GiB after each, and the scores."""
    from village import village

    from sarsplat import Dataset, DatasetEntry, ImageGrid, View, evaluate_run, reconstruct
    from sarsplat.scenes.simulate import simulate_images

    parts: dict[str, dict[str, float]] = {}

    def done(part: str, begun: float) -> None:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        parts[part] = {"seconds": time.perf_counter() - begun, "peak_gib": peak}

    grid = ImageGrid(side, side, (PIXEL_M, PIXEL_M), (PIXEL_M, PIXEL_M))
    views = [View(azimuth, grazing) for grazing in (15.0, 45.0, 75.0) for azimuth in range(0, 360, 45)]
    mesh = village(0.64 * side * PIXEL_M)
    with TemporaryDirectory() as folder:
        mesh.export(truth := Path(folder) / "village.ply")
        begun = time.perf_counter()
        images = simulate_images(mesh, views, grid)
        done("simulate", begun)
        entries = tuple(DatasetEntry(view, "train", f"{k:03}") for k, view in enumerate(views))
        dataset = Dataset(grid, entries, images, target="village", truth_mesh=truth)
        begun = time.perf_counter()
        run = reconstruct(dataset, preset, quiet=True)
        parts["train"] = {"seconds": run.time_s, "peak_gib": 0.0}
        done("reconstruct", begun)
        scores = evaluate_run(run, quiet=True)
    return {
        "side": side,
        "faces": len(mesh.faces),
        "gaussians": len(run.gaussians),
        "points": len(run.points),
        "parts": parts,
        "scores": {name: value for name, value in scores["points"].items() if isinstance(value, float)},
    }


def slope(rows: list[dict[str, Any]], part: str, what: str) -> float:
    """Of the straight line through the logarithms against the side, without the smallest size: 2 is linear in area."""
    sides, values = [row["side"] for row in rows[1:]], [row["parts"][part][what] for row in rows[1:]]
    return float(np.polyfit(np.log(sides), np.log(values), 1)[0])


def main(preset: str, sides: list[int]) -> None:
    """All sizes, one after the other."""
    path = RESULTS / f"scenes-{preset}.json"
    held = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"machine": machine(), "rows": []}
    for side in sides:
        if side in {row["side"] for row in held["rows"]}:
            continue
        command = [sys.executable, __file__, preset, str(side), "--alone"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if ended.returncode:
            raise SystemExit(f"{preset}, {side}²: {ended.stderr[-2000:]}")
        held["rows"] = sorted([*held["rows"], json.loads(ended.stdout.splitlines()[-1])], key=lambda row: row["side"])
        save(path, held)
        print(f"{preset}, {side}²: {held['rows'][-1]}", flush=True)


if __name__ == "__main__":
    preset_name, *words = sys.argv[1:]
    if words[-1:] == ["--alone"]:
        print(json.dumps(one(preset_name, int(words[0]))))
    else:
        main(preset_name, [int(word) for word in words] or list(SIDES))
