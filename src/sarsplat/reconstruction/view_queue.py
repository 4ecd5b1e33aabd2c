"""Which training images a step looks at."""

from __future__ import annotations

import torch

from sarsplat.reconstruction.snapshot import Snapshot


class ViewQueue:
    """Every training view once in a random order, then again in another.

    Parameters
    ----------
    views : int
        Number of training views.
    per_step : int
        Views in a step, if there are as many.
    generator : torch.Generator
        Of the order; on the CPU, so that it is the same on every device.
    """

    def __init__(self, views: int, per_step: int, generator: torch.Generator) -> None:
        self.waiting: list[int] = []
        self._views, self._count, self._generator = views, min(per_step, views), generator

    def next(self) -> list[int]:
        """Numbers of the views of the next step."""
        while len(self.waiting) < self._count:
            self.waiting += torch.randperm(self._views, generator=self._generator, device="cpu").tolist()
        chosen, self.waiting = self.waiting[: self._count], self.waiting[self._count :]
        return chosen

    def restore(self, snapshot: Snapshot) -> None:
        """Go on with the views that waited, and the state of the generator.

        Raises
        ------
        ValueError, KeyError, TypeError, RuntimeError
            If the snapshot does not hold them.
        """
        if len(snapshot.views) != self._views:
            raise ValueError(f"it has {len(snapshot.views)} views for {self._views} training images")
        if not all(0 <= k < self._views for k in snapshot.queue):
            raise ValueError("it queues views that are not there")
        self._generator.set_state(snapshot.tensors["generator"])
        self.waiting = list(snapshot.queue)
