"""Tensors on a device that recorded steps read: a cache for each queue, not filled meanwhile, and the chosen views.

Views are chosen by a tensor on the device, so that a recorded step renders other views each time.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar, cast

import torch
from jaxtyping import Int64
from torch import Tensor

from sarsplat.geometry import View

P = ParamSpec("P")
T = TypeVar("T")


class NotRecordable(Exception):
    """Error of a step that depends on numbers known only to the CPU, so that it cannot be recorded."""


def being_recorded() -> bool:
    """Return True while launches are recorded instead of run."""
    return torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()


_read: list[list[object]] = []  # cached objects that each recording in progress has read


@contextmanager
def read_meanwhile() -> Iterator[list[object]]:
    """Collect the cached objects that are read meanwhile: a record needs them longer than the cache may."""
    objects: list[object] = []
    _read.append(objects)
    try:
        yield objects
    finally:
        _read[:] = (other for other in _read if other is not objects)


def is_read(cached: T) -> T:
    """Keep an object alive as long as the records in progress."""
    for objects in _read:
        objects.append(cached)
    return cached


def queue_of(device: torch.device) -> int:
    """Return the queue of this thread on a device: torch's current stream of a GPU."""
    return torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0


def kept_on_device(maxsize: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Cache the latest tensors of a function whose arguments are hashable, the last being the device.

    Each queue has its own cache: tensors are complete before they are read, are not overwritten while another queue
    reads them, and other threads' trainings do not evict those of a recorded step (recorder.py). Misses while a step is
    recorded are errors, for such tensors would lie in the record's memory; earlier steps have made all it needs.
    """

    def decorate(make: Callable[P, T]) -> Callable[P, T]:
        def made(*arguments: P.args, **named: P.kwargs) -> T:
            if being_recorded():
                raise NotRecordable(f"{make.__name__} sends something to the device in every step")
            return make(*arguments, **named)

        by_queue: dict[int, Callable[P, T]] = {}

        @wraps(make)
        def kept(*arguments: P.args, **named: P.kwargs) -> T:
            queue = queue_of(cast(torch.device, arguments[-1]))
            if queue not in by_queue:
                by_queue.setdefault(queue, lru_cache(maxsize=maxsize)(made))  # type: ignore[arg-type]
            return is_read(by_queue[queue](*arguments, **named))

        return kept

    return decorate


class ChosenViews(Sequence[View]):
    """V of the views of a training, which may be rendered but not read on the CPU.

    `views` are all K candidates; `numbers`, int64 [V] on the device, the rendered ones, which change between replays.
    """

    item_type = View

    def __init__(self, views: tuple[View, ...], numbers: Int64[Tensor, " v"]) -> None:
        self.all, self.numbers = views, numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, which: Any) -> Any:
        raise NotRecordable("looks at single views on the CPU")


def candidates(views: Sequence[View]) -> tuple[Sequence[View], Int64[Tensor, " v"] | None]:
    """Return all candidates and the chosen indices; for plain views, these and None."""
    return (views.all, views.numbers) if isinstance(views, ChosenViews) else (views, None)


def by_view(of_view: Callable[..., Tensor], views: Sequence[View], *arguments: object) -> Tensor:
    """Stack `of_view(view, *arguments)` of all views."""
    if isinstance(views, ChosenViews):
        return _table(of_view, views.all, *arguments).index_select(0, views.numbers)
    return torch.stack([of_view(view, *arguments) for view in views])


@kept_on_device(maxsize=32)
def _table(of_view: Callable[..., Tensor], views: tuple[View, ...], *arguments: object) -> Tensor:
    return torch.stack([of_view(view, *arguments) for view in views])
