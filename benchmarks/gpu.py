"""The GPU that `cuda_suite.py` measures: clocks, counters and work for it; tests put the emulator in its place."""

from __future__ import annotations

import statistics
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from functools import cache, cached_property
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from clock import Clock, in_turn, spread
from results import REPOSITORY
from scene import Scene
from torch.profiler import DeviceType, profile

from sarsplat.geometry import ImageGrid, Terrain, View
from sarsplat.renderer import render
from sarsplat.renderer.engines.cuda_device import Device, device
from sarsplat.renderer.engines.cuda_tiles import TileLists
from sarsplat.renderer.engines.nvrtc import Nvrtc

sys.path.insert(0, str(REPOSITORY / "tests" / "renderer"))  # whose modules need pytest, and are imported when used

ALL_SIDES = tuple(View(45.0 * k, grazing) for grazing in (15.0, 45.0, 75.0) for k in range(8))
VIEWS, FEW = ("--protocol", "paper"), ("--azimuth", "0:360:120", "--grazing", "45", "--test-azimuth", "60")
KINDS = {
    "demo": (),
    "ground": ("--ground", "0.05", "--looks", "1", "--target-box", "-3.8", "-2", "-1", "6.2", "2", "2.4"),
    "stack": ("--passes", "4", "--baseline", "0.006"),
    "polarimetric": ("--polarimetric",),
    "small": ("--pixels", "64"),
}
"""What is simulated, besides a T-72 from the views of the demo."""
LONGEST = 12
"""Kernels of torch and ours that a profile tells apart."""


class Gpu:
    """One GPU, and a folder for what is made on the way; if `quick`, all work is tiny."""

    device = "cuda"

    def __init__(self, folder: Path, quick: bool) -> None:
        self.folder, self.quick = folder, quick
        self.dataset = cache(self._simulated)

    # ---- what a GPU has of its own -----------------------------------------------------------------------------------
    def about(self) -> dict[str, Any]:
        """Its name, and with what it is used."""
        return {"device": torch.cuda.get_device_name(), "torch": torch.__version__, "nvrtc": Nvrtc().version}

    def properties(self) -> dict[str, Any]:
        """What it has of everything."""
        found = torch.cuda.get_device_properties(torch.cuda.current_device())
        about = {"driver": self.launcher.description, "multiprocessors": found.multi_processor_count}
        return about | {"memory_bytes": found.total_memory}

    @cached_property
    def launcher(self) -> Device:
        """What queues the engine's kernels."""
        return device(torch.cuda.current_device())

    def synchronise(self) -> None:
        """Wait until it is done."""
        torch.cuda.synchronize()

    def moment(self) -> Any:
        """Now, on its own clock."""
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def begin_queue(self) -> None:
        """Have this thread ask for work in a queue of its own."""
        torch.cuda.set_stream(torch.cuda.Stream())

    def peak_bytes(self, program: Callable[[], object]) -> int:
        """The most memory that is taken at a time."""
        torch.cuda.reset_peak_memory_stats()
        program()
        return torch.cuda.max_memory_allocated()

    def waits(self, program: Callable[[], object]) -> dict[str, int]:
        """How often torch makes the CPU wait for the GPU in it, by the line of Python."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                program()
            finally:
                torch.cuda.set_sync_debug_mode("default")
        said = [warning for warning in caught if "synchronizing" in str(warning.message)]
        return dict(Counter(f"{Path(warning.filename).name}:{warning.lineno}" for warning in said))

    # ---- clocks ------------------------------------------------------------------------------------------------------
    def seconds(self, program: Callable[[], object], repeats: int) -> list[float]:
        """Of every call, until the GPU is done."""

        def finished() -> None:
            program()
            self.synchronise()

        return in_turn({"": finished}, repeats)[""]

    def peak_flop_s(self) -> float:
        """Multiplications and additions: a product of float32 matrices, not rounded to TF32."""
        torch.backends.cuda.matmul.allow_tf32 = False
        side = self.few(8192, 64)
        factors = torch.rand(2, side, side, device=self.device)
        return 2 * side**3 / statistics.median(self.seconds(lambda: torch.mm(*factors), 10))

    def kernel_ms(self, program: Callable[[], object], repeats: int) -> dict[str, float]:
        """Of each of the engine's kernels in one call, by events around its launch: an idle GPU's wait included."""
        launch, events, total = self.launcher.launch, [], dict[str, float]()

        def timed(name: str, *arguments: Any) -> None:
            begun = self.moment()
            launch(name, *arguments)
            events.append((name, begun, self.moment()))

        self.launcher.launch = timed  # type: ignore[method-assign,assignment]
        try:
            for _ in range(repeats):
                program()
        finally:
            self.launcher.launch = launch  # type: ignore[method-assign]
        self.synchronise()
        for name, begun, done in events:
            total[name] = total.get(name, 0.0) + begun.elapsed_time(done) / repeats
        return total

    def busy_ms(self, program: Callable[[], object], repeats: int) -> dict[str, float]:
        """How long the GPU works in one call, by torch's profiler: in all, and on the longest kernels, torch's too."""
        with profile() as profiled:
            for _ in range(repeats):
                program()
            self.synchronise()
        rows = [row for row in profiled.key_averages() if row.device_type == DeviceType.CUDA]
        spent = {row.key: row.self_device_time_total / 1e3 / repeats for row in rows}
        longest = sorted(spent, key=spent.__getitem__, reverse=True)[:LONGEST]
        return {"all": sum(spent.values())} | {name[:80]: spent[name] for name in longest}

    def paced(self, program: Callable[[], object], views: int, repeats: int) -> dict[str, Any]:
        """What one call takes, which is of so many views, and what one of these takes; by kernel, and with what lists.

        After a first call, which may compile and send.
        """
        program()
        step = spread(self.seconds(program, repeats))
        step_ms, kernel_ms = 1e3 * step["median"], self.kernel_ms(program, repeats)
        with lists_of_tiles() as lists:
            program()
        return {
            "views": views,
            "step_ms": step_ms,
            "per_view_ms": step_ms / views,
            "step_s": step,
            "busy_ms": self.busy_ms(program, min(repeats, 20)),
            "kernel_ms_per_view": {name: ms / views for name, ms in kernel_ms.items()},
            "peak_bytes": self.peak_bytes(program),
            "lists": lists,
        }

    # ---- work --------------------------------------------------------------------------------------------------------
    def few(self, many: int, quick: int) -> int:
        """How many it shall be."""
        return quick if self.quick else many

    def _simulated(self, kind: str) -> Any:
        """The demo's images or images like these, simulated on the CPU."""
        from sarsplat.cli import main
        from sarsplat.data import read_dataset

        if kind == "terrain":  # what images show does not matter to a step
            return replace(self.dataset("ground"), terrain=Terrain(np.outer(*2 * [np.hanning(9)]), (2.0, 2.0)))
        views = (*FEW, "--pixels", "32") if self.quick else VIEWS
        words = ["simulate", "--target", "t72", *KINDS[kind], *views, "--out", f"{self.folder}/{kind}"]
        with redirect_stdout(StringIO()):
            if code := main(words):
                raise RuntimeError(f"sarsplat {' '.join(words)} ended with {code}")
        return read_dataset(self.folder / kind)

    def trainer(self, preset: str, kind: str = "demo", recorded: bool = True, **changes: Any) -> Any:
        """A training before its first step, with all degrees of harmonics in use, as for most of a training.

        Unless `recorded`, its steps are made without a CUDA graph.
        """
        from sarsplat.learning.method import Inputs
        from sarsplat.learning.method_sar_gs import METHOD

        dataset = self.dataset(kind)
        if self.quick:
            changes |= {"gaussians": 60, "views_per_step": 2}
        config = replace(METHOD.preset(preset, dataset), harmonics_every=1, **changes)
        trainer = METHOD.trainer(dataset, config, Inputs(), torch.device(self.device), None)
        trainer.records = trainer.records and recorded
        return trainer

    def trained(self, dataset: Any, preset: str, where: str, **changes: Any) -> tuple[Any, dict[str, Any]]:
        """A run with its points and normals, computed there, and the seconds of these."""
        from sarsplat import reconstruct
        from sarsplat.learning.method_sar_gs import METHOD

        config, clock = replace(METHOD.preset(preset, dataset), **changes), Clock()
        if self.quick:
            few = replace(config.points, rays_per_pixel=2.0, voxel=0.3, optical_depth=0.01, seen_through=1.0, seen_by=0)
            config = replace(config, iterations=3, gaussians=60, views_per_step=2, points=few)
        run = clock.wrap("reconstruct_s", lambda: reconstruct(dataset, config, device=where, quiet=True))()
        run = replace(run, device=where)
        clock.wrap("points_s", lambda: run.points)()
        clock.wrap("normals_s", lambda: run.normals)()
        sizes = {"gaussians": len(run.gaussians), "points": len(run.points)}
        return run, {"training_s": run.time_s, **clock.spent, **sizes}

    def many_views(self) -> Scene:
        """Gaussians as in training, in 24 views."""
        from named_scenes import cloud

        side, count = self.few(128, 16), self.few(15_000, 50)
        gaussians = cloud(count, 1, size=(6.4, 3.3, 2.2), scale=0.06, kappa=(0.01, 4.0))
        return Scene(gaussians, ALL_SIDES[:: self.few(1, 12)], ImageGrid(side, side, (0.3, 0.3), (0.3, 0.3)))

    def many_gaussians(self) -> Scene:
        """A million Gaussians in one view."""
        from named_scenes import cloud

        side, count = self.few(2048, 32), self.few(1_000_000, 100)
        gaussians = cloud(count, 2, size=(self.few(200, 3), self.few(200, 3), 10.0), scale=0.1, kappa=(0.01, 4.0))
        return Scene(gaussians, ALL_SIDES[8:9], ImageGrid(side, side, (0.1, 0.1), (0.15, 0.15)))

    def image_and_gradients(self, scene: Scene) -> Callable[[], object]:
        """Forward and backward to every Gaussian."""
        moved = scene.gaussians.to(self.device)
        leaves = moved.with_tensors(**{name: tensor.requires_grad_() for name, tensor in moved.tensors().items()})
        seed = torch.rand(len(scene.views), scene.grid.rows, scene.grid.columns, device=self.device)

        def program() -> object:
            images = render(leaves, scene.views, scene.grid, engine="cuda").channel(0)
            return torch.autograd.grad(images, list(leaves.tensors().values()), seed)

        return program


@contextmanager
def lists_of_tiles() -> Iterator[dict[str, dict[str, int]]]:
    """Of each plane: its tiles and those with anything in them, the longest list, and the slots made and used."""
    found: dict[str, dict[str, int]] = {}
    usual = TileLists._list

    def kept(self: TileLists, name: str, plane: Any, slots: int, *others: Any, **options: Any) -> None:
        usual(self, name, plane, slots, *others, **options)
        lengths = self.arrays[f"{name} starts"].diff()
        count = {"tiles": plane.tiles, "filled": int((lengths > 0).sum()), "longest": int(lengths.max())}
        found[name] = count | {"slots": slots, "used": int(lengths.sum())}

    TileLists._list = kept  # type: ignore[method-assign]
    try:
        yield found
    finally:
        TileLists._list = usual  # type: ignore[method-assign]
