"""Reject double backward: gradients of gradients are not implemented by the engines."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError


def differentiable_once(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Refuse `create_graph=True`: torch's own `once_differentiable` lets second derivatives come out as zero."""

    @wraps(backward)
    def checked(ctx: Any, *grads: Tensor | None) -> Any:
        if torch.is_grad_enabled():
            raise SarsplatError(
                "the engines have no second derivatives; leave create_graph=True out, or use engine='reference'"
            )
        return backward(ctx, *grads)

    return checked
