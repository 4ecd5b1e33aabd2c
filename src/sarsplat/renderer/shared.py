"""A rendering whose views are shared by several processes, to the same bits as in one.

The engine sums gradients over a tree of views (csrc/differentiate.h): each process has whole branches of it, and
exchanges their sums.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from sarsplat.processes import Processes
from sarsplat.renderer.once import differentiable_once

Arrays = Sequence[Tensor | None]
Branch = tuple[int, int]
"""First view, and the one after the last."""

Some = Callable[[Branch, Arrays], Sequence[Tensor]]
"""Renders some of the views, given all arrays with only their rows: outputs with a row for each."""


def shared(
    processes: Processes,
    some: Some,
    arrays: Arrays,
    by_view: Sequence[bool],
    views: int,
    shapes: Sequence[tuple[int, ...]],
    planes: Tensor | None,
) -> tuple[Tensor, ...]:
    """What `some` returns of all views, of these shapes each, differentiable with respect to the arrays.

    `by_view` are the arrays with a row for each view; `planes` is one that `some` fills when gradients are computed.
    """
    job = _Job(processes, some, by_view, views, shapes, planes)
    return _Shared.apply(job, *arrays)


class _Job:
    """What is done with the views, and by whom."""

    def __init__(
        self,
        processes: Processes,
        some: Some,
        by_view: Sequence[bool],
        views: int,
        shapes: Sequence[tuple[int, ...]],
        planes: Tensor | None,
    ) -> None:
        self.processes, self.some, self.by_view, self.views = processes, some, by_view, views
        self.shapes, self.planes = shapes, planes
        self.differentiable = torch.is_grad_enabled()
        count = processes.count
        self.spans = [(views * rank // count, views * (rank + 1) // count) for rank in range(count)]
        self.branches = [list(_branches((0, views), span)) for span in self.spans]

    @property
    def own(self) -> list[Branch]:
        """Branches of this process."""
        return self.branches[self.processes.rank]

    def rows(self, arrays: Arrays, branch: Branch) -> list[Tensor | None]:
        """The arrays of a branch."""
        pairs = zip(arrays, self.by_view, strict=True)
        return [array[slice(*branch)] if cut and array is not None else array for array, cut in pairs]

    def joined(self, own: Sequence[Sequence[Tensor]], shapes: Sequence[tuple[int, ...]]) -> list[Tensor]:
        """Tensors with a row of each of these shapes for every view, from those of this process's branches."""
        sizes = [math.prod(shape) for shape in shapes]
        of = [[(end - first) * size for size in sizes] for first, end in self.spans]
        like = own[0][0] if own else torch.empty(0, dtype=torch.float32)
        flat = torch.cat([like.new_empty(0), *(of_all.reshape(-1) for of_all in map(_rows, zip(*own)))])
        every = [
            part.split(of_rank)
            for part, of_rank in zip(self.processes.gathered(flat, [sum(one) for one in of]), of, strict=True)
        ]
        return [torch.cat(parts).view(self.views, *shape) for parts, shape in zip(zip(*every), shapes, strict=True)]

    def summed(self, own: Sequence[Tensor], size: int) -> Tensor:
        """The sum over all views of vectors of this size, from the sums of this process's branches."""
        flat = torch.cat([torch.empty(0, dtype=torch.float32), *own])
        every = self.processes.gathered(flat, [len(branches) * size for branches in self.branches])
        sums = {
            branch: vector
            for branches, part in zip(self.branches, every, strict=True)
            for branch, vector in zip(branches, part.view(len(branches), size), strict=True)
        }
        return _sum((0, self.views), sums)


class _Shared(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, job: _Job, *arrays: Tensor | None) -> tuple[Tensor, ...]:
        ctx.job, ctx.parts = job, []
        for branch in job.own:
            leaves = [
                None if array is None else array.detach().requires_grad_(job.differentiable and needed)
                for array, needed in zip(job.rows(arrays, branch), ctx.needs_input_grad[1:], strict=True)
            ]
            with torch.set_grad_enabled(job.differentiable):
                ctx.parts.append((leaves, job.some(branch, leaves)))
        ctx.like = arrays
        ctx.set_materialize_grads(False)
        return tuple(job.joined([[one.detach() for one in outputs] for _, outputs in ctx.parts], job.shapes))

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        job, arrays = ctx.job, ctx.like
        needed = [k for k, need in enumerate(ctx.needs_input_grad[1:]) if need]
        over, of = ([k for k in needed if job.by_view[k] is cut] for cut in (False, True))
        sums, rows = [], []
        for branch, (leaves, outputs) in zip(job.own, ctx.parts, strict=True):
            pairs = [
                (out, grad[slice(*branch)])
                for out, grad in zip(outputs, grads, strict=True)
                if grad is not None and out.requires_grad
            ]
            found = torch.autograd.grad(
                [out for out, _ in pairs], [leaves[k] for k in needed], [grad for _, grad in pairs], allow_unused=True
            )
            known = {
                k: torch.zeros_like(leaves[k]) if one is None else one for k, one in zip(needed, found, strict=True)
            }
            sums.append(torch.cat([known[k].reshape(-1) for k in over]))
            rows.append([known[k] for k in of] + ([] if job.planes is None else [job.planes[slice(*branch)]]))
        results: dict[int, Tensor] = {}
        sizes = [arrays[k].numel() for k in over]
        for k, part in zip(over, job.summed(sums, sum(sizes)).split(sizes), strict=True):
            results[k] = part.view_as(arrays[k])
        shapes = [arrays[k].shape[1:] for k in of] + ([] if job.planes is None else [job.planes.shape[1:]])
        if shapes:
            whole = job.joined(rows, shapes)
            results |= dict(zip(of, whole))
            if job.planes is not None:
                job.planes.copy_(whole[-1])
        return None, *(results.get(k) for k in range(len(arrays)))


def _rows(parts: Sequence[Tensor]) -> Tensor:
    return torch.cat(list(parts))


def _halves(branch: Branch) -> tuple[Branch, Branch]:
    """The two branches that one is made of, as in csrc/differentiate.h."""
    first, end = branch
    middle = first + (1 << (end - first - 1).bit_length() - 1)
    return (first, middle), (middle, end)


def _branches(branch: Branch, span: Branch) -> Iterator[Branch]:
    """The largest parts of the tree that hold a span of views and no others."""
    (first, end), (low, high) = branch, span
    if low <= first and end <= high:
        yield branch
    elif first < high and low < end:
        for half in _halves(branch):
            yield from _branches(half, span)


def _sum(branch: Branch, sums: dict[Branch, Tensor]) -> Tensor:
    if branch in sums:
        return sums[branch]
    left, right = _halves(branch)
    return _sum(left, sums) + _sum(right, sums)
