"""TensorBoard, live page and Ctrl-C of a training, which ends between two steps, to be resumed bit for bit."""

from __future__ import annotations

import os
import shlex
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from sarsplat.cli import console
from sarsplat.cli.ending import Stopped, keeping

if TYPE_CHECKING:
    from sarsplat.data import Dataset
    from sarsplat.runs import Step

_LOG_FOLDER = "tensorboard"  # in the run's folder


@contextmanager
def watched(
    dataset: Path, out: Path, images: Dataset, *, tensorboard: bool, port: int | None
) -> Iterator[Callable[[Step[Any]], object]]:
    """A training that Ctrl-C ends between two steps, logged for TensorBoard and shown in a browser if asked for.

    Before the first step is done and after the last one, Ctrl-C ends it at once.

    The yielded function is called after each step. The KeyboardInterrupt says how to resume if there is a checkpoint.
    """
    words = shlex.join(["sarsplat", "reconstruct", str(dataset), "--out", str(out), "--resume"])
    kept = f"{out} keeps the progress so far; continue with `{words}`"
    with keeping(lambda: kept if (out / "config.json").is_file() else ""), ExitStack() as stack:
        hold_back = stack.enter_context(_interrupts())
        watchers: list[Callable[[Step[Any]], object]] = []
        if tensorboard:
            from sarsplat.runs.tensorboard import TensorBoard

            board = TensorBoard(out / _LOG_FOLDER, images)
            stack.callback(board.close)
            watchers.append(board)
        if port is not None:
            from sarsplat.viewer import watched as shown

            watchers.append(stack.enter_context(shown(images, port, console.say)))

        def on_step(step: Step[Any]) -> None:
            for watcher in watchers:
                watcher(step)
            if number := hold_back(not step.last):
                raise Stopped(number)

        yield on_step


@contextmanager
def _interrupts() -> Iterator[Callable[[bool], int]]:
    """Raise `Stopped` at Ctrl-C (and a polite kill) inside the block, at first at once.

    The yielded function says whether signals are held back from now on, and gives the number of one that was, or 0. A
    second one is not held back. Outside the main thread, where no signal arrives, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda held: 0
        return
    asked, holding = 0, False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked or not holding:
            raise Stopped(number)
        asked = number
        os.write(2, b"\nstopping after this step; once more stops at once\n")  # print must not be called in here

    def hold_back(held: bool) -> int:
        nonlocal holding
        holding = held
        return asked

    before = {number: signal.signal(number, hold) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield hold_back
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)
