"""The emulated CUDA engine, compiled once."""

from __future__ import annotations

from pathlib import Path

import pytest
from emulated_cuda import compile_emulator


@pytest.fixture(scope="session")
def library(request: pytest.FixtureRequest) -> Path:
    pytest.importorskip("ziglang", reason="the emulator is compiled with ziglang")
    return compile_emulator(Path(request.config.cache.mkdir("cuda-emulator")))
