"""Everything that is measured about a run, as one dictionary: the content of `metrics.json`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float

from sarsplat.data import Dataset
from sarsplat.data.plausible import warn
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import images, lpips
from sarsplat.evaluation.images import Stack
from sarsplat.evaluation.points import THRESHOLDS, VOXEL, PointMetrics, point_metrics
from sarsplat.evaluation.surface import visible_surface
from sarsplat.evaluation.yardsticks import yardstick_scores
from sarsplat.geometry import View
from sarsplat.scenes.mesh_files import read_mesh

if TYPE_CHECKING:
    import trimesh

IMAGE_METRICS = ("psnr_db", "psnr_target_db", "ssim", "lpips", "nats_per_pixel", "log_correlation")
POINT_METRICS = (
    *("accuracy_m", "completeness_m", "cd_m", "cd_squared_m2"),
    *("precision@0.3", "recall@0.3"),
    *(f"f1@{threshold}" for threshold in THRESHOLDS),
    "count",
)


class EvaluatedRun(Protocol):
    """What evaluation reads of a finished run."""

    @property
    def path(self) -> Path | None: ...

    @property
    def dataset(self) -> Dataset: ...

    @property
    def points(self) -> Float[np.ndarray, "p 3"]:
        """Reconstructed points, world frame, m, float64 [P, 3]."""

    @property
    def time_s(self) -> float | None: ...

    @property
    def seed(self) -> int | None: ...

    def render(self, views: Sequence[View], /) -> Stack:
        """β⁰ power of unseen views, float32 [V, rows, columns]."""


def evaluate_run(run: EvaluatedRun, *, lpips_weights: Path | None = None) -> dict[str, Any]:
    """Score a run on every test set of its dataset, and its points against the true surface.

    Parameters
    ----------
    run : EvaluatedRun
        A finished run.
    lpips_weights : pathlib.Path, optional
        Folder of the LPIPS weights; without it the environment variable SARSPLAT_LPIPS_WEIGHTS, without that no LPIPS.

    Returns
    -------
    dict
        The content of `metrics.json`: `images.<set>.<metric>`, `points.{visible, whole}.<metric>`, `yardsticks` (what
        two-dimensional tricks score on speckled images with ground), `time_s`, `seed`,
        `domain` (what exactly was compared) and `reasons`: for every metric that is None, its dotted key and why.
        Without test images `images` is empty.

    Raises
    ------
    SarsplatError
        If there is nothing to score (no test images, and no true mesh or no points), the training images are black, a
        rendered image is unsound, the LPIPS weights are given but unusable, or the true mesh cannot be read.

    Warns
    -----
    SarsplatWarning
        If points of a run from one training view are scored.
    """
    dataset = run.dataset
    test_sets = [split for split in dataset.splits() if split != "train"]
    if not test_sets and (dataset.truth_mesh is None or len(run.points) == 0):
        lacks = "no true mesh" if dataset.truth_mesh is None else "the run no points"
        raise SarsplatError(
            f"nothing can be scored: the dataset {dataset} has no test images and {lacks}; "
            "simulate it with --test-azimuth"
        )
    weights = lpips.lpips_weights(lpips_weights)
    network = None if weights is None else lpips.Lpips(weights)
    train = dataset.images("train")
    if not train.max() > 0:
        raise SarsplatError(f"the training images of {dataset} are black everywhere; simulate or import them again")
    reference_amplitude, mean_power = float(np.sqrt(train.max())), float(train.mean(dtype=np.float64))

    reasons: dict[str, str] = {}
    if not test_sets:
        reasons["images"] = "the dataset has no test images, so nothing is unseen; simulate it with --test-azimuth"
    scores: dict[str, dict[str, float | None]] = {}
    for split in test_sets:
        truth = dataset.images(split)
        rendered = run.render(dataset.select(split).views)
        table = _image_metrics(truth, rendered, reference_amplitude, mean_power, dataset.score_margin, network)
        scores[split] = images.defined(table, f"images.{split}", reasons, _not_applicable(dataset))
    return {
        "images": scores,
        "points": _points(run, reasons),
        "yardsticks": yardstick_scores(dataset, reasons) if dataset.looks is not None and dataset.ground else None,
        "time_s": run.time_s,
        "seed": run.seed,
        "domain": _domain(reference_amplitude, mean_power, dataset.score_margin),
        "reasons": reasons,
    }


def _image_metrics(
    truth: Stack,
    rendered: Stack,
    reference_amplitude: float,
    mean_power: float,
    margin: int,
    network: lpips.Lpips | None,
) -> dict[str, Callable[[], float]]:
    """Every image metric of one set, ready to be computed."""

    def perceptual() -> float:
        if network is None:
            raise images.UndefinedScore(
                f"no LPIPS weights: pass their folder with --lpips-weights or name it in {lpips.WEIGHTS_VARIABLE}"
            )
        return lpips.lpips(truth, rendered, reference_amplitude, network)

    return {
        "psnr_db": lambda: images.psnr_db(truth, rendered, reference_amplitude),
        "psnr_target_db": lambda: images.psnr_target_db(truth, rendered, reference_amplitude),
        "ssim": lambda: images.ssim(truth, rendered, reference_amplitude),
        "lpips": perceptual,
        "nats_per_pixel": lambda: images.nats_per_pixel(  # not in float32, of which faint images are no multiples
            truth.astype(np.float64) / mean_power, rendered.astype(np.float64) / mean_power, margin
        ),
        "log_correlation": lambda: images.log_correlation(truth, rendered, margin),
    }


def _not_applicable(dataset: Dataset) -> dict[str, str]:
    """Image metrics that say nothing about this kind of dataset, and why."""
    if dataset.looks is not None:
        reason = "the truth is speckled; this score needs an image without speckle"
        return dict.fromkeys(("psnr_db", "psnr_target_db", "ssim", "lpips"), reason)
    reason = "the truth is free of speckle; this score needs a speckled one"
    return dict.fromkeys(("nats_per_pixel", "log_correlation"), reason)


def _points(run: EvaluatedRun, reasons: dict[str, str]) -> dict[str, dict[str, float | None]]:
    """Point metrics against the visible and the whole surface."""
    dataset, points = run.dataset, run.points
    if dataset.truth_mesh is None:
        return _no_points("the dataset has no true mesh to compare with", reasons)
    if len(points) == 0:
        return _no_points("the run reconstructed no points", reasons)
    views = dataset.select("train").views
    surface = visible_surface(read_truth_mesh(dataset.truth_mesh), views)
    if len(views) == 1:
        warn([f"{run.path} was made from one view, from which no shape can be told: its CD and F1 say nothing"])
    return {
        "visible": _flat(point_metrics(points, surface.triangles, surface.samples)),
        "whole": _flat(point_metrics(points, surface.all_triangles, surface.samples_whole)),
    }


def _no_points(reason: str, reasons: dict[str, str]) -> dict[str, dict[str, float | None]]:
    parts = ("visible", "whole")
    reasons.update({f"points.{part}.{name}": reason for part in parts for name in POINT_METRICS})
    return {part: dict.fromkeys(POINT_METRICS) for part in parts}


def _flat(metrics: PointMetrics) -> dict[str, float | None]:
    return {
        "accuracy_m": metrics.accuracy_m,
        "completeness_m": metrics.completeness_m,
        "cd_m": metrics.cd_m,
        "cd_squared_m2": metrics.cd_squared_m2,
        "precision@0.3": metrics.precision[0.3],
        "recall@0.3": metrics.recall[0.3],
        **{f"f1@{threshold}": metrics.f1[threshold] for threshold in THRESHOLDS},
        "count": metrics.count,
    }


def read_truth_mesh(path: Path) -> trimesh.Trimesh:
    """The true mesh of a dataset, exactly as it was written.

    Raises
    ------
    SarsplatError
        If it cannot be read, or has no faces, or holds vertices that are not there or not finite.
    """
    try:
        mesh = read_mesh(path)
    except SarsplatError as error:
        raise SarsplatError(f"the true mesh cannot be used: {error}; restore it or simulate again") from error
    if not np.isfinite(mesh.vertices).all():
        raise SarsplatError(f"the true mesh {path} holds vertices that are not finite; restore it or simulate again")
    return mesh


def _domain(reference_amplitude: float, mean_power: float, margin: int) -> dict[str, Any]:
    """What exactly was compared, so that the figures can be read without this file."""
    return {
        "psnr_ssim_lpips": "amplitude √β⁰ / reference_amplitude (largest of the training set), no clip, data range 1; "
        "per image, averaged; LPIPS-AlexNet v0.1 on 2·amplitude − 1, grey repeated three times",
        "target_mask": f"truth β⁰ above −{images.TARGET_DYNAMIC_DB:g} dB of the maximum of the test set",
        "nats_log_correlation": "power β⁰ / mean_power (of the training set); mean of log S + I/S; correlation of log "
        f"3×3 means per chip, averaged; a margin of {margin} pixels is left out after filtering",
        "points": f"at most one point per {VOXEL} m voxel; accuracy to triangles, completeness from 10⁶ samples; "
        "visible = first hit of a 1 cm ray of a training view",
        "reference_amplitude": reference_amplitude,
        "mean_power": mean_power,
    }
