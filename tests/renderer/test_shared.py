"""Processes that share the views of a rendering get the bits of one that has them all."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from typing import Any

import pytest
import torch
from torch import Tensor

from sarsplat import ImageGrid, SarsplatError, View
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.gaussians.ground import Ground
from sarsplat.processes import Processes
from sarsplat.renderer import render

VIEWS = [View(50.0 * k, 30.0 + k) for k in range(7)]
GRID = ImageGrid(40, 36, (0.2, 0.2), (0.3, 0.3))
COUNT = 1500


class Threads(Processes):
    """As processes, in one."""

    def __init__(self, rank: int, count: int, board: list[Any], barrier: Barrier) -> None:
        self.rank, self.count, self._board, self._barrier = rank, count, board, barrier

    def gathered(self, own: Tensor, sizes: Sequence[int]) -> list[Tensor]:
        assert len(own) == sizes[self.rank]
        self._board[self.rank] = own
        self._barrier.wait(60)
        every = list(self._board)
        self._barrier.wait(60)
        return every


@pytest.fixture(scope="module")
def scene() -> dict[str, Tensor]:
    torch.manual_seed(0)
    return {
        "means": torch.randn(COUNT, 3),
        "quaternions": torch.randn(COUNT, 4),
        "scales": 0.05 + 0.2 * torch.rand(COUNT, 3),
        "optical_depth": 3 * torch.rand(COUNT),
        "scattering": torch.randn(COUNT, 9),
        "shift": 0.1 * torch.randn(len(VIEWS), 2),
        "gamma0": torch.rand(5, 5),
        "weight": torch.randn(len(VIEWS), 1, GRID.rows, GRID.columns),
    }


def found(scene: dict[str, Tensor], ground: bool, processes: Processes | None) -> dict[str, Tensor]:
    """Everything that a rendering and its gradients say."""
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.items() if name != "weight"}
    named = {name: leaves[name] for name in ("means", "quaternions", "scales", "optical_depth")}
    rendering = render(
        Gaussians(**named, scattering=Harmonics(leaves["scattering"])),
        VIEWS,
        GRID,
        shift=leaves["shift"],
        ground=Ground(leaves["gamma0"], 2.0, -1.0) if ground else None,
        plane_gradients=True,
        processes=processes,
    )
    (rendering.images * scene["weight"]).sum().backward()
    got = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    assert rendering.plane_gradients is not None
    return got | {
        "images": rendering.images.detach(),
        "cross_sections": rendering.cross_sections.detach(),
        "lit_area": rendering.lit_area,
        "planes": rendering.plane_gradients,
    }


@pytest.mark.parametrize("ground", [False, True])
@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_any_number_of_processes_gives_the_same_bits(scene: dict[str, Tensor], ground: bool, count: int) -> None:
    alone = found(scene, ground, None)
    assert ("gamma0" in alone) == ground
    board, barrier = [None] * count, Barrier(count)
    with ThreadPoolExecutor(count) as pool:
        members = [Threads(rank, count, board, barrier) for rank in range(count)]
        every = list(pool.map(lambda one: found(scene, ground, one), members))
    for got in every:
        assert got.keys() == alone.keys()
        assert [name for name in alone if not torch.equal(got[name], alone[name])] == []


def test_other_engines_are_refused(scene: dict[str, Tensor]) -> None:
    gaussians = Gaussians(
        *(scene[name].double() for name in ("means", "quaternions", "scales", "optical_depth")),
        scattering=Harmonics(scene["scattering"].double()),
    )
    with pytest.raises(SarsplatError, match="without ray maps or echoes of one's own, on the CPU engine"):
        render(gaussians, VIEWS, GRID, processes=Threads(0, 1, [None], Barrier(1)))
