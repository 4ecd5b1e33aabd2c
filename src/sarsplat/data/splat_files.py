"""Files of Gaussians that are no plain PLY, as the columns that 3DGS programs write into one.

* `.splat` of the web viewer antimatter15/splat: 32 bytes each, and nothing else;
* SuperSplat's compressed PLY: integers between the ends of chunks of 256 Gaussians.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int

from sarsplat.data.files import open_file
from sarsplat.data.ply_points import named, read_ply
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.harmonics import CONSTANTS

SPLAT = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""One Gaussian of a `.splat` file: m, standard deviations (m), colour and opacity, and 128 + 128·q of wxyz."""

PACKED = "packed_position"
"""A property of the vertices of SuperSplat's compressed PLY."""

_CHUNK = 256  # Gaussians between the same ends
_ENDS = tuple(f"{end}_{what}{axis}" for what in ("", "scale_") for axis in "xyz" for end in ("min", "max"))
_SURE = 40.0  # logit of an opacity of 1


def splat_columns(path: Path) -> dict[str, Float64[np.ndarray, " n"]]:
    """The Gaussians of a `.splat` file, by the names that properties have in a PLY."""
    with open_file(path) as file:
        data = file.read()
    if not data or len(data) % SPLAT.itemsize:
        raise SarsplatError(
            f"{path} has {len(data)} bytes, which are no whole number of Gaussians of {SPLAT.itemsize} bytes as .splat "
            "files hold them; get it again, or give a PLY"
        )
    table = np.frombuffer(data, SPLAT)
    colours = table["rgba"] / 255.0
    with np.errstate(divide="ignore"):
        scales = np.log(np.maximum(table["scale"].astype(np.float64), 0.0))
    return {
        **named(("x", "y", "z"), table["position"].astype(np.float64)),
        **named((f"scale_{k}" for k in range(3)), scales),
        **named((f"f_dc_{k}" for k in range(3)), _constant(colours[:, :3])),
        "opacity": _logit(colours[:, 3]),
        **named((f"rot_{k}" for k in range(4)), table["rotation"] / 128.0 - 1.0),
    }


def unpacked(path: Path) -> dict[str, Float64[np.ndarray, " n"]]:
    """The Gaussians of a compressed PLY, by the names that properties have in one that is not."""
    words = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
    packed, _ = read_ply(path, exact=words)
    chunks, _ = read_ply(path, element="chunk")
    if any(word not in packed for word in words) or any(end not in chunks for end in _ENDS):
        raise SarsplatError(f"{path} is a compressed PLY without some of its properties; export it again, uncompressed")
    position, rotation, scale, colour = (packed[word].astype(np.int64) for word in words)
    count, many = len(position), len(chunks["min_x"])
    if count > _CHUNK * many:
        raise SarsplatError(f"{path} has {many} chunks for {count} Gaussians, of {_CHUNK} at most; export it again")
    place = np.arange(count) // _CHUNK

    def between(values: Float64[np.ndarray, "n 3"], axes: str, prefix: str) -> Float64[np.ndarray, "n 3"]:
        low, high = (
            np.stack([chunks[f"{end}_{prefix}{axis}"].astype(np.float64)[place] for axis in axes], axis=1)
            for end in ("min", "max")
        )
        return low + (high - low) * values

    def parts(word: Int[np.ndarray, " n"], bits: tuple[int, ...]) -> Float64[np.ndarray, "n k"]:
        """Numbers from 0 to 1 of so many bits each, the first in the highest ones."""
        below = [sum(bits[k + 1 :]) for k in range(len(bits))]
        largest = [(1 << own) - 1 for own in bits]
        return np.stack([((word >> s) & most) / most for s, most in zip(below, largest, strict=True)], axis=1)

    colours = parts(colour, (8, 8, 8, 8))
    rgb = between(colours[:, :3], "rgb", "") if "min_r" in chunks else colours[:, :3]
    sizes = parts(scale, (11, 10, 11))
    columns = {
        **named(("x", "y", "z"), between(parts(position, (11, 10, 11)), "xyz", "")),
        **named((f"scale_{k}" for k in range(3)), between(sizes, "xyz", "scale_")),
        **named((f"f_dc_{k}" for k in range(3)), _constant(rgb)),
        "opacity": _logit(colours[:, 3]),
        **named((f"rot_{k}" for k in range(4)), _quaternions(rotation >> 30, parts(rotation, (2, 10, 10, 10))[:, 1:])),
    }
    harmonics, _ = read_ply(path, lambda name, _: name.startswith("f_rest_"), element="sh", missing=True)
    return columns | {name: column * (8 / 255) - 4 for name, column in harmonics.items()}


def _quaternions(largest: Int[np.ndarray, " n"], others: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 4"]:
    """wxyz, of which the largest is left out of what is stored."""
    others = (others - 0.5) * np.sqrt(2.0)
    whole = np.empty((len(others), 4))
    rows = np.arange(len(others))
    rest = np.arange(4)[None] != largest[:, None]
    whole[rest] = others.reshape(-1)
    whole[rows, largest] = np.sqrt(np.maximum(1 - (others**2).sum(axis=1), 0.0))
    return whole


def _constant(colours: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """The harmonic of degree 0 of colours from 0 to 1."""
    return (colours.astype(np.float64) - 0.5) / CONSTANTS[0]


def _logit(opacity: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    with np.errstate(divide="ignore"):
        return np.clip(np.log(opacity) - np.log1p(-opacity), -_SURE, _SURE)
