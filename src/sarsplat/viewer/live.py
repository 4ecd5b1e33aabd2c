"""A training to look at while it goes on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from sarsplat.data import Dataset
from sarsplat.reconstruction import Step, Trainer
from sarsplat.viewer.scene import OfScene, SceneImages
from sarsplat.viewer.subject import Cloud, dataset_subject
from sarsplat.viewer.viewer import Viewer

_SHARE = 0.03
"""Most of a training's time that may be spent on showing it."""

_WAIT_S = 2.0
"""Longest wait for one picture, s."""


class TrainingSubject(OfScene):
    """A training as it is after some steps.

    Parameters
    ----------
    dataset : Dataset
        Its images.
    trainer : Trainer
        The training, between two steps; what is shown is copied.
    """

    surface = None  # its normals would take seconds

    def __init__(self, dataset: Dataset, trainer: Trainer) -> None:
        known = dataset_subject(dataset)
        title = f"{dataset.target}: training, {trainer.iteration:,} steps, {trainer.gaussian_count:,} Gaussians"
        super().__init__(title, known.grid, known.train_views, known.peak, dataset)
        self.look_at(SceneImages(trainer.model, trainer.model.degree(trainer.iteration), dataset.grid))

    @cached_property
    def clouds(self) -> list[Cloud]:
        """See `Subject`."""
        return [self.images.cloud]


@contextmanager
def watched(dataset: Dataset, port: int, say: Callable[[str], None]) -> Iterator[Callable[[Step[Any]], None]]:
    """A page that shows a training; the yielded function is called after each step, and changes nothing of it.

    The page is drawn while the training waits, at most for 3 % of its time: two processors that share the work would
    only slow each other down.

    Parameters
    ----------
    dataset : Dataset
        The images that are trained on.
    port : int
        Of 127.0.0.1; 0 is any that is free.
    say : callable
        Told once where the page is.

    Raises
    ------
    SarsplatError
        If the port is taken.
    """
    watcher = _Watcher(dataset, port, say)
    try:
        yield watcher.after_step
    finally:
        watcher.close()


class _Watcher:
    def __init__(self, dataset: Dataset, port: int, say: Callable[[str], None]) -> None:
        self._dataset = dataset
        self._viewer = Viewer(dataset_subject(dataset), port)
        self._next = 0.0
        say(f"open {self._viewer.address} in a browser on this machine to watch the training")

    def after_step(self, step: Step[Any]) -> None:
        begun = time.monotonic()
        if begun < self._next:
            return
        self._viewer.show(TrainingSubject(self._dataset, step.trainer))
        self._viewer.wait(_WAIT_S)
        ended = time.monotonic()
        self._next = ended + (ended - begun) / _SHARE

    def close(self) -> None:
        self._viewer.close()
