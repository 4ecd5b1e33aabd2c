"""The kernels of terrain, emulated on the CPU: right, and the same bits however they are run."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
import torch
from emulated_cuda import SCHEDULES, Emulator, guarded
from torch import Tensor

from made import hill
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.echoes.lit_terrain import lit_terrain
from sarsplat.renderer.engines import cuda
from sarsplat.renderer.engines.passes import NewPass

GRID = ImageGrid(21, 19, (0.3, 0.25), (0.45, 0.4))
VIEWS = (View(0.0, 25.0), View(75.0, 40.0), View(200.0, 70.0))
RAYS = RayGrid((0.16, 0.13))
SIZES, FIRST = ((20, 24), (0, 0), (200, 9)), ((-10, -8), (0, 0), (3, -70))
"""The second view has no Gaussians; the last one's rays reach beyond the cells."""


def everything(
    new_pass: NewPass | None, shifted: bool, places: tuple[int, int], weight: float = 0.5
) -> dict[str, Tensor]:
    dtype, generator = torch.float64 if new_pass is None else torch.float32, torch.Generator().manual_seed(0)
    left = torch.rand(sum(rows * columns for rows, columns in SIZES), generator=generator)
    gamma0 = torch.rand(len(VIEWS), *places, generator=generator) + 0.1
    shift = 0.2 * torch.randn(len(VIEWS), 2, generator=generator)
    leaves = {"left": left, "gamma0": gamma0} | ({"shift": shift} if shifted else {})
    leaves = {name: tensor.to(dtype).requires_grad_() for name, tensor in leaves.items()}
    origins = [tuple((k + 0.5) * step for k, step in zip(first, RAYS.spacing_m, strict=True)) for first in FIRST]
    ends = RayEnds(leaves["left"], SIZES, origins)
    found = lit_terrain(ends, VIEWS, GRID, RAYS, hill(), leaves["gamma0"], 0.9, leaves.get("shift"), new_pass)
    seeds = torch.randn(found.shape, generator=generator).to(dtype)
    seeds[1] = weight
    gradients = torch.autograd.grad((found * seeds).sum(), list(leaves.values()))
    return {"lit": found.detach()} | {f"d {name}": one for name, one in zip(leaves, gradients, strict=True)}


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("places", [(1, 1), (7, 9), (1, 4)])
def test_as_the_twin_and_the_same_bits_however_it_is_run(places: tuple[int, int], shifted: bool, library: Path) -> None:
    found, expected = (
        everything(partial(cuda.Pass, Emulator(library)), shifted, places),
        everything(None, shifted, places),
    )
    for name, right in expected.items():
        assert float((found[name] - right).abs().max()) <= 4e-6 * float(right.abs().max()), name
    with guarded():
        for schedule in SCHEDULES:
            again = everything(partial(cuda.Pass, Emulator(library, schedule)), shifted, places)
            assert all(torch.equal(again[name], one) for name, one in found.items()), schedule


@pytest.mark.parametrize("weight", [0.0, torch.nan, torch.inf, 1e-30, 1e30])
def test_gradients_of_any_size(weight: float, library: Path) -> None:
    """Of a view that does not matter, too, and of one whose images have become no numbers."""
    found = everything(partial(cuda.Pass, Emulator(library)), False, (7, 9), weight)["d gamma0"]
    right = everything(None, False, (7, 9), weight)["d gamma0"]
    for v in range(len(VIEWS)):
        scale = float(right[v].abs().max())
        assert (
            bool(found[v].isnan().all()) if scale != scale else float((found[v] - right[v]).abs().max()) <= 4e-6 * scale
        )
