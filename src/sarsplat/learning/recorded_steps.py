"""Training steps as CUDA graphs; the numbers that change from step to step are written to the device."""

from collections.abc import Callable, Hashable, Sequence
from typing import Generic, TypeVar

import torch

from sarsplat.renderer.engines.recorder import Recorder, Told

T = TypeVar("T")


class RecordedSteps(Generic[T]):
    """A recorded training step, recorded anew when the training changes.

    The first step of a kind is rehearsed: it runs normally, with its numbers on the device. The second is recorded; it
    and all later ones replay the record. `views` and `rates` are how many views and numbers for Adam a step has.
    """

    def __init__(self, recorder: Recorder, views: int, rates: int) -> None:
        self._recorder = recorder
        self._told = Told(
            recorder, {"chosen": (torch.int64, views), "step": (torch.int64, 1), "rates": (torch.float32, rates)}
        )
        self._values: Hashable = None
        self._objects: Sequence[object] = ()  # kept alive: a later object could have the same address
        self._record: tuple[T, Callable[[], None]] | None = None

    def run(
        self,
        kind: tuple[Hashable, Sequence[object]],
        program: Callable[..., T],
        chosen: Sequence[int],
        step: int,
        rates: Sequence[float],
    ) -> T:
        """Make one step and return the program's result, whose tensors the next step may overwrite.

        `kind` is all that determines the program's launches: values, and objects that must stay identical. The program
        gets the other three as tensors. Raises NotRecordable, RuntimeError or SarsplatError if the step cannot be
        recorded; the parameters are then unchanged.
        """
        self._told.tell(
            chosen=torch.tensor(chosen, device="cpu"),
            step=torch.tensor([step], device="cpu"),
            rates=torch.tensor(rates, dtype=torch.float32, device="cpu"),
        )
        values, objects = kind
        if self._values != values or [*map(id, objects)] != [*map(id, self._objects)]:
            self._record = None
            result = self._recorder.rehearse(lambda: program(*self._told.tensors.values()))
            self._values, self._objects = values, objects
            return result
        if self._record is None:
            self._record = self._recorder.record(lambda: program(*self._told.tensors.values()))
        result, run = self._record
        run()
        return result
