"""What the CUDA engine does on a GPU, section by section, in eight minutes at most: proof, pace, and where time goes.

Results go to `benchmarks/results/cuda-<device>.json` whenever something is found, so that minutes on a machine are
enough; performance_page.py shows them. A section that fails says why, and the next one follows; one that would not fit
into the time left is left out. Needs pytest besides the package with all its extras; without these, the sections that
need none still run.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

import torch
from clock import Clock, spread
from gpu import ALL_SIDES, Gpu
from naive_torch import count_pairs
from results import RESULTS, machine, save
from work import FLOPS

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.renderer.engines.cuda_device import require_cuda

Found = Iterator[tuple[str, Any]]

BUDGET_S = 480.0
WARM_UP = 20  # steps
TOOL_S = 60  # of compute-sanitizer
TINY = (
    "from sarsplat.renderer.engines import cuda_device, trial; "
    "raise SystemExit(trial._disagreement(cuda_device.device(0)) or None)"
)


def of_the_machine(gpu: Gpu) -> Found:
    """The GPU, the machine around it, bytes copied and multiply-adds in a second."""
    yield "gpu", gpu.properties()
    yield "host", machine()
    size = gpu.few(1 << 30, 1 << 16)
    source, copy = torch.empty(2, size, dtype=torch.uint8, device=gpu.device)
    copying = statistics.median(gpu.seconds(lambda: copy.copy_(source), 10))
    yield "bandwidth_bytes_s", 2 * size / copying
    yield "peak_flop_s", gpu.peak_flop_s()


def of_scenes(gpu: Gpu) -> Found:
    """The tests' scenes: largest relative errors against the float64 reference, and whether bits stay the same."""
    from compared import relative
    from named_scenes import MATRIX
    from test_cpu_engine import NOTHING_TO_SEE, judged
    from test_cuda_emulated import on_gpu

    for name in list(MATRIX)[: gpu.few(len(MATRIX), 2)]:
        scene, values, norms, gradients, _ = judged(name)
        mine, again = (on_gpu(scene, norms, gpu.device) for _ in range(2))
        same = all(t is None or torch.equal(t.view(torch.int32), again[k].view(torch.int32)) for k, t in mine.items())
        valid = {output: ~torch.isnan(value) for output, value in values.items()}
        errors = [relative(mine[k][valid[k]], value[valid[k]]) for k, value in values.items()]
        judged_gradients = {} if name in NOTHING_TO_SEE else {k: v for k, v in gradients.items() if v is not None}
        slopes = [relative(mine[k], v) for k, v in judged_gradients.items()]
        yield name, {"values": max(errors), "gradients": max(slopes, default=0.0), "same_bits": same}


def of_steps(gpu: Gpu) -> Found:
    """A training step without a CUDA graph: in all, per view, by kernel, and whether a second one has the same bits."""
    steps = {
        "default": ("default", "demo"),
        "paper": ("paper", "demo"),
        "measured": ("measured", "ground"),
        "default with ground": ("default", "ground"),
    }
    for name, (preset, kind) in steps.items():
        trainer, again = (gpu.trainer(preset, kind, recorded=False) for _ in range(2))
        for _ in range(gpu.few(WARM_UP, 1)):
            trainer.step()
            again.step()
        learned, other = trainer.model.parameters, again.model.parameters
        same = all(torch.equal(other[key], tensor) for key, tensor in learned.items())
        size = {"gaussians": len(trainer.model), "same_bits": same}
        yield name, size | gpu.paced(trainer.step, trainer.config.views_per_step, gpu.few(100, 1))


def of_recording(gpu: Gpu) -> Found:
    """Steps replayed as a CUDA graph beside the same ones without: bits after 50, and time."""
    steps = {name: (name, "demo") for name in ("default", "quick", "speckled", "paper")}
    steps |= {"measured": ("measured", "ground")}
    steps |= {f"default with {kind}": ("default", kind) for kind in ("ground", "terrain")}
    for name, (preset, kind) in steps.items():
        by_itself, launched = gpu.trainer(preset, kind), gpu.trainer(preset, kind, recorded=False)
        losses = [[trainer.step() for trainer in (by_itself, launched)] for _ in range(gpu.few(50, 4))]
        learned, other = by_itself.model.parameters, launched.model.parameters
        same = all(torch.equal(*pair) for pair in losses)
        same = same and all(torch.equal(other[key], tensor) for key, tensor in learned.items())
        times = {
            f"{how}_ms": 1e3 * spread(gpu.seconds(trainer.step, gpu.few(100, 1)))["median"]
            for how, trainer in (("recorded", by_itself), ("launched", launched))
        }
        busy = gpu.busy_ms(by_itself.step, gpu.few(20, 1))
        yield name, {"recorded": by_itself.records, "same_bits": same, "busy_ms": busy, **times}


def of_the_paper(gpu: Gpu) -> Found:
    """The paper's training of the demo's images, a tenth of it and whole, from the first step to the last."""
    for iterations in (gpu.few(3_000, 3), gpu.few(30_000, 4)):
        trainer = gpu.trainer("paper", iterations=iterations)
        begun = time.perf_counter()
        for _ in range(iterations):
            trainer.step()
        gpu.synchronise()
        yield f"{iterations} iterations", {"training_s": time.perf_counter() - begun, "gaussians": len(trainer.model)}


def of_kernels(gpu: Gpu) -> Found:
    """Time by kernel: steps of the demo with coarse and with fine rays and of the paper; many views, many Gaussians."""
    steps = {"demo, 2 rays": ("default", 1.0), "demo, 4 rays": ("default", 0.0), "paper": ("paper", 1.0)}
    for name, (preset, fine_from) in steps.items():
        trainer = gpu.trainer(preset, recorded=False, fine_from=fine_from)
        for _ in range(gpu.few(WARM_UP, 1)):
            trainer.step()
        size = {"gaussians": len(trainer.model), "side": trainer.grid.rows}
        yield name, size | gpu.paced(trainer.step, trainer.config.views_per_step, gpu.few(50, 1))
    per_view_ms, scenes = {}, {"training": gpu.many_views(), "million": gpu.many_gaussians()}
    for (name, scene), repeats in zip(scenes.items(), (50, 10), strict=True):
        size = {"gaussians": len(scene.gaussians), "side": scene.grid.rows}
        found = gpu.paced(gpu.image_and_gradients(scene), len(scene.views), gpu.few(repeats, 1))
        yield name, size | found
        per_view_ms[name] = found["per_view_ms"]
    peak = gpu.peak_flop_s()
    for name, scene in scenes.items():  # last, for a million are counted by the CPU for half a minute
        pairs = [count_pairs(scene.gaussians, view, scene.grid, scene.rays) for view in scene.views]
        flops = statistics.mean(sum(each[plane] * FLOPS[plane] for plane in FLOPS) for each in pairs)
        share = flops / (1e-3 * per_view_ms[name]) / peak
        yield f"{name}: arithmetic", {"flops_per_view": flops, "share_of_peak": share}


def of_the_demo(gpu: Gpu) -> Found:
    """The demo from its images to its scores, stage by stage, on the GPU and on all cores beside it."""
    from sarsplat.evaluation import evaluate_run

    for place, where in (("cuda", gpu.device), ("cpu", "cpu")):
        run, stages = gpu.trained(gpu.dataset("demo"), "default", where)
        clock = Clock()
        clock.wrap("mesh_s", run.mesh)()
        metrics = clock.wrap("scores_s", lambda run=run: evaluate_run(run, quiet=True))()
        points = metrics["points"]["visible"]
        scores = {"psnr_db": metrics["images"]["test"]["psnr_db"], "chamfer_m": points["cd_m"], "f1": points["f1@0.3"]}
        yield place, stages | clock.spent | scores


def of_waits(gpu: Gpu) -> Found:
    """How often, and in which line, a step of every preset makes Python wait for the GPU."""
    from sarsplat.settings.presets import PRESETS

    kinds = {"scene": "ground", "measured": "ground", "stack": "stack", "polarimetric": "polarimetric"}
    steps = {f"default with {kind}": ("default", kind) for kind in ("ground", "terrain")}
    steps |= {name: (name, kinds.get(name, "demo")) for name in PRESETS}
    for name, (preset, kind) in steps.items():
        trainer = gpu.trainer(preset, kind)
        for _ in range(gpu.few(3, 1)):
            trainer.step()
        yield name, gpu.waits(trainer.step)


def of_a_fleet(gpu: Gpu) -> Found:
    """Small targets to their points, several at a time in threads of one process, as in a sweep: how many a minute."""
    dataset, threads, alone = gpu.dataset("small"), torch.get_num_threads(), None

    def learned(seed: int) -> torch.Tensor:
        run, _ = gpu.trained(dataset, "quick", gpu.device, seed=seed)
        return run.gaussians.means.cpu()

    learned(0)  # compiles, and reads programs from the disk
    torch.set_num_threads(1)
    try:
        for together in (1, 2, 4, 8)[: gpu.few(4, 2)]:
            begun = time.perf_counter()
            with ThreadPoolExecutor(together, initializer=gpu.begin_queue) as pool:
                means = [*pool.map(learned, range(gpu.few(24, 2)))]
            minutes = (time.perf_counter() - begun) / 60
            alone = alone or means
            same = all(map(torch.equal, means, alone))
            yield f"{together}", {"targets": len(means), "per_minute": len(means) / minutes, "same_bits": same}
    finally:
        torch.set_num_threads(threads)


def of_a_village(gpu: Gpu) -> Found:
    """A village of 640 × 640 pixels with two presets, stage by stage; and its points' scores."""
    from sarsplat import Dataset, DatasetEntry
    from sarsplat.evaluation import Yardstick, point_metrics, visible_surface
    from sarsplat.scenes.simulate import simulate_images
    from sarsplat.scenes.village import village

    side, views, clock = gpu.few(640, 48), ALL_SIDES[:: gpu.few(1, 5)], Clock()
    grid = ImageGrid(side, side, (0.3, 0.3), (0.3, 0.3))
    mesh = village(0.64 * 0.3 * side)
    mesh.export(truth := gpu.folder / "village.ply")
    images = clock.wrap("simulate_s", simulate_images)(mesh, views, grid)
    yield "simulated", {"side": side, "faces": len(mesh.faces), **clock.spent}
    entries = tuple(DatasetEntry(view, "train", f"{k:03}") for k, view in enumerate(views))
    dataset = Dataset(grid, entries, images, target="village", truth_mesh=truth)
    yardstick = Yardstick.of(grid)
    surface = visible_surface(mesh, views, yardstick.ray_spacing_m, samples=gpu.few(200_000, 1000))
    for preset in ("quick", "default"):
        run, stages = gpu.trained(dataset, preset, gpu.device)
        scores = point_metrics(run.points, surface.triangles, surface.samples, yardstick)
        yield preset, stages | {f"f1@{threshold:g}": value for threshold, value in scores.f1.items()}


def of_the_sanitizer(gpu: Gpu) -> Found:
    """What compute-sanitizer says of a tiny scene with its gradients."""
    program = shutil.which("compute-sanitizer", path=f"{os.environ.get('PATH', '')}:/usr/local/cuda/bin")
    if program is None:
        raise FileNotFoundError("compute-sanitizer is not on this machine")
    environment = {**os.environ, "PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}  # every array is one of the driver's
    for tool in ("memcheck", "racecheck"):
        command = [program, "--tool", tool, "--error-exitcode", "9", sys.executable, "-c", TINY]
        try:
            ended = subprocess.run(
                command, capture_output=True, text=True, env=environment, timeout=TOOL_S, check=False
            )
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"{tool} was not done after {TOOL_S} s") from None
        said = [line.strip("= ") for line in ended.stdout.splitlines() if "SUMMARY" in line]
        yield tool, {"code": ended.returncode, "said": said}


Section = Callable[[Gpu], Found]
SECTIONS: dict[str, tuple[Section, float]] = {
    "machine": (of_the_machine, 10),
    "scenes": (of_scenes, 60),
    "recording": (of_recording, 60),
    "steps": (of_steps, 45),
    "kernels": (of_kernels, 60),
    "demo": (of_the_demo, 40),
    "waits": (of_waits, 30),
    "paper": (of_the_paper, 30),
    "fleet": (of_a_fleet, 120),
    "village": (of_a_village, 120),
    "sanitizer": (of_the_sanitizer, 120),
}
"""What is measured, in the order of its worth, and about how many seconds each takes."""


def measure(gpu: Gpu, folder: Path, seconds: float = BUDGET_S, only: Sequence[str] = ()) -> Path:
    """Run all sections, or `only` those and leave the others as the file has them; returns the file."""
    results = gpu.about() | {"quick": gpu.quick, "sections": {}}
    name = re.sub("[^a-z0-9]+", "-", results["device"].lower())
    path, end = folder / f"cuda-{name}{'-quick' if gpu.quick else ''}.json", time.monotonic() + seconds
    if only and path.exists():
        results["sections"] = json.loads(path.read_text(encoding="utf-8"))["sections"]
    for name in only or SECTIONS:
        section, needs = SECTIONS[name]
        left, begun = end - time.monotonic(), time.monotonic()
        if left < (0 if gpu.quick else needs):
            print(f"{name}: not run; it takes about {needs:.0f} s, and {max(left, 0):.0f} s are left")
            continue
        print(f"{name} …", flush=True)
        entry: dict[str, Any] = {"done": False, "date": date.today().isoformat(), "seconds": 0.0, "found": {}}
        results["sections"][name] = entry
        try:
            for what, value in section(gpu):
                entry["found"][what], entry["seconds"] = value, time.monotonic() - begun
                save(path, results)
                print(f"  {what}: {shown(value)}", flush=True)
                if time.monotonic() > end:
                    raise TimeoutError("the time was used up")
            entry["done"] = True
        except (Exception, SystemExit) as error:  # whatever it is: the next section may work
            entry["error"] = f"{type(error).__name__}: {error}"
            print(f"  {entry['error']}", flush=True)
        entry["seconds"] = time.monotonic() - begun
        save(path, results)
    return path


def shown(value: Any) -> str:
    """In one line, with four digits."""
    if isinstance(value, dict):
        parts = {name: f"({shown(part)})" if isinstance(part, dict) else shown(part) for name, part in value.items()}
        return ", ".join(f"{name} {part}" for name, part in parts.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def missing() -> str | None:
    """What stands in the way, in one sentence."""
    try:
        require_cuda()
    except SarsplatError as error:
        reason = str(error).partition(";")[0]
        return f"cuda_suite runs only where there is an NVIDIA GPU: {reason}; the CPU is measured by `make bench`"
    if importlib.util.find_spec("pytest") is None:
        return "cuda_suite takes its scenes from the tests, which need pytest; install it with `pip install pytest`"
    return None


def main() -> None:
    """As the command line says."""
    lines = [f"  {name:10} {needs:3.0f} s  {section.__doc__}" for name, (section, needs) in SECTIONS.items()]
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="\n".join(["sections, and about how long they take:", *lines]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="everything, but tiny: a smoke test, in a file of its own")
    parser.add_argument(
        "--seconds", type=float, default=BUDGET_S, help="for all sections together (default: %(default)g)"
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", default=(), choices=SECTIONS, help="these sections")
    parser.add_argument("--out", type=Path, metavar="FOLDER", default=RESULTS, help="where the results are kept")
    arguments = parser.parse_args()
    if sentence := missing():
        print(sentence, file=sys.stderr)
        sys.exit(2)
    on_this_gpu(arguments.out, arguments.seconds, arguments.only, quick=arguments.quick)


def on_this_gpu(folder: Path, seconds: float = BUDGET_S, only: Sequence[str] = (), *, quick: bool = False) -> None:
    """Measure, and say where the results are."""
    with TemporaryDirectory() as scratch:
        print(measure(Gpu(Path(scratch), quick), folder, seconds, only))


if __name__ == "__main__":
    main()
