"""`.pcd`: points for the Point Cloud Library, binary float32."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sarsplat.data import write_bytes
from sarsplat.exports.format import Format, Points
from sarsplat.names import Colour

_BEGINS = b"# .PCD v0.7"
_NAMES = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}  # as that library calls them


def _write(points: Points, path: Path, _: Colour) -> None:
    columns = points.columns()
    names = ["x", "y", "z", *(_NAMES.get(name, name) for name in columns)]
    table = np.column_stack([points.positions, *columns.values()]).astype("<f4")
    header = [
        *("VERSION 0.7", f"FIELDS {' '.join(names)}", f"SIZE{' 4' * len(names)}", f"TYPE{' F' * len(names)}"),
        *(f"COUNT{' 1' * len(names)}", f"WIDTH {len(table)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0"),
        *(f"POINTS {len(table)}", "DATA binary\n"),
    ]
    write_bytes(path, _BEGINS + b"\n" + "\n".join(header).encode() + table.tobytes())


FORMAT = Format(
    writers={"points": _write},
    opened_with={"points": "CloudCompare, or programs with the Point Cloud Library or Open3D"},
    recognises=lambda head, _: head.startswith(_BEGINS),
)
