"""Time and memory of villages of 64² to 1024² pixels: simulate, train; and the scores of the points.

`python benchmarks/scenes.py PRESET [SIDE …]` adds to benchmarks/results/scenes-PRESET.json as sizes finish, and skips
those that it holds; `PRESET SIDE --alone` is one size, printed as JSON, in a process of its own. Pixels are .3 m wide,
and the village is .64 as wide as the images, so that all of it is seen from all sides.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

from results import RESULTS, add_rows

SIDES = (64, 128, 256, 512, 1024)
PIXEL_M = 0.3
SAMPLES = 200_000  # of the true surface


def one(preset: str, side: int) -> dict[str, Any]:
    """Seconds of every part, peak memory so far in GiB after each, and the scores."""
    from sarsplat import Dataset, DatasetEntry, ImageGrid, View, reconstruct
    from sarsplat.evaluation import Yardstick, point_metrics, visible_surface
    from sarsplat.scenes.simulate import simulate_images
    from sarsplat.scenes.village import village

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
        done("train", begun)
        assert run.gaussians is not None  # sar-gs has some
        yardstick = Yardstick.of(grid)
        surface = visible_surface(mesh, views, yardstick.ray_spacing_m, samples=SAMPLES)
        scores = point_metrics(run.points, surface.triangles, surface.samples, yardstick)
    return {
        "side": side,
        "faces": len(mesh.faces),
        "gaussians": len(run.gaussians),
        "points": len(run.points),
        "parts": parts,
        "f1": {f"{threshold:g}": value for threshold, value in scores.f1.items()},
    }


if __name__ == "__main__":
    preset_name, *words = sys.argv[1:]
    if words[-1:] == ["--alone"]:
        print(json.dumps(one(preset_name, int(words[0]))))
    else:
        add_rows(
            RESULTS / f"scenes-{preset_name}.json", [__file__, preset_name], [int(word) for word in words] or SIDES
        )
