"""Chips without azimuth: K with azimuths are learned from, the others located, added, and learned from as well.

Prints, for each training, the nats of unseen chips, and how well the azimuths of those added are known. Nothing is
trained twice, so end it at any time and start it again.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch is loaded

import numpy as np
from recognise import evenly

from sarsplat import Dataset, Run, import_mstar, locate, preset, read_dataset, reconstruct, write_dataset
from sarsplat.data.sidecar import UNPLACED
from sarsplat.evaluation import evaluate_run
from sarsplat.evaluation.azimuths import signed
from sarsplat.recognition import write_back

TRAINING, TEST = 17, 15
UNSEEN = 60
"""Unseen chips of each depression."""


def main() -> int:
    """Read the command line."""
    parser = options(__doc__)
    parser.add_argument("--known", type=int, default=8, metavar="K", help="chips with azimuths")
    parser.add_argument("--others", type=int, default=28, metavar="N", help="chips without")
    parser.add_argument("--rounds", type=int, default=2, metavar="N", help="of locating and training again")
    given = parser.parse_args()
    work, count = given.work / given.target, given.known + given.others
    train, tests = imported(given, count)
    known, others = divided(train, given.known)
    seeded = work / f"seed {given.seed}"
    before = written(with_tests(known, tests), others, work / f"{given.known} of {count} chips")
    run = trained(before, seeded / "known alone", given.seed)
    for number in range(1, given.rounds + 1):
        located = locate([run], before.path or "", split="train")
        after = write_back(located, before.path or "", seeded / f"placed {number}", overwrite=True)
        run = trained(after, seeded / f"round {number}", given.seed)
        told(after, others, run)
    trained(with_tests(train, tests), seeded / "all known", given.seed)
    return 0


def options(description: str | None) -> argparse.ArgumentParser:
    """Options of programs on chips of one class."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chips", type=Path, required=True, metavar="FOLDER", help="folder of the ten classes' chips")
    parser.add_argument("--labels", type=Path, required=True, metavar="TABLE", help="their table")
    parser.add_argument("--target", default="T72", metavar="CLASS")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, required=True, metavar="FOLDER")
    return parser


def imported(given: argparse.Namespace, count: int) -> tuple[Dataset, list[Dataset]]:
    """So many training chips of the class, and unseen ones of both depressions; imported once."""
    folder = given.work / given.target / f"{count} chips"
    if not folder.exists():
        about: dict[str, Any] = {"train_views": count, "train_depression": TRAINING}
        import_mstar(given.chips, folder, labels=given.labels, target_class=given.target, **about)
    every = read_dataset(folder)
    tests = [evenly(every.select(f"test-{depression}"), UNSEEN) for depression in (TRAINING, TEST)]
    return every.select("train"), tests


def divided(train: Dataset, count: int) -> tuple[Dataset, Dataset]:
    """So many chips evenly chosen in azimuth, and the others."""
    chosen = {entry.name for entry in evenly(train, count).entries}
    both = [[k for k, entry in enumerate(train.entries) if (entry.name in chosen) == known] for known in (True, False)]
    return train.take(both[0]), train.take(both[1])


def with_tests(train: Dataset, tests: Sequence[Dataset]) -> Dataset:
    """One dataset of training and test chips."""
    parts = (train, *tests)
    entries = tuple(entry for part in parts for entry in part.entries)
    return replace(train, entries=entries, power=np.concatenate([part.power for part in parts]))


def written(dataset: Dataset, others: Dataset, out: Path) -> Dataset:
    """Write a dataset with other training chips whose azimuth is unknown."""
    if out.exists():
        return read_dataset(out)
    pictures = {f"{UNPLACED}/{k:04}.tif": power for k, power in enumerate(others.power)}
    listed = [
        {"name": entry.name, "file": file, "set": "train", "grazing_deg": entry.view.grazing_deg}
        for entry, file in zip(others.entries, pictures, strict=True)
    ]
    return write_dataset(out, replace(dataset, source={**dataset.source, UNPLACED: listed}), pictures=pictures)


def trained(dataset: Dataset, out: Path, seed: int) -> Run:
    """Train, or go on; print the nats of unseen chips."""
    config = replace(preset("measured"), seed=seed)
    run = reconstruct(dataset, config, out, quiet=True, resume=(out / "config.json").is_file())
    images: Any = (run.metrics or evaluate_run(run, points=False, quiet=True))["images"]
    scores = {name: round(images[name]["registered_nats_per_pixel"], 4) for name in sorted(images)}
    print(f"{out.parent.name}, {out.name}: {len(dataset.select('train'))} chips, nats {scores}", flush=True)
    return run


def told(dataset: Dataset, others: Dataset, run: Run) -> None:
    """Print the errors of the azimuths that were found for the other chips, before and after the training."""
    true = {entry.name: entry.view.azimuth_deg for entry in others.entries}
    train = dataset.select("train").entries
    added = [k for k, entry in enumerate(train) if entry.name in true]
    labels = np.array([true[train[k].name] for k in added])
    for when, views in (("located", [entry.view for entry in train]), ("trained", run.snapshot.views)):
        errors = np.abs(signed(np.array([views[k].azimuth_deg for k in added]) - labels))
        near = errors[errors < 20]
        print(
            f"  {when}: {len(added)} of {len(others)}, median {np.median(errors):.2f}°, rms of those within 20° "
            f"{np.sqrt((near**2).mean()):.2f}°, beyond {(errors >= 20).sum()}, largest {errors.max():.1f}°",
            flush=True,
        )
    std = np.array([train[k].azimuth_std_deg for k in added])
    print(f"  standard deviations: median {np.median(std):.2f}°", flush=True)


if __name__ == "__main__":
    sys.exit(main())
