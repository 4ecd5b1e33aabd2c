"""An engine's operation between tensors as a differentiable function: one call of the engine each way."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.renderer.engines.passes import Pass
from sarsplat.renderer.once import differentiable_once

Tensors = Sequence[Tensor | None]


class Operation(ABC):
    """What is calculated in one call forward and one call backward, on contiguous tensors; made anew for every call.

    Parameters
    ----------
    kernel : Pass
        What runs it, and keeps what its backward pass needs.
    """

    names: ClassVar[tuple[str, ...]]
    """Names of the inputs, for errors."""

    saved: ClassVar[slice] = slice(None)
    """Which inputs the backward pass reads."""

    constant: tuple[int, ...] = ()
    """Which outputs have no gradient."""

    def __init__(self, kernel: Pass) -> None:
        self.kernel = kernel

    @abstractmethod
    def forward(self, inputs: Tensors) -> tuple[Tensor, ...]:
        """The outputs."""

    @abstractmethod
    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        """Gradients of the inputs from those of the outputs; None is zero."""

    def of(self, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        """The outputs, differentiable once."""
        return _Call.apply(self, *inputs)  # type: ignore[no-any-return]


class _Call(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, operation: Operation, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        inputs = [None if t is None else t.contiguous() for t in tensors]
        outputs = operation.forward(inputs)
        kept = inputs[operation.saved]
        ctx.operation, ctx.shapes = operation, [None if t is None else t.shape for t in kept]
        ctx.one_at_a_time = threading.Lock()  # the kernel lets go of Python's, and has one set of scratch memory
        ctx.save_for_backward(*kept)
        ctx.mark_non_differentiable(*(outputs[k] for k in operation.constant))
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = _saved_inputs(ctx)
        if all(grad is None for grad in grads):
            return (None,) * (1 + len(ctx.operation.names))
        with ctx.one_at_a_time:
            return None, *ctx.operation.backward(saved, [None if g is None else g.contiguous() for g in grads])


def _saved_inputs(ctx: Any) -> list[Any]:
    """The tensors that a forward pass saved, of the shapes they had.

    Also the check that nobody changed them in place; they need not lie where they lay in the forward pass.

    Raises
    ------
    SarsplatError
        If one has another shape now.
    """
    saved = ctx.saved_tensors  # asked for once: what checkpointing recomputes, it hands out once
    inputs = [None if t is None else t.contiguous() for t in saved]
    for name, tensor, shape in zip(ctx.operation.names[ctx.operation.saved], inputs, ctx.shapes, strict=True):
        if tensor is not None and tensor.shape != shape:
            raise SarsplatError(
                f"{name} had shape {tuple(shape)} when rendered and now have shape {tuple(tensor.shape)}; do not "
                "replace the data of tensors between rendering and backward"
            )
    return inputs
