"""The kernels of lit ground and terrain, emulated: right, and the same bits however they are run."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pytest
import torch
from emulated_cuda import SCHEDULES, Emulator, guarded, without_barrier
from torch import Tensor

from made import hill
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.echoes.lit_ground import lit_ground
from sarsplat.renderer.echoes.lit_terrain import lit_terrain
from sarsplat.renderer.engines import cuda
from sarsplat.renderer.engines.on_device import ChosenViews
from sarsplat.renderer.engines.passes import NewPass

GRID = ImageGrid(37, 41, (0.3, 0.25), (0.45, 0.4))
VIEWS = (View(0.0, 5.0), View(75.0, 35.0), View(140.0, 60.0), View(200.0, 88.0))
SIZES = ((90, 70), (33, 64), (0, 0), (10, 31))
RAYS = RayGrid((0.11, 0.07))
ORIGINS = ((-3.0, -2.0), (-2.0, -0.4), (0.0, 0.0), (1.0, -0.3))


def random(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def new_pass(library: Path) -> NewPass:
    return partial(cuda.Pass, Emulator(library))


def check_twin(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    """Within this part of the largest number."""
    assert found.keys() == expected.keys()
    for name, right in expected.items():
        if right.numel():
            assert float((found[name] - right).abs().max()) <= tolerance * float(right.abs().max()), name


# ---- level ground ----------------------------------------------------------------------------------------------------
def of_ground(new_pass: NewPass | None, shifted: bool, chosen: Sequence[int] | None = None) -> dict[str, Tensor]:
    """Lit ground and its gradients; of views that are chosen on the device, or of these in order."""
    dtype = torch.float64 if new_pass is None else torch.float32
    which, generator = range(len(VIEWS)) if chosen is None else chosen, torch.Generator().manual_seed(0)
    ends = [torch.rand(rows * columns, generator=generator).to(dtype) for rows, columns in SIZES]
    pitch = max(rows for rows, _ in SIZES) * max(columns for _, columns in SIZES)
    parts = [
        ends[v] if chosen is None else torch.cat([ends[v], torch.full((pitch - len(ends[v]),), torch.nan)])
        for v in which
    ]
    left = torch.cat(parts).requires_grad_()
    shift = (0.2 * random(1, 4, 2))[list(which)].to(dtype).requires_grad_()
    views = VIEWS if chosen is None else ChosenViews(VIEWS, torch.tensor(chosen))
    rays = RayEnds(left, SIZES, ORIGINS)
    found = lit_ground(rays, views, GRID, RAYS, 0.3, shift if shifted else None, new_pass)
    seeds = random(2, len(VIEWS), GRID.rows, GRID.columns)[list(which)].to(dtype)
    d_left, *d_shift = torch.autograd.grad((found * seeds).sum(), [left, shift] if shifted else [left])
    own = d_left.split([len(part) for part in parts])
    d_ends = {f"d ends {v}": part[: len(ends[v])] for v, part in zip(which, own, strict=True)}
    lit = {f"lit {v}": image for v, image in zip(which, found.detach(), strict=True)}
    return lit | d_ends | {f"d shift {v}": row for rows in d_shift for v, row in zip(which, rows, strict=True)}


@pytest.mark.parametrize("shifted", [False, True])
def test_ground_is_that_of_the_twin_and_the_same_bits_however_it_is_run(shifted: bool, library: Path, new_pass) -> None:
    right = of_ground(new_pass, shifted)
    check_twin(right, of_ground(None, shifted), 2e-6)
    assert torch.equal(right["lit 2"], torch.ones(GRID.rows, GRID.columns))  # nothing stands there
    with guarded():
        for schedule in SCHEDULES:
            found = of_ground(partial(cuda.Pass, Emulator(library, schedule)), shifted)
            assert all(torch.equal(found[name], one) for name, one in right.items())


def test_the_same_bits_of_views_that_only_the_device_knows(new_pass: NewPass) -> None:
    right = of_ground(new_pass, True)
    with guarded():
        for chosen in ([3, 0], [1, 2, 0], [2]):
            found = of_ground(new_pass, True, chosen)
            assert len(found) == 3 * len(chosen)
            assert all(torch.equal(one, right[name]) for name, one in found.items())


def test_pixels_see_no_more_than_the_band_has_room_for(new_pass: NewPass) -> None:
    """Of fine rays, and of rays that are wider than the response."""
    for spacing in ((0.01, 0.02), (2.0, 1.5)):
        ends = RayEnds(torch.full((60 * 70,), 0.3), [(60, 70)], [(-30 * spacing[0], -35 * spacing[1])])
        kernel, twin = (
            lit_ground(replaced, [VIEWS[1]], GRID, RayGrid(spacing), 0.0, None, made)
            for replaced, made in (
                (ends, new_pass),
                (RayEnds(ends.transmittance.double(), ends.sizes, ends.origins), None),
            )
        )
        torch.testing.assert_close(kernel.double(), twin, rtol=0, atol=2e-6)


def test_a_missing_barrier_shows(library: Path, new_pass: NewPass) -> None:
    right = of_ground(new_pass, True)
    with without_barrier(library, "cuda_loss.cuh", 1):
        others = [of_ground(partial(cuda.Pass, Emulator(library, schedule)), True) for schedule in SCHEDULES]
    assert not all(torch.equal(found["d shift 0"], right["d shift 0"]) for found in others)


# ---- terrain ---------------------------------------------------------------------------------------------------------
HILLY = ImageGrid(21, 19, (0.3, 0.25), (0.45, 0.4))
LOOKS = (View(0.0, 25.0), View(75.0, 40.0), View(200.0, 70.0))
COARSE = RayGrid((0.16, 0.13))
TRACED, FIRST = ((20, 24), (0, 0), (200, 9)), ((-10, -8), (0, 0), (3, -70))
"""The second view has no Gaussians; the last one's rays reach beyond the cells."""


def of_terrain(
    new_pass: NewPass | None, shifted: bool, places: tuple[int, int], weight: float = 0.5
) -> dict[str, Tensor]:
    dtype, generator = torch.float64 if new_pass is None else torch.float32, torch.Generator().manual_seed(0)
    left = torch.rand(sum(rows * columns for rows, columns in TRACED), generator=generator)
    gamma0 = torch.rand(len(LOOKS), *places, generator=generator) + 0.1
    shift = 0.2 * torch.randn(len(LOOKS), 2, generator=generator)
    leaves = {"left": left, "gamma0": gamma0} | ({"shift": shift} if shifted else {})
    leaves = {name: tensor.to(dtype).requires_grad_() for name, tensor in leaves.items()}
    origins = [tuple((k + 0.5) * step for k, step in zip(first, COARSE.spacing_m, strict=True)) for first in FIRST]
    ends = RayEnds(leaves["left"], TRACED, origins)
    found = lit_terrain(ends, LOOKS, HILLY, COARSE, hill(), leaves["gamma0"], 0.9, leaves.get("shift"), new_pass)
    seeds = torch.randn(found.shape, generator=generator).to(dtype)
    seeds[1] = weight
    gradients = torch.autograd.grad((found * seeds).sum(), list(leaves.values()))
    return {"lit": found.detach()} | {f"d {name}": one for name, one in zip(leaves, gradients, strict=True)}


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("places", [(1, 1), (7, 9), (1, 4)])
def test_as_the_twin_and_the_same_bits_however_it_is_run(places: tuple[int, int], shifted: bool, library: Path) -> None:
    found, expected = (
        of_terrain(partial(cuda.Pass, Emulator(library)), shifted, places),
        of_terrain(None, shifted, places),
    )
    check_twin(found, expected, 4e-6)
    with guarded():
        for schedule in SCHEDULES:
            again = of_terrain(partial(cuda.Pass, Emulator(library, schedule)), shifted, places)
            assert all(torch.equal(again[name], one) for name, one in found.items()), schedule


@pytest.mark.parametrize("weight", [0.0, torch.nan, torch.inf, 1e-30, 1e30])
def test_gradients_of_any_size(weight: float, library: Path) -> None:
    """Of a view that does not matter, too, and of one whose images have become no numbers."""
    found = of_terrain(partial(cuda.Pass, Emulator(library)), False, (7, 9), weight)["d gamma0"]
    right = of_terrain(None, False, (7, 9), weight)["d gamma0"]
    for v in range(len(LOOKS)):
        scale = float(right[v].abs().max())
        assert (
            bool(found[v].isnan().all()) if scale != scale else float((found[v] - right[v]).abs().max()) <= 4e-6 * scale
        )
