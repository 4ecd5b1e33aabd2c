"""A run's scores as tables: ours, and beside them what they are to be compared with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import PaperRow, paper_row

_HEADLINES = ("psnr_db", "psnr_target_db", "nats_per_pixel", "log_correlation", "cd_m", "f1@0.3")

# Key in metrics.json, what readers call it, decimals, whether more is better, field of the paper's row.
_IMAGE_ROWS = (
    ("psnr_db", "PSNR, whole image, dB", 2, True, "psnr_db"),
    ("psnr_target_db", "PSNR on the target, dB", 2, True, None),
    ("ssim", "SSIM", 4, True, "ssim"),
    ("lpips", "LPIPS", 4, False, "lpips"),
    ("nats_per_pixel", "speckle likelihood, nats per pixel", 3, False, None),
    ("log_correlation", "correlation of log power", 3, True, None),
)
_POINT_ROWS = (
    ("cd_m", "Chamfer distance, m", 3, False, "cd_m"),
    ("accuracy_m", "accuracy (points → truth), m", 3, False, None),
    ("completeness_m", "completeness (truth → points), m", 3, False, None),
    ("f1@0.3", "F1 at 0.3 m", 3, True, "f1"),
    ("f1@0.2", "F1 at 0.2 m", 3, True, None),
    ("f1@0.1", "F1 at 0.1 m", 3, True, None),
)


@dataclass(frozen=True)
class Cell:
    """One figure; `best` in its row if there is something to compare with."""

    text: str
    best: bool = False


@dataclass(frozen=True)
class Row:
    """One score across the columns: whether more is better, and whether it is a headline."""

    name: str
    more: bool
    cells: tuple[Cell, ...]
    headline: bool


@dataclass(frozen=True)
class ScoreTable:
    """A titled table of scores; the first column is always ours."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]


def paper_beside(dataset: Dataset) -> PaperRow | None:
    """The paper's row for this dataset's target, T72 where it has none; None unless the protocol is the paper's."""
    if dataset.protocol != "paper" or dataset.ground or dataset.looks is not None:
        return None
    try:
        return paper_row(dataset.target)
    except SarsplatError:
        return paper_row("T72")


def score_tables(metrics: Mapping[str, Any], paper: PaperRow | None) -> list[ScoreTable]:
    """Tables of `metrics.json`: one for each test set, one for the points. Scores that do not apply have no row.

    Parameters
    ----------
    metrics : mapping
        Content of `metrics.json`.
    paper : PaperRow or None
        The paper's figures, where they compare.
    """
    tables = [_images(split, scores, metrics, paper) for split, scores in metrics["images"].items()]
    points = _points(metrics["points"], paper)
    return [table for table in (*tables, points) if table.rows]


def _images(
    split: str, scores: Mapping[str, float | None], metrics: Mapping[str, Any], paper: PaperRow | None
) -> ScoreTable:
    yardsticks = (metrics.get("yardsticks") or {}).get(split, {})
    columns = ["ours", *(name.replace("_", " ") for name in yardsticks)]
    if paper is not None:
        columns.append(f"paper, {paper.target}")
    rows = []
    for key, name, decimals, more, field in _IMAGE_ROWS:
        values = [scores[key], *(scored.get(key) for scored in yardsticks.values())]
        if paper is not None:
            values.append(getattr(paper, field) if field else None)
        if scores[key] is not None:
            rows.append(Row(name, more, _cells(values, decimals, more), key in _HEADLINES))
    return ScoreTable(f"Unseen views: {split}", tuple(columns), tuple(rows))


def _points(points: Mapping[str, Mapping[str, float | None]], paper: PaperRow | None) -> ScoreTable:
    visible, whole = points["visible"], points["whole"]
    columns = ["ours, visible surface", "whole surface", *([f"paper, {paper.target}"] if paper else [])]
    rows = []
    for key, name, decimals, more, field in _POINT_ROWS:
        if visible[key] is None:
            continue
        against = [getattr(paper, field) if field else None] if paper else []
        compared = _cells([visible[key], *against], decimals, more)
        cells = (compared[0], Cell(_text(whole[key], decimals)), *compared[1:])
        rows.append(Row(name, more, cells, key in _HEADLINES))
    return ScoreTable("Reconstructed points", tuple(columns), tuple(rows))


def _cells(values: list[float | None], decimals: int, more: bool) -> tuple[Cell, ...]:
    known = [value for value in values if value is not None]
    best = (max if more else min)(known) if len(known) > 1 else None
    return tuple(Cell(_text(value, decimals), value is not None and value == best) for value in values)


def _text(value: float | None, decimals: int) -> str:
    return "–" if value is None else f"{value:.{decimals}f}"
