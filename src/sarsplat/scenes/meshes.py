"""Targets from mesh files, which may be dirty or hostile.

trimesh reads many formats, follows names in a file to other files, unpacks archives, and allocates whatever a glTF
header demands. Here it reads the bytes of one regular file in one of five formats, and nothing else.
"""

import io
import json
import logging
import os
import re
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Integer

from sarsplat.arguments import check_number, checks_arguments
from sarsplat.errors import SarsplatError, SarsplatWarning, counted
from sarsplat.extras import Trimesh
from sarsplat.geometry import ImageGrid
from sarsplat.scenes._polygons import polygon_mesh

_LARGEST_TARGET, _SMALLEST_TARGET = 1.0, 2.0
"""Plausible sizes of a target, in image sides and in resolution widths: vehicles in other units are outside."""

_FORMATS = (".obj", ".stl", ".ply", ".off", ".glb")
_FARTHEST = 1e9  # maximum distance of a vertex from the origin, m: beyond any mistaken unit, with a finite square
_LARGEST = {"binary": 1 << 28, ".obj": 1 << 25, ".stl": 1 << 25, ".off": 1 << 24, ".ply": 1 << 24}
"""Maximum size of binary files, and of text, bytes: trimesh needs 50 times (.obj, .stl) to 80 times as much memory."""
_HEAD = 1 << 12  # bytes that tell a binary file from text
_FREE_NUMBERS = 100_000  # count of numbers to which a .glb file of any size may expand
_LONGEST_SCENE = 1 << 20  # maximum length of the JSON in a .glb file, bytes
_MAX_PARTS = 2_000  # maximum number of nodes and primitives of a glTF scene: trimesh takes 0.1 ms for each
_MAX_SOLIDS = 1_000  # maximum number of solids in an ASCII .stl file: 0.5 ms for each
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

_VISIBLE, _COPIES = "KHR_node_visibility", "EXT_mesh_gpu_instancing"
_HARMLESS = re.compile(r"[A-Z]+_(materials|texture|lights|xmp)\w*|KHR_mesh_quantization|" + _VISIBLE)
"""Names of glTF's extensions that do not change the surface, or that are read here."""
_FAN, _TRIANGLES = 6, 4
"""Modes of primitives of a .glb file."""
_INDICES = {5121: "u1", 5123: "<u2", 5125: "<u4"}  # types of indices in a .glb file → types of numpy

_MISSING = "has faces that refer to missing vertices; repair the mesh"
_COMMENT = re.compile(rb"#[^\n]*")
_INDENTED = re.compile(rb"\n[ \t]+")
_RELATIVE = re.compile(rb"^f[^\n]*[ \t/]-", re.MULTILINE)
_ZERO = re.compile(rb"^f[^\n]*[ \t]0+(?![0-9])", re.MULTILINE)
_BACK = re.compile(rb"-[0-9]{1,12}")

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # sarsplat's errors describe damaged files


@checks_arguments
def load_mesh(path: str | os.PathLike[str]) -> Trimesh:
    """Read a triangle mesh from an .obj, .stl, .ply, .off or .glb file; a scene's parts become one mesh.

    Open, intersecting and inconsistently oriented surfaces are accepted unchanged. Degenerate faces and faces with a
    vertex that is not finite are dropped with one warning; of several equal faces, such as where two closed bodies
    touch, the first is kept.

    Parameters
    ----------
    path : path
        File, +x nose, +y left, +z up, ground at z = 0; coordinates in metres.

    Returns
    -------
    trimesh.Trimesh
        Every face with a positive area, once.

    Raises
    ------
    SarsplatError
        If the file is missing or damaged, is not a mesh, or has no usable face (see `read_mesh`).

    Warns
    -----
    SarsplatWarning
        If faces were dropped.
    """
    path = Path(path)
    mesh = read_mesh(path)
    count = len(mesh.faces)
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    first, second, third = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(invalid="ignore"):  # infinite vertices; squares of finite ones do not overflow
        area2 = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    usable = np.isfinite(area2) & (area2 > 0)
    if not usable.any():
        raise SarsplatError(f"none of the {count} faces of '{path}' is finite with a positive area; repair the mesh")
    if not usable.all():
        warnings.warn(
            f"'{path}': dropped {count - usable.sum()} of {count} faces (degenerate or not finite)",
            SarsplatWarning,
            stacklevel=2,
        )
    _, number = np.unique(vertices, axis=0, return_inverse=True)
    _, once = np.unique(np.sort(number.reshape(-1)[faces], axis=1), axis=0, return_index=True)
    mesh.update_faces(usable & np.isin(np.arange(count), once))
    mesh.remove_unreferenced_vertices()
    return mesh


def scaled(mesh: Trimesh, factor: float) -> Trimesh:
    """Multiply every coordinate of a mesh by a positive, finite factor."""
    check_number("`scale`", factor, 0, above=True)
    return mesh.copy().apply_scale(factor)


def is_larger(mesh: Trimesh, grid: ImageGrid) -> bool:
    """Return True if a mesh is longer than the shorter side of its images."""
    return float(mesh.extents.max()) > _LARGEST_TARGET * side_m(grid)


def suspicious_size(mesh: Trimesh, grid: ImageGrid) -> list[str]:
    """Return a warning if a mesh is larger than its images or hardly larger than a resolution cell."""
    extent = float(mesh.extents.max())
    cell = max(grid.resolution_m)
    if _SMALLEST_TARGET * cell <= extent and not is_larger(mesh, grid):
        return []
    return [
        f"the target is {extent:.3g} m long, but the images are {side_m(grid):.3g} m wide with a resolution of "
        f"{cell:.3g} m; if the mesh is not in metres, give `scale`, otherwise other `pixels` or `spacing`"
    ]


def side_m(grid: ImageGrid) -> float:
    """Return the shorter side of an image, m."""
    return min(grid.rows * grid.spacing_m[1], grid.columns * grid.spacing_m[0])


def read_mesh(path: Path) -> Trimesh:
    """Read all triangles of a self-contained .obj, .stl, .ply, .off or .glb file; parts of a scene become one mesh.

    Polygons, also concave ones, become triangles that do not depend on where their outline begins. Materials and
    textures are ignored. Faces refer to existing vertices, which may be NaN or infinite. Raise `SarsplatError` if the
    file is missing, of another format or damaged, or expands to far more than its size.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in _FORMATS:
        raise SarsplatError(f"'{path}' is not in a supported mesh format; give an {', '.join(_FORMATS)} file")
    import trimesh

    try:
        if not path.is_file():  # pipes and devices may never end
            raise SarsplatError(f"there is no mesh file at '{path}'; give the path of an {', '.join(_FORMATS)} file")
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(_HEAD)
            binary = kind == ".glb" or (kind == ".stl" and size == 84 + 50 * int.from_bytes(head[80:84], "little"))
            if kind == ".ply":  # trimesh's criterion
                binary = not re.match(rb"[^\r\n]*[\r\n]+[^\r\n]*ascii", head, re.IGNORECASE)
            if size > _LARGEST["binary" if binary else kind]:
                of_text = "" if binary else " of text"
                raise SarsplatError(
                    f"'{path}' has {size} bytes{of_text}; simplify the mesh, or write it as .glb or binary .ply"
                )
            data = head + file.read(_LARGEST["binary"])
    except (OSError, MemoryError) as error:
        raise SarsplatError(f"cannot read '{path}': {error}; check the path and its permissions") from error
    if kind == ".ply" and re.match(rb"ply\r[^\n]", data):  # lines that end in CR alone
        header, end, body = data.partition(b"end_header\r")
        data = (header + end).replace(b"\r", b"\n") + body
    try:
        if kind == ".glb":
            data, hidden = _plain_glb(data)
            if hidden:
                warnings.warn(
                    f"'{path}': left out {counted(hidden, 'node')} that the file hides; make them visible to keep them",
                    SarsplatWarning,
                    stacklevel=2,
                )
        data = data if binary else _plain_text(kind, data)
        cut = polygon_mesh(kind, data)
    except SarsplatError as error:
        raise SarsplatError(f"'{path}' {error}") from error
    mesh = _read_with_trimesh(path, kind, data) if cut is None else trimesh.Trimesh(*cut[:2], process=False)
    if cut is not None and cut[2]:
        warnings.warn(
            f"'{path}': the outlines of {counted(cut[2], 'face')} cross themselves, so that their surface is a guess; "
            "repair the mesh",
            SarsplatWarning,
            stacklevel=2,
        )
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if len(faces) == 0:
        raise SarsplatError(f"'{path}' holds no faces, or is damaged; give a triangle mesh")
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.min() < 0 or faces.max() >= len(vertices):
        raise SarsplatError(f"'{path}' {_MISSING}")
    if (far := np.abs(vertices[np.isfinite(vertices)])).size and far.max() > _FARTHEST:
        raise SarsplatError(f"'{path}' has a vertex {far.max():.3g} m from the origin; repair it or scale it to metres")
    return mesh


def _read_with_trimesh(path: Path, kind: str, data: bytes) -> Trimesh:
    import trimesh

    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            # numpy only warns about a number it cannot read, and skips the rest of the line.
            warnings.filterwarnings("error", message="string or file could not be read")
            # Unprocessed: merging vertices would move them. A stream without resolver: no other file can be named.
            scene = trimesh.load_scene(io.BytesIO(data), file_type=kind[1:], process=False, skip_materials=True)
            mesh = scene.to_mesh()
            if kind == ".glb":  # from y up to z up
                mesh.vertices = mesh.vertices[:, [0, 2, 1]] * (1, -1, 1)
    except Exception as error:  # parsers behind trimesh raise any exception
        reason = repr(str(error) or type(error).__name__)[:200]
        raise SarsplatError(f"'{path}' cannot be read as a mesh ({reason}); repair it or give another file") from error
    return mesh


def _plain_text(kind: str, data: bytes) -> bytes:
    """Return UTF-8 text without materials, comments and empty lines, which are expensive for trimesh."""
    data = data.decode("utf-8", "replace").encode()
    if kind == ".stl" and (solids := data.lower().count(b"endsolid")) > _MAX_SOLIDS:
        raise SarsplatError(f"holds {solids} solids, each a mesh; export it as one plain mesh")
    if kind == ".obj":
        return _plain_obj(data).replace(b"usemtl", b"#")  # each change of material would take milliseconds for a mesh
    if kind == ".off":
        return re.sub(rb"(?:[\n-\r\x1c-\x1e]|#[^\n]*)(?:[\s\x1c-\x1e]+|#[^\n]*)*+", b"\n", data)
    return re.sub(rb"[\n-\r\x1c-\x1e][\s\x1c-\x1e]*", b"\n", data)


def _plain_obj(data: bytes) -> bytes:
    """Remove comments, continued lines and indentation, and resolve relative indices of faces.

    A comment that ends with a backslash, such as a Windows folder, does not continue in the next line. Raise if a face
    refers to a missing vertex.
    """
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    data = _COMMENT.sub(b"", data).replace(b"\\\n", b" ")
    data = _INDENTED.sub(b"\n", data).lstrip()
    if _ZERO.search(data):  # for trimesh this is the last vertex
        raise SarsplatError(_MISSING)
    if not _RELATIVE.search(data):
        return data
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = []
    for line in data.split(b"\n"):
        words = line.split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        elif words and words[0] == b"f":
            line = b" ".join([b"f", *(_corner(word, [*counts.values()]) for word in words[1:])])
        lines.append(line)
    return b"\n".join(lines)


def _corner(word: bytes, counts: list[int]) -> bytes:
    """Make relative indices (−1: the last one) of a corner vertex/texture/normal absolute, given the counts so far."""
    numbers = word.split(b"/")
    for kind, (number, count) in enumerate(zip(numbers, counts, strict=False)):
        if _BACK.fullmatch(number):
            if not -count <= int(number) < 0:
                raise SarsplatError(_MISSING)
            numbers[kind] = b"%d" % (count + 1 + int(number))
    return b"/".join(numbers)


def _scene_of(data: bytes) -> dict[str, Any]:
    """Return the JSON of a scene; raise if it describes far more data than the file holds, or needs an extension."""
    length = int.from_bytes(data[12:16], "little")
    if data[:4] != b"glTF" or data[16:20] != b"JSON" or length > min(len(data) - 20, _LONGEST_SCENE):
        raise SarsplatError(f"is not a whole .glb file with at most {_LONGEST_SCENE} bytes of JSON; export it again")
    scene: dict[str, Any] = json.loads(data[20 : 20 + length].decode())
    needed = [name for name in scene.get("extensionsRequired", ()) if not _HARMLESS.fullmatch(name)]
    needed += [_COPIES] * any(_COPIES in node.get("extensions", ()) for node in scene.get("nodes", ()))
    numbers, parts = _unfolded(scene)
    if "KHR_gaussian_splatting" in scene.get("extensionsUsed", ()):
        raise SarsplatError("holds Gaussians (KHR_gaussian_splatting), no mesh; give a mesh, or `sarsplat render` them")
    if needed:
        raise SarsplatError(f"needs {', '.join(needed)[:80]}, which is not read; export it without that extension")
    if numbers > 2 * len(data) + _FREE_NUMBERS or parts > _MAX_PARTS:
        raise SarsplatError(
            f"expands {len(data)} bytes to {numbers} numbers in {parts} parts; export it as one plain mesh"
        )
    return scene


def _plain_glb(data: bytes) -> tuple[bytes, int]:
    """Return a .glb file whose fans are triangles and whose hidden nodes are empty, and the number of these."""
    length = int.from_bytes(data[12:16], "little")
    try:
        scene = _scene_of(data)
        values, nodes = data[28 + length :], scene.get("nodes", [])
        hidden = [node for node in nodes if not node.get("extensions", {}).get(_VISIBLE, {}).get("visible", True)]
        fans = [one for mesh in scene.get("meshes", ()) for one in mesh["primitives"] if one.get("mode") == _FAN]
        for node in hidden:
            node.pop("mesh", None), node.pop("children", None)
        for fan in fans:
            corners = _corners_of(scene, fan, values)
            first = np.broadcast_to(corners[:1], len(corners) - 2)
            triangles = np.stack([first, corners[1:-1], corners[2:]], axis=1).astype("<u4")
            values += bytes(-len(values) % 4)
            scene["bufferViews"].append({"buffer": 0, "byteOffset": len(values), "byteLength": triangles.nbytes})
            view = {"bufferView": len(scene["bufferViews"]) - 1, "componentType": 5125, "type": "SCALAR"}
            scene["accessors"].append({**view, "count": triangles.size})
            fan |= {"indices": len(scene["accessors"]) - 1, "mode": _TRIANGLES}
            values += triangles.tobytes()
        drawn = [node for node in nodes if "mesh" in node]
        deformed = any(any(one.get("weights", scene["meshes"][one["mesh"]].get("weights", ()))) for one in drawn)
        for index in {one["attributes"]["POSITION"] for mesh in scene.get("meshes", ()) for one in mesh["primitives"]}:
            if deformed or scene["accessors"][index].get("normalized"):
                raise ValueError("morph targets and normalised positions are not read")
        if hidden or fans:
            scene["buffers"][0]["byteLength"] = len(values)
    except (LookupError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise SarsplatError(f"has a scene not read ({repr(error)[:120]}); export it as one plain mesh") from error
    if not (hidden or fans):
        return data, 0
    text = json.dumps(scene).encode()
    chunks = [(text + b" " * (-len(text) % 4), b"JSON"), (values + bytes(-len(values) % 4), b"BIN\0")]
    body = b"".join(struct.pack("<I4s", len(chunk), name) + chunk for chunk, name in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body, len(hidden)


def _corners_of(scene: dict[str, Any], primitive: dict[str, Any], values: bytes) -> Integer[np.ndarray, " n"]:
    """Return the indices of a primitive's vertices."""
    accessors = scene["accessors"]
    if "indices" not in primitive:
        return np.arange(accessors[primitive["attributes"]["POSITION"]]["count"])
    stored = accessors[primitive["indices"]]
    start = scene["bufferViews"][stored["bufferView"]].get("byteOffset", 0) + stored.get("byteOffset", 0)
    return np.frombuffer(values, _INDICES[stored["componentType"]], stored["count"], start)


def _unfolded(scene: dict[str, Any]) -> tuple[int, int]:
    """Return the count of numbers in trimesh's memory, every instance of every part included, and of instances."""
    views, accessors, meshes, nodes = (scene.get(key, []) for key in ("bufferViews", "accessors", "meshes", "nodes"))
    numbers = sum(_natural(view["byteLength"]) // 4 for view in views)
    for accessor in accessors:
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("sparse and compressed data are not read")
        numbers += _natural(accessor["count"]) * _COMPONENTS[accessor["type"]]
    loads, parts = [], len(nodes)
    for mesh in meshes:
        primitives = mesh["primitives"]
        used = [index for p in primitives for index in (*p["attributes"].values(), p.get("indices"))]
        loads.append((sum(accessors[index]["count"] for index in used if index is not None), len(primitives)))
    for load, count in [*loads, *(loads[node["mesh"]] for node in nodes if "mesh" in node)]:
        numbers, parts = numbers + load, parts + count
    return numbers, parts + sum(len(node.get("children", ())) for node in nodes)


def _natural(value: object) -> int:
    if isinstance(value, int) and value >= 0:
        return value
    raise ValueError(f"{value!r:.40} is not a count")
