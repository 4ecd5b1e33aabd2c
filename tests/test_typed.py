"""Types that are new to msgspec are learned by one thread at a time, wherever data are read."""

import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import pytest

import sarsplat
from sarsplat.typed import convert, decode


def test_one_thread_at_a_time_learns_a_type(monkeypatch: pytest.MonkeyPatch) -> None:
    inside, most, learn = threading.Semaphore(1), [], msgspec.json.Decoder

    def learning(kind: Any) -> Any:
        most.append(inside.acquire(blocking=False))  # false if another thread is at it
        time.sleep(0.02)
        if most[-1]:
            inside.release()
        return learn(kind)

    monkeypatch.setattr(msgspec.json, "Decoder", learning)
    kinds = [msgspec.defstruct(f"Kind{k}", [("number", int)]) for k in range(3)]
    with ThreadPoolExecutor(6) as pool:
        read = [pool.submit(decode, b'{"number": 1}', kind) for kind in kinds]
        made = [pool.submit(convert, {"number": 1}, kind) for kind in kinds]
        assert [one.result() for one in read] == [one.result() for one in made]
    assert len(most) >= len(kinds)
    assert all(most)


def test_nothing_else_lets_msgspec_learn_types() -> None:
    package = Path(sarsplat.__file__).parent
    pattern = re.compile(r"msgspec\.convert\(|msgspec\.\w+\.decode\(.*type=|\.Decoder\(")
    own = [path.name for path in package.rglob("*.py") if pattern.search(path.read_text())]
    assert own == ["typed.py"]
