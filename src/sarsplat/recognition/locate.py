"""`locate`: class and azimuth of images by rendering runs from all azimuths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.azimuths import STEP_DEG, around
from sarsplat.evaluation.matching import Match, Matcher
from sarsplat.evaluation.templates import (
    Window,
    extents_m,
    floored,
    grid_for,
    phase_of,
    require_memory,
    templates,
    window_around,
)
from sarsplat.geometry import View
from sarsplat.names import Quantity, Side
from sarsplat.progress import progress
from sarsplat.radiometry import to_db
from sarsplat.recognition.chips import Chip, chips_of, require_comparable
from sarsplat.recognition.located import Located
from sarsplat.recognition.odds import TEMPERATURE, Calibration
from sarsplat.runs import Run
from sarsplat.samples.chip_set import target_of, warn_of_far_angles

_FAR_DEG = 14.0  # distance from the grazing angles of a training beyond which a warning is given
_UNKNOWN_DEG = 104.0  # standard deviation of an azimuth of which nothing is known, degrees

_LARGEST_EXPONENT = 50.0


@checks_arguments
def locate(
    runs: Sequence[Run | str | Path],
    images: Dataset | str | Path | Sequence[Dataset | str | Path],
    *,
    calibrate: str | Path | Sequence[Dataset | str | Path] = (),
    split: str | None = None,
    grazing_deg: float | None = None,
    step_deg: float = STEP_DEG,
    window_m: float | None = None,
    ground: Literal["learned", "flat"] = "learned",
    near: Side = "top",
    quantity: Quantity | None = None,
    quiet: bool = True,
) -> Located:
    """Find class and azimuth of images: each is compared with every run, rendered from all azimuths.

    An image's gain is free, and its target may be displaced by up to three resolution cells. The class is always one of
    the runs'. Neither the order of images and runs nor the number of threads changes the result.

    Parameters
    ----------
    runs : sequence of Run or path
        Runs, or their folders. The class of a run is the target of its dataset, or else the name of its folder; runs of
        one class are alternatives.
    images : Dataset, path, or sequence of these
        Datasets, whose azimuths and targets count as labels only, with their images without azimuth; folders of these;
        or folders of pictures with the runs' pixels.
    calibrate : path, or sequence of Dataset or path
        Labelled datasets of all classes, whose images calibrate the odds, except those in `images`, the more the truer;
        or the JSON file that `Calibration.write` made.
    split : str, optional
        Set of the datasets in `images`, such as "test-15"; by default all but the training set, if there are others.
    grazing_deg : float, optional
        Grazing angle of all images to be located, degrees; by default their own, to a degree. Pictures need it.
    step_deg : float
        Step between azimuths, degrees; it divides 360.
    window_m : float, optional
        Side of the square around the origin in which images are compared, m; by default a rectangle that holds targets
        and shadows of all runs. Either is cut to what an image and the runs' images show.
    ground : {"learned", "flat"}
        Ground of renderings: as in the training images, which knows the field where they were recorded, or uniform.
    near : {"top", "right", "bottom", "left"}
        Side of pictures that is near the radar.
    quantity : {"amplitude", "power", "db", "complex"}, optional
        Quantity of the numbers in pictures; by default inferred as by `import_folder`.
    quiet : bool
        Show no progress.

    Returns
    -------
    Located
        Odds, azimuths and displacements of all images for each class, and scores where labels are known.

    Raises
    ------
    SarsplatError
        If there are no runs or images, pixels differ, images are too small, a class has no image to calibrate with, or
        an option is out of range.

    Warns
    -----
    SarsplatWarning
        If grazing angles are far from those of the runs' training images.
    """
    if not runs:
        raise SarsplatError("there are no runs to compare images with; give at least one")
    steps = round(360 / step_deg) if 0 < step_deg <= 45 else 0
    if abs(steps * step_deg - 360) > 1e-6:
        raise SarsplatError(f"step_deg is {step_deg}; give a divisor of 360 up to 45, such as 2")
    opened = [run if isinstance(run, Run) else Run.load(run) for run in runs]
    opened.sort(key=lambda run: (target_of(run), run.fingerprint, str(run.path)))
    settings: dict[str, Any] = {"ground": ground, "step_deg": float(step_deg), "window_m": window_m}
    names = [f"{run.path.name if run.path else target_of(run)} {run.snapshot.digest()}" for run in opened]
    named = dict(zip(names, map(target_of, opened), strict=True))
    calibration = Calibration(runs=named, settings=settings)
    sources = _listed(calibrate)
    chips = chips_of(_listed(images), split, grazing_deg, near, quantity, opened)
    labelled: list[Chip] = []
    if len(sources) == 1 and not isinstance(sources[0], Dataset) and Path(sources[0]).suffix == ".json":
        calibration = calibration.read(Path(sources[0]))
    elif sources:
        located = {chip.power.tobytes() for chip in chips}
        others = chips_of(sources, None, None, near, quantity, opened)
        labelled = [one for one in others if one.target in calibration.classes and one.power.tobytes() not in located]
        if not labelled:
            raise SarsplatError("`calibrate` has no image of these classes, besides those to be located; give some")
    every = [*labelled, *chips]
    require_comparable(every)
    angles = [chip.view.grazing_deg for chip in every]
    warn_of_far_angles(opened, min(angles), max(angles), _FAR_DEG)
    matches = _matched(opened, every, steps, window_m, ground, quiet)
    if labelled:
        first = _assembled(opened, labelled, matches[: len(labelled)], calibration)
        samples = np.array([samples for _, samples in matches[: len(labelled)]])
        calibration = calibration.fitted(first.nats, samples, first.labels, first.relative_azimuth_errors)
    return _assembled(opened, chips, matches[len(labelled) :], calibration)


def _matched(
    runs: Sequence[Run],
    chips: Sequence[Chip],
    steps: int,
    window_m: float | None,
    ground: Literal["learned", "flat"],
    quiet: bool,
) -> list[tuple[Match, float]]:
    """Match every image with every run, view by view; also return the independent samples in the window.

    Images that show less than others have smaller windows.
    """
    matches: dict[int, tuple[Match, float]] = {}
    groups: dict[tuple[View, tuple[float, float]], list[int]] = {}
    for index, chip in enumerate(chips):
        groups.setdefault((chip.view, phase_of(chip.grid)), []).append(index)
    with progress("locate", len(chips) + len(groups) * len(runs), quiet) as shows:
        for (view, _), members in sorted(groups.items(), key=str):
            shown = [chips[index].grid for index in members]
            pixels = replace(shown[0], rows=max(one.rows for one in shown), columns=max(one.columns for one in shown))
            grids = [grid_for(run, pixels) for run in runs]
            extents = extents_m(runs, view) if window_m is None else [(-window_m / 2, window_m / 2)] * 2
            windows = {index: window_around(extents, [chips[index].grid, *grids]) for index in members}
            largest = Window.around([*windows.values()])
            require_memory(largest, len(runs) * steps, "give fewer runs, a larger `step_deg` or a smaller `window_m`")
            down, across = largest.margins  # of every window of the group
            views, rendered = around(view, steps), []
            for run, grid in zip(runs, grids, strict=True):
                shows.advance(1, f"rendering {target_of(run)}")
                rendered.append(templates(run, views, largest, grid, ground))
            for window in dict.fromkeys(windows.values()):
                matcher = Matcher([floored(window.within(largest, one)) for one in rendered], window)
                samples = replace(pixels, rows=window.size[0], columns=window.size[1]).independent_samples
                for index in (index for index in members if windows[index] == window):
                    chip = chips[index]
                    cut = window.cut(chip.power, chip.grid, window.margins)
                    if not cut[down:-down, across:-across].any():
                        raise SarsplatError(f"{chip.name} is black around its origin; leave it out")
                    matches[index] = matcher(cut), samples
                    shows.advance(1, "matching")
    return [matches[index] for index in range(len(chips))]


def _assembled(
    runs: Sequence[Run], chips: Sequence[Chip], matches: Sequence[tuple[Match, float]], calibration: Calibration
) -> Located:
    """Return the result for images, given their matches with the runs: each class has its most likely run."""
    samples, nats = np.array([samples for _, samples in matches]), np.stack([match.nats for match, _ in matches])
    of_class = [[k for k, run in enumerate(runs) if target_of(run) == name] for name in calibration.classes]
    best = np.stack([np.take(own, nats[:, own].argmin(axis=1)) for own in of_class], axis=1)

    def chosen(name: str) -> Any:
        return np.stack([getattr(match, name)[index] for (match, _), index in zip(matches, best, strict=True)])

    nats, certainty = chosen("nats"), samples[:, None] / calibration.temperature
    spacing_m = np.array(chips[0].grid.spacing_m)
    return Located(
        chips=tuple(chips),
        runs=tuple(runs),
        calibration=calibration,
        odds=calibration.odds(nats, samples),
        azimuth_deg=chosen("azimuth_deg"),
        azimuth_std_deg=np.minimum(
            calibration.azimuth_scale / np.sqrt(chosen("curvature") * samples[:, None] / TEMPERATURE), _UNKNOWN_DEG
        ),
        reversed_odds=1 / (1 + np.exp(np.minimum(chosen("reversal") * certainty, _LARGEST_EXPONENT))),
        shift_m=chosen("shift")[..., ::-1] * spacing_m,
        gain_db=to_db(chosen("gain")),
        nats=nats,
        run_index=best,
    )


def _listed(images: Dataset | str | Path | Sequence[Dataset | str | Path]) -> list[Dataset | str | Path]:
    return [images] if isinstance(images, Dataset | str | Path) else [*images]
