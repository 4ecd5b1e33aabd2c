"""What `sarsplat info` says about a run: how far it is, what it has learned, what is in its folder."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from sarsplat.cli import console
from sarsplat.errors import counted

if TYPE_CHECKING:
    import numpy as np

    from sarsplat.runs.run_folder import RunFolder, TrainingState


def describe_run(path: Path) -> None:
    """Print what a run's folder says of it: of a finished run without loading torch, of another without its model."""
    from sarsplat.runs.run_folder import RunFolder
    from sarsplat.settings.config import OWN_LOOP

    files = RunFolder(path)
    header, state = files.header, files.state
    where = None if header.dataset is None else Path(header.dataset)
    about = _about(files) if state.has_results else _so_far(files, state)
    stored = files.points
    rows = {
        "dataset": "images in memory" if where is None else f"{where}{'' if where.exists() else ' (no longer there)'}",
        "method": header.method,
        "state": str(state),
        **about,
        "points": "none yet" if stored is None else extent(stored[0]),
        "scores": "metrics.json" if files.metrics else "none yet; run sarsplat evaluate",
        "report": "report/index.html" if (path / "report" / "index.html").is_file() else "none yet",
    }
    whole = path.absolute().parents[1] if len(path.absolute().parents) > 1 else path
    if path.absolute().parent.name == "tiles" and (whole / "config.json").is_file():
        console.facts(f"{path}: a tile of the run {whole}, which goes on with it", rows)
        return
    console.facts(f"{path}: a run", rows)
    if not state.finished and (state.done or not state.has_results) and header.config.get("preset") != OWN_LOOP:
        dataset = "DATASET" if where is None or not where.exists() else shlex.quote(str(where))
        console.say(f"go on with: sarsplat reconstruct {dataset} --out {shlex.quote(str(path))} --resume")


def _about(files: RunFolder) -> dict[str, str]:
    """`Run.about`, from its file; only runs of older versions lack that."""
    from sarsplat.data import read_json
    from sarsplat.runs.run_folder import ABOUT

    if (files.path / ABOUT).is_file():
        return read_json(files.path / ABOUT, dict[str, str])
    from sarsplat.runs import Run

    return Run.load(files.path).about


def _so_far(files: RunFolder, state: TrainingState) -> dict[str, str]:
    """What settings and log say of a training that is not finished."""
    settings = files.header.config
    rows: dict[str, str] = {name: str(settings[name]) for name in ("preset", "seed") if name in settings}
    last = next((line for line in reversed(files.history) if line.iteration <= state.done), None)
    if last is None:
        return rows
    if last.gaussians is not None:
        rows["learned"] = counted(last.gaussians, "Gaussian")
    return {**rows, "loss": f"{last.loss:.3g}", "time": f"{last.seconds:.1f} s"}


def extent(points: np.ndarray) -> str:
    """How many points, and between which coordinates they lie."""
    if len(points) == 0:
        return "0"
    low, high = points.min(axis=0), points.max(axis=0)
    ranges = ", ".join(f"{name} {a:.4g} … {b:.4g} m" for name, a, b in zip("xyz", low, high, strict=True))
    return f"{len(points):,}; {ranges}"
