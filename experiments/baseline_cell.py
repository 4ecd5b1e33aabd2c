"""One cell of the comparison: a dataset, a method, how long it may take, a seed; what it scored is one small file.

`python experiments/baseline_cell.py WORK < cell.json` runs a single cell; `baselines.py` gives each its own process,
so that its peak memory is its own.
"""

from __future__ import annotations

import io
import json
import re
import statistics
import sys
import time
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from code_version import code_version, digest
from filelock import FileLock

from sarsplat import Dataset, Run, evaluate_run, import_mstar, read_dataset, reconstruct, target_mesh
from sarsplat.data import write_bytes, write_json
from sarsplat.data.mesh import write_mesh
from sarsplat.errors import SarsplatError
from sarsplat.reconstruction import METHODS, Inputs, Step
from sarsplat.reconstruction.run import InMemory

_TIMED_SHARE = 0.05
"""Share of a time in which steps are timed, to say how many fit into the whole; three at least, after the first."""


@dataclass(frozen=True)
class Images:
    """Where a dataset comes from.

    Attributes
    ----------
    name : str
        For readers.
    simulate : mapping
        Options of `sarsplat simulate`; empty for measured chips …
    chips : mapping
        … which have those of `sarsplat.import_mstar`, and `masks`, the folder of their masks.
    """

    name: str
    simulate: Mapping[str, Any] = field(default_factory=dict)
    chips: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class BaselineCell:
    """What is done once.

    Attributes
    ----------
    images : Images
        What is learned from and predicted.
    method : str
        One of `METHODS`.
    changes : mapping
        Settings that differ from its defaults.
    seconds : float or None
        How long it may train; None: as long as its settings say.
    seed : int
        Of the training.
    curve : tuple of float
        Seconds of training after which it is scored on the way, on a quarter of the test images.
    """

    images: Images
    method: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    seed: int = 0
    curve: tuple[float, ...] = ()

    def path(self, work: Path, code: str) -> Path:
        """Where its scores are kept."""
        return work / "cells" / f"{digest({**asdict(self), 'code': code})}.json"


class Bench:
    """A dataset with what is needed to train on it and to score it."""

    def __init__(self, images: Images, work: Path, code: str) -> None:
        self.images, self.work = images, work
        self._folder = work / "datasets" / digest({**asdict(images), "code": code})
        self._folder.parent.mkdir(parents=True, exist_ok=True)

    @cached_property
    def dataset(self) -> Dataset:
        """The images, made by whoever needs them first."""
        with FileLock(self._folder.with_suffix(".lock")):
            if not self._folder.exists() and self.images.simulate:
                from sarsplat.cli.simulate import simulate

                simulate(out=self._folder, masks=True, **self.images.simulate)
            elif not self._folder.exists():
                chips = {name: value for name, value in self.images.chips.items() if name not in ("chips", "masks")}
                import_mstar(self.images.chips["chips"], self._folder, **chips)
        return read_dataset(self._folder)

    @cached_property
    def masks(self) -> Path:
        """Masks of all images."""
        _ = self.dataset
        return Path(self.images.chips["masks"]) if self.images.chips else self._folder / "masks"

    @cached_property
    def tests(self) -> list[int]:
        """Numbers of the test images."""
        return [index for index, entry in enumerate(self.dataset.entries) if entry.split != "train"]

    @cached_property
    def fewer(self) -> Dataset:
        """The same with every fourth test image and without a mesh: to score images on the way, quickly."""
        chosen = sorted({*range(len(self.dataset))} - {*self.tests} | {*self.tests[::4]})
        return replace(self.dataset.take(chosen), truth_mesh=None)

    def scores(self, run: Run, *, fewer: bool = False) -> dict[str, Any]:
        """Everything that `evaluate` says; of chips, the surface is held against the procedural model, aligned.

        With `fewer`, only what it says of images.
        """
        if fewer:
            run = replace(run, images=self.fewer)
        if fewer or not self.images.chips:
            return evaluate_run(run, quiet=True)
        model = self.work / "datasets" / f"{self.images.chips['target_class'].lower()}.ply"
        with FileLock(model.with_suffix(".lock")):
            if not model.exists():
                write_mesh(model, target_mesh(self.images.chips["target_class"].lower()))
        return evaluate_run(run, mesh=model, alignment="rigid", quiet=True)


def run(cell: BaselineCell, work: Path) -> Path:
    """Do it, unless it has been done; returns the file that says what came of it."""
    code = code_version(cell.method)
    path = cell.path(work, code)
    if path.is_file():
        return path
    bench = Bench(cell.images, work, code_version())
    config = replace(METHODS[cell.method].preset("auto", bench.dataset), seed=cell.seed, **cell.changes)
    if cell.seconds is not None:
        config = replace(config, iterations=min(config.iterations, _fitting_in(cell.seconds, cell, config, bench)))
    watch = _Watch(cell, bench, Run(cell.method, config, ""))
    masks = _inputs(cell, bench).masks
    learned = reconstruct(bench.dataset, config, method=cell.method, masks=masks, on_step=watch, quiet=True)
    scored = bench.scores(learned)
    if code_version(cell.method) != code:
        raise SarsplatError("the package's sources changed while a cell was running; run it again")
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {name: scored[name] for name in ("images", "points", "baselines", "reasons")}
    done = {
        "code": code,
        "cell": asdict(cell),
        "config": learned.config.as_dict(),
        **kept,
        "time_s": watch.trained_s,
        "iterations": learned.iteration,
        "peak_bytes": watch.peak_bytes,
        "curve": watch.points,
    }
    pictured = [bench.tests[index] for index in _pictured(len(bench.tests))]
    images = learned.render([bench.dataset.views[index] for index in pictured])
    with io.BytesIO() as file:
        np.savez_compressed(file, images=images, truth=bench.dataset.power[pictured], points=learned.points)
        write_bytes(path.with_suffix(".npz"), file.getvalue())
    write_json(path, done)
    return path


def _pictured(count: int) -> list[int]:
    """Test images that are shown: two, far apart."""
    return [count // 5, (3 * count) // 5]


class _Watch:
    """Time and memory of a training, and scores as it goes on, without what scoring takes.

    Time is that of one core: cells have one thread, and whatever else runs on the machine does not count.
    """

    def __init__(self, cell: BaselineCell, bench: Bench, new: Run) -> None:
        self._left, self._bench, self._new = sorted(cell.curve), bench, new
        self._begun, self._spent, self.trained_s = time.process_time(), 0.0, 0.0
        self.points: list[dict[str, Any]] = []
        self.peak_bytes = 0
        """Most memory that the process held for the training: before anything was scored."""

    def __call__(self, step: Step[Any]) -> None:
        self.trained_s = seconds = time.process_time() - self._begun - self._spent
        if not self.points:
            self.peak_bytes = _peak_bytes()
        if not self._left or seconds < self._left[0]:
            return
        self._left = [later for later in self._left if later > seconds]
        begun = time.process_time()
        held = InMemory(step.trainer.snapshot(seconds), ())
        scored = self._bench.scores(replace(self._new, memory=held), fewer=True)
        kept = {name: scored[name] for name in ("images", "points")}
        self.points.append({"seconds": seconds, "iterations": step.iteration, **kept})
        self._spent += time.process_time() - begun


def _inputs(cell: BaselineCell, bench: Bench) -> Inputs:
    """Masks, for a method that learns from them."""
    return Inputs(masks=bench.masks if "masks" in METHODS[cell.method].takes else None)


def _fitting_in(seconds: float, cell: BaselineCell, config: Any, bench: Bench) -> int:
    """Steps that fit into so many seconds; the learning rate then falls within them."""
    trainer = METHODS[cell.method].trainer(bench.dataset, config, _inputs(cell, bench), torch.device("cpu"), None)
    took: list[float] = []
    while len(took) < 4 or sum(took) < _TIMED_SHARE * seconds:
        begun = time.process_time()
        trainer.step()
        took.append(time.process_time() - begun)
    return max(1, int(seconds / statistics.mean(took[1:])))


def _peak_bytes() -> int:
    """Most memory that this process has held; `getrusage` would also know that of whoever started it."""
    status = Path("/proc/self/status").read_text()
    return int(re.findall(r"VmHWM:\s*(\d+) kB", status)[0]) * 1024


def main() -> None:
    """Run the cell on stdin; a refusal is one sentence on stderr, and exit code 2."""
    data = json.load(sys.stdin)
    cell = BaselineCell(**{**data, "images": Images(**data["images"]), "curve": tuple(data["curve"])})
    try:
        with redirect_stdout(sys.stderr):
            path = run(cell, Path(sys.argv[1]))
    except SarsplatError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(path)


if __name__ == "__main__":
    main()
