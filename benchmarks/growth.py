"""How time and memory grow with Gaussians and with pixels; footprints (in pixels) and density are fixed.

Each size runs in a process of its own, so that its peak of memory is its own:
`python benchmarks/growth.py GAUSSIANS SIDE STD_PIXELS SECONDS THREADS` is one. It prints its results as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

import numpy as np
import torch
from clock import spread
from scene import field
from work import flops, measured_rate, visited

Size = tuple[int, int, float]  # Gaussians, pixels of a side, standard deviation in pixels

# many small Gaussians, so that they weigh; and few large ones, so that pixels do
SERIES: dict[str, list[Size]] = {
    "gaussians": [(1_000, 65, 0.2), (10_000, 205, 0.2), (100_000, 648, 0.2), (1_000_000, 2048, 0.2)],
    "pixels": [(side * side // 64, side, 2.0) for side in (128, 256, 512, 1024, 2048, 4096)],
}
QUICK: dict[str, list[Size]] = {name: [(500, 46, 0.2), (1000, 92, 0.2)] for name in SERIES}  # two runs serve both
MEMORY_BOUND = 4 << 30


def resident_bytes() -> tuple[int, int]:
    """Of this process, now and at its peak. (`getrusage` would begin at the peak of whoever started it.)"""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    now, peak = (int(lines[key].split()[0]) << 10 for key in ("VmRSS", "VmHWM"))
    return now, peak


def one(size: Size, budget_s: float) -> dict[str, Any]:
    """Memory of the first forward + backward and the times of those after it."""
    scene = field(*size)
    before, _ = resident_bytes()
    scene.step()
    _, whole = resident_bytes()
    samples: list[float] = []
    while len(samples) < 3 or (sum(samples) < budget_s and len(samples) < 200):
        begun = time.perf_counter()
        scene.step()
        samples.append(time.perf_counter() - begun)
    return {
        "gaussians": size[0],
        "side": size[1],
        "seconds": spread(samples),
        "peak_bytes": whole - before,
        "process_bytes": whole,
        "flops": flops(visited(scene)),
    }


def in_own_process(size: Size, budget_s: float) -> dict[str, Any]:
    """The same, elsewhere."""
    command = [sys.executable, __file__, *map(str, size), str(budget_s), str(torch.get_num_threads())]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{size[0]:,} Gaussians on {size[1]} × {size[1]} pixels failed: {done.stderr}")
    return json.loads(done.stdout)


def slope(sizes: list[float], seconds: list[float]) -> float:
    """Of the straight line through the logarithms: 1 is linear."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def bytes_each(measured: list[dict[str, Any]]) -> dict[str, float]:
    """Peak memory of a Gaussian, of a pixel and of nothing, by least squares of the relative errors."""
    size = np.array([[row["gaussians"], row["side"] ** 2, 1] for row in measured], dtype=float)
    peak = np.array([row["peak_bytes"] for row in measured], dtype=float)
    solution, *_ = np.linalg.lstsq(size / peak[:, None], np.ones(len(peak)), rcond=None)
    return dict(zip(("gaussian", "pixel", "nothing"), solution.tolist(), strict=True))


def measure(quick: bool) -> dict[str, Any]:
    """Both series, their slopes, the floor of each size, and the memory of a Gaussian and of a pixel."""
    series = QUICK if quick else SERIES
    flop_s = measured_rate()
    sizes = dict.fromkeys(size for row in series.values() for size in row)
    by_size = {size: in_own_process(size, 0.05 if quick else 1.5) for size in sizes}
    for row in by_size.values():
        row["floor_s"] = row.pop("flops") / flop_s
    rows = {name: [by_size[size] for size in row] for name, row in series.items()}
    counts = {"gaussians": [float(r["gaussians"]) for r in rows["gaussians"]]}
    counts["pixels"] = [float(r["side"]) ** 2 for r in rows["pixels"]]
    slopes = {name: slope(counts[name], [row["seconds"]["median"] for row in rows[name]]) for name in rows}
    each, largest = bytes_each(list(by_size.values())), rows["gaussians"][-1]
    if largest["process_bytes"] > MEMORY_BOUND:
        raise SystemExit(f"the largest scene takes {largest['process_bytes'] / 2**30:.1f} GiB, more than 4")
    return {
        "ratios": {
            **{f"slope of log time over log {name} (1 is linear)": value for name, value in slopes.items()},
            **{
                f"engine / floor, {row['gaussians']:,} Gaussians, {row['side']}²": row["seconds"]["median"]
                / row["floor_s"]
                for row in by_size.values()
            },
        },
        "times": {f"{row['gaussians']:,} Gaussians, {row['side']}²": row["seconds"] for row in by_size.values()},
        "bytes": {
            **{f"peak of a {name}": each[name] for name in ("gaussian", "pixel")},
            f"whole process, {largest['gaussians']:,} Gaussians, {largest['side']}²": largest["process_bytes"],
        },
        "slopes": slopes,
        "series": rows,
        "bytes_each": each,
        "largest_process_bytes": largest["process_bytes"],
    }


if __name__ == "__main__":
    gaussians, side, std_pixels, budget, threads = sys.argv[1:]
    torch.set_num_threads(int(threads))
    print(json.dumps(one((int(gaussians), int(side), float(std_pixels)), float(budget))))
