"""`sarsplat evaluate`: score a run."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sarsplat.cli import console
from sarsplat.cli.arguments import OptionalFile, OptionalFolder, RunOrFile, is_gaussians
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    from sarsplat.runs import Run


def evaluate(
    run: RunOrFile,
    *,
    mesh: OptionalFile = None,
    align: Literal["none", "rigid"] = "none",
    masks: OptionalFolder = None,
    lpips_weights: OptionalFolder = None,
    dataset: OptionalFolder = None,
    no_points: bool = False,
    no_report: bool = False,
) -> None:
    """Score a run on unseen views and against the true surface, and write its report.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`, or a PLY or .splat file of Gaussians, which is scored on --dataset, or
        without images against --mesh; its scores are printed only.
    mesh
        A model of the target to hold the points against, metres, in the frame of the views (x towards the nose, z up,
        ground at z = 0); without it, the dataset's true mesh, if it has one.
    align
        rigid: bring the points onto the visible surface first, by at most three resolution cells and 5° about the
        vertical; of a target aloft, about all axes. Where a measured target stands in its images, and how an assumed
        rotation turned it, says nothing about its reconstruction.
    masks
        Folder of true masks, grey PNGs with the names of the images (T72/17deg/hb03333.png): 0 clutter, 1 target,
        2 shadow; of MSTAR chips in the orientation as published, of others in that of the images.
    lpips_weights
        Folder of the LPIPS weights (default: SARSPLAT_LPIPS_WEIGHTS); without weights, LPIPS is skipped.
    dataset
        Dataset to score a PLY file on; of a run, where its own is now, if that has moved.
    no_points
        Score images only, as points and mesh take most of the time; their earlier scores stay.
    no_report
        Write the scores only; a report that is there stays as it is.
    """
    from sarsplat.progress import tally

    with tally() as spent:
        from sarsplat.evaluation import evaluate_run
        from sarsplat.report import write_report

        done = _run(run, dataset, mesh)
        spent.count("loading")
        metrics = evaluate_run(
            done, mesh=mesh, alignment=align, masks=masks, lpips_weights=lpips_weights, points=not no_points
        )
        _show(metrics, done)
        if no_points and any(value is not None for part in metrics["points"].values() for value in part.values()):
            mesh_was = metrics["truth"].get("mesh")
            against = "" if mesh_was is None else f", against {mesh_was}"
            console.say(f"points and mesh: their scores are those of the earlier evaluation{against}")
        page = None if done.path is None or no_report else write_report(done)
        spent.count("tables" if page is None else "report")
    console.say(f"time: {spent}")
    if page is not None:
        console.finish(f"{run / 'metrics.json'} and {page}", f"open {page} in a browser")
    elif done.path is not None:
        console.finish(f"{run / 'metrics.json'}", f"sarsplat report {shlex.quote(str(run))}")


def _run(run: Path, dataset: Path | None, mesh: Path | None) -> "Run":
    """Return the run in a folder, or that of the Gaussians in a file."""
    from sarsplat.data import read_dataset
    from sarsplat.report.write import refuse_linked_report
    from sarsplat.runs import Run

    if is_gaussians(run):
        return _of_gaussians(run, dataset, mesh)
    done = Run.load(run, dataset=None if dataset is None else read_dataset(dataset))
    refuse_linked_report(run)
    return done


def _show(metrics: Mapping[str, Any], run: "Run") -> None:
    """Print the table of scores, with notes and warnings."""
    from sarsplat.evaluation import NOT_THE_SAME_EXPERIMENT, Yardstick, comparison, metrics_table, paper_beside

    paper = paper_beside(run.dataset)
    yardstick = Yardstick(metrics["parameters"]["yardstick_m"])
    console.show(metrics_table(comparison(metrics, paper), yardstick, NOT_THE_SAME_EXPERIMENT if paper else None))
    if (capon := metrics.get("capon")) is not None:
        own, other = metrics["points"]["visible"], capon["visible"]
        keys = [key for key in other if key.startswith("f1@") and other[key] is not None and own[key] is not None]
        pairs = ", ".join(f"{key.replace('f1', 'F1')} {own[key]:.3f} (Capon {other[key]:.3f})" for key in keys)
        console.say(f"points beside those of Capon's method, pixel by pixel over 3 × 3: {pairs or 'it found none'}")
    console.warn_if_beaten(metrics)


def _of_gaussians(file: Path, dataset: Path | None, mesh: Path | None) -> "Run":
    """Return the Gaussians of a file as a run of the dataset, or else of images rendered from all sides."""
    from sarsplat.data import Dataset, SarImage, read_dataset, read_gaussians_ply
    from sarsplat.runs import Run

    gaussians = read_gaussians_ply(file)
    if dataset is not None:
        scored = read_dataset(dataset)
        if scored.ground:
            console.warn(
                f"the images of {dataset} show ground, and {file} holds Gaussians without any, so that scores of "
                "images are low or missing; evaluate the run that it was exported from"
            )
        return Run.from_gaussians(gaussians, dataset=scored)
    if mesh is None:
        raise SarsplatError(f"{file} holds Gaussians without images; give --dataset DIR, or --mesh FILE for the points")
    alone = Run.from_gaussians(gaussians)
    views = alone.snapshot.views
    images = [SarImage(image, view, alone.grid) for view, image in zip(views, alone.render(views), strict=True)]
    return Run.from_gaussians(gaussians, dataset=Dataset.from_images(images, target=file.stem))
