"""One run of a sweep: its dataset, method, settings and seed, and its content address."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar, cast

import msgspec
import numpy as np

from sarsplat.data import Dataset, read_dataset, read_masks
from sarsplat.errors import SarsplatError
from sarsplat.runs.methods import method_named
from sarsplat.sweeps.address import code_of, digest, scoring_code
from sarsplat.sweeps.plan import Plan

NAMES = ("part", "dataset", "method", "preset")
"""Labels that are not settings."""

_NO_RESULT = ("preset", "checkpoint_every")
"""Settings that change no result."""


class Cell(msgspec.Struct, frozen=True):
    """One run: a dataset, a method, settings and a seed."""

    work: ClassVar[str] = "sarsplat.sweeps.work:RUN"
    """Name of the executors' `Work`."""

    dataset: str
    """The dataset's folder."""
    method: str
    """Name of the method."""
    config: dict[str, Any]
    """All settings, including the seed."""
    masks: str | None
    mesh: str | None
    align: str
    reports: bool
    device: str
    """As in `Plan`; `masks` includes those that the method learns from."""
    labels: dict[str, Any]
    """Labels in tables: dataset, method, preset, and each setting that the plan names."""
    seed: int
    fingerprint: str
    recipe: str
    """Digest of data, method and settings."""
    code: str
    """Digest of the training's code."""
    scoring: str
    """Digest of the scoring's code and options."""

    def words(self, names: Collection[str]) -> str:
        """Description in one line, from the labels of these names and the seed."""
        labels = {name: value for name, value in self.labels.items() if name in names}
        return ", ".join(
            [
                *(f"{value}" if name in NAMES else f"{name} {value}" for name, value in labels.items()),
                f"seed {self.seed}",
            ]
        )

    @property
    def address(self) -> str:
        """Name of its run and row: a hash of data, settings and training code."""
        return digest([self.recipe, self.code])


def cells_of(plan: Plan, base: Path) -> list[Cell]:
    """List every run of a plan, in its order; patterns are below the folder `base`.

    Raises if a dataset, method, preset or setting does not exist, or a value is out of range.
    """
    return [cell for part in plan.each_part() for cell in _cells(part.at(base), base)]


def _cells(plan: Plan, base: Path) -> Iterator[Cell]:
    for folder, name in plan.folders(base).items():
        unreadable, dataset = "", None
        try:
            dataset = read_dataset(folder)
        except SarsplatError as error:  # the run fails with it when it is tried
            unreadable = str(error)
        for method in plan.each_method():
            yield from _of_dataset(plan, folder, name, dataset, unreadable, *method)


def _of_dataset(
    plan: Plan,
    folder: Path,
    name: str,
    dataset: Dataset | None,
    unreadable: str,
    method: str,
    settings: Mapping[str, Any],
) -> Iterator[Cell]:
    kind = method_named(method)
    masks = plan.masks or (str(folder / "masks") if (folder / "masks").is_dir() else None)
    learned = "masks" in kind.takes and masks is not None and dataset is not None
    learned_from = _fingerprint_of_masks(Path(masks or ""), dataset) if learned and dataset else ""
    fingerprint = f"{folder}: {unreadable}" if dataset is None else dataset.fingerprint()
    code = code_of(method, plan.device)
    scoring = digest([scoring_code(), masks, plan.mesh, plan.align])
    where = f"settings of {method}{f' in {plan.name}' if plan.name else ''}"
    preset_named = cache(partial(kind.preset, dataset=cast(Dataset, dataset)))  # may run a trial
    for preset, chosen in plan.each_choice(settings):
        labels = {"dataset": name, "method": method, "preset": preset, **chosen}
        if plan.name:
            labels = {"part": plan.name, **labels}
        base = None if dataset is None else preset_named(preset).with_settings(chosen, where)
        for seed in plan.seeds:
            config = {**labels, "seed": seed} if base is None else replace(base, seed=seed).as_dict()
            decisive = {one: value for one, value in config.items() if one not in _NO_RESULT}
            recipe = digest([fingerprint, method, decisive, plan.device, learned_from])
            yield Cell(
                dataset=str(folder),
                method=method,
                config=config,
                masks=masks,
                mesh=plan.mesh,
                align=plan.align,
                reports=plan.reports,
                device=plan.device,
                labels=labels,
                seed=seed,
                fingerprint=fingerprint,
                recipe=recipe,
                code=code,
                scoring=scoring,
            )


def _fingerprint_of_masks(folder: Path, dataset: Dataset) -> str:
    try:
        masks = read_masks(folder, dataset, ("train",))
    except SarsplatError as error:
        return str(error)
    return digest([np.stack([*masks.values()]).tobytes().hex(), sorted(masks)])
