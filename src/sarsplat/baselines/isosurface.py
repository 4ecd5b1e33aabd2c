"""Surface of an attenuation field: the level to cut it at, and its triangles by marching cubes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.extras import install_command

_AT_ONCE = 1 << 18


def level_of_half(depths: Sequence[Float[Tensor, "n r"]]) -> float:
    """The median, over rays from near to far, of the optical depth of the cell where half is first hidden."""
    at_half = []
    for depth in depths:
        half = depth.cumsum(1) >= math.log(2)
        at_half.append(depth.gather(1, half.to(torch.int8).argmax(1, keepdim=True))[half.any(1)])
    typical = torch.cat(at_half)
    return float(typical.median()) if len(typical) else math.inf


def isosurface(
    values: Callable[[Tensor], Tensor],
    low_m: Float64[np.ndarray, " 3"],
    high_m: Float64[np.ndarray, " 3"],
    longest: int,
    level: float,
    like: Tensor,
) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "f 3"]]:
    """Triangles where a field falls below a level, by marching cubes; open at the walls of the box.

    `values` maps places [P, 3], m, of the dtype and device of `like`, to the field's values [P]; the box has `longest`
    cubic voxels along its longest side. Returns vertices [N, 3], m, and faces [F, 3], counter-clockwise seen from where
    values are low; no faces if no value reaches the level, or all do.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise SarsplatError(
            f"a surface needs {error.name}, which is not installed; {install_command('mesh')}"
        ) from error
    voxel = float((high_m - low_m).max()) / longest
    shape = np.maximum(1, np.ceil((high_m - low_m) / voxel - 0.5 - 1e-9)).astype(int)  # whose centres lie in the box
    x, y, z = (torch.from_numpy(low + (np.arange(n) + 0.5) * voxel).to(like) for low, n in zip(low_m, shape))
    layers = np.zeros(shape, np.float32)
    step = max(1, _AT_ONCE // (len(y) * len(z)))
    for first in range(0, len(x), step):
        places = torch.stack(torch.meshgrid(x[first : first + step], y, z, indexing="ij"), dim=-1)
        layer = values(places.reshape(-1, 3)).reshape(places.shape[:3])
        layers[first : first + len(layer)] = layer.cpu().numpy()
    if min(shape) < 2 or not layers.min() < level < layers.max():
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(
        layers, level, spacing=(voxel,) * 3, gradient_direction="ascent", allow_degenerate=False
    )
    return vertices.astype(np.float64) + (low_m + voxel / 2), faces.astype(np.int64)
