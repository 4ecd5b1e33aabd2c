"""Programs of this repository: run by an interpreter of their own, or imported as modules."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]

COMMANDS = """
import json, sys
from sarsplat.cli import main
for words in json.load(sys.stdin):
    try:
        print("code", main(words), flush=True)
    except SystemExit as ended:
        print("code", ended.code, flush=True)
"""


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """What a fresh interpreter does with these words."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **{"timeout": 600, **options})


def sarsplat(site: Path, *commands: str) -> subprocess.CompletedProcess[str]:
    """Commands one after the other, in a process that finds the packages in a folder and runs beside it."""
    path = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    words = json.dumps([shlex.split(command) for command in commands])
    return python("-c", COMMANDS, cwd=site.parent, env={**os.environ, "PYTHONPATH": path}, input=words)
