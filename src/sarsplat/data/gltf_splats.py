"""Gaussians as binary glTF by the Khronos extension KHR_gaussian_splatting, for viewers.

A primitive of points has float attributes for each Gaussian: position, standard deviations, quaternion xyzw, opacity,
and harmonics of degree 0 to 3, red, green and blue, in the order and with the signs of 3D Gaussian splatting. glTF has
y up: (x, z, −y) of the scene. `extras` of the mesh hold a legend of the colours.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from sarsplat.data.files import decode_json, open_file, read_bytes
from sarsplat.data.ply_points import named
from sarsplat.data.viewer_colours import viewer_colours
from sarsplat.errors import SarsplatError, shown
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.law_harmonics import CONSTANTS, harmonic_basis
from sarsplat.names import Colour

EXTENSION = "KHR_gaussian_splatting"
_PREFIX = f"{EXTENSION}:"
_KIND = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
_HARMONICS = [f"{_PREFIX}SH_DEGREE_{degree}_COEF_{k}" for degree in range(4) for k in range(2 * degree + 1)]
_DEGREES = {(degree + 1) ** 2 for degree in range(4)}
_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # rotation from z up to y up
_FLOAT, _POINTS, _ARRAY_BUFFER = 5126, 0, 34962
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_EVEN = 1e-3  # tolerance of a node's scale that is the same along all axes
_LEAST_BYTES = 16  # minimum bytes of a file for each Gaussian: nodes that repeat a mesh may not multiply it without end


def glb_bytes(gaussians: Gaussians, colour: Colour) -> bytes:
    """Return Gaussians as bytes of a .glb file; `colour` is that of `write_gaussians_ply`."""
    values = {name: tensor.detach().double().cpu().numpy() for name, tensor in gaussians.tensors().items()}
    colours = viewer_colours(gaussians, colour)
    turn = Rotation.from_matrix(_Y_UP) * Rotation.from_quat(values["quaternions"], scalar_first=True)
    opacity = -np.expm1(-values["optical_depth"])
    srgb = np.clip(colours.harmonics[:, :, 0] * CONSTANTS[0] + 0.5, 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    arrays = {
        "POSITION": values["means"] @ _Y_UP.T,
        "COLOR_0": np.column_stack([linear, opacity]),
        f"{_PREFIX}ROTATION": turn.as_quat(),
        f"{_PREFIX}SCALE": values["scales"],
        f"{_PREFIX}OPACITY": opacity[:, None],
        **dict(zip(_HARMONICS, _turned(colours.harmonics, _Y_UP).transpose(2, 0, 1), strict=True)),
    }
    packed = {name: np.ascontiguousarray(array, "<f4") for name, array in arrays.items()}
    kinds = {width: kind for kind, width in _WIDTHS.items()}
    accessors: list[dict[str, Any]] = [
        {"bufferView": k, "componentType": _FLOAT, "count": len(array), "type": kinds[array.shape[1]]}
        for k, array in enumerate(packed.values())
    ]
    accessors[0] |= {end: getattr(packed["POSITION"], end)(axis=0).tolist() for end in ("min", "max")}
    starts = np.cumsum([0, *(array.nbytes for array in packed.values())]).tolist()
    attributes = {name: k for k, name in enumerate(packed)}
    primitive = {"mode": _POINTS, "attributes": attributes, "extensions": {EXTENSION: _KIND}}
    scene = {
        "asset": {"version": "2.0", "generator": "sarsplat"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive], "extras": {"harmonics": colours.legend}}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": _ARRAY_BUFFER}
            for start, array in zip(starts, packed.values(), strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + starts[-1], len(text), 0x4E4F534A)
    body = b"".join(array.tobytes() for array in packed.values())
    return head + text + struct.pack("<II", len(body), 0x004E4942) + body


def holds_gaussians(path: Path) -> bool:
    """Return whether a .glb file has Gaussians."""
    with open_file(path) as file:
        head = file.read(20)
        return EXTENSION.encode() in file.read(int.from_bytes(head[12:16], "little"))


def glb_columns(path: Path) -> dict[str, Float64[np.ndarray, " n"]]:
    """Read the Gaussians of a .glb file as the properties of a 3DGS PLY, z up."""
    data = read_bytes(path)
    length = int.from_bytes(data[12:16], "little")
    if data[:4] != b"glTF" or data[16:20] != b"JSON":
        raise SarsplatError(f"{path} is no binary glTF; give a .glb, or a PLY of a 3DGS program")
    scene = decode_json(data[20 : 20 + length], path, dict[str, Any])
    parts, count = [], 0
    try:
        with np.errstate(all="ignore"):
            for mesh, matrix in _placed(scene):
                for primitive in scene["meshes"][mesh]["primitives"]:
                    if EXTENSION not in primitive.get("extensions", {}):
                        continue
                    parts.append(_part(scene, data[28 + length :], primitive, matrix))
                    count += len(parts[-1]["x"])
                    if count > len(data) / _LEAST_BYTES or len({len(column) for column in parts[-1].values()}) != 1:
                        raise ValueError("a mesh repeated by many nodes, or attributes of different lengths")
        if not parts:
            raise SarsplatError(f"{path} holds no Gaussians ({EXTENSION}), perhaps a mesh; give a file of Gaussians")
        if len({len(part) for part in parts}) != 1:
            raise ValueError(f"{len(parts)} primitives with {EXTENSION}, of equal degree")
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError, np.linalg.LinAlgError) as error:
        raise SarsplatError(
            f"{path} cannot be read as Gaussians in glTF ({shown(str(error))}); write it as a PLY of 3DGS"
        ) from error


def _placed(scene: dict[str, Any]) -> Iterator[tuple[int, Float64[np.ndarray, "4 4"]]]:
    """Yield the mesh and the global transformation of each node."""
    left = [(node, np.eye(4)) for node in scene["scenes"][scene.get("scene", 0)]["nodes"]]
    visited: set[int] = set()
    while left:
        index, above = left.pop()
        if index in visited:
            raise ValueError(f"node {index} twice")
        visited.add(index)
        node = scene["nodes"][index]
        matrix = np.eye(4)
        if "matrix" in node:
            matrix = np.array(node["matrix"], float).reshape(4, 4).T
        else:
            turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
            matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), float)
            matrix[:3, 3] = node.get("translation", (0, 0, 0))
        matrix = above @ matrix
        if "mesh" in node:
            yield node["mesh"], matrix
        left += [(child, matrix) for child in node.get("children", ())]


def _part(
    scene: dict[str, Any], body: bytes, primitive: dict[str, Any], matrix: Float64[np.ndarray, "4 4"]
) -> dict[str, Float64[np.ndarray, " n"]]:
    """Return the Gaussians of a primitive, transformed by its node, z up."""
    about, attributes = primitive["extensions"][EXTENSION], primitive["attributes"]
    if {name: about.get(name) for name in _KIND} != _KIND or about.get("extensions"):
        raise ValueError(", ".join(f"{name} {value}" for name, value in about.items()))
    linear = _Y_UP.T @ matrix[:3, :3]
    size = np.cbrt(np.linalg.det(linear))
    if not (size > 0 and np.allclose(linear @ linear.T, size**2 * np.eye(3), rtol=0, atol=_EVEN * size**2)):
        raise ValueError("a node that mirrors, shears or scales unevenly")
    turn = linear / size
    names = [name for name in _HARMONICS if name in attributes]
    if len(names) not in _DEGREES or names != _HARMONICS[: len(names)]:
        raise ValueError(f"{len(names)} harmonics")
    harmonics = _turned(np.stack([_accessor(scene, body, attributes[name], 3) for name in names], axis=-1), turn)
    means = _accessor(scene, body, attributes["POSITION"], 3) @ linear.T + _Y_UP.T @ matrix[:3, 3]
    own = _accessor(scene, body, attributes[f"{_PREFIX}ROTATION"], 4)
    own = np.where(np.linalg.norm(own, axis=1, keepdims=True) > 0, own, np.nan)
    x, y, z, w = (Rotation.from_matrix(turn) * Rotation.from_quat(np.where(np.isfinite(own), own, 1.0))).as_quat().T
    opacity = _accessor(scene, body, attributes[f"{_PREFIX}OPACITY"], 1)[:, 0]
    return {
        **named(("x", "y", "z"), means),
        **named((f"rot_{k}" for k in range(4)), np.where(np.isfinite(own), np.column_stack([w, x, y, z]), np.nan)),
        **named(
            (f"scale_{k}" for k in range(3)), np.log(size * _accessor(scene, body, attributes[f"{_PREFIX}SCALE"], 3))
        ),
        "opacity": np.log(opacity) - np.log1p(-opacity),
        **named((f"f_dc_{k}" for k in range(3)), harmonics[:, :, 0]),
        **named((f"f_rest_{k}" for k in range(3 * len(names) - 3)), harmonics[:, :, 1:].reshape(len(means), -1)),
    }


def _accessor(scene: dict[str, Any], body: bytes, index: int, width: int) -> Float64[np.ndarray, "n k"]:
    """Return the values of an accessor of this width."""
    about = scene["accessors"][index]
    view = scene["bufferViews"][about["bufferView"]]
    kind, count = np.dtype(_COMPONENTS[about["componentType"]]), about["count"]
    if _WIDTHS[about["type"]] != width or "sparse" in about or "extensions" in view or view["buffer"] != 0:
        raise ValueError(f"accessor {index}, {about['type']}, sparse, compressed or in another file")
    start = view.get("byteOffset", 0) + about.get("byteOffset", 0)
    stride = view.get("byteStride", width * kind.itemsize)
    if min(count, start, stride - width * kind.itemsize) < 0 or start + (count - 1) * stride > len(body):
        raise ValueError(f"accessor {index}")
    values = np.ndarray((count, width), kind, body, start, (stride, kind.itemsize)).astype(np.float64)
    return np.maximum(values / np.iinfo(kind).max, -1.0) if about.get("normalized") else values


def _turned(harmonics: Float[np.ndarray, "n 3 k"], turn: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "n 3 k"]:
    """Return the coefficients of functions on the sphere that are turned by a rotation."""
    count = harmonics.shape[-1]
    directions = np.random.default_rng(0).normal(size=(4 * len(CONSTANTS), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    after, before = (harmonic_basis(torch.from_numpy(u), 3).numpy()[:, :count] for u in (directions, directions @ turn))
    turned: Float64[np.ndarray, "n 3 k"] = harmonics @ np.linalg.lstsq(after, before)[0].T
    return turned
