"""Tensors that are sent to a device once and kept there, whoever needs them, and never while a step is recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
T = TypeVar("T")


class NotRecordable(Exception):
    """What a step does depends on numbers that only the CPU knows, so it cannot be recorded."""


def being_recorded() -> bool:
    """Whether launches are recorded, not run."""
    return torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()


def kept_on_device(maxsize: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a function of hashable arguments that makes one tensor or several: the latest results are kept.

    They are whole when they are returned, for other threads use other streams. What were made while a step is recorded
    would lie in the record's own memory: that is an error, since the steps before it have made all that it needs.
    """

    def decorate(make: Callable[P, T]) -> Callable[P, T]:
        def made(*arguments: P.args, **named: P.kwargs) -> T:
            if being_recorded():
                raise NotRecordable(f"{make.__name__} sends something to the device in every step")
            result = make(*arguments, **named)
            for tensor in _tensors(result):
                if tensor.is_cuda:
                    torch.cuda.current_stream(tensor.device).synchronize()
            return result

        return wraps(make)(lru_cache(maxsize=maxsize)(made))  # type: ignore[return-value]

    return decorate


def _tensors(result: Any) -> Iterable[Tensor]:
    return (result,) if isinstance(result, Tensor) else result
