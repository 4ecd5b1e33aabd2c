"""An experiment as a plan for `sarsplat.sweep`: its datasets, simulated where missing, and a part for each row."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from catalogue import Experiment, Options, Row
from code_version import digest

from sarsplat.reconstruction.presets import PRESETS
from sarsplat.sweeps.address import code

_QUICK_ITERATIONS = 60


def plan_of(experiment: Experiment, work: Path) -> dict[str, Any]:
    """The plan; its datasets must be there (`simulated`)."""
    parts = [part for row in experiment.rows for part in _parts(experiment, row, work)]
    return {"datasets": parts[0]["datasets"], "reports": False, "parts": parts}


def missing(experiment: Experiment, work: Path) -> dict[Path, Options]:
    """Datasets that are still to be simulated, with their options."""
    each = (dataset for row in experiment.rows for seed in experiment.seeds for dataset in row.drawn(seed))
    folders = {folder_of(dataset, work): dataset for dataset in each}
    return {folder: dataset for folder, dataset in folders.items() if not folder.exists()}


def simulated(experiment: Experiment, work: Path) -> None:
    """Simulate what is missing."""
    from sarsplat.cli.simulate import simulate

    for folder, dataset in missing(experiment, work).items():
        folder.parent.mkdir(parents=True, exist_ok=True)
        simulate(out=folder, **dataset)


def folder_of(dataset: Options, work: Path) -> Path:
    """Where a dataset is: other options, or another simulation, are another folder."""
    made_by = code(("sarsplat.cli.simulate",), "cpu")
    return work.resolve() / "datasets" / digest({"options": dataset, "code": made_by})


def _parts(experiment: Experiment, row: Row, work: Path) -> list[dict[str, Any]]:
    """A plan for a row; one for each seed if its datasets depend on that."""
    settings = row.changes | (shortened(row) if experiment.quick else {})
    common = {"name": row.name, "preset": row.preset, "settings": settings}
    groups = [(seed,) for seed in experiment.seeds] if row.random else [experiment.seeds]
    return [
        {**common, "datasets": [str(folder_of(one, work)) for one in row.drawn(seeds[0])], "seeds": list(seeds)}
        for seeds in groups
    ]


def shortened(row: Row) -> Mapping[str, Any]:
    """Settings of the same training in small: whatever counts iterations shrinks by the same factor.

    It starts in the box: points still on the hemisphere are all about as far from a sample of the surface, so that
    finding the nearest takes minutes.
    """
    config = PRESETS["default" if row.preset == "auto" else row.preset].with_settings(row.changes)
    share = _QUICK_ITERATIONS / config.iterations
    counts = {name: getattr(config, name) for name in ("iterations", "harmonics_every", "checkpoint_every")}
    if config.densification is not None:
        counts |= {f"densification.{name}": getattr(config.densification, name) for name in ("start", "stop", "every")}
    settings: dict[str, Any] = {name: max(1, round(count * share)) for name, count in counts.items()}
    if config.gaussians is not None:
        settings["gaussians"] = max(1, config.gaussians // 10)
    return settings | {"initialisation": "box"}
