"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

from sarsplat.render import cpu

# `make sanitize` runs the renderer's tests on an engine of its own making
if (engine := os.environ.get("SARSPLAT_TEST_ENGINE")) is not None:
    cpu.LIBRARY = Path(engine)
