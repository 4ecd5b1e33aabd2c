"""Time and memory of one view of a town by tiles, from 1024² pixels on, at one density of Gaussians.

`python benchmarks/tiles.py [SIDE …]` adds to benchmarks/results/tiles.json as sizes finish, and skips those that it
holds; `SIDE --alone` is one size, printed as JSON, in a process of its own. One thread.
"""

from __future__ import annotations

import json
import math
import resource
import sys
import time
from typing import Any

import torch
from results import RESULTS, add_rows

from sarsplat import Gaussians, Harmonics, ImageGrid, View
from sarsplat.tiles import render_tiled

SIDES = (1024, 2048, 4096, 8192)
PIXEL_M = 0.3
GAUSSIANS_PER_M2 = 0.83
TOWER_M, TOWERS = 15.0, 0.1  # the height of the highest, and the share of Gaussians in towers


def town(side_m: float) -> Gaussians:
    """Clutter on the ground, and towers."""
    generator = torch.Generator().manual_seed(0)
    count = round(GAUSSIANS_PER_M2 * side_m**2)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    means = (uniform(count, 3) - 0.5) * torch.tensor([side_m, side_m / math.cos(math.radians(45.0)), 0.0])
    high = uniform(count) < TOWERS
    means[high, :2] = (means[high, :2] / 40).round() * 40 + 4 * (uniform(int(high.sum()), 2) - 0.5)
    means[:, 2] = torch.where(high, TOWER_M * uniform(count), 0.3 * uniform(count))
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    return Gaussians(
        means, upright, 0.2 + 0.4 * uniform(count, 3), 0.2 + 3 * uniform(count), Harmonics(uniform(count, 1))
    )


def one(side: int) -> dict[str, Any]:
    """CPU seconds, and the peak of memory in GiB, the town included."""
    torch.set_num_threads(1)
    scene, grid = town(side * PIXEL_M), ImageGrid(side, side, (PIXEL_M, PIXEL_M), (PIXEL_M, PIXEL_M))
    begun = time.process_time()
    render_tiled(scene, View(33.0, 45.0), grid)
    seconds = time.process_time() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"side": side, "gaussians": len(scene), "seconds": seconds, "peak_gib": peak}


if __name__ == "__main__":
    words = sys.argv[1:]
    if words[-1:] == ["--alone"]:
        print(json.dumps(one(int(words[0]))))
    else:
        add_rows(RESULTS / "tiles.json", [__file__], [int(word) for word in words] or SIDES)
