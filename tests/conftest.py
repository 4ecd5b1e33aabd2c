"""What all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# before torch is loaded: threads that spin while they wait stall everyone on a shared machine
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest
import torch

import shapes
from sarsplat.renderer import cpu

shapes.watch()

# `make sanitize` runs the renderer's tests on an engine of its own making
if (engine := os.environ.get("SARSPLAT_TEST_ENGINE")) is not None:
    cpu.LIBRARY = Path(engine)


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """Sets torch's thread count; the old one comes back."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """One of several processes tells the first what it counted."""
    if (output := getattr(session.config, "workeroutput", None)) is not None:
        output["shapes"] = dict(shapes.EXECUTED)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: object) -> None:
    """The first process adds it up."""
    shapes.EXECUTED.update(getattr(node, "workeroutput", {}).get("shapes", {}))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """How much of what is written about shapes was seen to hold."""
    calls = shapes.EXECUTED
    if calls:
        terminalreporter.write_line(
            f"shape annotations of {len(calls)} functions and classes held in {calls.total()} calls"
        )
