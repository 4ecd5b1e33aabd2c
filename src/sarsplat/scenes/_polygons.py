"""Triangles of mesh files with concave or warped polygons, by earcut: trimesh makes fans of all polygons."""

import re
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int

from sarsplat.errors import SarsplatError

_FLAT = 1e-6  # tolerance of a flat polygon: distance of a corner from its plane, relative to its size
_ROUNDING = 1e-9  # tolerance of an area, relative to the square of a polygon's size
_TIE = 1e-7
"""Difference between diagonals of equal length, relative to a polygon's size, by their place along `_TIE_AXIS`."""
_TIE_AXIS = np.array([0.36, 0.48, 0.8])
_MAX_CORNERS = 2_000
_MAX_WORK = 200_000_000  # maximum sum of squared numbers of corners over the concave polygons of a file

_PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_PLY_TYPES |= {"float": "f4", "double": "f8"}
_PLY_TYPES |= {np.dtype(code).name: code for code in _PLY_TYPES.values()}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}

Polygons = tuple[Float64[np.ndarray, "v 3"], Any, bool]
"""Vertices, the corners of each polygon, and True if trimesh reads such a file."""
Properties = list[tuple[str, str, str]]
"""Type of a list's length or "", type of the values, and name."""


def polygon_mesh(kind: str, data: bytes) -> tuple[Float64[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], int] | None:
    """Return vertices, triangles and the number of self-crossing outlines of an .obj, .off or .ply file.

    None if trimesh reads the file correctly, or if it is damaged. The surface does not depend on where an outline
    begins. Raises `SarsplatError` if there are far too many corners.
    """
    try:
        vertices, polygons, readable = {".obj": _obj, ".off": _off, ".ply": _ply}[kind](data)
        counts = np.array([len(polygon) for polygon in polygons])
        cut: dict[int, Any] = {}
        crossed = 0
        for count in np.unique(counts[counts > 3]):
            numbers = np.flatnonzero(counts == count)
            corners = vertices[np.array([polygons[number] for number in numbers])]
            odd = (np.abs(corners) < 1e30).all(axis=(1, 2))  # others are refused by `read_mesh`
            odd[odd] = ~are_fans(corners[odd])
            if odd.any():
                triangles, some = triangulated(corners[odd])
                cut |= zip(numbers[odd].tolist(), triangles, strict=True)
                crossed += some
        if readable and not cut:
            return None
        faces = [
            [polygon[k] for k in triangle]
            for number, polygon in enumerate(polygons)
            for triangle in cut.get(number) or [(0, k, k + 1) for k in range(1, len(polygon) - 1)]
        ]
        return vertices, np.array(faces, np.int64).reshape(-1, 3), crossed
    except (ValueError, LookupError, TypeError, OverflowError, MemoryError, StopIteration):  # for trimesh to report
        return None


def are_fans(corners: Float64[np.ndarray, "m n 3"]) -> Bool[np.ndarray, " m"]:
    """Mask of the polygons that are flat and convex, so that a fan from any corner covers them."""
    flat, heights, size = _in_its_plane(corners)
    least = -_ROUNDING * size[:, None] ** 2
    turns = _area(np.roll(flat, 1, axis=1), flat, np.roll(flat, -1, axis=1)) >= least
    fan = _area(flat[:, :1], flat[:, 1:-1], flat[:, 2:]) >= least
    level = np.abs(heights) <= _FLAT * size[:, None]
    fans: Bool[np.ndarray, " m"] = turns.all(1) & fan.all(1) & level.all(1)
    return fans


def triangulated(corners: Float64[np.ndarray, "m n 3"]) -> tuple[list[list[list[int]]], int]:
    """Return triangles of each polygon, as numbers of its corners, and the number of self-crossing outlines."""
    from mapbox_earcut import triangulate_float64

    count, number, _ = corners.shape
    if number > _MAX_CORNERS or count * number**2 > _MAX_WORK:
        raise SarsplatError(f"has {count:,} concave faces with {number:,} corners; triangulate it beforehand")
    flat, _, size = _in_its_plane(corners)
    scaled = (corners - corners.mean(axis=1, keepdims=True)) / size[:, None, None]
    before, after = np.roll(scaled, 1, axis=1), np.roll(scaled, -1, axis=1)
    diagonals = np.linalg.norm(after - before, axis=2) + _TIE * ((before + after) @ _TIE_AXIS)
    # earcut begins at the last corner: let that have the shortest diagonal
    order = (diagonals.argmin(axis=1)[:, None] + np.arange(1, number + 1)) % number
    outlines = np.take_along_axis(flat, order[:, :, None], axis=1)
    ring = np.array([number])
    triangles = [triangulate_float64(outline, ring).reshape(-1, 3) for outline in outlines]
    owners = np.repeat(np.arange(count), [len(own) for own in triangles])
    a, b, c = (outlines[owners, np.concatenate(triangles)[:, k]] for k in range(3))
    covered = np.bincount(owners, np.abs(_area(a, b, c)), count)
    enclosed = np.abs(_area(outlines[:, :1], outlines, np.roll(outlines, -1, axis=1)).sum(axis=1))
    crossed = int((np.abs(covered - enclosed) > _ROUNDING * size**2).sum())
    return [first[own].tolist() for first, own in zip(order, triangles, strict=True)], crossed


def _in_its_plane(
    corners: Float64[np.ndarray, "m n 3"],
) -> tuple[Float64[np.ndarray, "m n 2"], Float64[np.ndarray, "m n"], Float64[np.ndarray, " m"]]:
    """Project polygons along their normals, counter-clockwise; return also distances from their planes, and sizes."""
    centred = corners - corners.mean(axis=1, keepdims=True)
    size = np.abs(centred).max(axis=(1, 2))
    normal = np.cross(centred, np.roll(centred, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(least, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    flat = np.stack([np.einsum("mnk,mk->mn", centred, axis) for axis in (first, second)], axis=2)
    return flat, np.einsum("mnk,mk->mn", centred, normal), size


def _area(
    a: Float64[np.ndarray, "*#t 2"], b: Float64[np.ndarray, "*#t 2"], c: Float64[np.ndarray, "*#t 2"]
) -> Float64[np.ndarray, "*#t"]:
    """Return twice the area of triangles, negative where they are clockwise."""
    area: Float64[np.ndarray, "*#t"]
    area = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
    return area


def _vertices(lines: Iterable[bytes]) -> Float64[np.ndarray, "v 3"]:
    return np.array([[float(word) for word in line.split()[:3]] for line in lines], np.float64).reshape(-1, 3)


def _obj(data: bytes) -> Polygons:
    if not re.search(rb"^f(?:[ \t]+[^\s]+){4}", data, flags=re.MULTILINE):
        return np.empty((0, 3)), [], True
    vertices = _vertices(re.findall(rb"^v[ \t]([^\n]*)", data, flags=re.MULTILINE))
    faces = re.findall(rb"^f[ \t]([^\n]*)", data, flags=re.MULTILINE)
    return vertices, [[int(word.split(b"/")[0]) - 1 for word in face.split()] for face in faces], True


def _off(data: bytes) -> Polygons:
    lines = [line for line in data.partition(b"OFF")[2].splitlines() if line.strip()]
    vertices, faces = (int(word) for word in lines[0].split()[:2])
    rows = [[int(word) for word in line.split()[: int(line.split()[0]) + 1]] for line in lines[vertices + 1 :][:faces]]
    return _vertices(lines[1 : vertices + 1]), [row[1:] for row in rows], True


def _ply(data: bytes) -> Polygons:
    header, _, body = re.split(rb"[\r\n](end_header)(?:\r\n|\n|\r)", data, maxsplit=1)
    order, place, elements = "", 0, list[tuple[str, int, Properties]]()
    for line in header.decode("latin-1").splitlines():
        match [_PLY_TYPES.get(word, word) for word in line.split()]:
            case ["format", kind, *_]:
                order = _PLY_ORDERS[kind]
            case ["element", name, number]:
                elements.append((name, int(number), []))
            case ["property", "list", length, kind, name]:
                elements[-1][2].append((length, kind, name))
            case ["property", kind, name]:
                elements[-1][2].append(("", kind, name))
    lines = iter(body.splitlines())
    words: Iterator[bytes] = iter(())

    def read(kind: str, count: int) -> list[Any]:
        nonlocal place
        if not order:
            return [(float if kind.startswith("f") else int)(next(words)) for _ in range(count)]
        values = np.frombuffer(body, order + kind, count, place)
        place += values.nbytes
        return values.tolist()

    tables: dict[str, Any] = {}
    readable = True
    for element, number, properties in elements:
        rows = _uniform_rows(body, order, place, number, properties) if order else None
        if rows is not None:
            tables[element], place = {name: rows[name] for _, _, name in properties}, place + rows.nbytes
            continue
        readable = not order
        table = tables[element] = {name: [] for _, _, name in properties}
        for _ in range(number if properties else 0):
            words = words if order else iter(next(lines).split())
            for length, kind, name in properties:
                values = read(kind, read(length, 1)[0] if length else 1)
                table[name].append(values if length else values[0])
    vertices = np.stack([np.asarray(tables["vertex"][axis], np.float64) for axis in "xyz"], axis=1)
    faces = tables["face"]
    return vertices, faces.get("vertex_indices", faces.get("vertex_index")), readable


def _uniform_rows(body: bytes, order: str, place: int, number: int, properties: Properties) -> np.ndarray | None:
    """Read rows of an element of a binary PLY file; None if its lists differ in length."""
    fields, end = list[Any](), place
    for length, kind, name in properties:
        fields.append((name, order + kind))
        if length:
            count = int(np.frombuffer(body, order + length, 1, end)[0])
            fields[-1:] = [(f"number of {name}", order + length), (name, order + kind, (count,))]
        end = place + np.dtype(fields).itemsize
    if place + number * (end - place) > len(body):
        return None
    rows = np.frombuffer(body, fields, number, place)
    lists = [name for length, _, name in properties if length]
    same = all((rows[f"number of {name}"] == rows[name].shape[1]).all() for name in lists)
    return rows if same else None
