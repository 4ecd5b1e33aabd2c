"""The viewer during a training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from sarsplat.data import Dataset
from sarsplat.learning import Trainer
from sarsplat.runs import Step
from sarsplat.viewer.scene import OfScene
from sarsplat.viewer.subject import Cloud, dataset_subject
from sarsplat.viewer.viewer import Viewer


class TrainingSubject(OfScene):
    """A training as it is between two steps; what is shown is copied."""

    surface = None  # its normals would take seconds

    def __init__(self, dataset: Dataset, trainer: Trainer) -> None:
        images = dataset_subject(dataset)
        title = f"{dataset.target}: training, {trainer.iteration:,} steps, {trainer.gaussian_count:,} Gaussians"
        super().__init__(title, images.grid, images.train_views, images.peak, dataset)
        self.look_at(trainer.model, trainer.model.degree(trainer.iteration))

    @cached_property
    def clouds(self) -> list[Cloud]:
        return [self.gaussian_cloud]


@contextmanager
def watched(dataset: Dataset, port: int, say: Callable[[str], None]) -> Iterator[Callable[[Step[Any]], None]]:
    """A page that shows a training; call the yielded function after each step, which leaves the training unchanged.

    The page is drawn while the training waits, at most for 3 % of its time (`Viewer.keep_up`). `say` gets a sentence
    with the page's address. Raises `SarsplatError` if the port is taken; 0 takes any free one.
    """
    with Viewer(dataset_subject(dataset), port) as viewer:
        say(f"open {viewer.address} in a browser on this machine to watch the training")
        yield lambda step: viewer.keep_up(lambda: TrainingSubject(dataset, step.trainer))
