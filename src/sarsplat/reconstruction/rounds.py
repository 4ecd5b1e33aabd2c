"""Rounds of what happens now and then in a training."""

from __future__ import annotations


def at_round(iteration: int, first: float, last: float, steps: int) -> bool:
    """Whether an iteration is one of `steps` + 1 evenly spaced ones, the first and the last included.

    However many there are, only those near the iteration are looked at.
    """
    if steps == 0 or first == last:
        return iteration == round(first)
    near = min(max(round((iteration - first) * steps / (last - first)), 0), steps)
    around = range(max(0, near - 1), min(steps, near + 1) + 1)
    return any(iteration == round(first + (last - first) * k / steps) for k in around)
