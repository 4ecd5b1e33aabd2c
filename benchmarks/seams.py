"""Reconstruction by tiles against that of the whole scene: scores everywhere and at the seams, time and memory.

`python benchmarks/seams.py DATASET PRESET TILES…` adds to benchmarks/results/seams-DATASET-PRESET.json as numbers of
tiles along a side finish, and skips those that it holds; `DATASET PRESET TILES --alone` is one, printed as JSON, in a
process of its own with one thread. DATASET is a folder with a true mesh and test images; beside it is DATASET-seams,
with what has been trained: a run that was stopped goes on. Give 1 last: the whole is scored at the seams of the others.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

import numpy as np
from growth import resident_bytes
from results import RESULTS, add_rows
from scipy.spatial import cKDTree

NEAR_M = 2.0  # of a seam
SAMPLES = 200_000  # of the true surface
POINTS = 60_000  # that are compared with it, by chance
IMAGES = 12  # of the test sets, evenly chosen
COARSER = 3.0  # rays that find the visible surface, than in an evaluation


def one(path: str, preset_name: str, tiles: int) -> dict[str, Any]:
    """CPU seconds and peak memory in GiB of the training, and the scores of what it learned."""
    import torch

    from sarsplat import preset, read_dataset, reconstruct
    from sarsplat.evaluation import Yardstick, visible_surface
    from sarsplat.evaluation.images import psnr_db
    from sarsplat.evaluation.points import first_of_voxels, on_surface
    from sarsplat.evaluation.surface import read_truth_mesh
    from sarsplat.settings.sections import FlatGround

    torch.set_num_threads(1)
    dataset, config = read_dataset(path), replace(preset(preset_name), tiles=tiles, checkpoint_every=25)
    config = replace(config, ground=FlatGround()) if dataset.ground else config
    runs = Path(f"{path}-seams")
    out, spent = runs / f"{preset_name}-{tiles}", runs / f"{preset_name}-{tiles}.json"
    before: dict[str, Any] = {"seconds": 0.0, "peak_gib": 0.0, "tiles": []}
    if spent.exists():
        before = json.loads(spent.read_text())
    begun = time.process_time() - before["seconds"]

    def on_step(step: Any) -> None:
        tile = getattr(step.trainer, "tile", None)
        if tile is not None and [tile.low, tile.high] not in before["tiles"]:
            before["tiles"].append([tile.low, tile.high])
        peak = max(before["peak_gib"], resident_bytes()[1] / 2**30)
        before.update(seconds=time.process_time() - begun, peak_gib=peak)
        if step.line is not None:
            spent.write_text(json.dumps(before))

    runs.mkdir(exist_ok=True)
    run = reconstruct(dataset, config, out, on_step=on_step, resume=out.exists(), quiet=True)
    assert run.gaussians is not None  # sar-gs has some
    gaussians, seen = len(run.gaussians), run.points
    peak = resident_bytes()[1] / 2**30
    tests = [k for k, entry in enumerate(dataset.entries) if entry.split != "train"]
    tested = dataset.take(tests[:: max(1, len(tests) // IMAGES)])
    brightest = math.sqrt(run.brightest)
    psnr = psnr_db(tested.power, run.render(tested.views), brightest)

    yardstick = Yardstick.of(dataset.grid)
    assert dataset.truth_mesh is not None, f"{path} has no true mesh"
    mesh, views = read_truth_mesh(dataset.truth_mesh), dataset.select("train").views
    surface = visible_surface(mesh, views, COARSER * yardstick.ray_spacing_m, samples=SAMPLES)
    points = seen[first_of_voxels(seen, yardstick.voxel_m)].astype(np.float64)
    to_points = cKDTree(points).query(surface.samples)[0]
    chance = np.random.default_rng(0)

    def scores(own: Any, true: Any) -> dict[str, float]:
        some = points[own][chance.permutation(int(own.sum()))[:POINTS]]
        off, _ = on_surface(some, surface.triangles)
        values = {"cd_m": float(off.mean() + to_points[true].mean()) / 2, "samples": int(true.sum())}
        for threshold in (yardstick.thresholds_m[0], yardstick.thresholds_m[2]):
            precision, recall = float((off <= threshold).mean()), float((to_points[true] <= threshold).mean())
            values[f"f1@{threshold:g}"] = 2 * precision * recall / (precision + recall)
        return values

    row = {"side": tiles, "dataset": Path(path).name, "preset": preset_name, "gaussians": gaussians, "psnr_db": psnr}
    row |= {"points": len(seen), "training": {name: before[name] for name in ("seconds", "peak_gib")}, "peak_gib": peak}
    row["everywhere"] = scores(np.ones(len(points), bool), np.ones(len(surface.samples), bool))
    for other in sorted(runs.glob(f"{preset_name}-*.json")) if tiles == 1 else [spent]:
        seams = json.loads(other.read_text())["tiles"]
        if seams:
            row[f"at the seams of {other.stem}"] = scores(near(points, seams), near(surface.samples, seams))
    return row


def near(points: Any, tiles: Any) -> Any:
    """Which points are within two metres of an edge between two of these tiles."""
    found = np.zeros(len(points), bool)
    for low, high in tiles:
        for axis in (0, 1):
            other = 1 - axis
            beside = (points[:, other] >= low[other]) & (points[:, other] < high[other])
            for edge in (low[axis], high[axis]):
                if math.isfinite(edge):
                    found |= beside & (abs(points[:, axis] - edge) <= NEAR_M)
    return found


if __name__ == "__main__":
    where, how, *words = sys.argv[1:]
    if words[-1:] == ["--alone"]:
        print(json.dumps(one(where, how, int(words[0]))))
    else:
        name = f"seams-{Path(where).name}-{how}.json"
        add_rows(RESULTS / name, [__file__, where, how], [int(word) for word in words])
