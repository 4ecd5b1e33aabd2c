"""Progress of long work: a bar on a terminal, plain lines elsewhere."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from datetime import timedelta
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Column

T = TypeVar("T")

_SECONDS_BETWEEN_LINES = 4.0  # steps of a second then print within five
_FIGURES = 36  # width of the numbers and times of a bar with blanks, columns of the terminal

_TRUSTED_S, _TRUSTED_SHARE, _PATIENCE_S = 2.0, 0.1, 20.0
"""Seconds and share of the work after which the time left is estimated, and seconds after which it is in any case: the
first steps are often quicker or, while caches warm up, far slower than the rest."""

_current: "ContextVar[Reporter | None]" = ContextVar("_current", default=None)  # progress on display

_tally: "ContextVar[Tally | None]" = ContextVar("_tally", default=None)  # tally of the enclosing `tally` block


class Tally(dict[str, float]):
    """Seconds by kind of work, which is the reported status up to its colon."""

    def __init__(self) -> None:
        super().__init__()
        self._last = time.monotonic()

    def count(self, work: str) -> None:
        """Attribute the time since the last call to this kind of work."""
        kind, now = work.partition(":")[0], time.monotonic()
        self[kind] = self.get(kind, 0.0) + now - self._last
        self._last = now

    def __str__(self) -> str:
        parts = ", ".join(f"{kind} {seconds:.1f} s" for kind, seconds in self.items() if seconds >= 0.05)
        return f"{sum(self.values()):.1f} s" + (f" ({parts})" if parts else "")


@contextmanager
def _set(variable: ContextVar[Any], value: T) -> Iterator[T]:
    token = variable.set(value)
    try:
        yield value
    finally:
        variable.reset(token)


def tally() -> AbstractContextManager[Tally]:
    """Measure the seconds of each kind of work in the block."""
    return _set(_tally, Tally())


class Reporter:
    """Progress of one kind of work, as a bar or as lines."""

    def __init__(self, total: int, bar: Progress | None, description: str, quiet: bool = False) -> None:
        self._total, self._bar, self._description, self._quiet = total, bar, description, quiet
        self._task = bar.add_task(description, total=total, status="", left="") if bar else None
        self._begun = time.monotonic()
        self._spoken = [self._begun]  # time of the last line, in a list that parts share
        self._first = self._done = 0.0
        self._ended = False

    def part(self, description: str, total: int) -> "Reporter":
        """Return a reporter of a part of the work, with its own bar."""
        inner = Reporter(total, self._bar, description, self._quiet)
        inner._spoken = self._spoken  # so that the interval holds across parts
        return inner

    def note(self, text: str) -> None:
        """Print a line that stays."""
        if self._bar is not None:
            self._bar.console.print(text, highlight=False)
        elif not self._quiet:
            print(text, flush=True)

    def start_at(self, done: int) -> None:
        """Resume work with `done` steps done."""
        self._first = done
        self.update(done)

    def advance(self, steps: float, status: str = "") -> None:
        """Report `steps` more; `status` is a short text such as the loss."""
        self.update(self._done + steps, status)

    def update(self, done: float, status: str = "") -> None:
        """Report `done` steps of the total, perhaps a fraction."""
        self._done = done
        if (counted := _tally.get()) is not None:
            counted.count(status or self._description)
        now = time.monotonic()
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, status=status, left=self._left(now))
            return
        if self._quiet or self._ended or (now - self._spoken[0] < _SECONDS_BETWEEN_LINES and done < self._total):
            return
        self._spoken[0], self._ended = now, done >= self._total  # print the last line once
        left = self._left(now)
        print(f"{self._description}: {int(done)}/{self._total}  {status}{left and f'  {left}'}", flush=True)

    def _left(self, now: float) -> str:
        """Return the estimated time left as text, or an empty one."""
        steps = self._done - self._first  # steps of this process
        took_s, share = now - self._begun, steps / max(1, self._total - self._first)
        if steps <= 0 or (took_s < _PATIENCE_S and (took_s < _TRUSTED_S or share < _TRUSTED_SHARE)):
            return ""
        left_s = round(took_s / steps * max(0, self._total - self._done))
        return f"{timedelta(seconds=left_s)} left" if left_s >= 600 else f"{left_s} s left"


class PartOfSteps(Reporter):
    """Reporter of a part of the work, whose steps follow the first `before` steps that `outer` reports."""

    def __init__(self, outer: Reporter, before: int, name: str) -> None:
        self._outer, self._before, self._name = outer, before, name

    def note(self, text: str) -> None:
        self._outer.note(text)

    def start_at(self, done: int) -> None:
        self._outer.start_at(self._before + done)

    def update(self, done: float, status: str = "") -> None:
        self._outer.update(self._before + done, f"{self._name}  {status}")


@contextmanager
def progress(description: str, total: int, quiet: bool = False) -> Iterator[Reporter]:
    """Show progress of `total` steps while the block runs, unless `quiet`."""
    console = Console()
    with ExitStack() as stack:
        bar = None
        if not quiet and console.is_terminal:
            bar = stack.enter_context(Progress(*_columns(console.width, len(description)), console=console))
        yield stack.enter_context(_set(_current, Reporter(total, bar, description, quiet)))


def _columns(width: int, described: int) -> Iterator[ProgressColumn]:
    """Return the columns of a bar; on a narrow terminal texts are cut, numbers are not."""
    shared = max(width - _FIGURES, 0)  # of the bar and two texts
    bar, description = min(40, shared // 6), min(max(described, shared // 3), shared * 9 // 20)
    yield _text("{task.description}", description)
    yield BarColumn(bar)
    yield MofNCompleteColumn()
    yield _text("{task.fields[status]}", shared - bar - description)
    yield TimeElapsedColumn()
    yield TextColumn("{task.fields[left]}")


def _text(template: str, widest: int) -> TextColumn:
    return TextColumn(template, table_column=Column(no_wrap=True, overflow="ellipsis", max_width=widest))


@contextmanager
def stage(description: str, total: int) -> Iterator[Reporter]:
    """Show a long part of the current work in a separate bar or lines; quiet outside of `progress`."""
    outer = _current.get()
    if outer is None:
        yield Reporter(total, None, description, quiet=True)
        return
    yield outer.part(description, total)
