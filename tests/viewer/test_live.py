"""Watching a training changes nothing of it."""

import socket

import numpy as np
import pytest
import torch

from sarsplat.errors import SarsplatError
from sarsplat.reconstruction import reconstruct

pytest.importorskip("viser")

from sarsplat.viewer import live


def test_a_watched_training_learns_the_same_bits(dataset, config, finished, monkeypatch):
    monkeypatch.setattr(live, "_SHARE", 1e9)  # drawn after every step
    said, drawn = [], []
    with live.watched(dataset, 0, said.append) as show:

        def after_step(step):
            show(step)
            drawn.append(step.iteration)

        run = reconstruct(dataset, config, on_step=after_step, quiet=True)
    assert drawn == list(range(1, config.iterations + 1))
    assert said[0].startswith("open http://127.0.0.1:")
    for name, tensor in finished.snapshot.tensors.items():
        assert torch.equal(tensor, run.snapshot.tensors[name]), name


def test_the_page_shows_the_newest_state(dataset, config):
    from sarsplat.reconstruction import Trainer
    from sarsplat.viewer import Viewer
    from sarsplat.viewer.subject import dataset_subject

    trainer, viewer = Trainer(dataset, config), Viewer(dataset_subject(dataset))
    pictures = []
    for _ in range(2):
        for _ in range(5):
            trainer.step()
        viewer.show(live.TrainingSubject(dataset, trainer))
        assert viewer.wait(60)
        pictures.append(viewer._controls._rows[0][1].image.copy())
    viewer.close()
    assert pictures[0].shape == pictures[1].shape
    assert not np.array_equal(*pictures)
    assert "10 steps" in viewer._controls.title.content


def test_the_time_that_it_takes_is_a_small_share(dataset, config, monkeypatch):
    from types import SimpleNamespace

    clock, cost, shown = [100.0], 0.5, []

    def stand_in(*_: object) -> SimpleNamespace:
        wait = lambda _: clock.__setitem__(0, clock[0] + cost)  # noqa: E731
        return SimpleNamespace(address="", show=shown.append, wait=wait, close=lambda: None)

    monkeypatch.setattr(live, "Viewer", stand_in)
    monkeypatch.setattr(live, "TrainingSubject", lambda *_: "state")
    monkeypatch.setattr(live.time, "monotonic", lambda: clock[0])
    with live.watched(dataset, 0, lambda _: None) as after_step:
        for _ in range(10_000):
            after_step(SimpleNamespace(trainer=None))
            clock[0] += 0.01
    assert len(shown) >= 3
    assert len(shown) * cost <= 0.05 * 10_000 * 0.01 + cost


def test_a_port_in_use_is_told_before_anything_is_learned(dataset):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with (
            pytest.raises(SarsplatError, match=rf"port {port} of this machine cannot be used"),
            live.watched(dataset, port, print),
        ):
            pass
