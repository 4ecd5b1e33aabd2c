"""Gaussians as one would handle a tensor: indexed, joined and moved, with gradients."""

import numpy as np
import pytest
import torch

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Harmonics


def scene(count: int = 6, columns: int = 4) -> Gaussians:
    draw = torch.Generator().manual_seed(count)
    shapes = (count, 3), (count, 4), (count, 3), (count,), (count, columns)
    means, quaternions, scales, depth, law = (torch.rand(shape, generator=draw).requires_grad_() for shape in shapes)
    return Gaussians(means, quaternions, scales, depth, Harmonics(law, p_min=0.1))


@pytest.mark.parametrize(
    ("index", "rows"),
    [
        (0, [0]),
        (-1, [5]),
        (np.int64(2), [2]),
        (torch.tensor(3), [3]),
        (slice(1, 3), [1, 2]),
        (slice(None, None, 2), [0, 2, 4]),
        (torch.tensor([4, 4]), [4, 4]),
        ([5, 0], [5, 0]),
        (np.array([1, 2]), [1, 2]),
        (torch.arange(6) > 3, [4, 5]),
        (slice(6, None), []),
    ],
)
def test_rows_are_chosen_like_a_tensors(index: object, rows: list[int]) -> None:
    whole = scene()
    part = whole[index]
    assert len(part) == len(rows)
    assert part.scattering.p_min == 0.1
    for name, tensor in part.tensors().items():
        assert torch.equal(tensor, whole.tensors()[name][rows]), name
    gradient = torch.autograd.grad(part.means.sum() + part.scattering.parameters.sum(), whole.means)[0]
    assert gradient[:, 0].tolist() == [float(rows.count(row)) for row in range(6)]


@pytest.mark.parametrize(
    "index", [6, -7, np.int64(6), None, (0, 1), torch.zeros(2, 2, dtype=torch.long), torch.ones(5) > 0]
)
def test_what_is_no_index_of_rows(index: object) -> None:
    with pytest.raises(IndexError):
        scene()[index]


def test_scenes_are_joined_in_order_with_gradients() -> None:
    parts = [scene(2, 4), scene(3, 9), scene(4, 1)]
    whole = Gaussians.cat(parts)
    assert len(whole) == 9
    assert torch.equal(whole.means, torch.cat([part.means for part in parts]))
    assert whole.scattering.parameters.shape == (9, 9)
    assert whole.scattering.parameters[0, 4:].tolist() == [0.0] * 5
    weights = torch.arange(9.0)
    gradients = torch.autograd.grad((weights @ whole.optical_depth), [part.optical_depth for part in parts])
    assert torch.equal(torch.cat(gradients), weights)
    assert torch.equal(Gaussians.cat([whole[:5], whole[5:]]).quaternions, whole.quaternions)


def test_what_cannot_be_joined() -> None:
    with pytest.raises(SarsplatError, match="there are no Gaussians to join; give at least one scene"):
        Gaussians.cat([])
    with pytest.raises(
        SarsplatError, match=r"of torch.float64 on cpu cannot be joined to those of torch.float32 on cpu"
    ):
        Gaussians.cat([scene(), scene().to(torch.float64)])


@pytest.mark.parametrize(
    "arguments", [(torch.float64,), ("cpu", torch.float64), (torch.zeros(1, dtype=torch.float64),)]
)
def test_moved_with_gradients(arguments: tuple[object, ...]) -> None:
    whole = scene()
    moved = whole.to(*arguments)
    assert {tensor.dtype for tensor in moved.tensors().values()} == {torch.float64}
    gradient = torch.autograd.grad(moved.scales.sum(), whole.scales)[0]
    assert gradient.dtype == torch.float32
    assert gradient.sum() == 18
    assert not whole.detach().means.requires_grad
    assert {tensor.device.type for tensor in whole.to(device="meta").tensors().values()} == {"meta"}


def test_whole_numbers_are_refused_in_a_right_sentence() -> None:
    whole = {name: tensor.detach().long() for name, tensor in scene().tensors().items()}
    with pytest.raises(
        SarsplatError, match=r"^means is torch.int64; give floating-point numbers, such as torch.float32$"
    ):
        Gaussians(*list(whole.values())[:4], scattering=Harmonics(whole["scattering"]))
