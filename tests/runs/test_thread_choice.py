"""The number of threads that is quickest makes the steps."""

from collections.abc import Callable

import pytest
import torch

from sarsplat.runs import training_loop
from sarsplat.runs.training_loop import ThreadChoice


@pytest.mark.parametrize(
    ("slow", "quickest"), [({1: 4, 2: 2, 4: 1}, 4), ({1: 1, 2: 9, 4: 20}, 1), ({1: 2, 2: 1, 4: 4}, 2)]
)
def test_steps_have_the_threads_that_are_quickest(
    slow: dict[int, int], quickest: int, threads: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    threads(4)
    clock = iter(range(10**6))
    now = 0.0

    def step() -> int:
        nonlocal now
        now += slow[torch.get_num_threads()]
        return next(clock)

    monkeypatch.setattr(training_loop.time, "perf_counter", lambda: now)
    with ThreadChoice("cpu") as choice:
        made = [choice.step(step) for _ in range(20)]
        assert torch.get_num_threads() == quickest
    assert made == list(range(20))
    assert torch.get_num_threads() == 4


@pytest.mark.parametrize(("device", "count"), [("cuda:0", 4), ("cpu", 1)])
def test_a_gpu_and_one_thread_are_left_alone(device: str, count: int, threads: Callable[[int], None]) -> None:
    threads(count)
    with ThreadChoice(device) as choice:
        assert [choice.step(torch.get_num_threads) for _ in range(5)] == [count] * 5
