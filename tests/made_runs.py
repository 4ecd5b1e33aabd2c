"""Made-up runs of tests: short trainings, runs of chips, and runs without a training for pages."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from made import FEW_POINTS, dataset_of
from sarsplat import Config, Dataset, ImageGrid, Place, Run, Trainer, View, preset, reconstruct, write_dataset
from sarsplat.baselines import Baseline
from sarsplat.baselines.trainer import BaselineTrainer
from sarsplat.evaluation import IMAGE_METRICS, Yardstick, all_metrics, metrics_of_points
from sarsplat.geometry.responses import TAYLOR
from sarsplat.learning.snapshot import Snapshot
from sarsplat.names import RadarSide
from sarsplat.runs.run_folder import LogLine, TrainingState


# ---- trainings, and their comparison bit by bit ----------------------------------------------------------------------
def trained(dataset: Dataset, config: Config, steps: int, snapshot: Snapshot | None = None, **options: Any) -> Trainer:
    """Trainer after these steps, from a snapshot if one is given."""
    trainer = Trainer(dataset, config, **options)
    if snapshot is not None:
        trainer.restore(snapshot)
    for _ in range(steps):
        trainer.step()
    return trainer


def baseline_losses(model: Baseline, images: Tensor, steps: int) -> list[float]:
    """Losses of the first steps of a baseline's training on images in units of its scene's power."""
    dataset = SimpleNamespace(images=lambda split: images.numpy() * np.float32(model.scene.unit))
    trainer = BaselineTrainer(dataset, model.config, model)
    return [trainer.step().item() for _ in range(steps)]


def assert_same(one: Snapshot, other: Snapshot) -> None:
    """Assert that all tensors are the same to the bit."""
    assert_equal(one.tensors, other.tensors)


def assert_equal(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    """Assert that tensors of the same names are the same to the bit."""
    assert one.keys() == other.keys()
    assert [name for name, tensor in one.items() if not torch.equal(tensor, other[name])] == []


# ---- points of any surface ------------------------------------------------------------------------------------------
def with_points(run: Run, points: Any, normals: Any, gamma0: Any, **changes: Any) -> Run:
    """The run with these points, and other fields."""
    made = replace(run, **changes)
    for name, values in (("points", points), ("normals", normals), ("points_gamma0", gamma0)):
        vars(made)[name] = None if values is None else np.asarray(values, np.float32)
    return made


def at(run: Run, place: Place | None) -> Run:
    """The run with its points elsewhere on earth."""
    return with_points(run, run.points, run.normals, run.points_gamma0, place=place)


# ---- chips: a bright block and its shadow on speckled ground, hardly trained -----------------------------------------
GRID = ImageGrid(32, 36, (0.2, 0.2), (0.32, 0.3), response=TAYLOR)


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
    few = {"iterations": 3, "gaussians": 40, "fewest_gaussians": 40, "checkpoint_every": 3}
    run = reconstruct(dataset, replace(preset("measured"), **few, points=FEW_POINTS), out, quiet=True)
    # or it would be warned of a run that was never evaluated
    run.keep(make_metrics(registered_nats_per_pixel=0.5) | {"time_s": 1.0, "seed": 0})
    return run


# ---- pages -----------------------------------------------------------------------------------------------------------
METRICS = all_metrics(Yardstick(0.3))
POINT_KEYS = [metric.key for metric in metrics_of_points(Yardstick(0.3))]


class MadeUpRun(SimpleNamespace):
    """What pages need of a run."""

    __class__ = Run  # to `isinstance`
    state = TrainingState(1, 1, has_results=True)
    model = None


def make_dataset(
    folder: Path, *, measured: bool = False, tests: int = 5, target: str = "t72", mesh: bool = True
) -> Dataset:
    import trimesh

    power = np.full((2 + tests, 32, 32), 1.0 if measured else 0.0, dtype=np.float32)
    power[:, 12:20, 10:22] = 5.0
    views = [(View(10.0 * k, 30.0), "train" if k < 2 else "test") for k in range(2 + tests)]
    fields = {"calibration": "relative", "looks": 1.0, "ground": True} if measured else {"protocol": "paper"}
    grid, source = ImageGrid(32, 32, (0.3, 0.3), (0.3, 0.3)), {"law": {"floor": 0.1, "lobe": 0.9}}
    dataset = dataset_of(grid, views, power, target=target, source=source, **fields)
    return write_dataset(folder / "dataset", dataset, truth_mesh=trimesh.creation.box() if mesh else None)


def make_run(folder: Path, dataset: Dataset, metrics: dict[str, Any] | None, **changes: Any) -> Any:
    import trimesh

    run, kind = folder / "run", "measured" if dataset.ground else "default"
    run.mkdir()
    fields = {
        **{"path": run, "folder": run, "dataset": dataset, "config": preset(kind), "metrics": metrics},
        **{"learned": "1,234 Gaussians", "gaussians": None, "method": "sar-gs", "facts": {"preset": kind}},
        **{"loss_title": ("mean difference of amplitudes", "amplitude"), "time_s": 12.5, "seed": 7, "iteration": 20},
        **{"points": np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3)), "mesh": trimesh.creation.box},
        "azimuth_offset_deg": np.zeros(2),
        "history": [LogLine(k, float(k), 1 / k, 1234) for k in (1, 10, 20)],
        "render": lambda views: np.full((len(views), 32, 32), 0.5, dtype=np.float32),
        "views_of": lambda images: images.views,
    }
    return MadeUpRun(**{**fields, **changes})


def make_metrics(**scores: float) -> dict[str, Any]:
    points = {name: None if name not in ("cd_m", "f1@0.3") else 0.0625 for name in POINT_KEYS}
    return {
        "images": {"test": {**{metric.key: None for metric in IMAGE_METRICS}, **scores}},
        "points": {"visible": points, "whole": points},
        "mesh": {"visible": points | {"cd_m": 0.0375}, "whole": points},
        "baselines": None,
        "truth": {"mesh": None},
        "parameters": {"reference_amplitude": 2.5, "mean_power": 0.125, "score_margin": 0, "yardstick_m": 0.3},
        "definitions": {metric.key: metric.definition for metric in METRICS},
        "reasons": {"images.test.lpips": "no weights here", "points.whole.f1@0.3": "no points"},
    }
