"""One whole training with density control in a process of its own, for tests: DATASET OUT THREADS KIND [KILL_AT].

With KILL_AT the process kills itself, as `kill -9` does, in the middle of the step after that many.
"""

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from sarsplat import Config, preset, reconstruct
from sarsplat.learning.optimiser import Optimiser
from sarsplat.settings.sections import Densification

DENSITY = Densification(
    10, 90, 10, gradient=2.5e-4, split_above=0.36, max_extent=0.02, min_scattering=0.1, max_gaussians=4000
)


def config(kind: str) -> Config:
    """100 iterations of everything: density control and SSIM, or chips with all that surrounds a target."""
    if kind == "measured":
        measured = preset("measured")
        around = replace(measured.surroundings, texture_from=0.05, texture_rounds=10)
        return replace(
            measured, iterations=100, gaussians=1000, harmonics_every=30, checkpoint_every=50, surroundings=around
        )
    common = {"iterations": 100, "gaussians": 2500, "harmonics_every": 30, "checkpoint_every": 50}
    return replace(preset("default"), **common, initial_scale=0.27, ssim_weight=0.2, densification=DENSITY)


def main(dataset: str, out: str, threads: str, kind: str, kill_at: str = "") -> None:
    """Train, or go on if the run is there."""
    torch.set_num_threads(int(threads))
    update, steps = Optimiser.step, []

    def counted(*args: Any) -> None:
        steps.append(1)
        if kill_at and len(steps) > int(kill_at):
            os.kill(os.getpid(), signal.SIGKILL)
        update(*args)

    Optimiser.step = counted  # type: ignore[method-assign]
    reconstruct(dataset, config(kind), out, resume=Path(out).exists())


if __name__ == "__main__":
    main(*sys.argv[1:])
