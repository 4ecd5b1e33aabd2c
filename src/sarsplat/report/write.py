"""Put a report together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sarsplat.data import read_masks, write_bytes
from sarsplat.data.files import plain_os_errors
from sarsplat.data.folders import only_writer
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import Alignment, UndefinedScore, Yardstick, predicted_masks, read_truth_mesh
from sarsplat.reconstruction import AnyRun
from sarsplat.report.azimuths import azimuths_figure
from sarsplat.report.cloud import points_figure
from sarsplat.report.curves import curves_figure
from sarsplat.report.masks import masks_figure
from sarsplat.report.page import Picture, page
from sarsplat.report.solid import meshes_figure
from sarsplat.report.views import evenly, views_figure

_FOLDER = "report"
_VIEWS = 8
_SURFACE_SAMPLES = 60_000
_STILL = Alignment((0.0, 0.0, 0.0), 0.0)


def write_report(run: AnyRun[Any]) -> Path:
    """Write `RUN/report/`: `index.html`, which holds all it shows, and its pictures once more as PNGs.

    Parameters
    ----------
    run : AnyRun
        A reconstruction; its scores are shown if `metrics.json` is there.

    Returns
    -------
    Path
        `RUN/report/index.html`.

    Raises
    ------
    SarsplatError
        If the run's dataset is missing, `RUN/report` is a link, a file cannot be written or another process is writing
        the run.
    """
    refuse_linked_report(run.folder)
    folder = run.folder / _FOLDER
    with only_writer(run.folder):
        with plain_os_errors("write", folder):
            folder.mkdir(exist_ok=True)
        pictures = [_views(run), *_masks(run), _points(run), *_mesh(run)]
        training = [*_curves(run), *_azimuths(run)]
        for picture in (*pictures, *training):
            write_bytes(folder / picture.file, picture.png)
        try:
            html = page(run, pictures, training)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise SarsplatError(
                f"{run.folder / 'metrics.json'} does not contain all scores ({error!r}); write it again with "
                f"`sarsplat evaluate {run.path}`"
            ) from error
        write_bytes(folder / "index.html", html.encode())
    return folder / "index.html"


def refuse_linked_report(run: Path) -> None:
    """Refuse to write a report where a link leads out of the run.

    Raises
    ------
    SarsplatError
        If `RUN/report` is a link.
    """
    folder = run / _FOLDER
    if folder.is_symlink():
        raise SarsplatError(f"{folder} is a link, but a report is only written inside its run; remove the link")


def _views(run: AnyRun[Any]) -> Picture:
    dataset = run.dataset
    splits = [split for split in dataset.splits() if split != "train"] or ["train"]
    items = [index for index, entry in enumerate(dataset.entries) if entry.split in splits]
    chosen = [items[index] for index in evenly(len(items), _VIEWS)]
    truth, views = dataset.power[chosen], [dataset.views[index] for index in chosen]
    speckled = dataset.select(splits[0]).looks is not None
    png = views_figure(
        truth,
        run.render(views),
        views,
        dataset.grid,
        float(dataset.images("train").max()),
        speckled=speckled,
        margin=dataset.score_margin,
    )
    unseen = (
        f"{len(chosen)} of {len(items)} test views, evenly chosen; none of them was trained on."
        if splits != ["train"]
        else "The dataset has no test views, so these are training views."
    )
    what = (
        "The truth has its speckle; the rendering is the expected power, without speckle, so the "
        "difference compares 3×3 means."
        if speckled
        else "Orange: too bright; blue: too dark; what is darker than the pictures show counts as equal."
    )
    text = f"{unseen} Power in decibels, radar at the top, near range first. {what}"
    return Picture("views.png", "Unseen views", text, png)


def _masks(run: AnyRun[Any]) -> list[Picture]:
    """Of the folder that the run was evaluated with."""
    folder = None if (metrics := run.metrics) is None else metrics.get("masks")
    if folder is None:
        return []
    dataset = run.dataset
    masks = read_masks(Path(folder), dataset)
    known = list(masks)
    chosen = [known[index] for index in evenly(len(known), _VIEWS)]
    entries = tuple(dataset.entries[index] for index in chosen)
    looks = dataset.select(entries[0].split).looks
    images = replace(dataset, power=dataset.power[chosen], entries=entries, looks=looks, clean_tests=False)
    try:
        predicted = predicted_masks(run, images, run.render(images.views))
    except UndefinedScore:  # the evaluation gives the reason
        return []
    peak = float(dataset.images("train").max())
    png = masks_figure(images.power, np.stack([masks[i] for i in chosen]), predicted, images.views, dataset.grid, peak)
    text = (
        f"{len(chosen)} of {len(known)} test views with true masks, evenly chosen. The predicted outlines are those of "
        "the learned geometry, at the whole pixel where the rendered image suits its chip best."
    )
    return [Picture("masks.png", "Target and shadow", text, png)]


def _points(run: AnyRun[Any]) -> Picture:
    _, farthest_m, _ = Yardstick.of(run.dataset.grid).thresholds_m
    file, motion = _truth(run)
    points = motion.moved(run.points)
    if file is None:
        text = "Where the rays of the training views return, from three sides. No true surface is known here."
        return Picture("points.png", "Points", text, points_figure(points, None, farthest_m))
    import trimesh

    mesh = read_truth_mesh(file)
    surface, _ = trimesh.sample.sample_surface(mesh, _SURFACE_SAMPLES, seed=0)
    text = "The reconstruction beside the true surface, which it never saw: images and their views were all it had."
    if motion != _STILL:
        text += f" To compare them, it was {motion}."
    return Picture("points.png", "Points", text, points_figure(points, np.asarray(surface), farthest_m))


def _truth(run: AnyRun[Any]) -> tuple[Path | None, Alignment]:
    """The file of the true surface, and the motion that brought the points onto it."""
    file = run.dataset.truth_mesh
    if (metrics := run.metrics) is None or "truth" not in metrics:
        return file, _STILL
    truth = metrics["truth"]
    if truth["mesh"] is not None:
        file = Path(truth["mesh"])
    return file, Alignment(truth.get("shift_m", _STILL.shift_m), truth.get("heading_deg", _STILL.heading_deg))


def _mesh(run: AnyRun[Any]) -> list[Picture]:
    truth, motion = _truth(run)
    try:
        mesh = run.mesh()
    except SarsplatError:  # the evaluation gives the reason
        return []
    if len(mesh.faces) == 0:
        return []
    mesh.vertices = motion.moved(mesh.vertices)
    text = "The surface through the points, shaded; `sarsplat export` writes it. It is open where no view looked"
    beside = "; the true surface is whole." if truth else "."
    return [Picture("mesh.png", "Mesh", text + beside, meshes_figure(mesh, read_truth_mesh(truth) if truth else None))]


def _curves(run: AnyRun[Any]) -> list[Picture]:
    history = run.history
    if not history:
        return []
    name, unit = run.loss_title
    text = f"The loss is the {name}, averaged over the training views."
    return [Picture("curves.png", "Training", text, curves_figure(history, unit))]


def _azimuths(run: AnyRun[Any]) -> list[Picture]:
    if not run.azimuth_offset_deg.any():
        return []
    train = run.dataset.select("train")
    std = np.array([entry.azimuth_std_deg for entry in train.entries])
    text = (
        "By how much the training found each training image's azimuth to differ from its label. "
        "The band is ± one standard deviation, as the dataset gives it."
    )
    figure = azimuths_figure([view.azimuth_deg for view in train.views], run.azimuth_offset_deg, std)
    return [Picture("azimuths.png", "Azimuth corrections", text, figure)]
