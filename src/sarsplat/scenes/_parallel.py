"""Ordered results of work on several threads, with progress within each item; Ctrl-C ends it at once."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Event
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

_SECONDS_BETWEEN_REPORTS = 0.2


class _Ended(Exception):
    """Signal to a thread that its result is no longer needed."""


def in_order(
    work: Callable[[Item, Callable[[float], object]], Result],
    items: Sequence[Item],
    progress: Callable[[float], object] | None = None,
) -> Iterator[Result]:
    """Yield `work(item, report)` for each item, computed on as many threads as PyTorch has.

    `work` calls `report` often with its finished share; `progress` gets the sum of these shares.
    """
    done, end = [0.0] * len(items), Event()

    def task(index: int) -> Result:
        def report(share: float) -> None:
            if end.is_set():
                raise _Ended
            done[index] = min(share, 0.99)  # 1 once the result is yielded

        return work(items[index], report)

    pool = ThreadPoolExecutor(torch.get_num_threads())
    try:
        futures = [pool.submit(task, index) for index in range(len(items))]
        for index, future in enumerate(futures):
            while wait([future], timeout=_SECONDS_BETWEEN_REPORTS).not_done:
                if progress is not None:
                    progress(index + sum(done[index:]))
            yield future.result()
    finally:
        end.set()
        pool.shutdown(cancel_futures=True)
