"""The engine against a decent program in plain torch, forward and backward, each on all threads."""

from __future__ import annotations

from typing import Any

from clock import in_turn, ratio, spread
from naive_torch import render_naive
from recipes import training_view
from torch import Tensor


def measure(quick: bool) -> dict[str, Any]:
    """Plain torch's time over the engine's; stops if the two do not compute the same."""
    scene = training_view()

    def naive() -> list[Tensor]:
        images = render_naive(scene.leaves, list(scene.views), scene.grid, scene.rays)
        return [images.detach(), *scene.gradients(images)]

    for mine, theirs in zip(scene.step(), naive(), strict=True):
        difference = float((mine - theirs).norm() / mine.norm())
        if not difference < 1e-4:
            raise SystemExit(f"the two programs differ by {difference:.1e}; the comparison is void")
    times = in_turn({"plain torch": naive, "engine": scene.step}, 2 if quick else 40)
    return {
        "ratios": {"plain torch / engine": ratio(times["plain torch"], times["engine"])},
        "times": {name: spread(samples) for name, samples in times.items()},
    }
