"""`.xyz`: points as text, one a line, below a line of names."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from sarsplat.data import write_bytes
from sarsplat.exports.format import Format, Points
from sarsplat.names import Colour

_BEGINS = "# x_m y_m z_m"


def _write(points: Points, path: Path, _: Colour) -> None:
    columns = points.columns()
    text = io.StringIO()
    np.savetxt(text, np.column_stack([points.positions, *columns.values()]), fmt="%.7g")
    write_bytes(path, f"{' '.join([_BEGINS, *columns])}\n{text.getvalue()}".encode("ascii"))


FORMAT = Format(
    writers={"points": _write},
    opened_with={"points": "any point cloud viewer or spreadsheet"},
    recognises=lambda head, _: head.startswith(_BEGINS.encode()),
)
