"""Batches of views that fit into memory, with gradients accumulated over the batches of a step."""

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

_STEP_GIB = 2.0  # maximum memory of a batch of more than one view, GiB

Compared = Callable[[slice], tuple[Tensor, Rendering]]
"""Function that renders a slice of a step's views and returns their mean loss and the rendering."""


def in_groups(
    views: int, most: int, parameters: Mapping[str, Tensor], grid: ImageGrid, rays: RayGrid, scenes: int = 1
) -> list[slice]:
    """Divide views into batches of at most `most` that fit into memory; sizes alone decide, on every machine alike.

    The means in `parameters` give the number of Gaussians; a rendering holds `scenes` times the scene.
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
    """Mean loss of all views, differentiable with respect to the parameters, and the detached rendering.

    Each batch is rendered and differentiated before the next one, to save memory. The loss must be a mean over views.
    """
    if len(groups) == 1:
        return compared(groups[0])
    renderings: list[Rendering] = []
    loss = _Accumulated.apply(compared, groups, parameters, renderings, *parameters)
    images, sections, areas = zip(*((one.images, one.cross_sections, one.lit_area) for one in renderings), strict=True)
    planes = [one.plane_gradients for one in renderings if one.plane_gradients is not None]
    return loss, Rendering(
        torch.cat(images), torch.cat(sections), torch.cat(areas), plane_gradients=torch.cat(planes) if planes else None
    )


class _Accumulated(torch.autograd.Function):
    """Sum of the batches' losses, whose gradients the forward pass accumulates."""

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
            renderings.append(replace(detached(rendering), echoes=(), ground=None))
            del loss, share, rendering, found  # frees the graph
        return torch.stack(shares).sum()

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, None, None, *(one if one is None else one.mul_(slope) for one in ctx.gradients)


def _sum(total: Tensor | None, more: Tensor | None) -> Tensor | None:
    return more if total is None else total if more is None else total.add_(more)


def detached(rendering: Rendering) -> Rendering:
    """The rendering without its autograd graph, whose memory the next batch or strategies need."""
    return replace(
        rendering,
        images=rendering.images.detach(),
        cross_sections=rendering.cross_sections.detach(),
        echoes=tuple(one.detach() for one in rendering.echoes),
        ground=None if rendering.ground is None else rendering.ground.detach(),
    )
