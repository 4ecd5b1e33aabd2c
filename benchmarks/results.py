"""Where results are kept, and of which machine they are: never its name, never a path."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import torch

REPOSITORY = Path(__file__).resolve().parent.parent
RESULTS = REPOSITORY / "benchmarks" / "results"


def machine() -> dict[str, Any]:
    """The processor, what runs on it, and how busy it is before anything of ours runs."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "date": date.today().isoformat(),
        "load": os.getloadavg()[0],
    }


def _processor() -> str:
    """The model by the kernel's account, or the architecture."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def save(path: Path, results: Mapping[str, Any]) -> None:
    """Write whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(json.dumps(results, indent=1, ensure_ascii=False) + "\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def add_rows(path: Path, words: Sequence[str], sides: Sequence[int]) -> None:
    """Add to a file the row of each side that it lacks, as they finish: `python WORDS SIDE --alone` prints it."""
    held: dict[str, Any] = {"machine": machine(), "rows": []}
    if path.exists():
        held = json.loads(path.read_text(encoding="utf-8"))
    for side in sides:
        if side in {row["side"] for row in held["rows"]}:
            continue
        command = [sys.executable, *words, str(side), "--alone"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if ended.returncode:
            raise SystemExit(f"{path.stem}, {side}²: {ended.stderr[-2000:]}")
        held["rows"] = sorted([*held["rows"], json.loads(ended.stdout.splitlines()[-1])], key=lambda row: row["side"])
        save(path, held)
        print(f"{path.stem}, {side}²: {held['rows'][-1]}", flush=True)
