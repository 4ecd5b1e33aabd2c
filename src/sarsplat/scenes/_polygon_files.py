"""Mesh files with polygons as the same files with triangles, for trimesh makes fans of all polygons.

Files of triangles, and of polygons for which a fan is right, are handed on as they are.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int

from sarsplat.scenes._polygons import are_fans, triangulated

_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_CORNERS = ("vertex_indices", "vertex_index")
_SPACE = b" \t"

Polygon = Sequence[int]
Cut = dict[int, list[tuple[int, int, int]]]
"""Triangles, in numbers of its corners, by the number of the polygon; only of those that are no fans."""


def of_triangles(kind: str, data: bytes) -> tuple[bytes, int]:
    """The bytes of an .obj, .off or .ply file without polygons that are no fans, and how many cross themselves.

    What cannot be understood comes back as it is, for whoever reads it next to complain. Raises `SarsplatError` if
    there are far too many corners.
    """
    try:
        match kind:
            case ".obj":
                return _obj(data)
            case ".off":
                return _off(data)
            case ".ply":
                return _ply(data)
    except (ValueError, IndexError, KeyError, OverflowError, MemoryError):  # garbled
        pass
    return data, 0


def _cut(vertices: Float64[np.ndarray, "v 3"], polygons: Sequence[Polygon]) -> tuple[Cut, int]:
    """Triangles of the polygons that are no fans, and how many of these cross themselves."""
    by_count: dict[int, list[int]] = {}
    for number, polygon in enumerate(polygons):
        if len(polygon) > 3:
            by_count.setdefault(len(polygon), []).append(number)
    cut: Cut = {}
    crossed = 0
    for numbers in by_count.values():
        corners = vertices[np.array([polygons[number] for number in numbers])]
        odd = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
        odd = odd[~are_fans(corners[odd])]
        if len(odd):
            done = triangulated(corners[odd])
            crossed += done.crossed
            cut |= {numbers[k]: [tuple(t) for t in own] for k, own in zip(odd, done.triangles.tolist(), strict=True)}
    return cut, crossed


def _numbers(lines: Iterable[bytes]) -> Float64[np.ndarray, "v 3"]:
    return np.array([[float(word) for word in line.split()[:3]] for line in lines], np.float64).reshape(-1, 3)


def _obj(data: bytes) -> tuple[bytes, int]:
    data = data.replace(b"\r\n", b"\n").replace(b"\\\n", b"")
    faces = list(re.finditer(rb"^f[ \t]+(?:[^\s]+[ \t]+){3,}[^\s]+[^\n]*$", data, flags=re.MULTILINE))
    if not faces:
        return data, 0
    vertices = _numbers(re.findall(rb"^v[ \t]([^\n]*)", data, flags=re.MULTILINE))
    words = [face.group()[1:].split(b"#")[0].split() for face in faces]
    polygons = [[int(word.split(b"/")[0]) - 1 for word in own] for own in words]
    cut, crossed = _cut(vertices, polygons)
    if not cut:
        return data, 0
    parts, end = [], 0
    for number, triangles in cut.items():
        own = words[number]
        lines = (b"f " + b" ".join(own[k] for k in triangle) for triangle in triangles)
        words[number] = [b"\n".join(lines)]
    for number in sorted(cut):
        face = faces[number]
        parts += [data[end : face.start()], words[number][0]]
        end = face.end()
    return b"".join([*parts, data[end:]]), crossed


def _off(data: bytes) -> tuple[bytes, int]:
    head, name, rest = re.split(rb"(C?OFF)", data, maxsplit=1)
    lines = [line for line in (raw.strip() for raw in rest.splitlines()) if line]
    many, faces = (int(word) for word in lines[0].split()[:2])
    vertices = _numbers(lines[1 : many + 1])
    rows = [[int(word) for word in line.split()[: int(line.split()[0]) + 1]] for line in lines[many + 1 :][:faces]]
    polygons = [row[1:] for row in rows]
    cut, crossed = _cut(vertices, polygons)
    if not cut:
        return data, 0
    whole = [
        " ".join(map(str, [3, *(polygon[k] for k in triangle)])).encode()
        for number, polygon in enumerate(polygons)
        for triangle in cut.get(number) or _fan(polygon)
    ]
    counts = f"{many} {len(whole)} 0".encode()
    return b"\n".join([head + name, counts, *lines[1 : many + 1], *whole, b""]), crossed


def _fan(polygon: Polygon) -> list[tuple[int, int, int]]:
    return [(0, k, k + 1) for k in range(1, len(polygon) - 1)]


# ---- PLY -----------------------------------------------------------------------------------------------------------
Element = tuple[str, int, list[tuple[str, str, str]]]
"""Name, number, and properties: type of the number in a list or nothing, type of the values, name."""


def _ply(data: bytes) -> tuple[bytes, int]:
    elements, order, body = _ply_header(data)
    tables = _ply_text(elements, body) if order == "" else _ply_binary(elements, order, body)
    if "vertex" not in tables or "face" not in tables:
        return data, 0
    vertices = np.stack([np.asarray(tables["vertex"][axis], np.float64) for axis in "xyz"], axis=1)
    name = next((name for name in _CORNERS if name in tables["face"]), None)
    polygons: Sequence[Polygon] = tables["face"][name] if name else []
    counts = {polygons.shape[1]} if isinstance(polygons, np.ndarray) else {len(polygon) for polygon in polygons}
    if counts <= {3}:
        return data, 0
    cut, crossed = _cut(vertices, polygons)
    if not cut and (order == "" or len(counts) == 1):  # of others trimesh reads nothing
        return data, 0
    whole = np.array(
        [
            [polygon[k] for k in triangle]
            for number, polygon in enumerate(polygons)
            for triangle in cut.get(number) or _fan(polygon)
        ],
        np.int64,
    ).reshape(-1, 3)
    return _written(vertices, whole), crossed


def _written(vertices: Float64[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> bytes:
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    table = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    table["count"], table["corners"] = 3, faces
    return "\n".join(header).encode() + vertices.astype("<f8").tobytes() + table.tobytes()


def _ply_header(data: bytes) -> tuple[list[Element], str, bytes]:
    """Elements, the order of bytes ("" for text), and what follows the header."""
    end = re.search(rb"(?:^|[\r\n])end_header(?:\r\n|\n|\r)", data)
    if end is None:
        raise ValueError("no header")
    order, elements = "", list[Element]()
    for line in data[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", kind, *_]:
                order = _ORDERS[kind]
            case ["element", name, number]:
                elements.append((name, int(number), []))
            case ["property", "list", length, kind, name]:
                elements[-1][2].append((_PLY_TYPES[length], _PLY_TYPES[kind], name))
            case ["property", kind, name]:
                elements[-1][2].append(("", _PLY_TYPES[kind], name))
    return elements, order, data[end.end() :]


def _ply_text(elements: list[Element], body: bytes) -> dict[str, dict[str, Any]]:
    lines = [line for line in body.splitlines() if line.strip()]
    tables: dict[str, dict[str, Any]] = {}
    for element, number, properties in elements:
        table: dict[str, list[Any]] = {name: [] for _, _, name in properties}
        for line in lines[:number]:
            words, place = line.split(), 0
            for length, kind, name in properties:
                value = float if kind[0] == "f" else int
                if length:
                    many = int(words[place])
                    table[name].append([value(word) for word in words[place + 1 : place + 1 + many]])
                    place += many + 1
                else:
                    table[name].append(value(words[place]))
                    place += 1
        tables[element], lines = table, lines[number:]
    return tables


def _ply_binary(elements: list[Element], order: str, body: bytes) -> dict[str, dict[str, Any]]:
    tables: dict[str, dict[str, Any]] = {}
    offset = 0
    for element, number, properties in elements:
        if not any(length for length, _, _ in properties):
            kind = np.dtype([(name, order + one) for _, one, name in properties])
            rows = np.frombuffer(body, kind, number, offset)
            tables[element] = {name: rows[name] for _, _, name in properties}
            offset += number * kind.itemsize
            continue
        alike = _all_alike(properties, order, body, number, offset)
        if alike is not None:
            tables[element], offset = alike
            continue
        table: dict[str, list[Any]] = {name: [] for _, _, name in properties}
        for _ in range(number):
            for length, one, name in properties:
                many = 1
                if length:
                    many = int(np.frombuffer(body, order + length, 1, offset)[0])
                    offset += np.dtype(length).itemsize
                values = np.frombuffer(body, order + one, many, offset).tolist()
                offset += many * np.dtype(one).itemsize
                table[name].append(values if length else values[0])
        tables[element] = table
    return tables


def _all_alike(
    properties: list[tuple[str, str, str]], order: str, body: bytes, number: int, offset: int
) -> tuple[dict[str, np.ndarray], int] | None:
    """A table and where it ends, if all lists of a property are as long as the first: read in one go."""
    fields: list[Any] = []
    place = offset
    for length, one, name in properties:
        if not length:
            fields.append((name, order + one))
            place += np.dtype(one).itemsize
            continue
        many = int(np.frombuffer(body, order + length, 1, place)[0])
        fields += [(f"number of {name}", order + length), (name, order + one, (many,))]
        place += np.dtype(length).itemsize + many * np.dtype(one).itemsize
    kind = np.dtype(fields)
    if offset + number * kind.itemsize > len(body):
        return None
    rows = np.frombuffer(body, kind, number, offset)
    names = [name for length, _, name in properties if length]
    if any((rows[f"number of {name}"] != rows[name].shape[1]).any() for name in names):
        return None
    return {name: rows[name] for _, _, name in properties}, offset + number * kind.itemsize
