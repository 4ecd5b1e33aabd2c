"""Work on several views at once: order, progress and its end."""

import threading
import time

import pytest

from sarsplat.scenes._parallel import in_order


@pytest.fixture(params=[1, 3])
def count(request, threads):
    threads(request.param)
    return request.param


def test_results_come_in_order_with_progress_within_each(count):
    shares = []

    def work(item, report):
        for step in range(4):
            report(step / 4)
            time.sleep(0.15 if item == 0 else 0.01)
        return item**2

    assert list(in_order(work, range(5), shares.append)) == [0, 1, 4, 9, 16]
    assert shares == sorted(shares) and any(share % 1 for share in shares) and max(shares) < 5


def test_an_error_or_ctrl_c_ends_the_others(count):
    begun, ended, waits = threading.Event(), [], [0]

    def work(item, report):
        if item == 0:
            raise KeyboardInterrupt
        begun.set()
        try:
            for _ in range(1000):
                report(0.5)
                waits[0] += 1
                time.sleep(0.01)
        finally:
            ended.append(item)

    with pytest.raises(KeyboardInterrupt):
        list(in_order(work, range(10)))
    assert waits[0] < 200  # two seconds of the ten that one takes to its end, however busy the machine
    assert len(ended) <= count
