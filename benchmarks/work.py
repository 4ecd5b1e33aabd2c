"""What the engine's loops visit, and at what rate these cores multiply and add."""

from __future__ import annotations

import statistics
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import torch
from clock import in_turn
from scene import Scene

from sarsplat.renderer.engines import cpu

FLOPS = {"attenuation": 25 + 40 + 2 * 15, "imaging": 12 + 25 + 2 * 15}
"""Per lane: forward, backward, and an exponential in each."""

_SIDE = 1024
_FACTORS = torch.rand(2, _SIDE, _SIDE, generator=torch.Generator().manual_seed(0))


def multiply() -> None:
    """What the cores can do: a product of float32 matrices, on torch's threads."""
    torch.mm(*_FACTORS)


def rate(seconds: float) -> float:
    """Flop/s of a `multiply` that took so long."""
    return 2 * _SIDE**3 / seconds


def measured_rate(repeats: int = 15) -> float:
    """Flop/s of these cores now."""
    return rate(statistics.median(in_turn({"multiply": multiply}, repeats)["multiply"]))


def visited(scene: Scene) -> dict[str, int]:
    """Blocks visited and lanes live on each plane in one forward pass, and the lanes of a block."""
    per_view = []
    forward = cpu.Pass.forward

    def counted(self: cpu.Pass, step: str, problem: Any, outputs: Any) -> tuple[str, int]:
        result = forward(self, step, problem, outputs)
        per_view.append(self.statistics(problem))
        return result

    with patch.object(cpu.Pass, "forward", counted), torch.no_grad():
        scene.images()
    return {field[0]: int(getattr(per_view[0], field[0])) for field in per_view[0]._fields_}


def flops(counts: dict[str, int]) -> int:
    """Of every visited lane, live or not, forward and backward."""
    return counts["lanes"] * sum(counts[f"blocks_{plane}"] * each for plane, each in FLOPS.items())


def blocks(counts: dict[str, int]) -> int:
    """Visited on both planes."""
    return sum(counts[f"blocks_{plane}"] for plane in FLOPS)


def unseen(scene: Scene) -> Scene:
    """The same Gaussians, too thin to touch a ray and far from the image: all of the engine's work but its pairs."""
    thin = replace(scene.gaussians, optical_depth=torch.full_like(scene.gaussians.optical_depth, 1e-6))
    return Scene(thin, scene.views, replace(scene.grid, center_m=(1e4, 1e4)))
