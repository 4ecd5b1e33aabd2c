"""Several runs side by side: their scores, the same views, and their points."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sarsplat.arguments import checks_arguments
from sarsplat.data import new_folder, write_bytes
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import Yardstick, beaten
from sarsplat.report.boards import point_boards
from sarsplat.report.figure import Block, ColourBar, Figure
from sarsplat.report.page import ScoreTable, compared_tables, in_words, rendered
from sarsplat.report.views import Chosen, ranked_images, views_figure, with_others
from sarsplat.report.write import sampled, scores_expected
from sarsplat.runs import Run
from sarsplat.runs.run_folder import names_of

PAGE = "comparison.html"

_WHOLE, _HALF = (1.5, 6, 14), (1.2, 5, 7)  # views beside each other: as a multiple of the rows, at least, and at most
_LARGE_BOARDS = 2  # of points, at most; more are drawn smaller
_LARGEST = 192  # pixels along a side that the page shows of an image


@dataclass(frozen=True)
class Comparison:
    """Scores of several runs side by side."""

    runs: tuple[Run, ...]
    """Evaluated runs of any methods."""
    names: tuple[str, ...]
    """Names of their folders, or their differing settings in a sweep; their paths where names coincide."""
    tables: tuple[ScoreTable, ...]
    """A row for every metric, a column for every run."""
    caution: str | None
    """A warning if scores are not comparable or a run is unfinished."""
    beaten: tuple[str, ...]
    """A sentence for each run and test set where a baseline is better."""


@checks_arguments
def compare(runs: Sequence[Run]) -> Comparison:
    """Put the scores of two or more evaluated runs side by side.

    Raises
    ------
    SarsplatError
        If there are fewer than two runs, one is given twice, has not been evaluated, or its `metrics.json` was
        written by another version.
    """
    if len(runs) < 2:
        raise SarsplatError(f"{len(runs)} run cannot be compared with others; give at least two")
    paths = [run.folder.resolve() for run in runs]
    for index, (run, path) in enumerate(zip(runs, paths, strict=True)):
        if path in paths[:index]:
            raise SarsplatError(f"{run.folder} is given twice; give each run once")
        with scores_expected(run):
            compared_tables([""], [scores_of(run)])
    names = names_of([run.folder for run in runs])
    caution = _caution(runs, names)
    tables = compared_tables(names, [scores_of(run) for run in runs], ranked=caution is None)
    worse = (one.sentence(name) for name, run in zip(names, runs, strict=True) for one in beaten(scores_of(run)))
    return Comparison(tuple(runs), tuple(names), tuple(tables), caution, tuple(worse))


@checks_arguments
def write_comparison(comparison: Comparison, out: Path, *, overwrite: bool = False) -> Path:
    """Write the comparison as one page that needs no network, `OUT/comparison.html`, and return its path.

    Parameters
    ----------
    comparison : Comparison
        Result of `compare`.
    out : Path
        Folder to make.
    overwrite : bool
        Replace an existing comparison.

    Raises
    ------
    SarsplatError
        If the dataset of a run is missing, or `out` exists and may not be replaced.
    """
    definitions: dict[str, str] = {}
    for run in comparison.runs:
        definitions |= scores_of(run)["definitions"]
    parts = _by_dataset(comparison)
    html = rendered(
        "compare.html.j2",
        target=in_words(dict.fromkeys(run.dataset.target for run in comparison.runs)),
        lead=f"{in_words(comparison.names)} side by side.",
        caution=comparison.caution,
        beaten=comparison.beaten,
        tables=comparison.tables,
        definitions=definitions,
        views=[_views(runs, _across(parts), named=comparison.caution is not None) for runs in parts],
        points=_points(parts),
    )
    with new_folder(out, overwrite, marker=PAGE) as folder:
        write_bytes(folder / PAGE, html.encode())
    return out / PAGE


def scores_of(run: Run) -> Mapping[str, Any]:
    """Content of a run's `metrics.json`; raises if the run has not been evaluated."""
    if (metrics := run.metrics) is None:
        raise SarsplatError(f"{run.folder} has no scores yet; run `sarsplat evaluate {run.folder}` first")
    return metrics


def _caution(runs: Sequence[Run], names: Sequence[str]) -> str | None:
    """Reasons why scores may not be comparable, or None."""
    reasons = []
    made = dict[str, list[str]]()
    for name, run in zip(names, runs, strict=True):
        made.setdefault(str(run.dataset_path or "images in memory"), []).append(name)
    which = ", ".join(f"{in_words(of_one)} from {source}" for source, of_one in made.items())
    if len({run.fingerprint for run in runs}) > 1:
        reasons.append(
            f"These runs were made from different datasets, so their scores are not comparable one to one: {which}."
        )
    elif len({scores_of(run).get("truth", {}).get("sha256") for run in runs} - {None}) > 1:
        reasons.append(
            "The points of these runs were held against different surfaces, so their scores are not comparable."
        )
    reasons += [f"{name} is {run.state}." for name, run in zip(names, runs, strict=True) if not run.state.trained]
    return " ".join(reasons) or None


def _by_dataset(comparison: Comparison) -> list[dict[str, Run]]:
    """Runs of each dataset by name: no image is shown beside another dataset's truth."""
    shared: dict[str | None, dict[str, Run]] = {}
    for name, run in zip(comparison.names, comparison.runs, strict=True):
        shared.setdefault(run.fingerprint, {})[name] = run
    return [*shared.values()]


def _across(parts: Sequence[Mapping[str, Run]]) -> int:
    """Number of views in a row: grows with the number of rows, to bound the page's length.

    Several datasets share two columns, of which the longer counts.
    """
    rows = [1 + 2 * len(runs) for runs in parts]
    per_row, fewest, most = _HALF if len(parts) > 1 else _WHOLE
    return min(max(fewest, math.ceil(per_row * max(*rows, sum(rows) / 2))), most)


def _views(runs: Mapping[str, Run], views: int, *, named: bool) -> Figure:
    """Figure of one dataset's views, their renderings by every run, and the errors; its title may name the runs."""
    dataset, worst = next(iter(runs.values())).dataset, dict[int, str]()
    for name, run in runs.items():
        best_first, _ = ranked_images(dataset, scores_of(run))
        if best_first:
            index = best_first[-1][1]
            worst[index] = f"{worst[index]}, {name}" if index in worst else f"worst of {name}"
    by_all = f"worst of {', '.join(runs)}"
    of_note = [Chosen(index, "worst of all" if why == by_all else why) for index, why in worst.items()]
    chosen = with_others(dataset, of_note, max(2, views - len(of_note)))
    true = "Measured" if dataset.calibration == "relative" else "Truth"
    text = f"{true} and reconstructions on one scale, the radar above."
    title = f"The same views: {in_words(runs)}" if named else "The same views"
    return views_figure(title, text, runs, chosen, _LARGEST, views)


def _points(parts: Sequence[Mapping[str, Run]]) -> Figure:
    """The points of every run, those of one dataset in boards of one size."""
    blocks, bars, truths = list[Block](), list[ColourBar](), list[Path | None]()
    for runs in parts:
        dataset = next(iter(runs.values())).dataset
        truths.append(dataset.truth_mesh)
        surface = None if dataset.truth_mesh is None else sampled(dataset.truth_mesh)
        clouds = {name: run.points for name, run in runs.items()}
        boards, meanings = point_boards(clouds, surface, Yardstick.of(dataset.grid).thresholds_m[1], heights=False)
        blocks += boards
        bars += [bar for bar in meanings if bar not in bars]
    by = "their error" if all(truths) else "their error where the true surface is known, else by height"
    text = f"The surface points of every run, coloured by {by if any(truths) else 'height'}."
    layout = "beside" if len(blocks) <= _LARGE_BOARDS else "beside low"
    return Figure("Points", text, tuple(blocks), tuple(bars), layout=layout)
