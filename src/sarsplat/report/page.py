"""Report page: self-contained HTML with pictures, style and tables of scores."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from sarsplat.colours import DARK, LIGHT, PREDICTED, RADAR, TRUE
from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.evaluation import (
    NOT_THE_SAME_EXPERIMENT,
    RUN_METRICS,
    UNSEEN_METRICS,
    Metric,
    Scores,
    Yardstick,
    all_metrics,
    metrics_of_points,
    paper_beside,
)
from sarsplat.evaluation.tables import baselines, whose
from sarsplat.examination.plausible import weakest_direction
from sarsplat.extras import program_version
from sarsplat.report.figure import Figure
from sarsplat.runs import Run
from sarsplat.runs.run_folder import left_open

if TYPE_CHECKING:
    import jinja2


@dataclass(frozen=True)
class Cell:
    """Value of one column; `best` marks the best of its row."""

    column: Scores
    text: str
    best: bool


@dataclass(frozen=True)
class Row:
    """One metric across the columns."""

    metric: Metric[Any]
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class ScoreTable:
    """A titled table: a column for every method, the run's first, and a row for every metric."""

    title: str
    columns: tuple[Scores, ...]
    rows: tuple[Row, ...]


def score_table(
    title: str, metrics: Sequence[Metric[Any]], columns: Sequence[Scores], deciding: int | None = None
) -> ScoreTable:
    """Table of the page's metrics that any of the first `deciding` columns (default: all) has."""
    rows = []
    for metric in metrics:
        if metric.place == "file" or all(column.values.get(metric.key) is None for column in columns[:deciding]):
            continue
        values = [column.values.get(metric.key) for column in columns]
        best = metric.best([value for value, column in zip(values, columns, strict=True) if column.ranked])
        cells = (
            Cell(column, metric.text(value), column.ranked and value is not None and value == best)
            for value, column in zip(values, columns, strict=True)
        )
        rows.append(Row(metric, tuple(cells)))
    return ScoreTable(title, tuple(columns), tuple(rows))


def score_tables(metrics: Mapping[str, Any], others: Sequence[Scores] = ()) -> list[ScoreTable]:
    """Tables of `metrics.json`: for each test set and for the surface; each of `others` gets a column in them."""
    tables = []
    for split, values in metrics["images"].items():
        columns = [Scores(whose(metrics), values), *baselines(metrics, split), *others]
        tables.append(score_table(f"Unseen views: {split}", UNSEEN_METRICS, columns, deciding=1))
    visible, whole = metrics["points"]["visible"], metrics["points"]["whole"]
    columns = [
        *(Scores(f"{whose(metrics)}, visible surface", visible), Scores("whole surface", whole, ranked=False)),
        *(Scores(f"mesh, {part} surface", values, ranked=False) for part, values in metrics["mesh"].items()),
        *others,
    ]
    of_points = metrics_of_points(Yardstick(metrics["parameters"]["yardstick_m"]))
    tables.append(score_table("Reconstructed surface", of_points, columns, deciding=1))
    return [table for table in tables if table.rows]


def compared_tables(
    names: Sequence[str], every: Sequence[Mapping[str, Any]], *, ranked: bool = True
) -> list[ScoreTable]:
    """Scores of several runs: a table for each test set that any has, one for the surface, one for the training.

    `every` holds the content of the `metrics.json` of each; the best of a row is marked if `ranked`.
    """

    def columns(values: Iterable[Mapping[str, Any]]) -> list[Scores]:
        return [Scores(name, of_run, ranked=ranked) for name, of_run in zip(names, values, strict=True)]

    tables = []
    for split in dict.fromkeys(split for metrics in every for split in metrics["images"]):
        of_split = columns(metrics["images"].get(split, {}) for metrics in every)
        beside = {one.name: one for metrics in every for one in baselines(metrics, split)} if ranked else {}
        tables.append(score_table(f"Unseen views: {split}", UNSEEN_METRICS, [*of_split, *beside.values()]))
    cells = dict.fromkeys(metrics["parameters"]["yardstick_m"] for metrics in every)
    of_points = [*{metric.key: metric for cell in cells for metric in metrics_of_points(Yardstick(cell))}.values()]
    visible = columns(metrics["points"]["visible"] for metrics in every)
    tables.append(score_table("Points, visible surface", of_points, visible))
    tables.append(score_table("Training", RUN_METRICS, columns(every)))
    return [table for table in tables if table.rows]


def page(run: Run, figures: list[Figure], training: list[Figure], widget: dict[str, Any] | None) -> str:
    """The whole page as HTML: figures come before the scores, those of the training after them."""
    metrics, dataset = run.metrics, run.dataset
    paper = paper_beside(dataset)
    tables = score_tables(metrics, [paper] if paper else []) if metrics else []
    return rendered(
        "page.html.j2",
        target=dataset.target,
        lead=_lead(run),
        headlines=[
            _card(table, row, metrics["definitions"])
            for table in tables
            for row in table.rows
            if metrics and row.metric.place == "headline"
        ],
        widget=widget,
        figures=figures,
        evaluated=metrics is not None,
        missing=left_open(metrics or {}).get("missing"),
        caution=NOT_THE_SAME_EXPERIMENT if paper else None,
        tables=tables,
        definitions=metrics["definitions"] if metrics else {},
        notes=_notes(metrics) if metrics else [],
        training=training,
        dataset=_dataset_facts(dataset),
        run=_run_facts(run),
        configuration=json.dumps(run.config.as_dict(), indent=2),
    )


def rendered(template: str, **values: Any) -> str:
    """Fill a template of this package; the HTML needs no other file."""
    return _templates().get_template(template).render(**values)


@cache
def _templates() -> "jinja2.Environment":
    """Environment that caches compiled templates."""
    import jinja2

    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("sarsplat.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.globals.update(light=vars(LIGHT), dark=vars(DARK), true_mask=TRUE, own_mask=PREDICTED, radar=RADAR)
    return templates


def in_words(names: Iterable[str]) -> str:
    """E.g. a, b and c."""
    *others, last = [*names] or [""]
    return f"{', '.join(others)} and {last}" if others else last


def _lead(run: Run) -> str:
    dataset = run.dataset
    train = sum(entry.split == "train" for entry in dataset.entries)
    kind = "measured" if dataset.calibration == "relative" else "simulated"
    return (
        f"{run.learned} and {counted(len(run.points), 'surface point')}, reconstructed "
        f"from {counted(train, f'{kind} SAR image')} in {_duration(run.time_s)}."
    )


def _card(table: ScoreTable, row: Row, definitions: Mapping[str, str]) -> dict[str, Any]:
    """A headline: the run's value, the competing ones, and the winner."""
    own, *others = row.cells
    competing = [cell for cell in others if cell.column.ranked and cell.column.values.get(row.metric.key) is not None]
    winners = [cell.column.name for cell in competing if cell.best]
    if own.best:
        verdict = "This run is the best." if not winners else f"As good as {in_words(winners)}."
    else:
        verdict = f"Better than this run: {in_words(winners)}."
    return {
        "name": row.metric.title,
        "definition": definitions.get(row.metric.key),
        "value": own.text,
        "others": [{"name": cell.column.name, "text": cell.text, "best": cell.best} for cell in competing],
        "verdict": verdict,
        "table": table.title,
    }


def _notes(metrics: Mapping[str, Any]) -> list[str]:
    """Missing scores with their reasons, and the parameters of the metrics."""
    labels = {metric.key: metric.label for metric in all_metrics(Yardstick(metrics["parameters"]["yardstick_m"]))}
    missing: dict[str, list[str]] = {}
    for key, reason in metrics["reasons"].items():
        scored = next((metric for metric in labels if key.endswith(f".{metric}")), None)
        missing.setdefault(reason, []).append(key if scored is None else labels[scored])
    notes = [f"{'; '.join(dict.fromkeys(names))}: {reason}" for reason, names in missing.items()]
    return [*notes, ", ".join(f"{name} = {value:.6g}" for name, value in metrics["parameters"].items())]


def _dataset_facts(dataset: Dataset) -> dict[str, str]:
    grid = dataset.grid
    quantity = (
        "β⁰, linear power" if dataset.calibration == "absolute" else "power up to one common factor, β⁰ scale unknown"
    )
    sets = [entry.split for entry in dataset.entries]
    return {
        "folder": str(dataset),
        "quantity": quantity,
        "images": ", ".join(f"{count} {split}" for split, count in Counter(sets).items()),
        "speckle": dataset.speckle,
        "ground": ("shown" if dataset.terrain is None else f"terrain, {dataset.terrain}") if dataset.ground else "none",
        "weakest direction": str(weakest_direction(dataset.select("train").views)),
        "pixels": f"{grid.rows} × {grid.columns} (slant range × azimuth)",
        "spacing": f"{grid.spacing_m[0]:g} m in azimuth, {grid.spacing_m[1]:g} m in slant range",
        "resolution": f"{grid.resolution_m[0]:g} m, {grid.resolution_m[1]:g} m (3 dB)",
        **{name.replace("_", " "): _plain(value) for name, value in dataset.source.items() if name != "chips"},
    }


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_plain(item)}" for name, item in value.items())
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    if isinstance(value, float):
        return f"{value:.6g}"
    return "none" if value is None else str(value)


def _run_facts(run: Run) -> dict[str, str]:
    echoes = {}
    if run.model is not None and run.model.echoes():  # of ground and target alone, shares say little
        shares = run.model.power_by_echo(run.model.degree(run.iteration))
        echoes["power"] = ", ".join(f"{way} {share:.0%}" for way, share in shares.items())
    return {
        "folder": "in memory" if run.path is None else str(run.path),
        "method": run.method,
        **run.facts,
        **echoes,
        "training time": _duration(run.time_s),
        **({} if run.metrics is None else left_open(run.metrics)),
        "seed": str(run.seed),
        "report by": f"sarsplat {program_version()}",
    }


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds // 60:.0f} min {seconds % 60:.0f} s"
