"""The views of a step a few at a time, where all of them at once would take too much memory: gradients are added."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import starmap
from typing import Any

import torch
from torch import Tensor

from sarsplat.geometry import ImageGrid, RayGrid
from sarsplat.renderer import Rendering
from sarsplat.renderer.engines.operation import differentiable_once
from sarsplat.tiles.plan import memory_bytes

_STEP_GIB = 2.0
"""What the views of a step that are rendered at once take at most, unless it is one."""

Compared = Callable[[slice], tuple[Tensor, Rendering]]
"""Renders some of the views of a step: their mean loss, and what was rendered."""


def in_groups(
    views: int, most: int, parameters: Mapping[str, Tensor], grid: ImageGrid, rays: RayGrid, scenes: int = 1
) -> list[slice]:
    """So many views in their order, at most so many at once; decided by sizes alone, so alike on every machine.

    Of the `parameters` of a model, the means say how many Gaussians there are; a rendering takes as much as `scenes`.
    """
    count = len(parameters["means"])
    numbers = sum(tensor[0].numel() for tensor in parameters.values() if len(tensor) == count)
    pixels = grid.rows * grid.columns
    crossing = pixels * grid.spacing_m[0] * grid.spacing_m[1] / rays.cell_area
    together = min(most, max(1, int(_STEP_GIB * 2**30 / (scenes * memory_bytes(count, numbers, crossing, pixels)))))
    return [slice(first, min(first + together, views)) for first in range(0, views, together)]


def compared_in_groups(
    compared: Compared, groups: Sequence[slice], parameters: Sequence[Tensor]
) -> tuple[Tensor, Rendering]:
    """The mean loss of all views, differentiable with respect to the parameters, and what was rendered, detached.

    Each group is rendered and differentiated before the next one, so that memory holds what one of them needs. The loss
    must be a mean over views.
    """
    if len(groups) == 1:
        return compared(groups[0])
    renderings: list[Rendering] = []
    loss = _Added.apply(compared, groups, parameters, renderings, *parameters)
    images, sections, areas = zip(*((one.images, one.cross_sections, one.lit_area) for one in renderings), strict=True)
    planes = [one.plane_gradients for one in renderings if one.plane_gradients is not None]
    return loss, Rendering(
        torch.cat(images), torch.cat(sections), torch.cat(areas), plane_gradients=torch.cat(planes) if planes else None
    )


class _Added(torch.autograd.Function):
    """The gradients are found on the way forward."""

    @staticmethod
    def forward(
        ctx: Any,
        compared: Compared,
        groups: Sequence[slice],
        parameters: Sequence[Tensor],
        renderings: list[Rendering],
        *_: Tensor,
    ) -> Tensor:
        count, shares = groups[-1].stop, list[Tensor]()
        ctx.gradients = [None] * len(parameters)
        for group in groups:
            with torch.enable_grad():
                loss, rendering = compared(group)
                share = loss * ((group.stop - group.start) / count)
                found = torch.autograd.grad(share, parameters, allow_unused=True)
            ctx.gradients = list(starmap(_sum, zip(ctx.gradients, found, strict=True)))
            shares.append(share.detach())
            renderings.append(_detached(rendering))
            del loss, share, rendering, found  # and with them what the way back needed
        return torch.stack(shares).sum()

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, None, None, *(one if one is None else one.mul_(slope) for one in ctx.gradients)


def _sum(total: Tensor | None, more: Tensor | None) -> Tensor | None:
    return more if total is None else total if more is None else total.add_(more)


def _detached(rendering: Rendering) -> Rendering:
    images, sections = rendering.images.detach(), rendering.cross_sections.detach()
    return replace(rendering, images=images, cross_sections=sections, echoes=(), ground=None)
