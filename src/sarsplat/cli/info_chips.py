"""What `sarsplat info` says about generated chips: how they were made, whether all are there, and what to do next."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from sarsplat.cli import console
from sarsplat.cli.importers import dataset_name, typed_import
from sarsplat.errors import counted

if TYPE_CHECKING:
    from sarsplat.samples.write import Made


def chips_in(path: Path) -> Path | None:
    """Where the generated chips of a path lie: there, or if they are unfinished, where they are being made."""
    from sarsplat.data.folders import temporary_folder

    places = (path, temporary_folder(path)) if not path.exists() else (path,)
    return next((place for place in places if (place / "chips.json").is_file()), None)


def describe_chips(path: Path, place: Path) -> None:
    """Say what the set is that lies, or is to lie, at a path."""
    from sarsplat.samples.write import Made

    made, finished = Made.read(place), place == path
    each = Counter(run.target for run in made.runs)
    total = made.count * len(made.runs)
    low, high = (choose(end) for choose, end in zip((min, max), zip(*made.grazing_deg, strict=True), strict=True))
    rows = {
        **{f"class {name}": counted(made.count * runs, "chip") for name, runs in each.items()},
        "size": "{} × {} pixels of {:.6g} m × {:.6g} m (azimuth × range)".format(*made.pixels, *made.spacing_m),
        "pixels": f"{made.quantity}, {made.format}, scale {made.scale}, near range at the {made.near}",
        "grazing": f"{low:.6g}° to {high:.6g}°",
        "drawn with": f"speckle {made.speckle}, ground {made.ground}, scatterers {made.scatterers or math.inf:g}, "
        f"seed {made.seed}",
        "made by": f"sarsplat {made.program}, from {counted(len(made.runs), 'run')}",
    }
    whole = counted(total, "generated chip")
    console.facts(f"{path}: {whole if finished else f'unfinished, {_so_far(place, made):,} of {whole}'}", rows)
    console.say(_use(path, made) if finished else "go on with: the `sarsplat chips` command that began it")


def _so_far(place: Path, made: Made) -> int:
    if made.shard is None:
        return sum(1 for _ in place.glob("*/[0-9]*"))
    total = made.count * len(made.runs)
    begun = (made.shard * int(path.stem.rpartition("-")[2]) for path in place.glob("chips-*.tar"))
    return sum(min(made.shard, total - first) for first in begun)


def _use(path: Path, made: Made) -> str:
    train = "mixed with measured chips (docs/how-to/chips.md)"
    if made.shard is not None:
        return f"train on: {path}/chips-*.tar, shuffled and {train}"
    words = ["folder", str(path)]
    classes = dict.fromkeys(run.target for run in made.runs)
    words += ["--class", next(iter(classes))] if len(classes) > 1 else []
    return f"train on: {path}, {train}\nimport with: {typed_import(*words, out=dataset_name(path))}"
