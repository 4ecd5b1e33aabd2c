"""PLY files of points with named scalars, binary little endian; a header's counts must fit the file's length."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Real

from sarsplat.arguments import checks_arguments
from sarsplat.data.files import new_file, open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.place import places_of

_TYPES = {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"}
_TYPES |= {"float": "<f4", "double": "<f8"}
_TYPES |= {np.dtype(code).name: code for code in _TYPES.values()}  # "int8", "uint8" …
_FORMAT = "format binary_little_endian 1.0"
_LONGEST_HEADER = 65_536  # maximum length of a header, bytes
_CHUNK = 1 << 18  # vertices that are read or written at once
_FARTHEST = 1e9  # maximum distance of a point from the origin, m: its square stays finite


def write_ply(path: Path, columns: Mapping[str, Real[np.ndarray, " n"]], comments: Sequence[str]) -> None:
    """Write properties of vertices as float32, and comments as lines of ASCII, whole or not at all."""
    count = len(next(iter(columns.values())))
    lines = [line.encode("ascii", "backslashreplace").decode() for text in comments for line in text.splitlines()]
    header = [
        *("ply", _FORMAT, *(f"comment {line}" for line in lines)),
        *(f"element vertex {count}", *(f"property float {name}" for name in columns), "end_header"),
    ]
    table = np.empty(min(count, _CHUNK), dtype=[(name, "<f4") for name in columns])
    with new_file(path) as file:
        file.write("\n".join(header).encode("ascii") + b"\n")
        for first in range(0, count, _CHUNK):
            chunk = table[: count - first]
            for name, column in columns.items():
                chunk[name] = column[first : first + len(chunk)]
            file.write(chunk.data)


def read_ply(
    path: Path, wanted: Callable[[str, list[str]], bool] | None = None, exact: Collection[str] = ()
) -> tuple[dict[str, Float[np.ndarray, " n"]], list[str]]:
    """Read properties of vertices, by name, as float32, those named `exact` as float64, and the comments.

    `wanted(name, comments)` selects properties. Vertices are read in chunks, because a file can be several times as
    large as the selected properties.
    """
    with open_file(path) as file:
        data = file.read(_LONGEST_HEADER)
        newline = re.match(rb"ply(\r\n|\n|\r)", data)
        ends = newline[1] if newline else b"\n"
        head, end, _ = data.partition(ends + b"end_header" + ends)
        size = file.seek(0, 2)
        lines = head.split(ends)
        if newline is None or not end or not all(re.fullmatch(rb"[\t -~]*", line) for line in lines):
            raise SarsplatError(
                f"{path} is not a PLY file with a header of plain text; give one made by `sarsplat export` or a 3DGS "
                "program, or convert it, z up, with splat-transform or SuperSplat"
            )
        header = [line.decode("ascii") for line in lines[1:]]
        offset, count, dtype = _vertices(path, header, len(head) + len(end), size)
        file.seek(offset)
        comments = [line.removeprefix("comment").strip() for line in header if line.split()[:1] == ["comment"]]
        names = [name for name in dtype.names or () if wanted is None or wanted(name, comments)]
        columns = {name: np.empty(count, np.float64 if name in exact else np.float32) for name in names}
        for first in range(0, count, _CHUNK):
            chunk = min(_CHUNK, count - first)
            rows = np.ndarray(chunk, dtype, file.read(chunk * dtype.itemsize))
            with np.errstate(over="ignore", invalid="ignore"):  # invalid: signalling NaN
                for name, column in columns.items():
                    column[first : first + chunk] = rows[name]
    return columns, comments


def named(names: Iterable[str], values: Real[np.ndarray, "n k"]) -> dict[str, Real[np.ndarray, " n"]]:
    """Return the columns of a table [N, K] by name."""
    return dict(zip(names, values.T, strict=True))


def stacked(path: Path, columns: dict[str, np.ndarray], names: list[str]) -> Float[np.ndarray, "n {len(names)}"]:
    """Join columns to a table [N, len(names)]; raise if one is missing or not finite."""
    for name in names:
        if name not in columns:
            raise SarsplatError(f"{path} is missing the vertex property {name!r}; give a PLY file of the right kind")
        if bad := int((~np.isfinite(columns[name])).sum()):
            raise SarsplatError(
                f"{path} holds NaN or an infinity in {name!r} in {bad:,} of its {len(columns[name]):,} rows; remove "
                "those, or create it again"
            )
    rows = len(next(iter(columns.values()), ()))
    return np.stack([columns[name] for name in names], axis=1) if names else np.empty((rows, 0), np.float32)


def _vertices(path: Path, header: list[str], offset: int, size: int) -> tuple[int, int, np.dtype]:
    """Return offset, number and type of the vertices in a file of `size` bytes whose data begin at `offset`."""
    elements = _elements(path, header)
    names = [name for name, _, _ in elements]
    vertices = [[name for name, _ in properties] for name, _, properties in elements if name == "vertex"]
    if len(vertices) != 1 or len(set(vertices[0])) < len(vertices[0]):
        raise SarsplatError(
            f"{path} has the elements {shown(names)} in its PLY header, not one of vertices whose properties have "
            "different names; create it again"
        )
    sizes = [count * sum(np.dtype(kind).itemsize for _, kind in properties) for _, count, properties in elements]
    if size != offset + sum(sizes):
        state = "is truncated" if size < offset + sum(sizes) else "is too long"
        raise SarsplatError(
            f"{path} {state}: {size} bytes where its header asks for {offset + sum(sizes)}; create it again"
        )
    index = names.index("vertex")
    _, count, properties = elements[index]
    return offset + sum(sizes[:index]), count if properties else 0, np.dtype(properties)


def _elements(path: Path, header: list[str]) -> list[tuple[str, int, list[tuple[str, str]]]]:
    """Return name, count and properties (name, numpy type) of each element."""
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    if header[:1] != [_FORMAT]:
        raise SarsplatError(f"{path} is a PLY of {shown(header[:1])}; only {_FORMAT!r} is read; export it as binary")
    for line in header[1:]:
        match line.split():
            case ["comment" | "obj_info", *_]:
                pass
            case ["element", name, number] if re.fullmatch(r"[0-9]{1,12}", number):
                elements.append((name, int(number), []))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1][2].append((name, _TYPES[kind]))
            case _:
                raise SarsplatError(
                    f"{path} has {shown(line)} in its PLY header, which is garbled or of a mesh; give points or "
                    "Gaussians"
                )
    return elements


@checks_arguments
def write_points_ply(
    path: str | Path,
    points: Real[np.ndarray, "p 3"] | Sequence[Sequence[float]],
    /,
    normals: Real[np.ndarray, "p 3"] | Sequence[Sequence[float]] | None = None,
    **columns: np.ndarray | Sequence[float],
) -> None:
    """Write points with named scalars, whole or not at all.

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
    positions = places_of(points, "points").reshape(-1, 3)
    if normals is not None:
        columns = {**named(("nx", "ny", "nz"), places_of(normals, "normals").reshape(-1, 3)), **columns}
    table = {**named(("x", "y", "z"), positions), **{name: np.asarray(column) for name, column in columns.items()}}
    for name, column in table.items():
        if np.shape(column) != (len(positions),) or not np.isfinite(column).all() or columns.keys() & {"x", "y", "z"}:
            raise SarsplatError(
                f"the column {name!r} of the points has shape {np.shape(column)}, the name of a coordinate, NaN or an "
                f"infinity; give {len(positions)} finite numbers under another name"
            )
    write_ply(Path(path), table, ["sarsplat points 1"])


@checks_arguments
def read_points_ply(path: str | Path) -> tuple[Float[np.ndarray, "p 3"], dict[str, Real[np.ndarray, " p"]]]:
    """Read points, m, float32 [P, 3], and by name the other scalars of the file, float32 [P].

    Points are float64 if float32 would round them, as with map coordinates. Raise SarsplatError if the file is missing,
    damaged or truncated, has no x, y, z, or a point is farther than 10⁹ m from the origin.
    """
    path = Path(path)
    axes = ["x", "y", "z"]
    columns, _ = read_ply(path, exact=axes)
    points = stacked(path, columns, axes)
    if (farthest := np.abs(points).max(initial=0)) > _FARTHEST:
        raise SarsplatError(f"{path} holds a point {farthest:.3g} m from the origin; create it again, in metres")
    short = points.astype(np.float32)
    points = short if np.array_equal(short, points) else points
    return points, {name: column for name, column in columns.items() if name not in axes}
