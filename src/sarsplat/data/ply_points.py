"""Points as PLY, with named scalars. Needs no torch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Real

from sarsplat.arguments import checks_arguments
from sarsplat.data.ply_table import named, read_ply, stacked, write_ply
from sarsplat.errors import SarsplatError

_FARTHEST = 1e9  # m from the origin: squares of it stay finite


@checks_arguments
def write_points_ply(
    path: str | Path,
    points: Real[np.ndarray, "p 3"] | Sequence[Sequence[float]],
    /,
    normals: Real[np.ndarray, "p 3"] | Sequence[Sequence[float]] | None = None,
    **columns: np.ndarray | Sequence[float],
) -> None:
    """Write points with any number of named scalars each, whole or not at all.

    Parameters
    ----------
    path : str or Path
        File to write; an existing one is replaced.
    points : numpy.ndarray [P, 3], or a list
        Positions, m; stored as float32.
    normals : numpy.ndarray [P, 3], or a list, optional
        Unit normals, stored as nx, ny, nz.
    **columns : numpy.ndarray [P], or a list
        One scalar per point under that name; stored as float32.

    Raises
    ------
    SarsplatError
        If shapes do not fit, a value is not finite, or the file cannot be written.
    """
    places = _triples("points", points)
    if normals is not None:
        columns = {**named(("nx", "ny", "nz"), _triples("normals", normals)), **columns}
    for name, column in columns.items():
        if np.shape(column) != (len(places),) or name in ("x", "y", "z"):
            raise SarsplatError(
                f"the column {name!r} has shape {np.shape(column)}; for these points it must be ({len(places)},)"
            )
    table = {**named(("x", "y", "z"), places), **{name: np.asarray(column) for name, column in columns.items()}}
    for name, column in table.items():
        if not np.isfinite(column).all():
            raise SarsplatError(f"the column {name!r} of the points contains NaN or an infinity; remove those points")
    write_ply(Path(path), table, ["sarsplat points 1"])


def _triples(name: str, values: Any) -> Real[np.ndarray, "p 3"]:
    try:
        table = np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise SarsplatError(f"the {name} are rows of different lengths; give each three numbers") from error
    if table.ndim != 2 or table.shape[1] != 3:
        raise SarsplatError(f"the {name} have shape {table.shape}; it must be (P, 3)")
    return table


@checks_arguments
def read_points_ply(path: str | Path) -> tuple[Float32[np.ndarray, "p 3"], dict[str, Real[np.ndarray, " p"]]]:
    """Read points.

    Returns
    -------
    points : numpy.ndarray, float32 [P, 3]
        Positions, m.
    columns : dict of str to numpy.ndarray, float32 [P]
        Every other scalar of the file.

    Raises
    ------
    SarsplatError
        If the file is missing, damaged or truncated, has no x, y, z, or a point is farther than 10⁹ m from the origin.
    """
    path = Path(path)
    columns, _ = read_ply(path)
    points = stacked(path, columns, ["x", "y", "z"])
    if (farthest := np.abs(points).max(initial=0)) > _FARTHEST:
        raise SarsplatError(f"{path} holds a point {farthest:.3g} m from the origin; create it again, in metres")
    return points, {name: column for name, column in columns.items() if name not in ("x", "y", "z")}
