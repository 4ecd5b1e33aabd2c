"""Scores as a table in the terminal, beside what they are to be compared with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

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


def metrics_table(
    metrics: Mapping[str, Any],
    *,
    paper: PaperRow | None = None,
    yardsticks: Mapping[str, Mapping[str, Mapping[str, float]]] | None = None,
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
        PSNR, SSIM, LPIPS, CD, F1 and time for a rendered set; likelihood and correlation for a measured one. "–" stands
        for what does not apply.
    """
    if all(scores["psnr_db"] is None for scores in metrics["images"].values()):
        return _measured_table(metrics, yardsticks or {})
    return _rendered_table(metrics, paper)


def _rendered_table(metrics: Mapping[str, Any], paper: PaperRow | None) -> Table:
    table = Table("")
    for heading in ("PSNR dB", "target dB", "SSIM", "LPIPS", "CD m", "F1@0.3", "time"):
        table.add_column(heading, justify="right", no_wrap=True)
    visible = metrics["points"]["visible"]
    for name, scores in metrics["images"].items():
        table.add_row(
            f"ours, {name}",
            _number(scores["psnr_db"], 2),
            _number(scores["psnr_target_db"], 2),
            _number(scores["ssim"], 4),
            _number(scores["lpips"], 4),
            _number(visible["cd_m"], 3),
            _number(visible["f1@0.3"], 3),
            _duration(metrics["time_s"]),
        )
    if paper is None:
        return table
    table.add_row(
        f"paper, {paper.target}",
        _number(paper.psnr_db, 2),
        _number(None, 2),
        _number(paper.ssim, 4),
        _number(paper.lpips, 4),
        _number(paper.cd_m, 3),
        _number(paper.f1, 3),
        _duration(paper.time_s),
    )
    return table


def _measured_table(metrics: Mapping[str, Any], yardsticks: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Table:
    table = Table("")
    for heading in ("nats per pixel", "correlation", "time"):
        table.add_column(heading, justify="right", no_wrap=True)
    for split, scores in metrics["images"].items():
        ours = (f"ours, {split}", scores, metrics["time_s"])
        others = [
            (f"{name.replace('_', ' ')}, {split}", beside, None) for name, beside in yardsticks.get(split, {}).items()
        ]
        for label, row, seconds in (ours, *others):
            nats, correlation = _number(row["nats_per_pixel"], 3), _number(row["log_correlation"], 3)
            table.add_row(label, nats, correlation, _duration(seconds))
    return table


def _number(value: float | None, decimals: int) -> str:
    return "–" if value is None else f"{value:.{decimals}f}"


def _duration(seconds: float | None) -> str:
    """Minutes and seconds, as the paper gives them."""
    return "–" if seconds is None else f"{round(seconds) // 60}:{round(seconds) % 60:02d}"
