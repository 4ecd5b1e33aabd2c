"""The kernels of lit ground, emulated on the CPU: right, and the same bits however they are run and views are told."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pytest
import torch
from emulated_cuda import SCHEDULES, Emulator, guarded, without_barrier
from torch import Tensor

from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.echoes.lit_ground import lit_ground
from sarsplat.renderer.engines import cuda
from sarsplat.renderer.engines.on_device import ChosenViews
from sarsplat.renderer.engines.passes import NewPass

GRID = ImageGrid(37, 41, (0.3, 0.25), (0.45, 0.4))
VIEWS = (View(0.0, 5.0), View(75.0, 35.0), View(140.0, 60.0), View(200.0, 88.0))
SIZES = ((90, 70), (33, 64), (0, 0), (10, 31))
RAYS = RayGrid((0.11, 0.07))
ORIGINS = ((-3.0, -2.0), (-2.0, -0.4), (0.0, 0.0), (1.0, -0.3))


def ends_of(sizes: Sequence[tuple[int, int]], dtype: torch.dtype) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(rows * columns, generator=generator).to(dtype) for rows, columns in sizes]


def everything(new_pass: NewPass | None, shifted: bool, chosen: Sequence[int] | None = None) -> dict[str, Tensor]:
    """Lit ground and its gradients; of views that are chosen on the device, or of these in order."""
    dtype = torch.float64 if new_pass is None else torch.float32
    which, ends = range(len(VIEWS)) if chosen is None else chosen, ends_of(SIZES, dtype)
    pitch = max(rows for rows, _ in SIZES) * max(columns for _, columns in SIZES)
    parts = [
        ends[v] if chosen is None else torch.cat([ends[v], torch.full((pitch - len(ends[v]),), torch.nan)])
        for v in which
    ]
    left = torch.cat(parts).requires_grad_()
    shift = torch.randn(4, 2, generator=torch.Generator().manual_seed(1)).mul(0.2)[list(which)].to(dtype)
    views = VIEWS if chosen is None else ChosenViews(VIEWS, torch.tensor(chosen))
    found = lit_ground(
        RayEnds(left, SIZES, ORIGINS), views, GRID, RAYS, 0.3, shift.requires_grad_() if shifted else None, new_pass
    )
    seeds = torch.randn(len(VIEWS), GRID.rows, GRID.columns, generator=torch.Generator().manual_seed(2))[list(which)]
    inputs = [left, shift] if shifted else [left]
    d_left, *d_shift = torch.autograd.grad((found * seeds.to(dtype)).sum(), inputs)
    own = d_left.split([len(part) for part in parts])
    d_ends = {f"d ends {v}": part[: len(ends[v])] for v, part in zip(which, own, strict=True)}
    lit = {f"lit {v}": image for v, image in zip(which, found.detach(), strict=True)}
    return lit | d_ends | {f"d shift {v}": row for rows in d_shift for v, row in zip(which, rows, strict=True)}


@pytest.fixture
def new_pass(library: Path) -> NewPass:
    return partial(cuda.Pass, Emulator(library))


@pytest.mark.parametrize("shifted", [False, True])
def test_as_the_twin(shifted: bool, new_pass: NewPass) -> None:
    found, expected = everything(new_pass, shifted), everything(None, shifted)
    assert found.keys() == expected.keys()
    for name, right in expected.items():
        scale = float(right.abs().max()) if right.numel() else 0.0
        assert float((found[name] - right).abs().max() if right.numel() else 0.0) <= 2e-6 * scale, name
    assert torch.equal(found["lit 2"], torch.ones(GRID.rows, GRID.columns))  # nothing stands there


@pytest.mark.parametrize("shifted", [False, True])
def test_the_same_bits_however_it_is_run(shifted: bool, library: Path, new_pass: NewPass) -> None:
    right = everything(new_pass, shifted)
    with guarded():
        for schedule in SCHEDULES:
            found = everything(partial(cuda.Pass, Emulator(library, schedule)), shifted)
            assert all(torch.equal(found[name], one) for name, one in right.items())


def test_the_same_bits_of_views_that_only_the_device_knows(new_pass: NewPass) -> None:
    right = everything(new_pass, True)
    with guarded():
        for chosen in ([3, 0], [1, 2, 0], [2]):
            found = everything(new_pass, True, chosen)
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
    right = everything(new_pass, True)
    with without_barrier(library, "cuda_loss.cuh", 1):
        others = [everything(partial(cuda.Pass, Emulator(library, schedule)), True) for schedule in SCHEDULES]
    assert not all(torch.equal(found["d shift 0"], right["d shift 0"]) for found in others)
