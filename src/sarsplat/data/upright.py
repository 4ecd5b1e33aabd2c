"""Gaussians of files whose header states another vertical axis than z: they are turned upright."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from sarsplat.errors import SarsplatWarning
from sarsplat.gaussians.harmonics import harmonic_basis

_STATED = re.compile(r"vertical axis:\s*([+-]?)([xyz])\s*", re.IGNORECASE)
_DIRECTIONS = 200  # more than there are harmonics


def upright(
    values: dict[str, Float[np.ndarray, "n ..."]], path: Path, comments: list[str]
) -> dict[str, Float[np.ndarray, "n ..."]]:
    """Means, quaternions and harmonics ("scattering", for the direction to the radar) with z up; said in a warning.

    Brush states y of scenes in which y points down, as it does in photographs, and reads its files like that.
    """
    stated = next((match for line in reversed(comments) if (match := _STATED.fullmatch(line))), None)
    if stated is None or (stated[2].lower() == "z" and stated[1] != "-"):
        return values
    axis = stated[2].lower()
    down = stated[1] == "-" or (axis == "y" and any("from brush" in line.lower() for line in comments))
    up = np.where(np.array(list("xyz")) == axis, -1.0 if down else 1.0, 0.0)
    warnings.warn(
        f"{path} states {stated[0].strip()!r}: its Gaussians were turned so that {'−' if down else ''}{axis} is up, "
        "where z is in ours; remove that comment if they stand upright as they are",
        SarsplatWarning,
        stacklevel=5,
    )
    # the shortest turn; of what stands on its head, about x
    turn = Rotation.from_rotvec(_shortest(up))
    matrix = turn.as_matrix().round(12)
    quaternions = turn * Rotation.from_quat(values["quaternions"][:, [1, 2, 3, 0]])
    return values | {
        "means": values["means"] @ matrix.T.astype(values["means"].dtype),
        "quaternions": quaternions.as_quat()[:, [3, 0, 1, 2]],
        "scattering": turned(values["scattering"], matrix),
    }


def _shortest(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """The rotation, as a vector, that brings a direction along an axis to z."""
    if up[2] < 0:
        return np.array([np.pi, 0.0, 0.0])
    around: Float[np.ndarray, " 3"] = np.cross(up, (0.0, 0.0, 1.0)) * np.pi / 2
    return around


def turned(harmonics: Float[np.ndarray, "n k"], matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n k"]:
    """Coefficients of a function on the sphere that is turned with everything else."""
    degree = round(harmonics.shape[1] ** 0.5) - 1
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (harmonic_basis(torch.from_numpy(u), degree).numpy() for u in (directions @ matrix, directions))
    change = np.linalg.lstsq(after, before, rcond=None)[0]
    moved: Float[np.ndarray, "n k"] = harmonics @ change.T
    return moved
