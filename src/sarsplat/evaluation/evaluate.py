"""Score a run: everything that `metrics.json` holds."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sarsplat.data import write_json
from sarsplat.data.folders import only_writer
from sarsplat.data.plausible import warn
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.baselines import baseline_scores
from sarsplat.evaluation.images import UndefinedScore
from sarsplat.evaluation.lpips import Lpips, lpips_weights
from sarsplat.evaluation.metrics import (
    IMAGE_METRICS,
    METRICS,
    POINT_METRICS,
    RUN_METRICS,
    EvaluatedRun,
    ImagePair,
    compute_all,
    image_parameters,
)
from sarsplat.evaluation.points import PointMetrics, point_metrics
from sarsplat.evaluation.surface import read_truth_mesh, visible_surface

if TYPE_CHECKING:
    import trimesh

MESH_SAMPLES = 100_000
"""Points of a mesh that are compared with the truth."""


def evaluate_run(run: EvaluatedRun, *, lpips_weights: str | Path | None = None) -> dict[str, Any]:
    """Score a run on every test set, its points and mesh against the true surface; write `metrics.json`.

    Parameters
    ----------
    run : EvaluatedRun
        A finished run. If it has a folder, its `metrics.json` is written, whole or not at all.
    lpips_weights : pathlib.Path, optional
        Folder of the LPIPS weights; without it the environment variable SARSPLAT_LPIPS_WEIGHTS, without that no LPIPS.

    Returns
    -------
    dict
        The content of `metrics.json`: `images.<set>.<metric>`, `points.{visible, whole}.<metric>`, `mesh` (the
        same of points on the mesh), `baselines` (what methods without a third dimension score on speckled images with
        ground), `time_s`, `seed`, `definitions` (of every metric), `parameters` (what they refer to) and `reasons`: for
        every metric that is None, its dotted key and why. Without test images `images` is empty.

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

    reasons: dict[str, str] = {}
    if not test_sets:
        reasons["images"] = "the dataset has no test images, so nothing is unseen; simulate it with --test-azimuth"
    images: dict[str, dict[str, float | None]] = {}
    for split in test_sets:
        rendered = run.render(dataset.select(split).views)
        pair = ImagePair(dataset.images(split), rendered, **parameters, network=network)
        images[split] = compute_all(IMAGE_METRICS, dataset, pair, f"images.{split}.", reasons)
    return {
        "images": images,
        **_surfaces(run, reasons),
        "baselines": baseline_scores(dataset, reasons) if dataset.looks is not None and dataset.ground else None,
        **compute_all(RUN_METRICS, dataset, run, "", reasons),
        "seed": run.seed,
        "definitions": {metric.key: metric.definition for metric in METRICS},
        "parameters": parameters,
        "reasons": reasons,
    }


def _surfaces(run: EvaluatedRun, reasons: dict[str, str]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Scores of the points and of the mesh against the visible and the whole surface."""
    dataset = run.dataset
    clouds: dict[str, Float[np.ndarray, "p 3"]] = {"points": run.points, "mesh": np.empty((0, 3))}
    surface = None
    if dataset.truth_mesh is not None and len(run.points):
        clouds["mesh"] = _points_on(run.mesh())
        views = dataset.select("train").views
        surface = visible_surface(read_truth_mesh(dataset.truth_mesh), views)
        if len(views) == 1:
            name = run.path or "the run"
            warn([f"{name} was made from one view, which cannot determine the shape, so its CD and F1 mean nothing"])
    scores: dict[str, dict[str, dict[str, float | None]]] = {}
    for kind, points in clouds.items():
        measured: dict[str, PointMetrics | UndefinedScore]
        if surface is None or len(points) == 0:
            lacks = "no points" if len(run.points) == 0 else "no mesh"
            measured = dict.fromkeys(("visible", "whole"), UndefinedScore(f"the run reconstructed {lacks}"))
        else:
            measured = {
                "visible": point_metrics(points, surface.triangles, surface.samples),
                "whole": point_metrics(points, surface.all_triangles, surface.samples_whole),
            }
        scores[kind] = {
            part: compute_all(POINT_METRICS, dataset, values, f"{kind}.{part}.", reasons)
            for part, values in measured.items()
        }
    return scores


def _points_on(mesh: trimesh.Trimesh) -> Float[np.ndarray, "p 3"]:
    """Random points of a mesh, spread by area; none if it has no faces."""
    from trimesh.sample import sample_surface

    return np.asarray(sample_surface(mesh, MESH_SAMPLES, seed=0)[0]) if len(mesh.faces) else np.empty((0, 3))
