"""Proof and pace of the CUDA engine, to run where a GPU is.

The scenes of the tests against the float64 reference, twice for equal bits; milliseconds per view for 15,000 Gaussians
with 24 views at a time, kernel by kernel; a million Gaussians on 2048 × 2048 pixels; the share of the device's own
rate; gsplat beside it where it is installed; the demo trained on the GPU, with time and scores, and what a step takes
(`cuda_training.py`, which needs the extras). Results go to `benchmarks/results/cuda-<device>.json`. Needs pytest
besides the package, and no compiler.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from clock import Spread, in_turn, spread
from naive_torch import count_pairs
from results import REPOSITORY, RESULTS, save
from scene import Scene
from work import FLOPS

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.renderer import render
from sarsplat.renderer.cuda_device import Device, device, require_cuda
from sarsplat.renderer.nvrtc import Nvrtc

sys.path.insert(
    0, str(REPOSITORY / "tests" / "renderer")
)  # whose modules are imported where a GPU is: they need pytest

VIEWS = tuple(View(45.0 * k, grazing) for grazing in (15.0, 45.0, 75.0) for k in range(8))
REPEATS = {"training": 50, "million": 10}
STEP_AIM_S = 0.2e-3  # of a view in a training step


def workload(title: str) -> Scene:
    """What is measured: Gaussians as in training, in 24 views, or a million of them in one."""
    from named_scenes import cloud

    if title == "training":
        gaussians = cloud(15_000, 1, size=(6.4, 3.3, 2.2), scale=0.06, kappa=(0.01, 4.0))
        return Scene(gaussians, VIEWS, ImageGrid(128, 128, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3)))
    gaussians = cloud(1_000_000, 2, size=(200.0, 200.0, 10.0), scale=0.1, kappa=(0.01, 4.0))
    return Scene(gaussians, VIEWS[8:9], ImageGrid(2048, 2048, spacing_m=(0.1, 0.1), resolution_m=(0.15, 0.15)))


def proof() -> dict[str, dict[str, float]]:
    """Largest relative errors of every scene; stops at bits that differ from run to run."""
    from named_scenes import MATRIX
    from test_cpu_engine import NOTHING_TO_SEE, judged, relative
    from test_cuda_native import on_gpu

    measured = {}
    for name in MATRIX:
        scene, values, norms, gradients, _ = judged(name)
        mine, again = on_gpu(scene, norms), on_gpu(scene, norms)
        for output, tensor in mine.items():
            if tensor is not None and not torch.equal(tensor.view(torch.int32), again[output].view(torch.int32)):
                raise SystemExit(f"{name}: {output} differs from run to run")
        valid = {output: ~torch.isnan(value) for output, value in values.items()}
        compared = {k: relative(mine[k][valid[k]], value[valid[k]]) for k, value in values.items()}
        judged_gradients = {} if name in NOTHING_TO_SEE else {k: v for k, v in gradients.items() if v is not None}
        measured[name] = {
            "values": max(compared.values()),
            "gradients": max((relative(mine[k], v) for k, v in judged_gradients.items()), default=0.0),
        }
        print(f"  {name:24} values {measured[name]['values']:.1e}, gradients {measured[name]['gradients']:.1e}")
    return measured


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


def on_device(scene: Scene) -> Gaussians:
    """The Gaussians on the GPU, differentiable."""
    moved = scene.gaussians.to("cuda")
    return moved.with_tensors(**{name: tensor.requires_grad_() for name, tensor in moved.tensors().items()})


def timed(programs: dict[str, Callable[[], object]], repeats: int, views: int) -> dict[str, Spread]:
    """Seconds per view of each, in turn, until the GPU is done."""

    def finished(program: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            program()
            torch.cuda.synchronize()

        return run

    samples = in_turn({name: finished(program) for name, program in programs.items()}, repeats)
    return {name: spread([second / views for second in seconds]) for name, seconds in samples.items()}


def peak_flop_s() -> float:
    """What the device can do: a product of float32 matrices, not rounded to TF32."""
    torch.backends.cuda.matmul.allow_tf32 = False
    side = 8192
    factors = torch.rand(2, side, side, device="cuda")
    return 2 * side**3 / timed({"multiply": lambda: torch.mm(*factors)}, 10, 1)["multiply"]["median"]


def pace(scene: Scene, repeats: int, peak: float) -> dict[str, Any]:
    """Forward and backward to every Gaussian: seconds per view, by kernel, share of the peak, and the memory taken."""
    leaves = on_device(scene)
    views, grid = len(scene.views), scene.grid
    seed = torch.rand(views, grid.rows, grid.columns, device="cuda")

    def step() -> None:
        images = render(leaves, scene.views, grid, engine="cuda").channel(0)
        torch.autograd.grad(images, list(leaves.tensors().values()), seed)

    step()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    seconds = timed({"engine": step}, repeats, views)["engine"]
    memory = torch.cuda.max_memory_allocated()
    with Stopwatch(device(leaves.means.device.index)) as watch:
        for _ in range(repeats):
            step()
    pairs = [count_pairs(scene.gaussians, view, grid, RayGrid.for_image(grid)) for view in scene.views]
    flops = statistics.mean(sum(each[plane] * FLOPS[plane] for plane in FLOPS) for each in pairs)
    return {
        "gaussians": len(scene.gaussians),
        "side": grid.rows,
        "views": views,
        "view_s": seconds,
        "kernel_ms_per_view": {name: ms / views for name, ms in watch.spent(repeats).items()},
        "peak_bytes": memory,
        "flops_per_view": flops,
        "share_of_peak": flops / seconds["median"] / peak,
    }


def training() -> dict[str, Any] | None:
    """`cuda_training`, or None where the package is without its extras."""
    try:
        import cuda_training
    except ImportError as error:
        print(f"no training: {error}; install the whole package with pip install 'sarsplat[all]'")
        return None
    measured = cuda_training.measure()
    for place, scores in measured["demo"].items():
        print(f"demo on {place}: " + ", ".join(f"{name} {value:.4g}" for name, value in scores.items()))
    for name, step in measured["steps"].items():
        view_s = step["step_s"]["median"] / step["views"]
        print(
            f"step of preset {name}: {1e3 * view_s:.3f} ms a view, {view_s / STEP_AIM_S:.2f} × the aim; "
            f"the CPU waits {step['waits']} times; {'the same' if step['same_bits'] else 'OTHER'} bits the second time"
        )
        print(step["profile"])
    return measured


def beside_gsplat(scene: Scene, repeats: int) -> dict[str, Any] | None:
    """An optical rasteriser in orthographic mode on the same Gaussians and image size, or None if it is not installed.

    It has one plane to our two, and alpha instead of optical depth.
    """
    try:
        from gsplat import rasterization
    except ImportError:
        return None
    leaves, grid, count = on_device(scene), scene.grid, len(scene.views)
    cameras = torch.eye(4, device="cuda").repeat(count, 1, 1)
    for camera, view in zip(cameras, scene.views, strict=True):
        camera[:3, :3] = torch.from_numpy(radar_frame(view))
        camera[2, 3] = 1000.0  # m: all of the scene is in front
    half = (grid.columns / 2, grid.rows / 2)
    lens = torch.tensor([[1 / grid.spacing_m[0], 0, half[0]], [0, 1 / grid.spacing_m[1], half[1]], [0, 0, 1]])
    lenses = lens.cuda().repeat(count, 1, 1)
    colours = torch.rand(len(scene.gaussians), 3, device="cuda", requires_grad=True)
    seed = torch.rand(count, grid.rows, grid.columns, device="cuda")

    def optical() -> None:
        images, *_ = rasterization(
            leaves.means,
            leaves.quaternions,
            leaves.scales,
            -torch.expm1(-leaves.optical_depth),
            colours,
            cameras,
            lenses,
            grid.columns,
            grid.rows,
            camera_model="ortho",
            far_plane=1e5,
        )
        wanted = [leaves.means, leaves.quaternions, leaves.scales, leaves.optical_depth, colours]
        torch.autograd.grad(images, wanted, seed[..., None].expand_as(images))

    def radar() -> None:
        images = render(leaves, scene.views, grid, engine="cuda").channel(0)
        torch.autograd.grad(images, list(leaves.tensors().values()), seed)

    view_s = timed({"gsplat": optical, "engine": radar}, repeats, count)
    return {"view_s": view_s, "gsplat / engine": view_s["gsplat"]["median"] / view_s["engine"]["median"]}


def main(folder: Path = RESULTS) -> None:
    """Run everything, print it and write it down."""
    name = torch.cuda.get_device_name()
    print(f"{name}, torch {torch.__version__}, NVRTC {Nvrtc().version}")
    results: dict[str, Any] = {"device": name, "torch": torch.__version__, "nvrtc": Nvrtc().version}
    results["largest_relative_error"] = proof()
    results["peak_flop_s"] = peak_flop_s()
    results["workloads"] = {}
    for title, repeats in REPEATS.items():
        measured = results["workloads"][title] = pace(workload(title), repeats, results["peak_flop_s"])
        print(
            f"{measured['gaussians']:,} Gaussians, {measured['side']}², {measured['views']} views: "
            f"{1e3 * measured['view_s']['median']:.3f} ms a view, {measured['peak_bytes'] >> 20} MiB, "
            f"{100 * measured['share_of_peak']:.1f} % of the device's {results['peak_flop_s'] / 1e12:.1f} TFlop/s"
        )
        for kernel, ms in measured["kernel_ms_per_view"].items():
            print(f"    {kernel:26} {ms:.4f} ms")
    beside = results["gsplat"] = beside_gsplat(workload("training"), REPEATS["training"])
    print(f"gsplat / engine: {beside['gsplat / engine']:.2f}" if beside else "gsplat is not installed")
    results["training"] = training()
    path = folder / f"cuda-{re.sub('[^a-z0-9]+', '-', name.lower())}.json"
    save(path, results)
    print(path)


def missing() -> str | None:
    """What stands in the way, in one sentence."""
    try:
        require_cuda()
    except SarsplatError as error:
        reason = str(error).partition(";")[0]
        return f"cuda_check runs only where there is an NVIDIA GPU: {reason}; the CPU is measured by `make bench`"
    if importlib.util.find_spec("pytest") is None:
        return "cuda_check takes its scenes from the tests, which need pytest; install it with `pip install pytest`"
    return None


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    if sentence := missing():
        print(sentence, file=sys.stderr)
        sys.exit(2)
    main()
