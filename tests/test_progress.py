"""Lines of progress where there is no terminal."""

import io
import re
import time

import pytest
from rich.console import Console
from rich.progress import Progress

from sarsplat import progress


def test_the_time_left_is_told_once_something_is_done_here(monkeypatch, capsys) -> None:
    now = iter(range(0, 100, 10))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(now)))
    with progress.progress("sweep", 8) as reporter:
        reporter.start_at(4)  # done before
        reporter.advance(0, "running")
        reporter.advance(2, "box")
    lines = [re.sub(r" +", " ", line).rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines == ["sweep: 4/8", "sweep: 4/8 running", "sweep: 6/8 box 30 s left"]


def test_short_parts_of_long_work_are_not_silent_together(monkeypatch, capsys) -> None:
    now = iter(range(0, 100, 3))  # the work and its parts look at the clock when they begin, and at every step
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(now)))
    with progress.progress("report", 2) as reporter:
        reporter.advance(0, "points")
        with progress.stage("mesh", 3) as part:
            part.advance(1)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["mesh:"]


@pytest.mark.parametrize("width", [60, 80, 110, 200])
@pytest.mark.parametrize(("seconds", "left"), [(1, ""), (10, ""), (60, "0:21:13 left"), (25, "531 s left")])
def test_narrow_terminals_cut_words_and_no_figures(width: int, seconds: float, left: str) -> None:
    """And nothing is foretold of the first twentieth, until it has taken long."""
    console = Console(width=width, file=io.StringIO())
    bar = Progress(*progress._columns(width, 44), console=console)
    reporter = progress.Reporter(20_000, bar, "evaluate /home/someone/data/t72/runs/first-run")
    reporter._begun -= seconds
    reporter.update(900, "distances: points from the visible surface  12345 Gaussians")
    with console.capture() as shown:
        console.print(bar.get_renderable())
    (line,) = shown.get().splitlines()
    assert "900/20000" in line
    assert "0:00:00" in line  # the bar's own clock
    assert line.rstrip().endswith(left or "0:00:00")


def test_a_tally_says_where_the_time_went() -> None:
    with progress.tally() as spent, progress.progress("work", 3, quiet=True) as shown:
        time.sleep(0.12)
        shown.advance(1, "digging: a hole")
        time.sleep(0.06)
        shown.advance(1, "digging: another")
        shown.advance(1)
    assert spent["digging"] >= 0.18 > spent["work"]
    assert re.fullmatch(r"\d\.\d s \(digging \d\.\d s\)", str(spent))
    with progress.progress("work", 1, quiet=True) as shown:
        shown.advance(1, "unasked")
    assert "unasked" not in spent
