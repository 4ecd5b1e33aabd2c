"""The backward pass reads the tensors that torch hands it, not memory it remembers from the forward pass."""

import threading
from typing import Any

import pytest
import torch
from named_scenes import GRID, VIEWS, cloud
from torch.autograd.graph import saved_tensors_hooks
from torch.utils.checkpoint import checkpoint

from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.renderer import render


def leaves() -> list[torch.Tensor]:
    return [tensor.clone().requires_grad_() for tensor in cloud(300, 1).tensors().values()]


def scene(*parameters: torch.Tensor) -> Gaussians:
    return Gaussians(*parameters[:4], scattering=Harmonics(parameters[4]))


def images(*parameters: torch.Tensor, output: str = "images") -> torch.Tensor:
    return getattr(render(scene(*(tensor * 1.0 for tensor in parameters)), VIEWS, GRID, engine="cpu"), output)


def gradients(rendered: torch.Tensor, parameters: list[torch.Tensor], **options: Any) -> tuple[torch.Tensor, ...]:
    _litter = [torch.full((300, k), 7.0) for k in (1, 3, 4, 16) for _ in range(8)]  # over what was freed
    return torch.autograd.grad(rendered.square().flatten(1).sum(1).sum(0), parameters, **options)


def equal(found: tuple[torch.Tensor, ...], expected: tuple[torch.Tensor, ...]) -> bool:
    return all(torch.equal(mine, theirs) for mine, theirs in zip(found, expected, strict=True))


@pytest.mark.parametrize("output", ["images", "cross_sections"])
def test_checkpointing(output):
    parameters = leaves()
    expected = gradients(images(*parameters, output=output), parameters)
    again = checkpoint(images, *parameters, use_reentrant=False, output=output)
    assert equal(gradients(again, parameters), expected)


def test_saved_tensors_that_were_put_elsewhere():
    parameters = leaves()
    expected = gradients(images(*parameters), parameters)
    with saved_tensors_hooks(lambda tensor: tensor.numpy().copy(), torch.from_numpy):
        rendered = images(*parameters)
    assert equal(gradients(rendered, parameters), expected)


def test_backward_passes_of_one_graph_on_two_threads():
    """Torch holds its lock during a backward pass in Python; ctypes lets go of it."""
    parameters = [tensor.clone().requires_grad_() for tensor in cloud(3000, 3).tensors().values()]
    rendered = render(scene(*parameters), VIEWS, GRID, engine="cpu").images
    seeds = torch.randn(2, *rendered.shape, generator=torch.Generator().manual_seed(1))
    expected = [torch.autograd.grad(rendered, parameters, seed, retain_graph=True) for seed in seeds]
    right: list[bool] = []

    def work(k: int) -> None:
        for _ in range(60):
            right.append(equal(torch.autograd.grad(rendered, parameters, seeds[k], retain_graph=True), expected[k]))

    workers = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(right) == 120
    assert all(right)
