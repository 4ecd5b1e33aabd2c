"""The surface of something that attenuates: at which level, and its triangles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from sarsplat.errors import SarsplatError

_LEVELS = 48
_LOWEST = 0.02  # of the median attenuation where half is hidden
_AT_ONCE = 1 << 18


def level_of_half(depths: Sequence[Float[Tensor, "n r"]]) -> float:
    """The level that, on average over the rays, is first reached nearest to where half is hidden.

    Parameters
    ----------
    depths : sequence of Tensor [rays, R]
        Optical depth of every cell along rays, from near to far; numbers of cells may differ.

    Returns
    -------
    float
        Infinite if no ray is ever half hidden. A ray that reaches the level or is half hidden, but not both, counts as
        if the other happened at its end.
    """
    half = [(depth.cumsum(1) >= math.log(2)).to(torch.int8) for depth in depths]
    at_half = [
        depth.gather(1, h.argmax(1, keepdim=True))[h.any(1)[:, None]] for depth, h in zip(depths, half, strict=True)
    ]
    typical = torch.cat(at_half)
    if not len(typical):
        return math.inf
    levels = float(typical.median()) * np.geomspace(_LOWEST, 2.0, _LEVELS)
    wrong = np.zeros(_LEVELS)
    for depth, h in zip(depths, half, strict=True):
        there = _first(h)
        for i, level in enumerate(levels):
            wrong[i] += float((_first((depth >= level).to(torch.int8)) - there).abs().sum())
    return float(levels[wrong.argmin()])


def _first(hit: Tensor) -> Tensor:
    """Index of the first 1 in each row, or the row's length."""
    return torch.where(hit.any(1), hit.argmax(1), hit.shape[1])


def isosurface(
    values: Callable[[Tensor], Tensor],
    low_m: Float64[np.ndarray, " 3"],
    high_m: Float64[np.ndarray, " 3"],
    longest: int,
    level: float,
    like: Tensor,
) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "f 3"]]:
    """Where a field falls below a level, by marching cubes, closed at the walls of the box.

    Parameters
    ----------
    values : callable
        Places [P, 3], m, to the field's values [P].
    low_m, high_m : numpy.ndarray, float64 [3]
        Corners of the box, m.
    longest : int
        Cubic voxels along its longest side.
    level : float
        Positive; infinite for nothing.
    like : Tensor
        The dtype and device of places.

    Returns
    -------
    vertices, faces : numpy.ndarray, float64 [N, 3], int64 [F, 3]
        Counter-clockwise seen from where values are low; without faces where no value reaches the level.

    Raises
    ------
    SarsplatError
        If scikit-image is missing.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise SarsplatError(
            f"a surface needs {error.name}, which is not installed; install it with: pip install 'sarsplat[mesh]'"
        ) from error
    voxel = float((high_m - low_m).max()) / longest
    shape = np.ceil((high_m - low_m) / voxel - 1e-9).astype(int)
    x, y, z = (torch.from_numpy(low + (np.arange(n) + 0.5) * voxel).to(like) for low, n in zip(low_m, shape))
    layers = np.zeros(shape + 2, np.float32)  # with an empty rim
    step = max(1, _AT_ONCE // (len(y) * len(z)))
    for first in range(0, len(x), step):
        places = torch.stack(torch.meshgrid(x[first : first + step], y, z, indexing="ij"), dim=-1)
        some = values(places.reshape(-1, 3)).reshape(places.shape[:3])
        layers[first + 1 : first + 1 + len(some), 1:-1, 1:-1] = some.cpu().numpy()
    if not layers.max() > level:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(
        layers, level, spacing=(voxel,) * 3, gradient_direction="ascent", allow_degenerate=False
    )
    return vertices.astype(np.float64) + (low_m - voxel / 2), faces.astype(np.int64)
