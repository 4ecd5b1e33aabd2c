"""Where a training is quicker is found by trying, and said if it is not the GPU."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from functools import cache

import pytest
import torch

from sarsplat import Dataset, Run, reconstruct
from sarsplat.errors import SarsplatError
from sarsplat.learning.device_choice import quicker_device
from sarsplat.learning.method_sar_gs import METHOD
from sarsplat.renderer.engines import cpu
from sarsplat.runs import reconstruction

GPU = torch.device("cuda", 0)


class Taking:
    """A training whose steps take so many seconds."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.steps = seconds, 0
        warnings.warn("as ever", UserWarning, stacklevel=1)

    def step(self) -> None:
        self.steps += 1
        time.sleep(self.seconds)

    def check(self) -> None:
        pass


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("on_gpu", "on_cpu", "chosen"), [(0.001, 0.02, "cuda"), (0.02, 0.001, "cpu")])
def test_the_quicker_one(on_gpu: float, on_cpu: float, chosen: str) -> None:
    made: list[tuple[str, Taking]] = []

    def make(where: torch.device) -> Taking:
        made.append((where.type, Taking(on_gpu if where == GPU else on_cpu)))
        return made[-1][1]

    where, said = quicker_device(make, GPU, 1000)  # type: ignore[arg-type]
    assert where.type == chosen
    assert [kind for kind, _ in made] == ["cuda", "cpu"]
    if chosen == "cuda":
        assert said == ""
        assert made[1][1].steps < 5  # it is not waited for
    else:
        assert said.startswith("training on the CPU: a step takes 1.")
        assert " ms there, and 2" in said
        assert said.endswith("device cuda takes the GPU nevertheless")


@pytest.mark.parametrize(
    ("fails", "chosen", "message"),
    [("cuda", "cpu", "training on the CPU: on the GPU, the memory of cuda:0 is not enough"), ("cpu", "cuda", "")],
)
def test_where_a_step_fails_it_is_not_done(fails: str, chosen: str, message: str) -> None:
    class Failing(Taking):
        def step(self) -> None:
            raise SarsplatError("the memory of cuda:0 is not enough\nfor it")

    where, said = quicker_device(lambda where: (Failing if where.type == fails else Taking)(0.001), GPU, 1000)  # type: ignore[arg-type, return-value]
    assert (where.type, said) == (chosen, message)


def test_what_is_said_once_of_the_cpu_engine_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu, "torch_pool", lambda: None)
    monkeypatch.setattr(cpu, "library", cache(cpu.library.__wrapped__))
    with pytest.warns(UserWarning, match="runs on one thread"):
        quicker_device(lambda _: Taking(0.001), GPU, 1000)  # type: ignore[arg-type, return-value]
    monkeypatch.undo()
    cpu.library.cache_clear()
    cpu.library()  # with torch's threads again


def test_a_reconstruction_says_so_and_goes_on_where_it_began(
    dataset: Dataset, config, tmp_path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    named, asked = reconstruction.device_named, []
    monkeypatch.setattr(reconstruction, "device_named", lambda name: GPU if name == "auto" else named(name))
    monkeypatch.setattr(
        reconstruction,
        "quicker_device",
        lambda make, gpu, _: asked.append(gpu) or (torch.device("cpu"), "on the CPU: said"),
    )
    run = reconstruct(dataset, config, tmp_path / "run", on_step=lambda step: step.iteration == 21)
    assert "on the CPU: said" in capsys.readouterr().out
    assert (asked, run.trained_on, Run.load(tmp_path / "run").trained_on) == ([GPU], "cpu", "cpu")
    reconstruct(dataset, config, tmp_path / "run", resume=True)  # on the CPU again, without a question
    assert len(asked) == 1


def test_a_loss_of_ones_own_is_on_the_gpu_untried(dataset: Dataset, config, monkeypatch: pytest.MonkeyPatch) -> None:
    class ReachedError(Exception):
        pass

    def trainer(self: object, dataset: object, config: object, inputs: object, device: object, begun: object) -> None:
        assert device == GPU
        raise ReachedError

    monkeypatch.setattr(reconstruction, "device_named", lambda name: GPU)
    monkeypatch.setattr(reconstruction, "quicker_device", lambda *_: pytest.fail("is tried"))
    monkeypatch.setattr(type(METHOD), "trainer", trainer)
    with pytest.raises(ReachedError):
        reconstruct(dataset, replace(config, iterations=1000), loss=lambda a, b: (a - b).abs().mean())


def test_few_iterations_are_not_tried() -> None:
    assert quicker_device(lambda where: pytest.fail("is tried"), GPU, 100) == (GPU, "")
