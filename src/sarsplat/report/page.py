"""The page: HTML with its pictures and style inside, so that one file can be passed on."""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from sarsplat.data import Dataset
from sarsplat.data.determined import weakest_direction
from sarsplat.errors import counted
from sarsplat.evaluation import NOT_THE_SAME_EXPERIMENT, Yardstick, all_metrics, paper_beside
from sarsplat.reconstruction import AnyRun
from sarsplat.report.scores import Row, ScoreTable, score_tables


@dataclass(frozen=True)
class Picture:
    """A figure of the report: file name, heading, what is seen, PNG."""

    file: str
    title: str
    text: str
    png: bytes

    @property
    def data(self) -> str:
        """The PNG as an address that holds it."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode()}"


def page(run: AnyRun[Any], pictures: list[Picture], training: list[Picture]) -> str:
    """The whole page as HTML: pictures come before the scores, those of the training after them."""
    import jinja2

    metrics, dataset = run.metrics, run.dataset
    paper = paper_beside(dataset)
    tables = score_tables(metrics, [paper] if paper else []) if metrics else []
    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("sarsplat.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return templates.get_template("page.html.j2").render(
        target=dataset.target,
        lead=_lead(run),
        headlines=[_card(table, row) for table in tables for row in table.rows if row.metric.place == "headline"],
        pictures=pictures,
        evaluated=metrics is not None,
        caution=NOT_THE_SAME_EXPERIMENT if paper else None,
        tables=tables,
        notes=_notes(metrics, tables) if metrics else [],
        training=training,
        dataset=_dataset_facts(dataset),
        run=_run_facts(run),
        configuration=json.dumps(run.config.as_dict(), indent=2),
    )


def _lead(run: AnyRun[Any]) -> str:
    dataset = run.dataset
    train = sum(entry.split == "train" for entry in dataset.entries)
    kind = "measured" if dataset.calibration == "relative" else "simulated"
    return (
        f"{run.learned} and {counted(len(run.points), 'surface point')}, reconstructed "
        f"from {counted(train, f'{kind} SAR image')} in {_duration(run.time_s)}."
    )


def _card(table: ScoreTable, row: Row) -> dict[str, Any]:
    """A headline: our value, and below it those it competes with."""
    ours, *others = row.cells
    known = [cell for cell in others if cell.column.ranked and cell.column.values.get(row.metric.key) is not None]
    return {
        "name": row.metric.title,
        "value": ours.text,
        "others": [f"{cell.column.name} {cell.text}" for cell in known],
        "table": table.title.lower(),
    }


def _notes(metrics: Mapping[str, Any], tables: list[ScoreTable]) -> list[str]:
    """What was left out and why, what was computed, and what images were divided by."""
    known = all_metrics(Yardstick(metrics["parameters"]["yardstick_m"]))
    missing: dict[str, list[str]] = {}
    for key, reason in metrics["reasons"].items():
        label = next((metric.label for metric in known if key.endswith(f".{metric.key}")), key)
        missing.setdefault(reason, []).append(label)
    notes = [f"{'; '.join(dict.fromkeys(labels))}: {reason}" for reason, labels in missing.items()]
    shown = {row.metric.key: row.metric.label for table in tables for row in table.rows}
    notes += [f"{label}: {metrics['definitions'][key]}" for key, label in shown.items()]
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
        "ground": "shown" if dataset.ground else "none",
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


def _run_facts(run: AnyRun[Any]) -> dict[str, str]:
    try:
        program = version("sarsplat")
    except PackageNotFoundError:  # run from source
        program = "from source"
    return {
        "folder": str(run.path),
        "method": run.method,
        **run.facts,
        "training time": _duration(run.time_s),
        "seed": str(run.seed),
        "report by": f"sarsplat {program}",
    }


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds // 60:.0f} min {seconds % 60:.0f} s"
