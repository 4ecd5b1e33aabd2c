"""The page: HTML with its pictures and style inside, so that one file can be passed on."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from html import escape
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from string import Template
from typing import Any

from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.evaluation.tables import NOT_THE_SAME_EXPERIMENT
from sarsplat.reconstruction import Run
from sarsplat.report.scores import ScoreTable, paper_beside, score_tables


@dataclass(frozen=True)
class Picture:
    """A figure of the report: file name, heading, what is seen, PNG."""

    file: str
    title: str
    text: str
    png: bytes


def page(run: Run, pictures: list[Picture], training: list[Picture]) -> str:
    """The whole page as HTML: pictures come before the scores, those of the training after them."""
    metrics, dataset = run.metrics, run.dataset
    paper = paper_beside(dataset)
    tables = score_tables(metrics, paper) if metrics else []
    here = files("sarsplat.report")
    return Template(here.joinpath("page.html").read_text("utf-8")).substitute(
        style=here.joinpath("style.css").read_text("utf-8"),
        target=escape(dataset.target),
        lead=escape(_lead(run)),
        cards=_cards(run, tables),
        pictures="\n".join(_picture(picture) for picture in pictures),
        training="\n".join(_picture(picture) for picture in training),
        scores=_scores(tables, metrics, NOT_THE_SAME_EXPERIMENT if paper else ""),
        dataset=_facts(_dataset_facts(dataset)),
        run=_facts(_run_facts(run)),
        configuration=escape(json.dumps(run.config.as_dict(), indent=2)),
    )


def _lead(run: Run) -> str:
    dataset = run.dataset
    train = dataset.select("train")
    kind = "measured" if dataset.calibration == "relative" else "simulated"
    return (
        f"{counted(len(run.gaussians), 'Gaussian')} and {counted(len(run.points), 'surface point')}, reconstructed "
        f"from {counted(len(train), f'{kind} SAR image')} in {_duration(run.time_s)}."
    )


def _cards(run: Run, tables: list[ScoreTable]) -> str:
    """The headlines of each table, large."""
    rows = [(table, row) for table in tables for row in table.rows if row.headline]
    if not rows:
        return '<p class="note">Not evaluated yet: <code>sarsplat evaluate</code> adds the scores.</p>'
    cards = []
    for table, row in rows:
        beside = [
            f"{column} {cell.text}"
            for column, cell in zip(table.columns[1:], row.cells[1:], strict=True)
            if cell.text != "–" and not column.startswith("whole")
        ]
        small = escape(" · ".join(beside)) or "&nbsp;"
        cards.append(
            f'<div class="card"><div class="name">{escape(row.name)}</div><div class="value">{row.cells[0].text}</div>'
            f'<div class="beside">{small}</div><div class="set">{escape(table.title.lower())}</div></div>'
        )
    return f'<div class="cards">{"".join(cards)}</div>'


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.png).decode()
    return (
        f"<section><h2>{escape(picture.title)}</h2><p>{escape(picture.text)}</p>"
        f'<img src="data:image/png;base64,{data}" alt="{escape(picture.title)}"></section>'
    )


def _scores(tables: list[ScoreTable], metrics: dict[str, Any] | None, caution: str) -> str:
    if metrics is None:
        return ""
    parts = [f'<p class="note">{escape(caution)}</p>'] if caution else []
    parts += [_table(table) for table in tables]
    missing: dict[str, list[str]] = {}
    for key, reason in metrics.get("reasons", {}).items():
        missing.setdefault(reason, []).append(key.rpartition(".")[2])
    notes = [f"{', '.join(dict.fromkeys(names))}: {reason}" for reason, names in missing.items()]
    notes += [str(text) for text in metrics.get("domain", {}).values() if isinstance(text, str)]
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    explained = (
        f"<details><summary>What exactly was compared, and what was left out</summary><ul>{items}</ul></details>"
    )
    return f"<section><h2>Scores</h2>{''.join(parts)}{explained}</section>"


def _table(table: ScoreTable) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    body = "".join(
        f'<tr><th>{escape(row.name)} <span class="sense">{"↑" if row.more else "↓"}</span></th>'
        + "".join(f'<td class="{"best" if cell.best else ""}">{cell.text}</td>' for cell in row.cells)
        + "</tr>"
        for row in table.rows
    )
    return (
        f'<div class="scroll"><table><thead><tr><th>{escape(table.title)}</th>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _facts(rows: dict[str, str]) -> str:
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in rows.items())
    return f"<dl>{items}</dl>"


def _dataset_facts(dataset: Dataset) -> dict[str, str]:
    grid = dataset.grid
    quantity = (
        "β⁰, linear power" if dataset.calibration == "absolute" else "power up to one common factor, β⁰ scale unknown"
    )
    return {
        "folder": str(dataset),
        "quantity": quantity,
        "images": ", ".join(f"{len(dataset.select(split))} {split}" for split in dataset.splits()),
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
    config = run.config
    try:
        program = version("sarsplat")
    except PackageNotFoundError:  # run from source
        program = "from source"
    return {
        "folder": str(run.path),
        "preset": config.preset,
        "start": config.initialisation,
        "iterations": f"{run.iteration:,} of {config.iterations:,}, {counted(config.views_per_step, 'view')} each",
        "training time": _duration(run.time_s),
        "seed": str(run.seed),
        "report by": f"sarsplat {program}",
    }


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds // 60:.0f} min {seconds % 60:.0f} s"
