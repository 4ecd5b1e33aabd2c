"""Reader of `.splat` files (web viewer antimatter15/splat)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from sarsplat.data.files import open_file
from sarsplat.data.ply_points import named
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.law_harmonics import CONSTANTS

SPLAT = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""One Gaussian of a `.splat` file: m, standard deviations (m), colour and opacity, and 128 + 128·q of wxyz."""

_MAX_LOGIT = 40.0
"""Logit of an opacity of 1."""


def splat_columns(path: Path) -> dict[str, Float64[np.ndarray, " n"]]:
    """Read the Gaussians of a `.splat` file as the properties of a 3DGS PLY."""
    with open_file(path) as file:
        data = file.read()
    if not data or len(data) % SPLAT.itemsize:
        raise SarsplatError(
            f"{path} has {len(data)} bytes, but a .splat file has {SPLAT.itemsize} for each Gaussian; get it again, or "
            "give a PLY"
        )
    table = np.frombuffer(data, SPLAT)
    colours = table["rgba"] / 255.0
    with np.errstate(divide="ignore"):
        scales = np.log(np.maximum(table["scale"].astype(np.float64), 0.0))
    return {
        **named(("x", "y", "z"), table["position"].astype(np.float64)),
        **named((f"scale_{k}" for k in range(3)), scales),
        **named((f"f_dc_{k}" for k in range(3)), (colours[:, :3] - 0.5) / CONSTANTS[0]),  # harmonic of degree 0
        "opacity": _logit(colours[:, 3]),
        **named((f"rot_{k}" for k in range(4)), table["rotation"] / 128.0 - 1.0),
    }


def _logit(opacity: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    with np.errstate(divide="ignore"):
        return np.clip(np.log(opacity) - np.log1p(-opacity), -_MAX_LOGIT, _MAX_LOGIT)
