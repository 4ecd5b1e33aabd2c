"""Runs without a training, for tests of pages."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import trimesh

from datasets import dataset_of
from sarsplat.data import Dataset, write_dataset
from sarsplat.evaluation import IMAGE_METRICS, Yardstick, all_metrics, metrics_of_points
from sarsplat.geometry import ImageGrid, View
from sarsplat.runs import Run
from sarsplat.runs.run_folder import LogLine, TrainingState
from sarsplat.settings import preset

GRID = ImageGrid(32, 32, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
METRICS = all_metrics(Yardstick(0.3))
IMAGE_KEYS = [metric.key for metric in IMAGE_METRICS]
POINT_KEYS = [metric.key for metric in metrics_of_points(Yardstick(0.3))]


class MadeUpRun(SimpleNamespace):
    """What pages need of a run."""

    __class__ = Run  # to `isinstance`
    state = TrainingState(1, 1, has_results=True)
    model = None


def make_dataset(
    folder: Path, *, measured: bool = False, tests: int = 5, target: str = "t72", mesh: bool = True
) -> Dataset:
    power = np.full((2 + tests, 32, 32), 1.0 if measured else 0.0, dtype=np.float32)
    power[:, 12:20, 10:22] = 5.0
    views = [(View(10.0 * k, 30.0), "train" if k < 2 else "test") for k in range(2 + tests)]
    fields = {"calibration": "relative", "looks": 1.0, "ground": True} if measured else {"protocol": "paper"}
    source = {"law": {"floor": 0.1, "lobe": 0.9}}
    dataset = dataset_of(GRID, views, power, target=target, source=source, **fields)
    return write_dataset(folder / "dataset", dataset, truth_mesh=trimesh.creation.box() if mesh else None)


def make_run(folder: Path, dataset: Dataset, metrics: dict[str, Any] | None, **changes: Any) -> Any:
    run = folder / "run"
    run.mkdir()
    rng = np.random.default_rng(0)
    fields = {
        "path": run,
        "folder": run,
        "dataset": dataset,
        "config": preset("measured" if dataset.ground else "default"),
        "metrics": metrics,
        "learned": "1,234 Gaussians",
        "gaussians": None,
        "method": "sar-gs",
        "facts": {"preset": "measured" if dataset.ground else "default"},
        "loss_title": ("mean difference of amplitudes", "amplitude"),
        "points": rng.uniform(-0.5, 0.5, (200, 3)),
        "mesh": trimesh.creation.box,
        "time_s": 12.5,
        "seed": 7,
        "iteration": 20,
        "azimuth_offset_deg": np.zeros(2),
        "history": [LogLine(k, float(k), 1 / k, 1234) for k in (1, 10, 20)],
        "render": lambda views: np.full((len(views), 32, 32), 0.5, dtype=np.float32),
        "views_of": lambda images: images.views,
    }
    return MadeUpRun(**{**fields, **changes})


def make_metrics(**scores: float) -> dict[str, Any]:
    points = {name: None if name not in ("cd_m", "f1@0.3") else 0.0625 for name in POINT_KEYS}
    return {
        "images": {"test": {**dict.fromkeys(IMAGE_KEYS), **scores}},
        "points": {"visible": points, "whole": points},
        "mesh": {"visible": points | {"cd_m": 0.0375}, "whole": points},
        "baselines": None,
        "truth": {"mesh": None},
        "parameters": {"reference_amplitude": 2.5, "mean_power": 0.125, "score_margin": 0, "yardstick_m": 0.3},
        "definitions": {metric.key: metric.definition for metric in METRICS},
        "reasons": {"images.test.lpips": "no weights here", "points.whole.f1@0.3": "no points"},
    }
