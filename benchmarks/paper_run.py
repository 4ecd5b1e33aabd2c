"""The whole training of the paper, 30,000 iterations with densification, as the command line runs it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from sarsplat.evaluation import paper_scores
from sarsplat.settings.presets import preset

CODE = "import sys, sarsplat.cli; sys.exit(sarsplat.cli.main())"


def sarsplat(*words: str) -> float:
    """Run a command; returns its seconds."""
    begun = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", CODE, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"sarsplat {' '.join(words)}: {done.stderr}")
    return time.perf_counter() - begun


def measure(quick: bool) -> dict[str, Any]:
    """Simulate, reconstruct and evaluate a T-72; a quick run learns next to nothing, from a few views.

    It starts in the box, because points left on the paper's hemisphere are slow to evaluate.
    """
    views = ("--azimuth", "0:360:120", "--grazing", "45", "--test-azimuth", "60") if quick else ()
    start = ("--initialisation", "box") if quick else ()
    iterations = str(20 if quick else preset("paper").iterations)
    with tempfile.TemporaryDirectory() as folder:
        dataset, run = f"{folder}/dataset", f"{folder}/run"
        steps = {
            "simulate": sarsplat("simulate", "--target", "t72", "--source", "raycast", *views, "--out", dataset),
            "reconstruct": sarsplat(
                "reconstruct", dataset, "--preset", "paper", "--iterations", iterations, *start, "--out", run
            ),
            "evaluate": sarsplat("evaluate", run),
        }
        metrics = json.loads(Path(run, "metrics.json").read_text())
    seconds = metrics["time_s"]
    return {
        "ratios": {
            "the paper's training time, on an RTX 3060 Ti / ours": paper_scores("T72").values["time_s"] / seconds
        },
        "times": {**{f"sarsplat {name}": value for name, value in steps.items()}, "training": seconds},
        "iterations": int(iterations),
        "training_s": seconds,
        "scores": {**metrics["images"]["test"], **metrics["points"]["visible"]},
    }
