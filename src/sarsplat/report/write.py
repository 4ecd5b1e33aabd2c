"""Assemble and write a report."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sarsplat.arguments import checks_arguments
from sarsplat.data import write_bytes
from sarsplat.data.files import plain_os_errors
from sarsplat.data.folders import only_writer
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import Alignment, Yardstick, read_truth_mesh
from sarsplat.progress import progress
from sarsplat.report.boards import mesh_boards, point_boards
from sarsplat.report.curves import azimuths_figure, curves_figure
from sarsplat.report.figure import Figure
from sarsplat.report.page import page
from sarsplat.report.stacks import PAULI, brightest_layover, pauli_figure, phases_figure, slice_figure
from sarsplat.report.views import chosen_views, masks_figure, unseen_figure
from sarsplat.report.widget import widget
from sarsplat.runs import Run
from sarsplat.scenes.surface_samples import surface_samples

_FOLDER = "report"

_SURFACE_SAMPLES = 200_000
_STILL = Alignment((0.0, 0.0, 0.0), 0.0)


@checks_arguments
def write_report(run: Run, out: str | Path | None = None, *, quiet: bool = False) -> Path:
    """Write `RUN/report/index.html`, or another file: one page that holds all it shows and needs no network.

    Parameters
    ----------
    run : Run
        A reconstruction; its scores are shown if it was evaluated.
    out : str or Path, optional
        The page, such as `target.html`; a run in memory needs one.
    quiet : bool
        Show no progress.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    SarsplatError
        If the run's dataset is missing, it is in memory and `out` is not given, `RUN/report` is a link, a file cannot
        be written or another process is writing the run.
    """
    if out is None:
        refuse_linked_report(run.folder)
    path = run.folder / _FOLDER / "index.html" if out is None else Path(out)
    if path.is_dir():
        raise SarsplatError(f"{path} is a folder; give the name of the page, such as {path / 'report.html'}")
    with only_writer(run.folder) if out is None else nullcontext():
        html = _html(run, quiet)
        with plain_os_errors("write", path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, html)
    return path


def _html(run: Run, quiet: bool) -> bytes:
    with scores_expected(run):
        chosen = chosen_views(run.dataset, run.metrics)
    figures, turning = list[Figure | None](), list[dict[str, Any] | None]()
    parts: list[tuple[str, int, Callable[[], object]]] = [  # with approximate durations, relative to the first
        ("unseen views", 1, lambda: figures.append(unseen_figure(run, chosen))),
        *([("stacks", 10, lambda: figures.extend(_stacks(run)))] if run.dataset.passes else []),
        ("masks", 1, lambda: figures.append(masks_figure(run))),
        ("points", 5, lambda: figures.append(_points(run))),
        ("mesh", 5, lambda: figures.append(_mesh(run))),
        ("images from all sides", 10, lambda: turning.append(widget(run))),
    ]
    with progress("report", sum(steps for _, steps, _ in parts), quiet) as shown:
        for name, steps, draw in parts:
            shown.advance(0, name)
            draw()
            shown.advance(steps)
    with scores_expected(run):
        training = [curves_figure(run.history, *run.loss_title) if run.history else None, azimuths_figure(run)]
        before_scores, after_scores = ([one for one in drawn if one is not None] for drawn in (figures, training))
        return page(run, before_scores, after_scores, turning[0]).encode()


def refuse_linked_report(run: Path) -> None:
    """Raise if `RUN/report` is a link: a report is only written inside its run."""
    folder = run / _FOLDER
    if folder.is_symlink():
        raise SarsplatError(f"{folder} is a link, but a report is only written inside its run; remove the link")


@contextmanager
def scores_expected(run: Run) -> Iterator[None]:
    """Turn errors of missing scores into one that asks for a new `metrics.json`."""
    try:
        yield
    except (KeyError, TypeError, AttributeError, ValueError, StopIteration) as error:
        if run.path is None:
            raise
        raise SarsplatError(
            f"{run.folder / 'metrics.json'} does not contain all scores ({error!r}); write it again with "
            f"`sarsplat evaluate {run.path}`"
        ) from error


def _stacks(run: Run) -> list[Figure | None]:
    """Figures of learned stacks: polarisations, or phase with a slice through layover."""
    if run.model is None or run.config.passes is None:
        return []
    window = run.config.passes.window
    if run.dataset.polarimetric:
        return [pauli_figure(run, window)] if set(run.dataset.stacks[0].of_channels) >= PAULI else []
    index, cut = brightest_layover(run.dataset, run.points, window)
    truth, motion = _truth(run)
    return [phases_figure(run, index, cut, window), slice_figure(run, cut, truth if motion == _STILL else None)]


def _points(run: Run) -> Figure:
    _, farthest_m, _ = Yardstick.of(run.dataset.grid).thresholds_m
    file, motion = _truth(run)
    surface = None if file is None else sampled(file)
    found = "The first returns of the training views' rays"
    if run.dataset.passes and run.model is not None and run.config.passes is not None:
        found = f"The centres of the Gaussians that together return {run.config.points.power_share:.0%} of the power"
    truth = "; the true surface is unknown."
    if surface is not None:
        truth = ", and the true surface, which the training never saw. Height and error have separate colour scales."
    text = f"{found}, seen from three sides{truth}"
    if motion != _STILL:
        text += f" To compare them, the points were {motion}."
    blocks, bars = point_boards({"reconstruction": motion.moved(run.points)}, surface, farthest_m)
    return Figure("Points", text, blocks, bars)


def sampled(mesh: Path) -> Float[np.ndarray, "s 3"]:
    """Points on a true surface, spread by area, m."""
    return surface_samples(read_truth_mesh(mesh), _SURFACE_SAMPLES, np.random.default_rng(0))


def _truth(run: Run) -> tuple[Path | None, Alignment]:
    """The file of the true surface, and the motion that brought the points onto it."""
    file = run.dataset.truth_mesh
    if (metrics := run.metrics) is None or "truth" not in metrics:
        return file, _STILL
    truth = metrics["truth"]
    if truth["mesh"] is not None:
        file = Path(truth["mesh"])
    shift_m, heading_deg = truth.get("shift_m", _STILL.shift_m), truth.get("heading_deg", _STILL.heading_deg)
    return file, Alignment(shift_m, heading_deg, tilts_deg=truth.get("tilts_deg", _STILL.tilts_deg))


def _mesh(run: Run) -> Figure | None:
    truth, motion = _truth(run)
    try:
        mesh = run.mesh()
    except SarsplatError:  # the evaluation gives the reason
        return None
    if len(mesh.faces) == 0:
        return None
    mesh = mesh.copy()
    mesh.vertices = motion.moved(mesh.vertices)
    text = "The surface through the points, shaded (sarsplat export writes it). It is open where no view looked"
    beside = "; the true surface is whole." if truth else "."
    return Figure("Mesh", text + beside, mesh_boards(mesh, read_truth_mesh(truth) if truth else None))
