"""Every element of a Jacobian against central differences: gradcheck, but for a backward pass for each of its rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def check_gradients(function: Callable[..., Sequence[Tensor]], leaves: Sequence[Tensor], step: float = 1e-6) -> None:
    """Each output by each element of each leaf, all float64, to 1e-5 of its size and 1e-7; and twice the same bits."""

    def flat(*values: Tensor) -> Tensor:
        return torch.cat([output.flatten() for output in function(*values)])

    outputs = flat(*leaves)
    rows = torch.eye(len(outputs), dtype=outputs.dtype)
    jacobians = torch.autograd.grad(outputs, leaves, rows, is_grads_batched=True, retain_graph=True, allow_unused=True)
    once, twice = (
        torch.autograd.grad(outputs, leaves, outputs.detach().cos(), retain_graph=True, allow_unused=True)
        for _ in range(2)
    )
    for k, (leaf, jacobian) in enumerate(zip(leaves, jacobians, strict=True)):
        assert once[k] is None or torch.equal(once[k], twice[k]), k
        steps = step * torch.eye(leaf.numel(), dtype=leaf.dtype).view(-1, *leaf.shape)
        with torch.no_grad():
            pairs = [[flat(*leaves[:k], leaf + way, *leaves[k + 1 :]) for way in (one, -one)] for one in steps]
        for place, (above, below) in enumerate(pairs):
            expected = (above - below) / (2 * step)
            found = torch.zeros_like(expected) if jacobian is None else jacobian.view(len(outputs), -1)[:, place]
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7)
