"""What is called after every step of a training that the command line started."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sarsplat.cli import console
from sarsplat.cli.interrupt import interruptible

if TYPE_CHECKING:
    from sarsplat.data import Dataset
    from sarsplat.reconstruction import Step

LOG_FOLDER = "tensorboard"
"""In the run's folder."""


@contextmanager
def watched(
    dataset: Path, out: Path, images: Dataset, *, tensorboard: bool, port: int | None
) -> Iterator[Callable[[Step[Any]], object]]:
    """A training that Ctrl-C ends between two steps, logged for TensorBoard and shown in a browser if asked for.

    Raises
    ------
    SarsplatError
        If tensorboard is asked for but not installed, or the page's port is taken.
    KeyboardInterrupt
        If there was one; it says how to resume, if there is a checkpoint.
    """
    with ExitStack() as stack:
        stop_if_asked = stack.enter_context(interruptible(dataset, out))
        watchers: list[Callable[[Step[Any]], object]] = []
        if tensorboard:
            from sarsplat.reconstruction.tensorboard import TensorBoard

            board = TensorBoard(out / LOG_FOLDER, images)
            stack.callback(board.close)
            watchers.append(board)
        if port is not None:
            from sarsplat.viewer import watched as shown

            watchers.append(stack.enter_context(shown(images, port, console.say)))
        watchers.append(stop_if_asked)

        def on_step(step: Step[Any]) -> None:
            for watcher in watchers:
                watcher(step)

        yield on_step
