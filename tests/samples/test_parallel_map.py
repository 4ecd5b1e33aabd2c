"""Work shared among processes: in order, the same as alone, and failures come back as they are."""

import os
import signal
import time
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
import torch

from sarsplat import SarsplatError
from sarsplat.samples.write import parallel_map


@pytest.fixture(params=[1, 2])
def count(request, threads):
    threads(request.param)
    return request.param


def test_results_come_in_order_from_as_many_processes_as_there_are_threads(count: int) -> None:
    made = list(parallel_map(lambda index: (index, os.getpid(), torch.get_num_threads()), range(500, 0, -1)))
    assert [index for index, _, _ in made] == list(range(500, 0, -1))
    assert {one for _, _, one in made} == {1}
    processes = {process for _, process, _ in made}
    assert len(processes) == count
    assert (os.getpid() in processes) == (count == 1)


def test_few_are_made_here(count: int) -> None:
    assert set(parallel_map(lambda _: os.getpid(), range(20))) == {os.getpid()}
    assert list(parallel_map(str, [])) == []


def test_a_polite_kill_of_all_is_left_to_the_first_process(count: int) -> None:
    def work(index: int) -> int:
        if index == 130 and os.getpid() != first:
            os.kill(os.getpid(), signal.SIGTERM)
        return index

    first = os.getpid()
    assert list(parallel_map(work, range(300))) == list(range(300))


def long_results(tell: Connection) -> None:
    torch.set_num_threads(2)
    for number, (process, _) in enumerate(parallel_map(lambda _: (os.getpid(), bytes(100_000)), range(1000))):
        tell.send(process)
        if number == 100:
            time.sleep(60)


def lives(process: int) -> bool:
    """Also false of one whose end nobody has asked about yet."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{process}/cmdline").read_bytes() != b""
    return False


def test_processes_end_with_the_first_one_however_that_ends() -> None:
    processes = get_context("fork")
    told, tell = processes.Pipe(duplex=False)
    first = processes.Process(target=long_results, args=(tell,))
    first.start()
    try:
        workers = {told.recv() for _ in range(101)}
    finally:
        first.kill()
        first.join()
    assert len(workers) == 2
    until = time.monotonic() + 10
    while any(map(lives, workers)):
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_failure_is_raised_where_it_was_in_the_same_words(count: int) -> None:
    def work(index: int) -> int:
        if index == 130:
            raise SarsplatError("the disk is full; make room")
        return index

    made = parallel_map(work, range(300))
    assert [next(made) for _ in range(130)] == list(range(130))
    with pytest.raises(SarsplatError, match=r"^the disk is full; make room$"):
        next(made)
