"""What a sweep has made, to compare two of them."""

from pathlib import Path
from typing import Any

from sarsplat.data.files import read_json
from sarsplat.sweeps.work import Row


def results(out: Path) -> dict[str, Any]:
    """What must not depend on who did it, bit for bit, by address."""
    found = {}
    for path in sorted((out / "rows").glob("*.json")):
        row, run = read_json(path, Row), out / "runs" / path.stem
        row.scores.pop("time_s")
        found[path.stem] = (
            row.state,
            row.scores,
            *((run / name).read_bytes() for name in ("gaussians.ply", "points.ply")),
        )
    return found
