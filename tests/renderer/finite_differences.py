"""A Jacobian against central differences: gradcheck, but along some directions instead of one for each element."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def check_gradients(function: Callable[..., Sequence[Tensor]], leaves: Sequence[Tensor], step: float = 1e-6) -> None:
    """Each output along three directions of each leaf, float64, to 1e-6 of its size and 1e-9; and twice the same bits.

    Every element of the leaf changes in every direction. The backward pass, which is linear in the cotangents, is
    differentiated by them, which gives the changes of all outputs at once.
    """

    def flat(*values: Tensor) -> Tensor:
        return torch.cat([output.flatten() for output in function(*values)])

    outputs, generator = flat(*leaves), torch.Generator().manual_seed(12)
    once, twice = (
        torch.autograd.grad(outputs, leaves, outputs.detach().cos(), retain_graph=True, allow_unused=True)
        for _ in range(2)
    )
    cotangents = torch.ones_like(outputs, requires_grad=True)
    gradients = torch.autograd.grad(outputs, leaves, cotangents, create_graph=True, allow_unused=True)
    for k, (leaf, gradient) in enumerate(zip(leaves, gradients, strict=True)):
        assert once[k] is None or torch.equal(once[k], twice[k]), k
        for _ in range(3):
            way = 0.5 + torch.rand(leaf.shape, generator=generator, dtype=leaf.dtype)
            way = torch.where(torch.rand(leaf.shape, generator=generator) < 0.5, way, -way)
            with torch.no_grad():
                above, below = (flat(*leaves[:k], leaf + one * way, *leaves[k + 1 :]) for one in (step, -step))
            expected = (above - below) / (2 * step)
            found = torch.zeros_like(expected)
            if gradient is not None:
                (found,) = torch.autograd.grad(gradient, cotangents, way, retain_graph=True)
            assert torch.allclose(found, expected, rtol=1e-6, atol=1e-9), (k, float((found - expected).abs().max()))
