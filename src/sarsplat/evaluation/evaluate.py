"""Score a run: everything that `metrics.json` holds."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from sarsplat.data import write_json
from sarsplat.data.folders import only_writer
from sarsplat.data.plausible import warn
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.baselines import baseline_scores
from sarsplat.evaluation.images import UndefinedScore
from sarsplat.evaluation.lpips import Lpips, lpips_weights
from sarsplat.evaluation.metrics import (
    IMAGE_METRICS,
    RUN_METRICS,
    EvaluatedRun,
    ImagePair,
    all_metrics,
    compute_all,
    image_parameters,
    metrics_of_points,
)
from sarsplat.evaluation.points import PointMetrics, Yardstick, point_metrics
from sarsplat.evaluation.surface import read_truth_mesh, visible_surface


def evaluate_run(run: EvaluatedRun, *, lpips_weights: str | Path | None = None) -> dict[str, Any]:
    """Score a run on every test set of its dataset, and its points against the true surface; write `metrics.json`.

    Parameters
    ----------
    run : EvaluatedRun
        A finished run. If it has a folder, its `metrics.json` is written, whole or not at all.
    lpips_weights : pathlib.Path, optional
        Folder of the LPIPS weights; without it the environment variable SARSPLAT_LPIPS_WEIGHTS, without that no LPIPS.

    Returns
    -------
    dict
        The content of `metrics.json`: `images.<set>.<metric>`, `points.{visible, whole}.<metric>`, `baselines` (what
        methods without a third dimension score on speckled images with ground), `time_s`, `seed`, `definitions` (of
        every metric), `parameters` (what they refer to) and `reasons`: for every metric that is None, its dotted key
        and why. Without test images `images` is empty.

    Raises
    ------
    SarsplatError
        If there is nothing to score (no test images, and no true mesh or no points), the training images are black, a
        rendered image is unsound, the LPIPS weights are given but unusable, the true mesh cannot be read, or another
        process is writing the run.

    Warns
    -----
    SarsplatWarning
        If points of a run from one training view are scored.
    """
    with nullcontext() if run.path is None else only_writer(run.path):
        metrics = _evaluate(run, None if lpips_weights is None else Path(lpips_weights))
        if run.path is not None:
            write_json(run.path / "metrics.json", metrics)
    return metrics


def _evaluate(run: EvaluatedRun, weights_dir: Path | None) -> dict[str, Any]:
    dataset = run.dataset
    test_sets = [split for split in dataset.splits() if split != "train"]
    if not test_sets and (dataset.truth_mesh is None or len(run.points) == 0):
        lacks = "no true mesh" if dataset.truth_mesh is None else "the run no points"
        raise SarsplatError(
            f"nothing can be scored: {dataset} has no test images and {lacks}; simulate it with --test-azimuth"
        )
    weights = lpips_weights(weights_dir)
    network = None if weights is None else Lpips(weights)
    parameters = image_parameters(dataset)
    if not parameters["reference_amplitude"] > 0:
        raise SarsplatError(f"the training images of {dataset} are black everywhere; simulate or import them again")

    yardstick = Yardstick.of(dataset.grid)
    reasons: dict[str, str] = {}
    speckled_tests = dataset.looks is not None and not dataset.clean_tests
    if not test_sets:
        reasons["images"] = "the dataset has no test images, so nothing is unseen; simulate it with --test-azimuth"
    images: dict[str, dict[str, float | None]] = {}
    for split in test_sets:
        tested = dataset.select(split)
        pair = ImagePair(tested.power, run.render(tested.views), **parameters, network=network)
        images[split] = compute_all(IMAGE_METRICS, tested, pair, f"images.{split}.", reasons)
    return {
        "images": images,
        "points": _points(run, yardstick, reasons),
        "baselines": baseline_scores(dataset, reasons) if speckled_tests and dataset.ground else None,
        **compute_all(RUN_METRICS, dataset, run, "", reasons),
        "seed": run.seed,
        "definitions": {metric.key: metric.definition for metric in all_metrics(yardstick)},
        "parameters": {**parameters, "yardstick_m": yardstick.cell_m},
        "reasons": reasons,
    }


def _points(run: EvaluatedRun, yardstick: Yardstick, reasons: dict[str, str]) -> dict[str, dict[str, float | None]]:
    """Point metrics against the visible and the whole surface."""
    dataset, points = run.dataset, run.points
    measured: dict[str, PointMetrics | UndefinedScore]
    if dataset.truth_mesh is None or len(points) == 0:
        measured = dict.fromkeys(("visible", "whole"), UndefinedScore("the run reconstructed no points"))
    else:
        views = dataset.select("train").views
        surface = visible_surface(read_truth_mesh(dataset.truth_mesh), views, ray_spacing=yardstick.ray_spacing_m)
        if len(views) == 1:
            name = run.path or "the run"
            warn([f"{name} was made from one view, which cannot determine the shape, so its CD and F1 mean nothing"])
        measured = {
            "visible": point_metrics(points, surface.triangles, surface.samples, yardstick),
            "whole": point_metrics(points, surface.all_triangles, surface.samples_whole, yardstick),
        }
    return {
        part: compute_all(metrics_of_points(yardstick), dataset, values, f"points.{part}.", reasons)
        for part, values in measured.items()
    }
