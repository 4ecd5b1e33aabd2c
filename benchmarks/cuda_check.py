"""Proof and pace of the CUDA engine, to run where a GPU is: `python benchmarks/cuda_check.py`.

The scenes of the tests against the float64 reference, twice for equal bits; milliseconds per view for 15,000 Gaussians
with 24 views at a time, kernel by kernel; a million Gaussians on 2048 × 2048 pixels. Results go to
`benchmarks/results/cuda-<device>.json`. Needs pytest besides the package, and no compiler.
"""

from __future__ import annotations

import json
import re
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "tests" / "render"))

from named_scenes import MATRIX, Scene, cloud  # noqa: E402
from test_cpu_engine import NOTHING_TO_SEE, judged, relative  # noqa: E402
from test_cuda_native import on_gpu  # noqa: E402

from sarsplat.gaussians import Gaussians  # noqa: E402
from sarsplat.geometry import ImageGrid, View  # noqa: E402
from sarsplat.render import render  # noqa: E402
from sarsplat.render.cuda_device import Device, device, require_cuda  # noqa: E402
from sarsplat.render.nvrtc import Nvrtc  # noqa: E402

VIEWS = tuple(View(45.0 * k, grazing) for grazing in (15.0, 45.0, 75.0) for k in range(8))
WORKLOADS: dict[str, tuple[Callable[[], Scene], int]] = {
    "15,000 Gaussians, 128 x 128, 24 views": (
        lambda: Scene(
            cloud(15_000, 1, size=(6.4, 3.3, 2.2), scale=0.06, kappa=(0.01, 4.0)),
            VIEWS,
            ImageGrid(128, 128, spacing=(0.3, 0.3), resolution=(0.3, 0.3)),
        ),
        50,
    ),
    "1,000,000 Gaussians, 2048 x 2048, 1 view": (
        lambda: Scene(
            cloud(1_000_000, 2, size=(200.0, 200.0, 10.0), scale=0.1, kappa=(0.01, 4.0)),
            VIEWS[8:9],
            ImageGrid(2048, 2048, spacing=(0.1, 0.1), resolution=(0.15, 0.15)),
        ),
        10,
    ),
}


def proof() -> dict[str, dict[str, float]]:
    """Largest relative errors of every scene; stops at bits that differ from run to run."""
    found = {}
    for name in MATRIX:
        scene, values, norms, gradients, _ = judged(name)
        mine, again = on_gpu(scene, norms), on_gpu(scene, norms)
        for output, tensor in mine.items():
            if tensor is not None and not torch.equal(tensor.view(torch.int32), again[output].view(torch.int32)):
                raise SystemExit(f"{name}: {output} differs from run to run")
        valid = {output: ~torch.isnan(value) for output, value in values.items()}
        compared = {k: relative(mine[k][valid[k]], value[valid[k]]) for k, value in values.items()}
        judged_gradients = {} if name in NOTHING_TO_SEE else {k: v for k, v in gradients.items() if v is not None}
        found[name] = {
            "values": max(compared.values()),
            "gradients": max((relative(mine[k], v) for k, v in judged_gradients.items()), default=0.0),
        }
        print(f"  {name:24} values {found[name]['values']:.1e}, gradients {found[name]['gradients']:.1e}")
    return found


class Stopwatch:
    """GPU time of every kernel, between events around its launch."""

    def __init__(self, gpu: Device) -> None:
        self._launch, self._gpu = gpu.launch, gpu
        self._events: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    def __enter__(self) -> Stopwatch:
        def launch(name: str, *arguments: object) -> None:
            begun, done = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            begun.record()
            self._launch(name, *arguments)
            done.record()
            self._events.append((name, begun, done))

        self._gpu.launch = launch
        return self

    def __exit__(self, *_: object) -> None:
        self._gpu.launch = self._launch
        torch.cuda.synchronize()

    def spent(self, repeats: int) -> dict[str, float]:
        """Milliseconds of each kernel in one of `repeats` steps."""
        total: dict[str, float] = {}
        for name, begun, done in self._events:
            total[name] = total.get(name, 0.0) + begun.elapsed_time(done) / repeats
        return total


def pace(scene: Scene, repeats: int) -> dict[str, object]:
    """Forward and backward to every Gaussian: milliseconds per view, by kernel, and the memory taken."""
    moved = scene.gaussians.to("cuda")
    leaves = Gaussians(*(t.requires_grad_() for t in moved.tensors().values()), p_min=moved.p_min)
    views, grid = len(scene.views), scene.grid
    seed = torch.rand(views, grid.rows, grid.columns, device="cuda")

    def step() -> None:
        images = render(leaves, scene.views, grid, engine="cuda").images
        torch.autograd.grad(images, list(leaves.tensors().values()), seed)

    for _ in range(3):
        step()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    samples = []
    for _ in range(repeats):
        begun = time.perf_counter()
        step()
        torch.cuda.synchronize()
        samples.append(1e3 * (time.perf_counter() - begun))
    memory = torch.cuda.max_memory_allocated()
    with Stopwatch(device(leaves.means.device.index)) as watch:
        for _ in range(repeats):
            step()
    kernels = {name: ms / views for name, ms in watch.spent(repeats).items()}
    deciles = statistics.quantiles(samples, n=10)
    result = {
        "ms_per_view": statistics.median(samples) / views,
        "ms_per_view_fastest": min(samples) / views,
        "ms_per_view_90_percent": deciles[-1] / views,
        "kernel_ms_per_view": kernels,
        "peak_bytes": memory,
    }
    print(f"  {result['ms_per_view']:.3f} ms a view (fastest {result['ms_per_view_fastest']:.3f}), {memory >> 20} MiB")
    for name, ms in kernels.items():
        print(f"    {name:26} {ms:.4f}")
    return result


def main() -> None:
    """Run everything and write it down."""
    require_cuda()
    name = torch.cuda.get_device_name()
    print(f"{name}, torch {torch.__version__}, NVRTC {Nvrtc().version}")
    results: dict[str, object] = {"device": name, "torch": torch.__version__, "nvrtc": Nvrtc().version}
    results["largest relative error"] = proof()
    for title, (make, repeats) in WORKLOADS.items():
        print(title)
        results[title] = pace(make(), repeats)
    path = REPOSITORY / "benchmarks" / "results" / f"cuda-{re.sub('[^a-z0-9]+', '-', name.lower())}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(results, indent=2) + "\n")
    print(path)


if __name__ == "__main__":
    main()
