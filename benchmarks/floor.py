"""The engine against its own arithmetic: what its loops visit, at the rate these cores multiply and add."""

from __future__ import annotations

import statistics
from typing import Any

from clock import in_turn, ratio, spread
from recipes import training_view
from work import FLOPS, flops, multiply, rate, unseen, visited


def measure(quick: bool) -> dict[str, Any]:
    """Engine forward + backward over the floor, with and without what it does once per Gaussian."""
    scene = training_view()
    counts, empty = visited(scene), unseen(scene)
    times = in_turn({"engine": scene.step, "unseen": empty.step, "multiply": multiply}, 5 if quick else 60)
    bound = [flops(counts) / rate(seconds) for seconds in times["multiply"]]
    pairs = [whole - rest for whole, rest in zip(times["engine"], times["unseen"], strict=True)]
    live = {plane: counts[f"live_{plane}"] / (counts[f"blocks_{plane}"] * counts["lanes"]) for plane in FLOPS}
    return {
        "ratios": {
            "engine / floor of visited blocks": ratio(times["engine"], bound),
            "engine less the same Gaussians unseen / floor of visited blocks": ratio(pairs, bound),
            **{f"live lanes, {plane}": share for plane, share in live.items()},
        },
        "times": {
            "engine forward + backward": spread(times["engine"]),
            "the same Gaussians unseen": spread(times["unseen"]),
            "engine less the same Gaussians unseen": spread(pairs),
            "floor of visited blocks": spread(bound),
        },
        "counts": counts,
        "rate_flop_s": rate(statistics.median(times["multiply"])),
    }
