"""Scores as a table in the terminal, beside what they are to be compared with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.table import Table

from sarsplat.errors import SarsplatError


@dataclass(frozen=True)
class PaperRow:
    """Published scores of one rendered target (SAR-GS, Tables I and II).

    Attributes
    ----------
    target : str
    psnr_db, ssim, lpips : float
        Of whole images.
    cd_m, f1 : float
        Chamfer distance, and F1 at a threshold the paper does not state.
    time_s : float
        Training time, s.
    """

    target: str
    psnr_db: float
    ssim: float
    lpips: float
    cd_m: float
    f1: float
    time_s: float


_PAPER = {
    row.target.lower(): row
    for row in (
        PaperRow("T72", psnr_db=35.91, ssim=0.9943, lpips=0.0165, cd_m=0.187, f1=0.925, time_s=400),
        PaperRow("BTR70", psnr_db=34.35, ssim=0.9928, lpips=0.0176, cd_m=0.228, f1=0.846, time_s=358),
        PaperRow("KRAZ", psnr_db=37.33, ssim=0.9969, lpips=0.0109, cd_m=0.207, f1=0.862, time_s=376),
    )
}


def paper_row(target_name: str) -> PaperRow:
    """Published scores of a rendered target.

    Parameters
    ----------
    target_name : str
        T72, BTR70 or KRAZ, in any case.

    Raises
    ------
    SarsplatError
        If the paper has no such row.
    """
    try:
        return _PAPER[target_name.lower()]
    except KeyError:
        names = ", ".join(row.target for row in _PAPER.values())
        raise SarsplatError(f"the paper has no row for {target_name!r}; it has {names}") from None


NOT_THE_SAME_EXPERIMENT = (
    "The paper's figures are not the same experiment: its targets and images are not published, its truth is rendered "
    "by its own method, and its F1 threshold and Chamfer distance are not defined."
)
"""What must stand wherever the paper's figures stand beside others."""


def _decimals(count: int) -> Callable[[float | None], str]:
    return lambda value: "–" if value is None else f"{value:.{count}f}"


def _duration(seconds: float | None) -> str:
    """Minutes and seconds, as the paper gives them."""
    return "–" if seconds is None else f"{round(seconds) // 60}:{round(seconds) % 60:02d}"


_COLUMNS: tuple[tuple[str, str, Callable[[float | None], str]], ...] = (
    ("psnr_db", "PSNR dB", _decimals(2)),
    ("psnr_target_db", "target dB", _decimals(2)),
    ("ssim", "SSIM", _decimals(4)),
    ("lpips", "LPIPS", _decimals(4)),
    ("nats_per_pixel", "nats per pixel", _decimals(3)),
    ("log_correlation", "log corr.", _decimals(3)),
    ("cd_m", "CD m", _decimals(3)),
    ("f1@0.3", "F1@0.3", _decimals(3)),
    ("time_s", "time", _duration),
)
"""Key of a score, its heading, and how it is written."""


def metrics_table(
    metrics: Mapping[str, Any],
    *,
    paper: PaperRow | None = None,
    yardsticks: Mapping[str, Mapping[str, Mapping[str, float | None]]] | None = None,
) -> Table:
    """The headline scores: ours, one row per test set, and below them what they compare with.

    Parameters
    ----------
    metrics : mapping
        What `evaluate_run` returned, or `metrics.json`.
    paper : PaperRow, optional
        The paper's figures, where the protocol is the paper's.
    yardsticks : mapping, optional
        What `yardstick_scores` returned, for a measured set.

    Returns
    -------
    rich.table.Table
        A column for every score that any row has: PSNR, SSIM and LPIPS of noise-free truth, likelihood and correlation
        of speckled truth, CD and F1 of a known surface, and time. "–" stands for what does not apply.
        Below the paper's row, what it means.
    """
    points = {key: metrics["points"]["visible"][key] for key in ("cd_m", "f1@0.3")}
    common = {**points, "time_s": metrics["time_s"]}
    rows: list[tuple[str, Mapping[str, float | None]]] = []
    for split, scores in metrics["images"].items():
        rows.append((f"ours, {split}", {**scores, **common}))
        beside = (yardsticks or {}).get(split, {})
        rows += [(f"{name.replace('_', ' ')}, {split}", scores) for name, scores in beside.items()]
    if not rows:
        rows.append(("ours", common))
    if paper is not None:
        rows.append((f"paper, {paper.target}", {**vars(paper), "f1@0.3": paper.f1}))
    shown = [column for column in _COLUMNS if any(scores.get(column[0]) is not None for _, scores in rows)]
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("", no_wrap=True)
    for key, heading, text in shown:
        words = [*heading.split(), *(text(scores.get(key)) for _, scores in rows)]
        table.add_column(heading, justify="right", min_width=max(map(len, words)))  # headings may wrap
    for name, scores in rows:
        table.add_row(name, *(text(scores.get(key)) for key, _, text in shown))
    if paper is not None:
        table.caption, table.caption_justify = NOT_THE_SAME_EXPERIMENT, "left"
    return table
