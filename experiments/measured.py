"""Measured chips: how well unseen ones are predicted, beside simpler methods, and what each term of the model is worth.

    python experiments/measured.py CHIPS LABELS SET… [--seeds 0 1 2] [--terms | --shape] [--readme]

A SET is CLASS:VIEWS, as T72:36, or CLASS:VIEWS:DEPRESSION,…. It is trained on, and all other chips are predicted. With
--terms no test chip is looked at: of every four training chips three are trained on and one is predicted, with one term
of the model after the other switched off. With --shape the points are held against a model of the target. Tables go to
docs/results/measured-CLASS….md, measured-CLASS…-terms.md or measured-CLASS…-shape.md; finished trainings stay in
runs/measured.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from code_version import code_version

from sarsplat import Config, Dataset, evaluate_run, import_mstar, preset, read_dataset, reconstruct, target_mesh
from sarsplat.data.files import write_bytes
from sarsplat.data.mesh import write_mesh
from sarsplat.reconstruction.config import FlatGround

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "docs"))

from fill_block import fill_block

HERE = Path(__file__).resolve().parent.parent
WORK, RESULTS = HERE / "runs" / "measured", HERE / "docs" / "results"

TERMS: Mapping[str, Mapping[str, Any]] = {
    "everything": {},
    "no ground": {"ground": None},
    "ground of one γ⁰ only": {"ground": FlatGround(pitch=0)},
    "nothing shared by neighbouring chips": {"texture_looks": 0},
    "no side lobes": {"side_lobes": 0},
    "every chip in its place": {"shift_std": 0},
    "every chip of the same gain": {"gain_std": 0},
    "no Gaussian left out": {"dropout": 0},
    "Gaussians as often full as empty": {"sparsity": 0},
    "directions free of each other": {"directional_std": None},
    "γ⁰ the same in all directions": {"harmonics_degree": 0},
}
"""What is switched off, and the settings that do it."""

SCORES = {
    "registered_nats_per_pixel": "registered nats ↓",
    "registered_log_correlation": "registered correlation ↑",
    "nats_per_pixel": "plain nats ↓",
    "log_correlation": "plain correlation ↑",
}
"""Keys of `metrics.json`, and what tables call them."""

SHAPE = {"cd_m": "Chamfer distance, m ↓", "accuracy_m": "accuracy, m ↓", "completeness_m": "completeness, m ↓"}
SHAPE |= {"f1@0.3": "F1 at 0.3 m ↑"}
"""The same for points, against the visible surface."""


def changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """With these settings, of the surroundings or of the whole."""
    around = {name: value for name, value in changes.items() if hasattr(config.surroundings, name)}
    rest = {name: value for name, value in changes.items() if name not in around}
    return replace(config, surroundings=replace(config.surroundings, **around), **rest)


def imported(chips: Path, labels: Path, name: str) -> Dataset:
    """The dataset of CLASS:VIEWS or CLASS:VIEWS:DEPRESSION,…."""
    out = WORK / "datasets" / name.replace(":", "-")
    if out.exists():
        return read_dataset(out)
    target_class, views, *depressions = name.split(":")
    return import_mstar(
        chips,
        out,
        labels=labels,
        target_class=target_class,
        train_views=int(views),
        train_depression=[int(value) for value in depressions[0].split(",")] if depressions else 17,
    )


def folded(dataset: Dataset) -> Dataset:
    """Its training chips alone: of every four, three are trained on and one is predicted."""
    train = dataset.select("train")
    entries = tuple(
        replace(entry, split="test" if index % 4 == 1 else "train") for index, entry in enumerate(train.entries)
    )
    return replace(train, entries=entries)


def scores(dataset: Dataset, config: Config, name: str, mesh: Path | None = None) -> dict[str, Any]:
    """Train and evaluate, with points against a mesh if there is one, unless that was done already."""
    path = WORK / code_version("sar-gs") / f"{name}.json"
    if not path.exists():
        print(name, flush=True)
        run = reconstruct(dataset, config, quiet=True)
        scored = evaluate_run(run, mesh=mesh, alignment="rigid" if mesh else "none", quiet=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = {"time_s": run.time_s, **{part: scored[part] for part in ("images", "baselines", "points")}}
        write_bytes(path, json.dumps(kept).encode())
    return json.loads(path.read_bytes())


def row(label: str, several: Sequence[Mapping[str, float]], keys: Mapping[str, str] = SCORES) -> str:
    """One line of a table: means over the seeds, with their standard deviation if there are several."""
    cells = []
    for key in keys:
        values = np.array([scores[key] for scores in several])
        spread = f" ± {values.std(ddof=1):.4f}" if len(values) > 1 else ""
        cells.append(f"{values.mean():.3f}{spread}")
    return f"| {label} | {' | '.join(cells)} |"


def table(first: str, rows: Sequence[str], keys: Mapping[str, str] = SCORES) -> str:
    """Markdown."""
    return "\n".join([f"| {first} | {' | '.join(keys.values())} |", "|---|" + "---:|" * len(keys), *rows, ""])


def predictions(datasets: Mapping[str, Dataset], seeds: Sequence[int]) -> str:
    """Chips that were not trained on, of every set, beside simpler methods."""
    parts = []
    for name, dataset in datasets.items():
        runs = [scores(dataset, replace(preset("measured"), seed=seed), f"{name}-{seed}") for seed in seeds]
        seconds = max(run["time_s"] for run in runs)
        parts.append(f"## {name}\n\nTrained on {len(dataset.select('train'))} chips in {seconds:.0f} s at most.\n")
        for split in runs[0]["images"]:
            simpler = runs[0]["baselines"][split].items()
            rows = [row(method.replace("_", " "), [figures]) for method, figures in simpler]
            parts.append(table(split, [row("sarsplat", [run["images"][split] for run in runs]), *rows]))
    return "\n".join(parts)


def summary(datasets: Mapping[str, Dataset], seeds: Sequence[int]) -> str:
    """The README's table: the mean over seeds, beside simpler methods."""
    lines = [
        "| nats per pixel ↓ (correlation ↑), both registered | sarsplat | rotated average | nearest chip |",
        "|---|---:|---:|---:|",
    ]
    keys = ("registered_nats_per_pixel", "registered_log_correlation")
    for name, dataset in datasets.items():
        runs = [scores(dataset, replace(preset("measured"), seed=seed), f"{name}-{seed}") for seed in seeds]
        for split in runs[0]["images"]:
            simpler = [runs[0]["baselines"][split][method] for method in ("rotated_average", "nearest_chip")]
            ours = {key: float(np.mean([run["images"][split][key] for run in runs])) for key in keys}
            cells = " | ".join(f"{figures[keys[0]]:.3f} ({figures[keys[1]]:.3f})" for figures in (ours, *simpler))
            target, views = name.split(":")[:2]
            lines.append(f"| {target}, {views} chips → {split.removeprefix('test-')}° | {cells} |")
    return "\n".join([*lines, ""])


def terms(datasets: Mapping[str, Dataset], seeds: Sequence[int]) -> str:
    """What training chips that were left out cost when a term is missing."""
    parts = []
    for name, dataset in datasets.items():
        fold = folded(dataset)
        part = f"{len(fold.select('train'))} of {len(fold)}"
        rows = []
        for label, changes in TERMS.items():
            config = changed(preset("measured"), changes)
            runs = [
                scores(fold, replace(config, seed=seed), f"{name}-{part}-{label}-{seed}".replace(" ", "_"))
                for seed in seeds
            ]
            rows.append(row(label, [run["images"]["test"] for run in runs]))
        parts.append(f"## {name}, trained on {part} chips\n\n{table('', rows)}")
    return "\n".join(parts)


def shape(datasets: Mapping[str, Dataset], seeds: Sequence[int]) -> str:
    """Points against our model of the target, brought onto it by a small motion."""
    rows = []
    for name, dataset in datasets.items():
        target = name.split(":")[0].split("-")[0].lower()
        model = WORK / "datasets" / f"{target}.ply"
        write_mesh(model, target_mesh(target))
        train = [index for index, entry in enumerate(dataset.entries) if entry.split == "train"]
        alone = dataset.take([*train, next(index for index in range(len(dataset)) if index not in train)])
        runs = [
            scores(alone, replace(preset("measured"), seed=seed), f"{name}-shape-{seed}", mesh=model) for seed in seeds
        ]
        rows.append(row(f"{name}, against the model `{target}`", [run["points"]["visible"] for run in runs], SHAPE))
    return table("", rows, SHAPE)


def main() -> None:
    """See the head of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("chips", type=Path)
    parser.add_argument("labels", type=Path)
    parser.add_argument("sets", nargs="+", metavar="SET")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--terms", action="store_true")
    kind.add_argument("--shape", action="store_true")
    parser.add_argument("--readme", action="store_true", help="also fill the README's table with these sets")
    options = parser.parse_args()
    datasets = {name: imported(options.chips, options.labels, name) for name in options.sets}
    classes = dict.fromkeys(name.split(":")[0] for name in datasets)
    page = "-".join(classes).lower()
    if options.terms:
        page, title = f"{page}-terms", f"What each term of the model is worth: {', '.join(classes)}"
        text = terms(datasets, options.seeds)
    elif options.shape:
        page, title = f"{page}-shape", f"Shape of {', '.join(classes)}"
        text = shape(datasets, options.seeds)
    else:
        title = f"Measured chips of {', '.join(classes)}"
        text = predictions(datasets, options.seeds)
    if options.readme:
        fill_block(HERE / "README.md", "measured", summary(datasets, options.seeds))
    head = f"# {title}\n\nWritten by `experiments/measured.py`; do not edit. Seeds: {len(options.seeds)}.\n\n"
    write_bytes(RESULTS / f"measured-{page}.md", (head + text).encode())


if __name__ == "__main__":
    main()
