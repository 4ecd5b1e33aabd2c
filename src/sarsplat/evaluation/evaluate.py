"""Score a run: all contents of `metrics.json`."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float64

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset, Mask, read_masks
from sarsplat.data.files import sha256_of
from sarsplat.data.folders import only_writer
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.azimuths import azimuth_errors
from sarsplat.evaluation.baselines import baseline_scores, levelled_average
from sarsplat.evaluation.capon import capon_points
from sarsplat.evaluation.images import MaskPair, Stack, UndefinedScore, predicted_masks
from sarsplat.evaluation.left_open import missing
from sarsplat.evaluation.lpips import Lpips, lpips_weights
from sarsplat.evaluation.metrics import (
    AZIMUTH_METRICS,
    IMAGE_METRICS,
    LOCATABLE,
    MASK_METRICS,
    RUN_METRICS,
    ImagePair,
    all_metrics,
    compute_all,
    image_parameters,
    leading_metric,
    metrics_of_points,
)
from sarsplat.evaluation.points import MOST_TURNED_DEG, Cloud, PointMetrics, Yardstick, align, side_by_side
from sarsplat.evaluation.surface import imaged_alone, of_stacks, read_truth_mesh, visible_surface
from sarsplat.examination.plausible import warn, weakest_direction
from sarsplat.extras import Trimesh
from sarsplat.geometry import View
from sarsplat.progress import Reporter, progress
from sarsplat.runs import Run
from sarsplat.runs.run_folder import left_open
from sarsplat.scenes.placement import shown_in
from sarsplat.scenes.surface_samples import blocks_of_samples

_BATCH = 8  # views rendered at once
_MESH_SAMPLES = 100_000

# Durations of mesh, visible surface and distances for the progress bar, relative to a test view with its scores; that
# of the distances does not grow with the images, and holds for 128² pixels.
_MESH, _SURFACE, _DISTANCES, _REFERENCE_PIXELS = 40, 80, 30, 128**2


@checks_arguments
def evaluate_run(
    run: Run,
    *,
    mesh: str | Path | None = None,
    alignment: Literal["none", "rigid"] = "none",
    masks: str | Path | None = None,
    lpips_weights: str | Path | None = None,
    points: bool = True,
    quiet: bool = False,
) -> dict[str, Any]:
    """Score a run on every test set, and its points and mesh against the true surface; write `metrics.json`.

    Parameters
    ----------
    run : Run
        A finished run. If it has a folder, its `metrics.json` is written, whole or not at all.
    mesh : pathlib.Path, optional
        A model of the target, m, in the frame of the views, instead of the dataset's true mesh.
    alignment : {"none", "rigid"}
        Align points and mesh with the visible surface first, by a small rigid motion (`align`).
    masks : pathlib.Path, optional
        Folder of true masks, a PNG for each image (`read_masks`): target and shadow are then scored as well.
    lpips_weights : pathlib.Path, optional
        Folder of the LPIPS weights; without it the environment variable SARSPLAT_LPIPS_WEIGHTS, without that no LPIPS.
    points : bool
        Score points and mesh, which takes most of the time. If False, their earlier scores stay.
    quiet : bool
        Show no progress.

    Returns
    -------
    dict
        The content of `metrics.json`: `images.<set>.<metric>`, `by_image` (for each set, the leading metric and its
        values for the images, in order), `points.{visible, whole}.<metric>`, `mesh` (the same for points on the
        mesh), for interferometric stacks `capon` (the same for Capon's method, between the heights of the run's points;
        the true surface then includes level ground if images show it), `baselines` (scores of 2D methods on speckled
        images with ground), `truth` (the given mesh, and the motion of the alignment), `masks` (the given folder),
        `time_s`, `seed`, `method`, `missing` (places of objects that images show and points lack, m), `definitions` (of
        all metrics), `parameters` (of the metrics) and `reasons` (dotted key of each metric that is None, and why).
        Without test images `images` is empty.

    Raises
    ------
    SarsplatError
        If there are no test images and points are left out, a mesh or an alignment is given with `points=False`,
        the training images are black, a rendered image is unsound, given LPIPS weights or masks
        are unusable, the true mesh cannot be read, or another process is writing the run.

    Warns
    -----
    SarsplatWarning
        If the training is not finished, or if points are scored whose training views cannot determine the shape.
    """
    with nullcontext() if run.path is None else only_writer(run.path):
        dataset = run.dataset if mesh is None else replace(run.dataset, truth_mesh=Path(mesh))
        folder = None if masks is None else Path(masks)
        weights = None if lpips_weights is None else Path(lpips_weights)
        if not points and (mesh is not None or alignment == "rigid"):
            raise SarsplatError("points are left out, but a mesh or an alignment is given for them; leave that out")
        if not run.state.trained:
            warn([f"{run.path or 'the run'} is {run.state}: the scores are provisional"])
        metrics = _evaluate(run, dataset, alignment, folder, weights, points, quiet)
        if not points and run.metrics is not None and _same_truth(run.metrics, run.dataset):
            metrics |= _of_points(run.metrics, metrics["reasons"])
        run.keep(metrics)
    return metrics


def _same_truth(before: Mapping[str, Any], dataset: Dataset) -> bool:
    """Return True if earlier scores of points are complete and their true mesh is unchanged."""
    if not all(before[kind].keys() == {"visible", "whole"} for kind in ("points", "mesh")):
        return False
    truth = before.get("truth", {})
    mesh = Path(truth["mesh"]) if truth.get("mesh") else dataset.truth_mesh
    return mesh is not None and mesh.is_file() and truth.get("sha256") == sha256_of(mesh)


def _of_points(before: Mapping[str, Any], reasons: dict[str, str]) -> dict[str, Any]:
    """Return the scores of points in earlier metrics; replaces their `reasons`."""
    kinds = ("points", "mesh", "capon")
    for key in [key for key in reasons if key.partition(".")[0] in kinds]:
        del reasons[key]
    reasons |= {key: why for key, why in before["reasons"].items() if key.partition(".")[0] in kinds}
    return {kind: before[kind] for kind in (*kinds, "truth") if kind in before}


def _evaluate(
    run: Run,
    dataset: Dataset,
    alignment: str,
    masks_dir: Path | None,
    weights_dir: Path | None,
    points: bool,
    quiet: bool,
) -> dict[str, Any]:
    if alignment == "rigid" and dataset.truth_mesh is None:
        raise SarsplatError(f"{dataset} has no true mesh to align the points to; give one as `mesh`")
    test_sets = [split for split in dataset.splits() if split != "train"]
    if not test_sets and not points:
        raise SarsplatError(f"nothing can be scored: {dataset} has no test images, and points are left out; score them")
    true_mesh = read_truth_mesh(dataset.truth_mesh) if points and dataset.truth_mesh is not None else None
    if true_mesh is not None and not any(shown_in(true_mesh, dataset.views, dataset.grid)):
        where = ", ".join(f"{value:.10g}" for value in true_mesh.bounds.mean(axis=0))
        raise SarsplatError(
            f"the true mesh {dataset.truth_mesh} is centred on ({where}) m, outside all images; subtract the "
            "images' offset from its coordinates"
        )
    weights = lpips_weights(weights_dir)
    network = None if weights is None else Lpips(weights)
    parameters = image_parameters(dataset)
    if not parameters["reference_amplitude"] > 0:
        raise SarsplatError(f"the training images of {dataset} are black everywhere; simulate or import them again")
    masks = {} if masks_dir is None else read_masks(masks_dir, dataset)
    yardstick = Yardstick.of(dataset.grid)
    reasons: dict[str, str] = {}
    speckled_tests = dataset.looks is not None and not dataset.clean_tests
    if not test_sets:
        reasons["images"] = "the dataset has no test images, so nothing is unseen; add views of other splits"
    images: dict[str, dict[str, float | None]] = {}
    by_image: dict[str, dict[str, Any]] = {}
    errors: dict[str, Sequence[Float64[np.ndarray, " v"] | UndefinedScore]] = {}
    tests = sum(len(dataset.images(split)) for split in test_sets)
    surfaced = points and dataset.truth_mesh is not None
    steps = tests + len(masks) + (_MESH + _SURFACE + 4 * _distances(dataset) if surfaced else 0)
    with progress(f"evaluate {run.path or dataset.target}", steps, quiet) as shown:
        for split in test_sets:
            tested = dataset.select(split)
            pair = ImagePair(tested.power, _rendered(run, run.views_of(tested), shown), **parameters, network=network)
            images[split] = compute_all(IMAGE_METRICS, tested, pair, f"images.{split}.", reasons)
            by_image[split] = _by_image(tested, pair)
            shown.advance(0, "scores of the test images")
            numbers = [index for index, entry in enumerate(dataset.entries) if entry.split == split]
            compared = _masks(run, tested, pair.rendered, [masks.get(index) for index in numbers], shown)
            images[split] |= compute_all(MASK_METRICS, tested, compared, f"images.{split}.", reasons)
            errors[split] = _azimuth_errors(run, dataset, split, shown)
            images[split] |= compute_all(AZIMUTH_METRICS, tested, errors[split][0], f"images.{split}.", reasons)
        surfaces = _surfaces(run, dataset, true_mesh, points, alignment == "rigid", yardstick, reasons, shown)
        shown.update(steps)
        lacking = _missing(run, reasons, shown)
    beside = baseline_scores(dataset, reasons) if speckled_tests and dataset.ground else None
    for split, others in (beside or {}).items():
        where = f"baselines.{split}.rotated_average."
        others["rotated_average"] |= compute_all(AZIMUTH_METRICS, dataset, errors[split][1], where, reasons)
    return {
        "images": images,
        "by_image": by_image,
        **surfaces,
        "masks": None if masks_dir is None else str(masks_dir.resolve()),
        "baselines": beside,
        **compute_all(RUN_METRICS, dataset, run, "", reasons),
        "missing": lacking,
        "seed": run.seed,
        "method": run.method,
        "definitions": {metric.key: metric.definition for metric in all_metrics(yardstick)},
        "parameters": {**parameters, "yardstick_m": yardstick.cell_m},
        "reasons": reasons,
    }


def _missing(run: Run, reasons: dict[str, str], shown: Reporter) -> list[list[float]] | None:
    """Find places of objects that images show and points lack, m; note them."""
    try:
        places = np.round(missing(run), 2).tolist()
    except UndefinedScore as undefined:
        reasons["missing"] = str(undefined)
        return None
    for name, text in left_open({"missing": places}).items():
        shown.note(f"{name}: {text}")
    return places


def _rendered(run: Run, views: Sequence[View], shown: Reporter) -> Stack:
    """β⁰ of the views, linear power, float32 [V, rows, columns]."""
    images = []
    for first in range(0, len(views), _BATCH):
        batch = views[first : first + _BATCH]
        images.append(run.render(batch))
        shown.advance(len(batch), "test views")
    return np.concatenate(images)


def _azimuth_errors(
    run: Run, dataset: Dataset, split: str, shown: Reporter
) -> Sequence[Float64[np.ndarray, " v"] | UndefinedScore]:
    """Errors of the azimuths that are found by the run and by the rotated average, degrees, in the hardest set."""
    tested = dataset.select(split)
    try:
        if split != (hardest := _hardest(dataset)):  # each set would take a seventh of an evaluation
            raise UndefinedScore(
                f"azimuths are found in {hardest} alone, the set farthest from the training's grazing angles"
            )
        if not LOCATABLE.met(tested):
            raise UndefinedScore(LOCATABLE.otherwise)
        shown.advance(0, "azimuths of the test images")
        return azimuth_errors(run, tested, [run.render, partial(levelled_average, dataset.select("train"))])
    except UndefinedScore as undefined:
        return [undefined] * 2


def _hardest(dataset: Dataset) -> str:
    """Return the test set whose mean grazing angle is farthest from the training's."""
    mean = {name: np.mean([view.grazing_deg for view in dataset.select(name).views]) for name in dataset.splits()}
    return max((name for name in mean if name != "train"), key=lambda name: abs(mean[name] - mean["train"]))


def _by_image(tested: Dataset, pair: ImagePair) -> dict[str, Any]:
    """The leading metric of each single image; None where it is undefined."""
    metric = leading_metric(tested)
    singles = (replace(pair, truth=a[None], rendered=b[None]) for a, b in zip(pair.truth, pair.rendered, strict=True))
    scores = [compute_all([metric], tested, single, "", {})[metric.key] for single in singles]
    return {"metric": metric.key, "scores": scores}


def _masks(
    run: Run, tested: Dataset, rendered: Stack, masks: Sequence[Mask | None], shown: Reporter
) -> MaskPair | UndefinedScore:
    """True and predicted masks of the images of a test set that have a true mask."""
    masked = [index for index, mask in enumerate(masks) if mask is not None]
    if not masked:
        return UndefinedScore("no true masks; give their folder as `masks`")
    try:
        predicted = predicted_masks(run, tested.take(masked), rendered[masked])
    except UndefinedScore as undefined:
        return undefined
    shown.advance(len(masked), "masks of the test views")
    return MaskPair(np.stack([mask for mask in masks if mask is not None]), predicted)


def _surfaces(
    run: Run,
    dataset: Dataset,
    true_mesh: Trimesh | None,
    scored: bool,
    aligned: bool,
    yardstick: Yardstick,
    reasons: dict[str, str],
    shown: Reporter,
) -> dict[str, Any]:
    """Score points and mesh against the visible and the whole surface; `truth` describes the surface."""
    clouds: dict[str, Float[np.ndarray, "p 3"]] = dict.fromkeys(("points", "mesh"), np.empty((0, 3)))
    parts: dict[str, tuple[Float64[np.ndarray, "t 3 3"], Float64[np.ndarray, "s 3"]] | None]
    parts = dict.fromkeys(("visible", "whole"))
    given = dataset.truth_mesh != run.dataset.truth_mesh
    truth: dict[str, Any] = {"mesh": str(dataset.truth_mesh.resolve()) if given and dataset.truth_mesh else None}
    normals: dict[str, Float[np.ndarray, "p 3"]] = {}
    lacks = dict.fromkeys(clouds, "the run reconstructed no points" if scored else "points were left out")
    if scored:
        if run.path is not None and run.state.trained and not run.state.has_results:
            run.write_results()  # takes long: kept
        clouds["points"] = run.points
    if dataset.truth_mesh is not None and true_mesh is not None and len(clouds["points"]):
        normals["points"] = run.normals
        clouds["mesh"], normals["mesh"], lacks["mesh"] = _points_on_mesh(run)
        shown.advance(_MESH, "surface: mesh")
        truth["sha256"] = sha256_of(dataset.truth_mesh)
        views = dataset.select("train").views
        stacks = dataset.interferometric or dataset.polarimetric
        surface = visible_surface(
            of_stacks(true_mesh, dataset) if stacks else true_mesh,
            views,
            ray_spacing=yardstick.ray_spacing_m,
            advanced=_advancing(shown, _SURFACE, "surface: what the views see"),
        )
        if stacks:
            surface = imaged_alone(surface, dataset)
        if dataset.interferometric:
            low, high = run.points[:, 2].min(), run.points[:, 2].max()
            clouds["capon"] = capon_points(dataset, float(low), float(high))
            lacks["capon"] = "Capon's method found no peaks"
        elif weakest_direction(views).undetermined:
            name = run.path or "the run"
            warn([f"{name} was made from views that cannot determine the shape, so its CD and F1 mean nothing"])
        if aligned:
            motion = align(clouds["points"], surface.samples, yardstick.cell_m, aloft=views[0].aloft)
            limits = f"at most {motion.farthest_m:.2g} m along each axis and {MOST_TURNED_DEG:g}°"
            shown.note(f"to align them with {dataset.truth_mesh}, points were {motion} ({limits})")
            if motion.at_limit:
                warn([f"points were {motion}, which is as far as they may be; bring the mesh nearer to the target"])
            for kind, directions in normals.items():
                normals[kind] = motion.moved(clouds[kind] + directions) - motion.moved(clouds[kind])
            clouds = {kind: motion.moved(points) for kind, points in clouds.items()}
            truth |= {"shift_m": motion.shift_m, "heading_deg": motion.heading_deg}
            if views[0].aloft:
                truth["tilts_deg"] = motion.tilts_deg
        parts["visible"] = surface.triangles, side_by_side(surface.samples)
        parts["whole"] = surface.all_triangles, side_by_side(surface.samples_whole)
    scores: dict[str, dict[str, dict[str, float | None]]] = {}
    for kind, points in clouds.items():
        scores[kind], cloud = {}, Cloud(points, yardstick, normals.get(kind)) if len(points) else None
        for part, surfaces in parts.items():
            measured: PointMetrics | UndefinedScore
            if surfaces is None or cloud is None:
                measured = UndefinedScore(lacks[kind])
            else:
                work = f"distances: {kind} from the {part} surface"
                measured = cloud.scores(*surfaces, _advancing(shown, _distances(dataset), work))
            scores[kind][part] = compute_all(
                metrics_of_points(yardstick), dataset, measured, f"{kind}.{part}.", reasons
            )
    return {**scores, "truth": truth}


def _distances(dataset: Dataset) -> int:
    """Progress steps of the distances from one part of the surface."""
    return max(1, round(_DISTANCES * _REFERENCE_PIXELS / (dataset.grid.rows * dataset.grid.columns)))


def _advancing(shown: Reporter, steps: int, work: str) -> Callable[[float], None]:
    """Return a function that reports a share of the work as steps."""
    reported = 0.0

    def advance(share: float) -> None:
        nonlocal reported
        shown.advance(steps * (share - reported), work)
        reported = share

    return advance


def _points_on_mesh(run: Run) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"], str]:
    """Random points of a run's mesh, uniform by area, with normals and ""; or none and the reason."""
    none = np.empty((0, 3))
    try:
        mesh = run.mesh()
    except SarsplatError as error:
        return none, none, str(error)
    if len(mesh.faces) == 0:
        return none, none, "the points make no surface"
    blocks = blocks_of_samples(mesh, _MESH_SAMPLES, np.random.default_rng(0))
    places, faces = zip(*((places.T, faces) for _, places, faces in blocks), strict=True)
    return np.concatenate(places), mesh.face_normals[np.concatenate(faces)], ""
