"""An experiment as a plan for `sarsplat.sweep`: its datasets, made where missing, and a part for each row."""

from __future__ import annotations

import csv
import hashlib
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from chip_draws import write_table
from experiment import Experiment, Options, Row
from finished import Finished
from made_scenes import written

from sarsplat import Dataset, import_mstar, read_dataset, target_mesh, write_dataset
from sarsplat.baselines import BaselineMethod
from sarsplat.baselines.baseline import BaselineConfig
from sarsplat.cli.app import parse
from sarsplat.data import read_masks
from sarsplat.data.mesh import write_mesh
from sarsplat.runs import METHODS
from sarsplat.scenes import TARGETS
from sarsplat.settings.config import DEFAULT_METHOD
from sarsplat.settings.presets import PRESETS
from sarsplat.sweeps.cell import code

_QUICK_ITERATIONS, _FEW_ITERATIONS, _FEW_VOXELS = 60, 3, 24


@dataclass(frozen=True)
class Chips:
    """Where measured chips are: their folder, their table, and the folder of their masks, if there are any."""

    folder: Path
    labels: Path
    masks: Path | None = None


def plan_of(experiment: Experiment, work: Path, chips: Chips | None = None) -> dict[str, Any]:
    """The plan; its datasets must be there (`make`)."""
    parts = [part for row in experiment.rows for part in _parts(experiment, row, work, chips)]
    return {"datasets": parts[0]["datasets"], "reports": False, "parts": parts}


def in_our_time(experiment: Experiment, runs: Sequence[Finished]) -> Experiment:
    """With the iterations that fit into the time of each group's first row, once that is known; otherwise without."""
    rows = []
    for row in experiment.rows:
        if not row.full:
            rows.append(row)
            continue
        group = {other.label: other for other in experiment.groups()[row.group]}
        ours, whole = (_time_s(one, runs) for one in (next(iter(group.values())), group[row.full]))
        if ours is not None and whole is not None:
            share = min(1.0, ours / whole)
            steps = float(
                f"{_iterations(group[row.full]) * share:.2g}"
            )  # a time that differs a little asks for no others
            rows.append(replace(row, changes={**row.changes, "iterations": max(1, int(steps))}))
    return replace(experiment, rows=tuple(rows))


def missing(experiment: Experiment, work: Path) -> dict[Path, Options]:
    """Datasets that are still to be made, with their options."""
    each = (dataset for row in experiment.rows for seed in experiment.seeds for dataset in row.drawn(seed))
    folders = {folder_of(dataset, work): dataset for dataset in each}
    return {folder: dataset for folder, dataset in folders.items() if not folder.exists()}


def make(experiment: Experiment, work: Path, chips: Chips | None) -> None:
    """Simulate or import what is missing; chips only if it is said where they are."""
    for folder, dataset in missing(experiment, work).items():
        folder.parent.mkdir(parents=True, exist_ok=True)
        if "scene" in dataset:
            dataset = written(dataset, folder.parent / "meshes")
        if experiment.quick and "target_class" not in dataset:
            whole = folder.with_suffix(".whole")
            parse(simulation_words(whole, dataset))()
            write_dataset(folder, **_without_truth(read_dataset(whole)))
        elif "target_class" not in dataset:
            parse(simulation_words(folder, dataset))()
        elif chips is not None:
            options = {name: value for name, value in dataset.items() if name not in ("folded", "seed")}
            if dataset.get("folded"):
                every = import_mstar(chips.folder, folder.with_suffix(".whole"), labels=chips.labels, **options)
                write_dataset(folder, folded(every))
            elif "seed" in dataset:
                labels = drawn(chips.labels, dataset, folder.with_suffix(".csv"))
                every = import_mstar(chips.folder, folder.with_suffix(".whole"), labels=labels, **options)
                write_dataset(folder, with_the_others(every, dataset))
            else:
                import_mstar(chips.folder, folder, labels=chips.labels, **options)


def simulation_words(out: Path, options: Options) -> list[str]:
    """Return the words of `sarsplat simulate` that ask for these options."""
    words = ["simulate", "--out", str(out)]
    for name, value in options.items():
        if value is not None and value is not False:
            words.append(f"--{name.replace('_', '-')}")
            words += () if value is True else map(str, value if isinstance(value, tuple) else (value,))
    return words


def _without_truth(dataset: Dataset) -> dict[str, Any]:
    """The dataset and its masks: to find the nearest of points that are no surface yet takes minutes."""
    folder = Path(dataset.path or "") / "masks"
    found = read_masks(folder, dataset, dataset.splits()) if folder.is_dir() else {}
    masks = np.stack([found[index] for index in range(len(dataset))]) if found else None
    return {"dataset": replace(dataset, truth_mesh=None), "masks": masks}


def folded(dataset: Dataset) -> Dataset:
    """Its training chips alone: of every four, three are trained on and one is predicted."""
    train = dataset.select("train")
    entries = tuple(
        replace(entry, split="test" if index % 4 == 1 else "train") for index, entry in enumerate(train.entries)
    )
    return replace(train, entries=entries)


_NOT_DRAWN = "1"  # a planned depression angle that no chip has


def drawn(labels: Path, dataset: Options, out: Path) -> Path:
    """The table with a class's training chips drawn at random: all others get another planned depression angle."""
    with labels.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    (at,) = dataset["train_depression"]
    own = [
        row for row in rows if row["class"] == dataset["target_class"] and float(row["desired_depression_deg"]) == at
    ]
    known = [row["path"] for row in own if row["target_az_deg"]]
    chance = np.random.default_rng([dataset["seed"], dataset["train_views"], *dataset["target_class"].encode()])
    chosen = set(chance.choice(known, dataset["train_views"], replace=False).tolist())
    for row in own:
        if row["path"] not in chosen:
            row["measured_depression_deg"] = row["measured_depression_deg"] or row["desired_depression_deg"]
            row["desired_depression_deg"] = _NOT_DRAWN
    return write_table(rows, out)


def with_the_others(dataset: Dataset, options: Options) -> Dataset:
    """With chips that were not drawn as test chips of their depression angle."""
    (angle,) = options["train_depression"]
    names = {f"test-{_NOT_DRAWN}": f"test-{angle}"}
    entries = tuple(replace(entry, split=names.get(entry.split, entry.split)) for entry in dataset.entries)
    return replace(dataset, entries=entries)


def folder_of(dataset: Options, work: Path) -> Path:
    """Where a dataset is: other options, or another simulation or import, are another folder."""
    maker = "sarsplat.importers.mstar" if "target_class" in dataset else "sarsplat.cli.simulate"
    content = json.dumps({"options": dataset, "code": code((maker,), "cpu")}, sort_keys=True)
    return work.resolve() / "datasets" / hashlib.sha256(content.encode()).hexdigest()[:20]


def _parts(experiment: Experiment, row: Row, work: Path, chips: Chips | None) -> list[dict[str, Any]]:
    """A plan for a row; one for each seed if its datasets depend on that."""
    settings = {**row.changes, **(shortened(row) if experiment.quick else {})}
    own: dict[str, Any] = {} if row.method == DEFAULT_METHOD else {"methods": [row.method]}
    own |= {"name": row.name, "preset": row.preset, "settings": settings}
    if not experiment.quick:
        own |= _truth(row, work)
    if "masks" in METHODS[row.method].takes and chips is not None and "target_class" in row.datasets[0]:
        own["masks"] = str(chips.masks)
    seeds = experiment.seeds_of(row)
    groups = [(seed,) for seed in seeds] if row.random else [seeds]
    return [
        {**own, "datasets": [str(folder_of(one, work)) for one in row.drawn(seeds[0])], "seeds": list(seeds)}
        for seeds in groups
    ]


def _truth(row: Row, work: Path) -> dict[str, Any]:
    """What measured chips are held against: a model of their target, if there is one."""
    target = str(row.datasets[0].get("target_class", "")).partition("-")[0].lower()
    if target not in TARGETS or row.datasets[0].get("folded"):
        return {}
    model = work.resolve() / "datasets" / f"{target}.ply"
    if not model.exists():
        model.parent.mkdir(parents=True, exist_ok=True)
        write_mesh(model, target_mesh(target))
    return {"mesh": str(model), "align": "rigid"}


def _time_s(row: Row, runs: Sequence[Finished]) -> float | None:
    times = [run.scores["time_s"] for run in runs if run.row == row.name and "time_s" in run.scores]
    return statistics.fmean(times) if times else None


def defaults(row: Row) -> BaselineConfig:
    """Default settings of its method, which is a baseline."""
    method = METHODS[row.method]
    assert isinstance(method, BaselineMethod), f"{row.method} has presets instead"
    return method.defaults


def _iterations(row: Row) -> int:
    """Of the training of a baseline."""
    return int(row.changes.get("iterations", defaults(row).iterations))


def shortened(row: Row) -> Mapping[str, Any]:
    """Settings of the same training in small: whatever counts iterations shrinks by the same factor."""
    if row.method != DEFAULT_METHOD:
        voxels = {"surface_voxels": _FEW_VOXELS} if hasattr(defaults(row), "surface_voxels") else {}
        return {"iterations": min(_FEW_ITERATIONS, _iterations(row)), **voxels}
    config = PRESETS["default" if row.preset == "auto" else row.preset].with_settings(row.changes)
    share = _QUICK_ITERATIONS / config.iterations
    counts = {name: getattr(config, name) for name in ("iterations", "harmonics_every", "checkpoint_every")}
    if config.densification is not None:
        counts |= {f"densification.{name}": getattr(config.densification, name) for name in ("start", "stop", "every")}
    settings: dict[str, Any] = {name: max(1, round(count * share)) for name, count in counts.items()}
    if config.gaussians is not None:
        settings["gaussians"] = max(1, config.gaussians // 10)
    return settings
