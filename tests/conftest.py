"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

# before torch is loaded: threads that spin while they wait stall everyone on a shared machine
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest

import shapes
from sarsplat.renderer import cpu

shapes.watch()

# `make sanitize` runs the renderer's tests on an engine of its own making
if (engine := os.environ.get("SARSPLAT_TEST_ENGINE")) is not None:
    cpu.LIBRARY = Path(engine)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """How much of what is written about shapes was seen to hold."""
    calls = shapes.EXECUTED
    if calls:
        terminalreporter.write_line(
            f"shape annotations of {len(calls)} functions and classes held in {calls.total()} calls"
        )
