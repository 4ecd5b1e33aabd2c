"""Steps of a training that a GPU does by itself, with what changes from one to the next told to it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Generic, TypeVar

import torch

from sarsplat.renderer.engines.recorder import MOST_WORDS, Recorder, Told

T = TypeVar("T")


class RecordedSteps(Generic[T]):
    """A step as it was recorded, and what becomes of it when a training changes.

    The first step of a kind is rehearsed: it runs as usual, from numbers on the device. The second is recorded, and it
    and all that follow are run from the record.

    Parameters
    ----------
    recorder : Recorder
        What records on the training's device.
    views, rates : int
        How many views a step has, and how many numbers Adam has of it.
    """

    def __init__(self, recorder: Recorder, views: int, rates: int) -> None:
        self._recorder = recorder
        self._told = Told(
            recorder, {"chosen": (torch.int64, views), "step": (torch.int64, 1), "rates": (torch.float32, rates)}
        )
        self._values: Hashable = None
        self._things: Sequence[object] = ()  # kept alive: two things at different times may have one address
        self._again: tuple[T, Callable[[], None]] | None = None

    @staticmethod
    def has_room(views: int, rates: int) -> bool:
        """Whether so many numbers can be told."""
        return 2 * views + 2 + rates <= MOST_WORDS

    def run(
        self,
        kind: tuple[Hashable, Sequence[object]],
        program: Callable[..., T],
        chosen: Sequence[int],
        step: int,
        rates: Sequence[float],
    ) -> T:
        """One step: what the program gives, whose tensors the next step may change.

        `kind` is all that decides about the launches of the program: values, and things that must be the very same. The
        program gets the other three as tensors.

        Raises
        ------
        NotRecordable, RuntimeError, SarsplatError
            If it cannot be recorded. Nothing has been learned, then.
        """
        self._told.tell(
            chosen=torch.tensor(chosen, device="cpu"),
            step=torch.tensor([step], device="cpu"),
            rates=torch.tensor(rates, dtype=torch.float32, device="cpu"),
        )
        values, things = kind
        if self._values != values or [*map(id, things)] != [*map(id, self._things)]:
            self._again = None
            result = self._recorder.rehearse(lambda: program(*self._told.tensors.values()))
            self._values, self._things = values, things
            return result
        if self._again is None:
            self._again = self._recorder.record(lambda: program(*self._told.tensors.values()))
        result, run = self._again
        run()
        return result
