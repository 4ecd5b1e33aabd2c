"""Views chosen by a tensor on the device, so that a recorded step renders other views each time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Int64
from torch import Tensor

from sarsplat.geometry import View
from sarsplat.renderer.engines.on_device import NotRecordable, kept_on_device


class ChosenViews(Sequence[View]):
    """V of the views of a training, which may be rendered but not read on the CPU.

    Parameters
    ----------
    views : tuple of View
        All K candidates.
    numbers : Tensor, int64 [V]
        Indices of the rendered views, on the device; they change between replays.
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
