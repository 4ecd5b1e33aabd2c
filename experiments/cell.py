"""One cell of the tables: a dataset, a training and a seed; what it scored is one small file in the work folder.

`python experiments/cell.py WORK < cell.json` runs a single cell; `tables.py` gives each a process of its own.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from code_version import code_version
from filelock import FileLock

from sarsplat.errors import SarsplatError
from sarsplat.reconstruction import Config, preset

if TYPE_CHECKING:
    from sarsplat import Dataset

_QUICK_ITERATIONS = 60


@dataclass(frozen=True)
class Cell:
    """What is done once.

    Attributes
    ----------
    dataset : mapping
        Options of `sarsplat simulate`, `--out` apart.
    preset : str
        Of the training; "auto" is the one that fits the images.
    changes : mapping
        Settings that differ from the preset, by their names on the command line.
    seed : int
        Of the training.
    alone : bool
        Whether it has the machine to itself, so that its time counts.
    quick : bool
        Whether it only shows that everything works: few iterations, few Gaussians.
    """

    dataset: Mapping[str, Any]
    preset: str = "default"
    changes: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    alone: bool = False
    quick: bool = False

    def path(self, work: Path, code: str) -> Path:
        """Where its scores are kept: another recipe, other settings or other code are another file.

        The same settings are the same file, whatever changes led to them.
        """
        settings = self.changes if self.preset == "auto" else self.config(preset(self.preset)).as_dict()
        return work / "cells" / f"{digest({**asdict(self), 'changes': settings, 'code': code})}.json"

    def config(self, base: Config) -> Config:
        """The preset with the changes and the seed."""
        settings = base.as_dict()
        for name, value in {**self.changes, "seed": self.seed}.items():
            *sections, last = name.split(".")
            place = settings
            for section in sections:
                place = place[section]
            place[last] = value
        return Config.from_dict(shortened(settings) if self.quick else settings)


def shortened(settings: dict[str, Any]) -> dict[str, Any]:
    """The same training in small: whatever counts iterations shrinks by the same factor.

    It starts in the box: points still on the hemisphere are all about as far from a sample of the surface, so that
    finding the nearest takes minutes.
    """
    share = _QUICK_ITERATIONS / settings["iterations"]
    density = settings["densification"] or {}
    for place, names in (
        (settings, ("iterations", "harmonics_every", "checkpoint_every")),
        (density, ("start", "stop", "every")),
    ):
        place.update({name: max(1, round(place[name] * share)) for name in names if name in place})
    if settings["gaussians"] is not None:
        settings["gaussians"] = max(1, settings["gaussians"] // 10)
    settings["initialisation"] = "box"
    return settings


def run(cell: Cell, work: Path) -> Path:
    """Do it, unless it has been done.

    Parameters
    ----------
    cell : Cell
        What to do.
    work : pathlib.Path
        Folder of datasets and finished cells; made if missing.

    Returns
    -------
    pathlib.Path
        JSON: the cell, its settings, the images' and the points' scores, training time and time in all (s).

    Raises
    ------
    SarsplatError
        If the simulation, the training or the evaluation refuses, or the sources changed meanwhile.
    """
    from sarsplat import evaluate_run, reconstruct
    from sarsplat.data import write_json
    from sarsplat.reconstruction import METHODS

    code, begun = code_version("sar-gs"), time.monotonic()
    path = cell.path(work, code)
    if path.is_file():
        return path
    dataset = _dataset(cell.dataset, work, code)
    config = cell.config(METHODS["sar-gs"].preset(cell.preset, dataset))
    trained = reconstruct(dataset, config, quiet=True)
    metrics = evaluate_run(trained)
    if code_version("sar-gs") != code:
        raise SarsplatError("the package's sources changed while a cell was running; run it again")
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {name: metrics[name] for name in ("images", "points", "time_s", "reasons")}
    made = {"code": code, "cell": asdict(cell), "config": config.as_dict(), "cell_m": dataset.grid.cell_m}
    write_json(path, {**made, **kept, "took_s": round(time.monotonic() - begun, 1)})
    return path


def _dataset(options: Mapping[str, Any], work: Path, code: str) -> Dataset:
    """The simulated dataset, made by whoever needs it first."""
    from sarsplat import read_dataset
    from sarsplat.cli.simulate import simulate

    folder = work / "datasets" / digest({"options": options, "code": code})
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_suffix(".lock")):
        if not folder.exists():
            simulate(out=folder, **options)
    return read_dataset(folder)


def digest(content: Mapping[str, Any]) -> str:
    """Name of a file or folder for what it holds."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:20]


def main() -> None:
    """Run the cell on stdin; a refusal is one sentence on stderr, and exit code 2."""
    try:
        with redirect_stdout(sys.stderr):
            path = run(Cell(**json.load(sys.stdin)), Path(sys.argv[1]))
    except SarsplatError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(path)


if __name__ == "__main__":
    main()
