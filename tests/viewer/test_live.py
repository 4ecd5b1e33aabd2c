"""Watching a training changes nothing of it."""

import socket
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from sarsplat import View
from sarsplat.runs import reconstruct

pytest.importorskip("viser")

from sarsplat.viewer import viewer
from sarsplat.viewer.subject import scene_of, training_subject


def test_a_watched_training_learns_the_same_bits(dataset, config, finished, monkeypatch):
    monkeypatch.setattr(viewer, "_SHARE", 1e9)  # drawn after every step
    said, drawn = [], []
    with viewer.watched(dataset, 0, said.append) as show:

        def after_step(step):
            show(step)
            drawn.append(step.iteration)

        run = reconstruct(dataset, config, on_step=after_step, quiet=True)
    assert drawn == list(range(1, config.iterations + 1))
    assert said[0].startswith("open http://127.0.0.1:")
    for name, tensor in finished.snapshot.tensors.items():
        assert torch.equal(tensor, run.snapshot.tensors[name]), name


def test_the_page_shows_the_newest_state(dataset, config):
    from sarsplat.learning import Trainer
    from sarsplat.viewer import Viewer
    from sarsplat.viewer.subject import dataset_subject

    trainer, viewer = Trainer(dataset, config), Viewer(dataset_subject(dataset))
    pictures = []
    for _ in range(2):
        for _ in range(5):
            trainer.step()
        viewer.show(training_subject(dataset, trainer))
        assert viewer.wait(60)
        pictures.append(viewer._controls._rows[0][1].image.copy())
    viewer.close()
    assert pictures[0].shape == pictures[1].shape
    assert not np.array_equal(*pictures)
    assert "10 steps" in viewer._controls.title.content


def test_the_time_that_it_takes_is_a_small_share(monkeypatch):
    clock, cost, shown = [100.0], 0.5, []

    class Slow(viewer.Viewer):
        def __init__(self) -> None:
            self._pause_until = 0.0

        def show(self, subject: Any) -> None:
            shown.append(subject)

        def wait(self, timeout_s: float = 10.0) -> bool:
            clock[0] += cost
            return True

    monkeypatch.setattr(viewer.time, "monotonic", lambda: clock[0])
    page = Slow()
    for _ in range(10_000):
        page.keep_up(SimpleNamespace)
        clock[0] += 0.01
    assert len(shown) >= 3
    assert len(shown) * cost <= 0.05 * 10_000 * 0.01 + cost


def test_gaussians_of_ones_own_loop_are_shown_and_followed(finished, monkeypatch):
    """By whatever they are now, in pixels that show all of them; the loop's own tensors stay differentiable."""
    monkeypatch.setattr(viewer, "_SHARE", 1e9)
    gaussians, pictures = finished.gaussians, []
    moving = gaussians.means.clone().requires_grad_()
    with viewer.Viewer(gaussians) as page:
        assert page.wait(60)
        for _ in range(2):
            pictures.append(page._controls._rows[0][1].image.copy())
            assert pictures[-1].max() > 100
            with torch.no_grad():
                moving[:, 0] += 1.0
            page.update(gaussians.with_tensors(means=moving))
            assert page.wait(60)
        assert f"{len(gaussians):,} Gaussians" in page._controls.title.content
        server = page._server
    assert not np.array_equal(*pictures)
    assert moving.requires_grad
    view = View(10.0, 20.0)  # on a grid of one's own
    scene = scene_of(gaussians, finished.grid, [view])
    assert scene.views == [(view, "train")]
    np.testing.assert_allclose(scene.render(view), finished.render([view])[0], rtol=0.05, atol=0.05 * scene.peak)
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", server.get_port()), 1)
