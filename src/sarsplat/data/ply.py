"""Gaussians as PLY, in the layout of 3D Gaussian splatting, so that other programs open them; `.splat` files.

A Gaussian's vertex holds, as float32,

* x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..44, opacity, scale_0..2, rot_0..3 — what viewers read: scales as natural
  logarithms, opacity as the logit of 1 − e^{−κ}, quaternions wxyz, and harmonics of degree 3, channel by channel, whose
  colours show γ⁰ in decibels or the height (see viewer_colours.py);
* optical_depth, scale_m_0..2, scattering_0.. — κ, the standard deviations (m) and the parameters of the scattering,
  from which sarsplat reads the same bits back.

The header's comments hold the version, the law of scattering as JSON, and a legend of the colours.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.data.files import decode_json, read_bytes
from sarsplat.data.gltf_splats import glb_columns
from sarsplat.data.outliers import outliers
from sarsplat.data.ply_points import named, read_ply, stacked, write_ply
from sarsplat.data.viewer_colours import ODD, viewer_colours
from sarsplat.errors import SarsplatError, SarsplatWarning, counted, shown
from sarsplat.gaussians import (
    MAX_OPTICAL_DEPTH,
    MIN_SCALE,
    SCATTERINGS,
    Gaussians,
    Harmonics,
    Scattering,
    scattering_named,
)
from sarsplat.gaussians.law_harmonics import CONSTANTS
from sarsplat.names import Colour

_OTHER_AXIS = re.compile(r"vertical axis:\s*([+-]?[xy]|-z)\s*", re.IGNORECASE)  # comment of Gaussians whose z is not up
_VERSION = "sarsplat gaussians 2"
_LAW = "scattering "
_FOR_VIEWERS = ("n", "f_", "opacity", "scale_0", "scale_1", "scale_2")
"""Prefixes of properties of sarsplat's files that only viewers read."""
_FAR = 20.0
"""Distance from the origin, in sizes, beyond which Gaussians are moved: an image of both would show them as a dot."""
_OUTLIERS = 0.002  # share of the centres on either side that is left out of the size
_UNUSED = ("nx", "ny", "nz")
_SMALLEST_LOG, _LARGEST_LOG = math.log(MIN_SCALE), 80.0
"""Range of logarithms of scales in m; e^80 is near the largest float32."""
_MIN_LOGIT = -30.0  # logit written for an opacity of zero
_MAX_LOGIT = 40.0  # logit of an opacity of 1 in a `.splat` file
SPLAT = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""One Gaussian of a `.splat` file (web viewer antimatter15/splat): m, standard deviations (m), colour and opacity, and
128 + 128·q of wxyz."""


@checks_arguments
def write_gaussians_ply(
    path: str | Path, gaussians: Gaussians, comments: Iterable[str] = (), *, colour: Colour = "db"
) -> None:
    """Write Gaussians, whole or not at all.

    Parameters
    ----------
    path : str or Path
        File to write; an existing one is replaced.
    gaussians : Gaussians
        Stored as float32.
    comments : iterable of str
        Lines for the header.
    colour : "db" or "height"
        Quantity that viewers show: γ⁰ in decibels, or the height. It does not affect reading the file.

    Raises
    ------
    SarsplatError
        If a value is not finite or outside its range, the scattering law is not registered, or the file cannot be
        written.
    """
    law = _stated(gaussians.scattering)
    values = {name: t.detach().cpu().numpy().astype(np.float32) for name, t in gaussians.tensors().items()}
    _check_gaussians(values, "the Gaussians")
    depth = values["optical_depth"].astype(np.float64)
    with np.errstate(divide="ignore"):
        opacity = np.maximum(np.log(np.expm1(depth)), _MIN_LOGIT)  # logit(1 − e^{−κ}) = ln(e^κ − 1)
    shown_as = viewer_colours(gaussians, colour)
    rest = shown_as.harmonics[:, :, 1:].reshape(len(gaussians), 45)
    columns = {
        **named(("x", "y", "z"), values["means"]),
        **named(("nx", "ny", "nz"), np.zeros_like(values["means"])),
        **named((f"f_dc_{c}" for c in range(3)), shown_as.harmonics[:, :, 0]),
        **named((f"f_rest_{k}" for k in range(rest.shape[1])), rest),
        "opacity": opacity,
        **named((f"scale_{k}" for k in range(3)), np.log(values["scales"])),
        **named((f"rot_{k}" for k in range(4)), values["quaternions"]),
        "optical_depth": values["optical_depth"],
        **named((f"scale_m_{k}" for k in range(3)), values["scales"]),
        **named((f"scattering_{k}" for k in range(values["scattering"].shape[1])), values["scattering"]),
    }
    write_ply(Path(path), columns, [_VERSION, _LAW + law, shown_as.legend, *comments])


@checks_arguments
def read_gaussians_ply(path: str | Path) -> Gaussians:
    """Read Gaussians: exactly from sarsplat's PLY files, approximately from PLY, `.splat` or `.glb` of 3DGS programs.

    In files of 3DGS programs, κ = −ln(1 − opacity), the harmonics are the mean over the three colours, and p_min is 0;
    a property filter_3D (Mip-Splatting) widens Gaussians and lowers their opacity.
    A `.splat` file has one colour per Gaussian, a `.glb` (KHR_gaussian_splatting) harmonics: in sarsplat's exports
    shades of grey for decibels.

    Returns
    -------
    Gaussians
        float32, on the CPU.

    Raises
    ------
    SarsplatError
        If the file is missing, damaged, truncated, no 3DGS file, or holds values outside their range.

    Warns
    -----
    SarsplatWarning
        If Gaussians with NaN, an infinity or no orientation were left out.
    """
    return _read(Path(path), ())[0]


def read_centred_gaussians(path: Path) -> tuple[Gaussians, Float64[np.ndarray, " 3"]]:
    """Read Gaussians, moved near the origin if they are far from it for their size, and the vector subtracted, m.

    Gaussians in map or geocentric coordinates are moved: their middle above the origin, their lowest onto z = 0. This
    precedes rounding to float32, which has steps of 0.5 m at 5·10⁶ m.
    """
    return _read(path, ("x", "y", "z"))


def _read(path: Path, exact: tuple[str, ...]) -> tuple[Gaussians, Float64[np.ndarray, " 3"]]:
    """Read Gaussians and the vector subtracted from their means, which is zero unless coordinates are read `exact`."""
    if (other := {".splat": _splat_columns, ".glb": glb_columns}.get(path.suffix.lower())) is not None:
        columns, comments = other(path), list[str]()
    else:
        columns, comments = read_ply(
            path, lambda name, of: _VERSION not in of or not name.startswith(_FOR_VIEWERS), exact
        )
    ours = _VERSION in comments
    foreign = next((line for line in comments if line.startswith("sarsplat gaussians") and not ours), None)
    if foreign is not None:
        raise SarsplatError(f"{path} has the format {shown(foreign)} but this program reads {_VERSION!r}; update it")
    states = [f"states {shown(one)}" for one in comments if _OTHER_AXIS.fullmatch(one)]
    if wrong := ["is compressed"] * ("packed_position" in columns) + states:
        raise SarsplatError(f"{path} {wrong[0]}; convert it to a plain PLY, z up, with splat-transform or SuperSplat")
    columns = _usable(path, columns)
    values = {
        "means": stacked(path, columns, ["x", "y", "z"]),
        "quaternions": stacked(path, columns, [f"rot_{k}" for k in range(4)]),
        **(_exact(path, columns) if ours else _from_3dgs(path, columns)),
    }
    del columns
    _check_gaussians(values, str(path))
    moved = far_from_origin(values["means"], values["scales"]) if exact else np.zeros(3)
    values["means"] = values["means"] - moved
    tensors = {name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in values.items()}
    law = _law(path, comments, tensors.pop("scattering")) if ours else Harmonics(tensors.pop("scattering"))
    return Gaussians(**tensors, scattering=law), moved


def _splat_columns(path: Path) -> dict[str, Float64[np.ndarray, " n"]]:
    """Read the Gaussians of a `.splat` file as the properties of a 3DGS PLY."""
    data = read_bytes(path)
    if not data or len(data) % SPLAT.itemsize:
        raise SarsplatError(
            f"{path} has {len(data)} bytes, but a .splat file has {SPLAT.itemsize} for each Gaussian; get it again, or "
            "give a PLY"
        )
    table = np.frombuffer(data, SPLAT)
    colours = table["rgba"] / 255.0
    with np.errstate(divide="ignore", invalid="ignore"):  # invalid: signalling NaN
        position, lengths = (table[name].astype(np.float64) for name in ("position", "scale"))
        scales = np.log(np.maximum(lengths, 0.0))
        logit = np.log(colours[:, 3]) - np.log1p(-colours[:, 3])
    return {
        **named(("x", "y", "z"), position),
        **named((f"scale_{k}" for k in range(3)), scales),
        **named((f"f_dc_{k}" for k in range(3)), (colours[:, :3] - 0.5) / CONSTANTS[0]),  # harmonic of degree 0
        "opacity": np.clip(logit, -_MAX_LOGIT, _MAX_LOGIT),
        **named((f"rot_{k}" for k in range(4)), table["rotation"] / 128.0 - 1.0),
    }


def _usable(path: Path, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Leave out Gaussians with NaN or infinity in a used property, with a warning.

    Infinite logits (opacity 0 or 1) and infinite logarithms (length 0) are valid and clipped.
    """
    columns = dict(columns)
    if "opacity" in columns:
        columns["opacity"] = np.clip(columns["opacity"], -MAX_OPTICAL_DEPTH, MAX_OPTICAL_DEPTH)
    for name in {f"scale_{k}" for k in range(3)} & columns.keys():
        length = np.maximum(columns[name], _SMALLEST_LOG)
        columns[name] = np.where(length < _LARGEST_LOG, length, np.nan)
    count = len(next(iter(columns.values()), ()))
    good = np.ones(count, bool)
    for name, column in columns.items():
        if not name.startswith(_UNUSED):
            good &= np.isfinite(column)
    turns = [columns[name] for name in (f"rot_{k}" for k in range(4)) if name in columns]
    if turns:
        good &= np.any([turn != 0 for turn in turns], axis=0)
    if good.all():
        return columns
    text = f"{counted(count - int(good.sum()), 'Gaussian')} of {count:,} hold NaN or an infinity, or no orientation"
    if not good.any():
        raise SarsplatError(f"{path}: {text}; create it again")
    warnings.warn(f"{path}: {text}; they were left out", SarsplatWarning, stacklevel=4)
    return {name: column[good] for name, column in columns.items()}


def far_from_origin(means: Float[np.ndarray, "n 3"], scales: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, " 3"]:
    """Return the offset to subtract from means (m) that are far from the origin for their size; zeros otherwise."""
    if not len(means):
        return np.zeros(3)
    middle = np.median(means.astype(np.float64), axis=0)
    inlier = ~outliers(means - middle, scales)
    low, high = np.quantile(means[inlier].astype(np.float64), (_OUTLIERS, 1 - _OUTLIERS), axis=0)
    size = float(np.linalg.norm(high - low)) + 2 * float(np.median(scales[inlier].max(axis=1)))
    if np.abs([low, high]).max() <= _FAR * size:
        return np.zeros(3)
    unit = 10.0 ** math.floor(math.log10(size / 10))  # rounded offsets have few digits
    moved: Float64[np.ndarray, " 3"] = unit * np.round(np.array([*(low + high)[:2] / 2, low[2]]) / unit)
    return moved


def _exact(path: Path, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return scales, optical depth and scattering of a sarsplat file."""
    count = sum(name.startswith("scattering_") for name in columns)
    return {
        "scales": stacked(path, columns, [f"scale_m_{k}" for k in range(3)]),
        "optical_depth": stacked(path, columns, ["optical_depth"])[:, 0],
        "scattering": stacked(path, columns, [f"scattering_{k}" for k in range(count)]),
    }


def _from_3dgs(path: Path, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Convert properties of a 3DGS file to scales, optical depth and scattering."""
    rest = sum(name.startswith("f_rest_") for name in columns)
    if rest not in (0, 9, 24, 45):
        raise SarsplatError(f"{path} has {rest} properties f_rest_*; degrees 0 to 3 have 0, 9, 24 or 45")
    constant = stacked(path, columns, [f"f_dc_{c}" for c in range(3)])
    harmonics = np.empty((len(constant), 1 + rest // 3), np.float32)
    colours = stacked(path, columns, [f"f_rest_{k}" for k in range(rest)]).reshape(len(constant), 3, rest // 3)
    harmonics[:, 0], harmonics[:, 1:] = constant.mean(1), colours.mean(1)
    logit = stacked(path, columns, ["opacity"])[:, 0].astype(np.float64)
    depth = np.logaddexp(0, logit)  # −ln(1 − sigmoid(x)) = ln(1 + eˣ)
    if "scale_1" in columns and "scale_2" not in columns:
        raise SarsplatError(
            f"{path} holds flat Gaussians (2DGS), which have no scale_2; add it, the logarithm of their thickness in m"
        )
    with np.errstate(over="ignore", divide="ignore"):
        scales = np.maximum(np.exp(stacked(path, columns, [f"scale_{k}" for k in range(3)])), np.float32(MIN_SCALE))
        if "filter_3D" in columns:  # convolution with a Gaussian of that width keeps the integral of the opacity
            narrow, scales = scales, np.hypot(scales, columns["filter_3D"][:, None]).astype(np.float32)
            depth = -np.log1p(np.expm1(-depth) * (narrow / scales).prod(axis=1, dtype=np.float64))
    harmonics[:, [k for k in ODD if k < harmonics.shape[1]]] *= -1  # Y_k(−u) = (−1)^degree Y_k(u)
    depth = np.minimum(depth, MAX_OPTICAL_DEPTH).astype(np.float32)
    return {"scales": scales, "optical_depth": depth, "scattering": harmonics}


def _check_gaussians(values: dict[str, np.ndarray], name: str) -> None:
    for key, value in values.items():
        if not np.isfinite(value).all():
            raise SarsplatError(f"{name} contain NaN or an infinity in {key}; remove those Gaussians")
    for key, low, high in (("scales", np.float32(MIN_SCALE), np.inf), ("optical_depth", 0.0, MAX_OPTICAL_DEPTH)):
        if ((values[key] < low) | (values[key] > high)).any():
            raise SarsplatError(
                f"{name} contain {key} of {values[key].min()} to {values[key].max()}; give {low:g} to {high:g}"
            )
    if (np.abs(values["quaternions"]).max(axis=1, initial=0) == 0).any():
        raise SarsplatError(f"{name} contain a quaternion of zeros; give each Gaussian an orientation")


def _stated(law: Scattering) -> str:
    """Serialise a law of scattering to JSON for the header; `_law` reads it."""
    name = f"the scattering law {type(law).__name__}"
    if (kind := getattr(law, "kind", "")) not in SCATTERINGS or SCATTERINGS[kind] is not type(law):
        raise SarsplatError(
            f"{name} ({shown(kind)}) is not registered, so the file could not be read again; decorate the class with "
            "@sarsplat.gaussians.register_scattering"
        )
    try:
        text = json.dumps(law.settings())
        type(law)(law.parameters, **json.loads(text))
    except (TypeError, ValueError, SarsplatError) as error:
        raise SarsplatError(
            f"{name} cannot be made again from its settings ({shown(str(error))}); use JSON types for them"
        ) from error
    return json.dumps({"kind": kind, **law.settings()})


def _law(path: Path, comments: list[str], parameters: Tensor) -> Scattering:
    """Make the header's law of scattering with these parameters."""
    stated = [line.removeprefix(_LAW) for line in comments if line.startswith(_LAW)]
    laws = [decode_json(text.encode(), Path(f"the header of {path}"), dict[str, Any]) for text in stated]
    if len(laws) != 1 or not isinstance(laws[0].get("kind"), str):
        raise SarsplatError(f"{path} does not name exactly one scattering law in its header; create it again")
    try:
        return scattering_named(laws[0].pop("kind"))(parameters, **laws[0])
    except (TypeError, SarsplatError) as error:
        raise SarsplatError(f"{path} has an invalid scattering law ({shown(str(error))}); create it again") from error
