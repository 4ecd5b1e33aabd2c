"""Differentiable functions of tensors that engines compute.

Most are an `Operation`: one structure of csrc/api.h, and the same in plain torch for tensors without an engine. The
steps of a rendering (stages.py) are only `Call`s: their engines keep the state that the backward pass needs.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, ClassVar

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.renderer.engines.abi import filled, members_of, structure_of
from sarsplat.renderer.engines.passes import NewPass, Pass

Tensors = Sequence[Tensor | None]


def differentiable_once(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Raise on `create_graph=True`; torch's own `once_differentiable` makes second derivatives zero instead."""

    @wraps(backward)
    def checked(ctx: Any, *grads: Tensor | None) -> Any:
        if torch.is_grad_enabled():
            raise SarsplatError(
                "the engines have no second derivatives; leave create_graph=True out, or use engine='reference'"
            )
        return backward(ctx, *grads)

    return checked


class Call(ABC):
    """Autograd function of one engine call forward and one backward, on contiguous tensors; used once."""

    names: ClassVar[tuple[str, ...]]
    """Names of the inputs, for errors."""

    saved: ClassVar[slice] = slice(None)
    """Inputs that the backward pass reads."""

    constant: tuple[int, ...] = ()
    """Indices of outputs without gradient."""

    needed: Sequence[bool]
    """True for inputs that need a gradient."""

    @abstractmethod
    def forward(self, inputs: Sequence[Any]) -> tuple[Tensor, ...]:
        """Compute the outputs; inputs that are not given are None."""

    @abstractmethod
    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        """Compute gradients of the inputs from those of the outputs; None is zero."""

    def to_save(self, inputs: Tensors) -> Tensors:
        """Return the tensors saved for the backward pass, of the shapes of the saved inputs."""
        return inputs[self.saved]

    def of(self, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        """Compute the outputs, differentiable once."""
        try:
            return _Call.apply(self, *inputs)
        except (RuntimeError, NotImplementedError) as error:  # torch's, of custom autograd functions
            if not any(words in str(error) for words in ("functorch", "forward mode AD")):
                raise
            raise SarsplatError(
                "the engines take no part in torch.func and in forward-mode derivatives; use loss.backward() or "
                "torch.autograd.grad, or engine='reference', which has all of them but vmap"
            ) from error


class Operation(Call):
    """Operation of one structure of csrc/api.h, with inputs as members of the same names.

    A member `d_NAME` is the gradient of the input, or of the output, NAME; inputs without one have none.
    """

    operation: ClassVar[str]
    """Name in csrc/api.h."""

    optional: ClassVar[tuple[str, ...]] = ()
    """Inputs whose gradients the kernel omits if they are not needed."""

    at_once: ClassVar[bool] = False
    """True if the forward call also computes gradients, of the first output, a scalar."""

    @abstractmethod
    def plain(self, *inputs: Any) -> Any:
        """Compute the output, or a tuple of outputs, in plain torch, for any device and floating dtype."""

    @abstractmethod
    def numbers(self, *inputs: Any) -> dict[str, Any]:
        """Return all other members by name, as `filled` takes them."""

    @abstractmethod
    def outputs(self, *inputs: Any) -> dict[str, Tensor]:
        """Return new tensors for the outputs, by the names of their members."""

    def on(self, new_pass: NewPass | None, *inputs: Tensor | None) -> Any:
        """Compute the outputs: by the engine if it has this operation, otherwise by `plain`."""
        if new_pass is not None:
            self._new_pass, self._kernel, self._numbers = new_pass, new_pass(), self.numbers(*inputs)
            if self._kernel.has(self.operation, self._numbers):
                outputs = self.of(*inputs)
                return outputs[0] if len(outputs) == 1 else outputs
        return self.plain(*inputs)

    def forward(self, inputs: Sequence[Any]) -> tuple[Tensor, ...]:
        outputs = self.outputs(*inputs)
        self._shapes = {name: tensor.shape for name, tensor in outputs.items()}
        self._at_once = self._new_gradients(inputs) if self.at_once else {}
        self._run(self._kernel, inputs, outputs | self._at_once)
        del self._kernel  # stateless, and may be reused
        return tuple(outputs.values())

    def to_save(self, inputs: Tensors) -> Tensors:
        if not self.at_once:
            return inputs
        gradients, self._at_once = self._at_once, {}  # torch frees them after the backward pass
        return [gradients.get(f"d_{name}") for name in self.names]

    def backward(self, saved: list[Any], grads: Tensors) -> Tensors:
        if self.at_once:
            return [None if gradient is None else gradient * grads[0] for gradient in saved]
        like = next(grad for grad in grads if grad is not None)
        seeds = {
            f"d_{name}": like.new_zeros(shape) if grad is None else grad
            for (name, shape), grad in zip(self._shapes.items(), grads, strict=True)
        }
        gradients = self._new_gradients(saved)
        self._run(self._new_pass(), saved, seeds | gradients)
        return [gradients.get(f"d_{name}") for name in self.names]

    def _new_gradients(self, inputs: Tensors) -> dict[str, Tensor]:
        members = members_of(structure_of(self.operation))
        return {
            f"d_{name}": torch.empty_like(tensor)
            for name, tensor, needed in zip(self.names, inputs, self.needed, strict=True)
            if tensor is not None and f"d_{name}" in members and (needed or name not in self.optional)
        }

    def _run(self, kernel: Pass, inputs: Tensors, others: Mapping[str, Tensor]) -> None:
        named = dict(zip(self.names, inputs, strict=True))
        kernel.run(self.operation, filled(structure_of(self.operation), {**self._numbers, **named, **others}))


class _Call(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, call: Call, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        inputs = [None if t is None else t.contiguous() for t in tensors]
        call.needed = ctx.needs_input_grad[1:]
        outputs = call.forward(inputs)
        saved = call.to_save(inputs)
        ctx.call, ctx.shapes = call, [None if t is None else t.shape for t in saved]
        ctx.one_at_a_time = threading.Lock()  # kernels release the GIL, and share scratch memory
        ctx.save_for_backward(*saved)
        ctx.mark_non_differentiable(*(outputs[k] for k in call.constant))
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = _saved_inputs(ctx)
        if all(grad is None for grad in grads):
            return (None,) * (1 + len(ctx.call.names))
        with ctx.one_at_a_time:
            return None, *ctx.call.backward(saved, [None if g is None else g.contiguous() for g in grads])


def _saved_inputs(ctx: Any) -> list[Any]:
    """Return the saved tensors, whose memory may have moved; raise if they were changed in place, or in shape."""
    saved = ctx.saved_tensors  # once: checkpointing hands out recomputed tensors only once
    inputs = [None if t is None else t.contiguous() for t in saved]
    for name, tensor, shape in zip(ctx.call.names[ctx.call.saved], inputs, ctx.shapes, strict=True):
        if tensor is not None and tensor.shape != shape:
            raise SarsplatError(
                f"{name} had shape {tuple(shape)} when rendered and now has shape {tuple(tensor.shape)}; do not "
                "replace the data of tensors between rendering and backward"
            )
    return inputs
