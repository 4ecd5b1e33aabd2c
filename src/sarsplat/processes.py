"""The processes of one training, as torchrun starts them: they share the views of every step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from sarsplat.errors import Abandoned

T = TypeVar("T")


class Processes:
    """One process among those that torchrun started; all of them make the same calls, in the same order.

    Attributes
    ----------
    rank : int
        Its number, from 0.
    count : int
        How many there are.

    Raises
    ------
    Abandoned
        From every method, if another process has ended.
    """

    def __init__(self) -> None:
        with _all_there():
            if not dist.is_initialized():
                dist.init_process_group("gloo")
            self._group = dist.new_group(backend="gloo")  # whatever else a script's own group is for
        self.rank, self.count = dist.get_rank(), dist.get_world_size()

    @classmethod
    def started(cls) -> Processes | None:
        """The processes of this program; None unless torchrun has started it."""
        return _started() if dist.is_available() and dist.is_torchelastic_launched() else None

    def __repr__(self) -> str:
        return f"torchrun with {self.count} processes"

    @property
    def leads(self) -> bool:
        """Whether this is the first process (rank 0), which writes and prints."""
        return self.rank == 0

    def shared(self, value: T) -> T:
        """Broadcast a value from rank 0."""
        held = [value]
        with _all_there():
            dist.broadcast_object_list(held, src=0, group=self._group)
        return held[0]

    def said(self, flag: bool) -> bool:
        """The flag of the first process, broadcast to all."""
        told = torch.tensor([flag], dtype=torch.uint8, device="cpu")
        return bool(self.gathered(told, [1] + [0] * (self.count - 1))[0])

    def gathered(self, own: Tensor, sizes: Sequence[int]) -> list[Tensor]:
        """Gather the vectors of all processes, which have these sizes."""
        every = [own if rank == self.rank and size else own.new_empty(size) for rank, size in enumerate(sizes)]
        with _all_there():
            sent = [
                dist.broadcast(vector, src=rank, group=self._group, async_op=True)
                for rank, vector in enumerate(every)
                if len(vector)
            ]
            for one in sent:
                one.wait()
        return every


@cache
def _started() -> Processes:
    return Processes()


@contextmanager
def _all_there() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        raise Abandoned(
            "another process of this training has ended or cannot be reached; what is saved is kept: start all of them "
            "again, with resume=True if there is a checkpoint"
        ) from error
