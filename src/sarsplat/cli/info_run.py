"""What `sarsplat info` says about a run: how far it is, what it has learned, what is in its folder."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from sarsplat.cli import console
from sarsplat.errors import counted

if TYPE_CHECKING:
    import numpy as np

    from sarsplat.runs.run_folder import Header
    from sarsplat.runs.state import TrainingState


def describe_run(path: Path) -> None:
    """Print what a run's folder says of it: of a finished run without loading torch, of another without its model."""
    from sarsplat.runs.run_folder import read_header, read_metrics
    from sarsplat.runs.state import state_of

    header = read_header(path)
    where = None if header.dataset is None else Path(header.dataset)
    state = state_of(path, header)
    about, points = _results(path) if state.has_results else (_so_far(header, state), None)
    rows = {
        "dataset": "images in memory" if where is None else f"{where}{'' if where.exists() else ' (no longer there)'}",
        "method": header.method,
        "state": str(state),
        **about,
        "points": "none yet" if points is None else extent(points),
        "scores": "metrics.json" if read_metrics(path) else "none yet; run sarsplat evaluate",
        "report": "report/index.html" if (path / "report" / "index.html").is_file() else "none yet",
    }
    console.facts(f"{path}: a run", rows)
    if not state.finished:
        dataset = "DATASET" if where is None or not where.exists() else shlex.quote(str(where))
        console.say(f"go on with: sarsplat reconstruct {dataset} --out {shlex.quote(str(path))} --resume")


def _results(path: Path) -> tuple[dict[str, str], np.ndarray]:
    """`Run.about` and `Run.points`, from their files; only runs of older versions lack the first."""
    from sarsplat.data import read_json, read_points_ply
    from sarsplat.runs.run_folder import ABOUT, POINTS

    points = read_points_ply(path / POINTS)[0]
    if (path / ABOUT).is_file():
        return read_json(path / ABOUT, dict[str, str]), points
    from sarsplat.runs import Run

    return Run.load(path).about, points


def _so_far(header: Header, state: TrainingState) -> dict[str, str]:
    """What settings and log say of a training that is not finished."""
    rows: dict[str, str] = {name: str(header.config[name]) for name in ("preset", "seed") if name in header.config}
    if state.last is None:
        return rows
    if state.last.gaussians is not None:
        rows["learned"] = counted(state.last.gaussians, "Gaussian")
    return {**rows, "loss": f"{state.last.loss:.3g}", "time": f"{state.last.seconds:.1f} s"}


def extent(points: np.ndarray) -> str:
    """How many points, and between which coordinates they lie."""
    if len(points) == 0:
        return "0"
    low, high = points.min(axis=0), points.max(axis=0)
    ranges = ", ".join(f"{name} {a:.4g} … {b:.4g} m" for name, a, b in zip("xyz", low, high, strict=True))
    return f"{len(points):,}; {ranges}"
