"""A run of made-up chips: a bright block and its shadow on speckled ground, hardly trained."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from datasets import FEW_POINTS, dataset_of
from reports import make_metrics
from sarsplat import ImageGrid, Run, View, preset, reconstruct, write_dataset
from sarsplat.geometry.responses import TAYLOR
from sarsplat.names import RadarSide
from sarsplat.settings import Config

GRID = ImageGrid(32, 36, (0.2, 0.2), (0.32, 0.3), response=TAYLOR)


def settings() -> Config:
    few = {"iterations": 3, "gaussians": 40, "fewest_gaussians": 40, "checkpoint_every": 3}
    return replace(preset("measured"), **few, points=FEW_POINTS)


def made_up(target: str, out: Path | None = None, grid: ImageGrid = GRID, tilt_deg: float = 0.0) -> Run:
    """Of images of a level radar that looks to the right, or a tilted one that looks to the left."""
    side: RadarSide = "left" if tilt_deg else "right"
    views = [(View(azimuth, 16.0 + azimuth / 180, tilt_deg, side), "train") for azimuth in range(0, 360, 60)]
    power = np.random.default_rng(0).exponential(size=(6, grid.rows, grid.columns)).astype(np.float32)
    power[:, 10:16, 12:22] *= 30
    power[:, 16:24, 12:22] *= 0.05
    dataset = dataset_of(grid, views, power, looks=1.0, ground=True, target=target)
    if out is not None:
        dataset = write_dataset(out.with_name(f"{out.name}-data"), dataset)
    run = reconstruct(dataset, settings(), out, quiet=True)
    run.keep(
        make_metrics(registered_nats_per_pixel=0.5) | {"time_s": 1.0, "seed": 0}
    )  # or it would be warned of a run that was never evaluated
    return run
