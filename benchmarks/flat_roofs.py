"""Flat roofs of many resolution cells, beside vehicles: how high they are found, and the scores of the points.

`python benchmarks/flat_roofs.py PRESET [SEED]` makes the scene of twelve boxes and fifteen vehicles on 147 m × 134 m,
24 clean images of 640 × 640 pixels of .3 m at grazing angles of 35° and 50°, trains, and prints JSON; minutes.
"""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, cast

import numpy as np

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

if TYPE_CHECKING:
    import trimesh

SIDE, PIXEL_M, SAMPLES = 640, 0.3, 200_000
AREA_M, LOTS, VEHICLES = (147.0, 134.0), (4, 3), 15
INSIDE_M = 2.0  # of its edges: where a roof looks the same everywhere


def flat_roofs(seed: int = 0) -> tuple[trimesh.Trimesh, list[tuple[float, ...]]]:
    """The surface, and of each roof width, depth, height, x and y of its middle (m) and turn (degrees)."""
    import trimesh

    chance, lot = np.random.default_rng(seed), np.array(AREA_M) / LOTS
    middles = [(np.array(place) + 0.5) * lot - np.array(AREA_M) / 2 for place in np.ndindex(*LOTS)]
    roofs = [(*chance.uniform((8, 8, 4), (22, 22, 15)), *middle, chance.uniform(0, 90)) for middle in middles]
    sizes = [(4.2, 1.8, 1.4), (6.0, 2.4, 2.6)]
    beside = [(middles[k % len(middles)] + (1 if k < len(middles) else -1) * 0.45 * lot) for k in range(VEHICLES)]
    cars = [(*sizes[k % 2], *place, chance.uniform(0, 180)) for k, place in enumerate(beside)]
    parts = []
    for width, depth, height, x, y, turn in (*roofs, *cars):
        part = trimesh.creation.box((width, depth, height))
        part.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn), (0, 0, 1)))
        part.apply_translation((x, y, height / 2))
        parts.append(part)
    return cast("trimesh.Trimesh", trimesh.util.concatenate(parts)).subdivide_to_size(1.0), roofs  # type: ignore[return-value]


def too_high(points: np.ndarray, roof: tuple[float, ...]) -> tuple[float, float]:
    """By how much the points of a roof's inside are too high, m: mean and standard deviation."""
    width, depth, height, x, y, turn = roof
    (east, north), (c, s) = (points[:, :2] - (x, y)).T, (np.cos(np.radians(turn)), np.sin(np.radians(turn)))
    along, across = east * c + north * s, north * c - east * s
    inside = (abs(along) < width / 2 - INSIDE_M) & (abs(across) < depth / 2 - INSIDE_M)
    errors = points[inside & (abs(points[:, 2] - height) < 2), 2] - height
    return float(errors.mean()), float(errors.std())


def measure(preset_name: str, seed: int) -> dict[str, Any]:
    """Scores, heights and seconds of a training."""
    from sarsplat import Dataset, DatasetEntry, ImageGrid, View, preset, reconstruct
    from sarsplat.evaluation import Yardstick, evaluate_run, point_metrics, visible_surface
    from sarsplat.scenes.simulate import simulate_images

    grid, (mesh, roofs) = ImageGrid(SIDE, SIDE, (PIXEL_M, PIXEL_M), (PIXEL_M, PIXEL_M)), flat_roofs()
    views = [View(azimuth + (grazing > 40) * 15, grazing) for grazing in (35.0, 50.0) for azimuth in range(0, 360, 30)]
    unseen = [View(8.0 + azimuth, 42.0) for azimuth in range(0, 360, 90)]
    splits = ["train"] * len(views) + ["test"] * len(unseen)
    entries = tuple(
        DatasetEntry(view, split, f"{k:03}") for k, (view, split) in enumerate(zip([*views, *unseen], splits))
    )
    with TemporaryDirectory() as folder:
        mesh.export(truth := Path(folder) / "roofs.ply")
        images = simulate_images(mesh, [*views, *unseen], grid)
        dataset = Dataset(grid, entries, images, target="flat roofs", truth_mesh=truth)
        begun = time.perf_counter()
        run = reconstruct(dataset, replace(preset(preset_name), seed=seed), quiet=True)
        seconds = time.perf_counter() - begun
        metrics = evaluate_run(run, points=False, quiet=True)
    yardstick = Yardstick.of(grid)
    surface = visible_surface(mesh, views, yardstick.ray_spacing_m, samples=SAMPLES)
    scores = point_metrics(run.points, surface.triangles, surface.samples, yardstick)
    return {
        "seconds": seconds,
        "cd_m": scores.cd_m,
        "f1": {f"{threshold:g}": value for threshold, value in scores.f1.items()},
        "unseen": metrics["images"],
        "roofs": [[round(number, 3) for number in too_high(run.points, roof)] for roof in roofs],
        "points": len(run.points),
    }


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 0)))
