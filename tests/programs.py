"""Programs that an interpreter of their own runs."""

import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """What a fresh interpreter does with these words."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **{"timeout": 600, **options})
