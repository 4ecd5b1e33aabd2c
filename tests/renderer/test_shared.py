"""Processes that share the views of a rendering get the bits of one that has them all."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier
from typing import Any

import pytest
import torch
from named_scenes import Scene, cloud
from torch import Tensor

from sarsplat import ImageGrid, SarsplatError, View
from sarsplat.gaussians.ground import Ground
from sarsplat.processes import Processes
from sarsplat.renderer import render

SCENE = Scene(
    cloud(1500, 0, degree=2),
    tuple(View(50.0 * k, 30.0 + k) for k in range(7)),
    ImageGrid(40, 36, (0.2, 0.2), (0.3, 0.3)),
    shift=torch.full((7, 2), 0.1),
    first_return_depth=None,
)


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


def found(scene: Scene, processes: Processes | None) -> dict[str, Tensor]:
    """Everything that a rendering and its gradients say."""
    leaves = scene.leaves(torch.float32)
    rendering = scene.call(render, leaves, plane_gradients=True, processes=processes)
    seeds = torch.randn(rendering.images.shape, generator=torch.Generator().manual_seed(0))
    (rendering.images * seeds).sum().backward()
    return {name: leaf.grad for name, leaf in leaves.items()} | {
        "images": rendering.images.detach(),
        "cross_sections": rendering.cross_sections.detach(),
        "lit_area": rendering.lit_area,
        "planes": rendering.plane_gradients,
    }


LEVEL, TEXTURED = (Ground(gamma0, 2.0, -1.0) for gamma0 in (torch.tensor(0.3), torch.rand(5, 5)))
# over texture, the gradient of a shift is the same to rounding alone
SCENES = [SCENE, replace(SCENE, ground=LEVEL), replace(SCENE, ground=TEXTURED, shift=None)]


@pytest.mark.parametrize("scene", SCENES, ids=["no ground", "level ground", "textured ground"])
@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_any_number_of_processes_gives_the_same_bits(scene: Scene, count: int) -> None:
    alone = found(scene, None)
    board, barrier = [None] * count, Barrier(count)
    with ThreadPoolExecutor(count) as pool:
        members = [Threads(rank, count, board, barrier) for rank in range(count)]
        every = list(pool.map(lambda one: found(scene, one), members))
    for got in every:
        assert got.keys() == alone.keys()
        assert [name for name in alone if not torch.equal(got[name], alone[name])] == []


def test_other_engines_are_refused() -> None:
    with pytest.raises(SarsplatError, match="without ray maps or echoes of one's own, on the CPU engine"):
        SCENE.call(render, SCENE.leaves(torch.float64), processes=Threads(0, 1, [None], Barrier(1)))
