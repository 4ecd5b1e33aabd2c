"""The backward pass reads the tensors that torch hands it, not memory it remembers from the forward pass."""

import threading
from functools import partial

import pytest
import torch
from named_scenes import Scene, cloud
from torch.autograd.graph import saved_tensors_hooks
from torch.utils.checkpoint import checkpoint

from sarsplat.renderer import render

SCENE = Scene(cloud(300, 1))


def images(*parameters: torch.Tensor, scene: Scene = SCENE, output: str = "images") -> torch.Tensor:
    made = (tensor * 1.0 for tensor in parameters)
    return getattr(scene.call(render, dict(zip(scene.gaussians.tensors(), made)), engine="cpu"), output)


def gradients(rendered: torch.Tensor, parameters: list[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    _litter = [torch.full((300, k), 7.0) for k in (1, 3, 4, 16) for _ in range(8)]  # over what was freed
    return torch.autograd.grad(rendered.square().flatten(1).sum(1).sum(0), parameters)


def equal(found: tuple[torch.Tensor, ...], expected: tuple[torch.Tensor, ...]) -> bool:
    return all(torch.equal(mine, theirs) for mine, theirs in zip(found, expected, strict=True))


@pytest.mark.parametrize("output", ["images", "cross_sections"])
def test_checkpointing_and_saved_tensors_that_were_put_elsewhere(output):
    parameters, of_output = [*SCENE.leaves(torch.float32).values()], partial(images, output=output)
    expected = gradients(of_output(*parameters), parameters)
    again = checkpoint(of_output, *parameters, use_reentrant=False)
    assert equal(gradients(again, parameters), expected)
    with saved_tensors_hooks(lambda tensor: tensor.numpy().copy(), torch.from_numpy):
        rendered = of_output(*parameters)
    assert equal(gradients(rendered, parameters), expected)


def test_backward_passes_of_one_graph_on_two_threads():
    """Torch holds its lock during a backward pass in Python; ctypes lets go of it."""
    scene = Scene(cloud(3000, 3))
    parameters = [*scene.leaves(torch.float32).values()]
    rendered = images(*parameters, scene=scene)
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
