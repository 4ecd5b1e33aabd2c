"""Times that can be trusted on a busy machine: contenders run in turns, medians, and the spread beside them."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any, TypedDict

TURN = 8
"""Calls of one program before the next has its turn; the first of them finds its data out of the caches."""


class Spread(TypedDict):
    """A median and how far the samples scatter, in their unit."""

    median: float
    p10: float
    p90: float
    samples: int


def spread(samples: Sequence[float]) -> Spread:
    """Median, and 10th and 90th percentile."""
    deciles = statistics.quantiles(samples, n=10, method="inclusive") if len(samples) > 1 else list(samples) * 9
    return Spread(median=statistics.median(samples), p10=deciles[0], p90=deciles[8], samples=len(samples))


def ratio(numerator: Sequence[float], denominator: Sequence[float]) -> Spread:
    """Ratio of the medians, with the spread of the ratios of neighbours in time."""
    quotients = spread([a / b for a, b in zip(numerator, denominator, strict=True)])
    quotients["median"] = statistics.median(numerator) / statistics.median(denominator)
    return quotients


def in_turn(programs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Seconds of `repeats` calls of each, rounded up to whole turns, and one for each turn that does not count."""
    samples: dict[str, list[float]] = {name: [] for name in programs}
    turn = min(TURN, repeats + 1)
    for _ in range(math.ceil(repeats / (turn - 1))):
        for name, program in programs.items():
            for k in range(turn):
                begun = time.perf_counter()
                program()
                if k:
                    samples[name].append(time.perf_counter() - begun)
    return samples


class Clock:
    """Seconds spent inside named functions."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time added to `name`."""

        @wraps(function)
        def timed(*arguments: object) -> object:
            begun = time.perf_counter()
            result = function(*arguments)
            self.spent[name] = self.spent.get(name, 0.0) + time.perf_counter() - begun
            return result

        return timed

    @contextmanager
    def watching(self, owner: type, methods: dict[str, str]) -> Iterator[None]:
        """Add the time of these methods of a class, {method: name}, while the block runs."""
        originals = {method: getattr(owner, method) for method in methods}
        for method, name in methods.items():
            setattr(owner, method, self.wrap(name, originals[method]))
        try:
            yield
        finally:
            for method, original in originals.items():
                setattr(owner, method, original)
