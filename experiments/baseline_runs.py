"""Every finished training of the comparison, a line of a CSV file each, so that none is repeated by the same code."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sarsplat.data import write_bytes

if TYPE_CHECKING:
    from baselines import Comparison

_NAME = "baselines-runs.csv"
_ABOUT = ("set", "method", "budget", "seed", "iterations", "time_s", "peak_bytes", "cell")
"""Columns that are no scores; the last is the name of the cell, which only the same code gives it."""


def scores_of(result: Mapping[str, Any]) -> dict[str, float]:
    """Of one cell, by key: the mean over its test sets, and of the points against the visible surface."""
    sets = result["images"].values()
    keys = [*dict.fromkeys(key for scores in sets for key in scores)]
    means = {key: statistics.fmean(values) for key in keys if None not in (values := [scores[key] for scores in sets])}
    points = {key: value for key, value in result["points"]["visible"].items() if value is not None}
    return {**means, **points}


def write_runs(comparison: Comparison) -> None:
    """Write what is finished."""
    lines = []
    for images in comparison.sets:
        for bout in comparison.bouts(images):
            for cell in bout.cells:
                if (result := comparison.read(cell)) is not None:
                    about = {
                        "set": images.name,
                        "method": bout.contender.title,
                        "budget": "in our time" if bout.equal else "stopped" if cell.seconds else "full",
                        "seed": cell.seed,
                        **{name: result[name] for name in ("iterations", "time_s", "peak_bytes")},
                        "cell": comparison.path(cell).stem,
                    }
                    lines.append({**about, **scores_of(result)})
    with io.StringIO(newline="") as file:
        table = csv.DictWriter(file, [*_ABOUT, *dict.fromkeys(k for line in lines for k in line if k not in _ABOUT)])
        table.writeheader()
        table.writerows(lines)
        write_bytes(comparison.out / _NAME, file.getvalue().encode())


def read_runs(out: Path) -> dict[str, dict[str, Any]]:
    """What came of cells that were finished earlier, perhaps elsewhere, by the cell's name; without their curves."""
    path = out / _NAME
    if not path.is_file():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        return {line["cell"]: _result(line) for line in csv.DictReader(file)}


def _result(line: Mapping[str, str]) -> dict[str, Any]:
    scores = {name: float(text) for name, text in line.items() if name not in _ABOUT and text}
    return {
        "images": {"all": scores},
        "points": {"visible": {}},
        "reasons": {},
        "curve": [],
        "iterations": int(line["iterations"]),
        "time_s": float(line["time_s"]),
        "peak_bytes": int(line["peak_bytes"]),
    }
