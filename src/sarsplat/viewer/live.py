"""The viewer during a training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from sarsplat.data import Dataset
from sarsplat.learning import Trainer
from sarsplat.runs import Step
from sarsplat.viewer.scene import SceneAlone
from sarsplat.viewer.subject import dataset_subject
from sarsplat.viewer.viewer import Viewer


def training_subject(dataset: Dataset, trainer: Trainer) -> SceneAlone:
    """A training as it is between two steps; what is shown is copied."""
    title = f"{dataset.target}: training, {trainer.iteration:,} steps, {trainer.gaussian_count:,} Gaussians"
    images = dataset_subject(dataset)
    scene = SceneAlone(title, images.grid, images.train_views, images.peak, dataset)
    scene.look_at(trainer.model, trainer.model.degree(trainer.iteration))
    return scene


@contextmanager
def watched(dataset: Dataset, port: int, say: Callable[[str], None]) -> Iterator[Callable[[Step[Any]], None]]:
    """A page that shows a training; call the yielded function after each step, which leaves the training unchanged.

    The page is drawn while the training waits, at most for 3 % of its time (`Viewer.keep_up`). `say` gets a sentence
    with the page's address. Raises `SarsplatError` if the port is taken; 0 takes any free one.
    """
    with Viewer(dataset_subject(dataset), port) as viewer:
        say(f"open {viewer.address} in a browser on this machine to watch the training")
        yield lambda step: viewer.keep_up(lambda: training_subject(dataset, step.trainer))
