"""The README's table of measured chips."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiment import Experiment
from finished import Finished
from metrics import METRIC
from summary import Line, lines

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "docs"))

from fill_block import fill_block

_README = Path(__file__).resolve().parent.parent / "README.md"
_KEYS = ("registered_nats_per_pixel", "registered_log_correlation")


def fill_readme(experiment: Experiment, runs: Sequence[Finished]) -> None:
    """Fill it, if this is the experiment and something of it is finished."""
    finished = lines(experiment, runs)
    if experiment.name != "measured" or not any(line.seeds for line in finished):
        return
    groups = experiment.groups()
    names = [row.label for row in next(iter(groups.values()))]
    rows = [
        f"| nats per pixel ↓ (correlation ↑), both registered | {' | '.join(names)} |",
        "|---|" + "---:|" * len(names),
    ]
    for group in groups:
        cells = [_cell(line) for line in finished if line.row.group == group]
        rows.append(f"| {group} | {' | '.join(cells)} |")
    fill_block(_README, "measured", "\n".join([*rows, ""]))


def _cell(line: Line) -> str:
    if not line.seeds:
        return "–"
    nats, correlation = (METRIC[key].text(line.spreads[key].mean) for key in _KEYS)
    return f"{nats} ({correlation})"
