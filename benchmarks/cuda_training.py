"""The demo trained on a GPU and on the CPU, with time and scores, and what a step of it takes.

The part of `cuda_check.py` that needs the whole package with its extras.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from clock import in_turn, spread
from paper_run import sarsplat
from torch.profiler import profile

from sarsplat.data import Dataset, read_dataset
from sarsplat.reconstruction import Trainer, preset

PRESETS = ("default", "paper")  # several views and one a step, without and with SSIM
STEPS, WARM_UP = 100, 20


def measure(device: str = "cuda", quick: bool = False) -> dict[str, Any]:
    """Scores of the demo by device, and the step of each preset; a quick one learns next to nothing."""
    views = ("--azimuth", "0:360:120", "--grazing", "45", "--test-azimuth", "60") if quick else ("--protocol", "paper")
    with tempfile.TemporaryDirectory() as folder:
        dataset = f"{folder}/dataset"
        sarsplat("simulate", "--target", "t72", "--source", "raycast", *views, "--out", dataset)
        where = dict.fromkeys(("cpu", device))
        demo = {place: trained(dataset, f"{folder}/{place}", place, quick) for place in where}
        images = read_dataset(Path(dataset))
        steps = {name: step(images, name, device, 3 if quick else STEPS) for name in PRESETS}
    return {"demo": demo, "steps": steps}


def trained(dataset: str, run: str, device: str, quick: bool) -> dict[str, float]:
    """One training from the command line, and its scores."""
    shorter = ("--iterations", "20") if quick else ()
    sarsplat("reconstruct", dataset, "--out", run, "--device", device, *shorter)
    sarsplat("evaluate", run)
    metrics = json.loads(Path(run, "metrics.json").read_text())
    return {
        "training_s": metrics["time_s"],
        "psnr_db": metrics["images"]["test"]["psnr_db"],
        "chamfer_m": metrics["points"]["visible"]["cd_m"],
        "f1": metrics["points"]["visible"]["f1@0.3"],
    }


def step(dataset: Dataset, name: str, device: str, repeats: int) -> dict[str, Any]:
    """Seconds of a step until the device is done, how often it waits on the way, and what torch spends its time on.

    Also whether a second training learned the same bits.
    """
    config = replace(preset(name), harmonics_every=1)  # all degrees in use, as for most of a training
    trainer, again = Trainer(dataset, config, device=device), Trainer(dataset, config, device=device)
    for _ in range(min(WARM_UP, repeats)):
        trainer.step()
        again.step()
    same = all(torch.equal(again.model.parameters[key], tensor) for key, tensor in trainer.model.parameters.items())
    seconds = in_turn({name: finished(trainer.step, device)}, repeats)[name]
    with profile() as profiled:
        for _ in range(min(WARM_UP, repeats)):
            trainer.step()
        synchronise(device)
    order = "self_cpu_time_total" if device == "cpu" else "self_cuda_time_total"
    return {
        "views": config.views_per_step,
        "same_bits": same,
        "step_s": spread(seconds),
        "waits": waits(trainer.step) if device != "cpu" else 0,
        "profile": profiled.key_averages().table(sort_by=order, row_limit=20, max_name_column_width=40),
    }


def finished(program: Callable[[], object], device: str) -> Callable[[], None]:
    """The program, and the wait for what it began."""

    def run() -> None:
        program()
        synchronise(device)

    return run


def synchronise(device: str) -> None:
    """Wait for the device."""
    if device != "cpu":
        torch.cuda.synchronize()


def waits(program: Callable[[], object]) -> int:
    """How often torch makes the CPU wait for the GPU in it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            program()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    return sum("synchronizing" in str(warning.message) for warning in caught)
