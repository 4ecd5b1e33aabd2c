"""Loads that break other renderers: they may cost their work, and no more."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from clock import Spread, in_turn, ratio, spread
from recipes import training_view
from scene import Scene, field
from work import blocks, unseen, visited

from sarsplat.geometry import View


def loads(quick: bool) -> dict[str, Scene]:
    """Footprints that cover everything, and Gaussians that nothing but their shape tells apart."""
    count = 30 if quick else 150
    wide = field(count, 64, std_pixels=40.0)
    wide = replace(wide, gaussians=replace(wide.gaussians, optical_depth=wide.gaussians.optical_depth * 0.1))
    together = training_view(5000)
    centre = together.gaussians.means.mean(0, keepdim=True)
    means = centre.expand(len(together.gaussians), 3).contiguous()
    return {
        f"{count} Gaussians wider than the image": wide,
        "5,000 Gaussians in one place": replace(together, gaussians=replace(together.gaussians, means=means)),
    }


def measure(quick: bool) -> dict[str, Any]:
    """Time over that of the same work in the ordinary scene: so many blocks, and what each Gaussian costs unseen."""
    scenes = {"ordinary": training_view(), **loads(quick)}
    if not all(math.isfinite(float(t.sum())) for scene in scenes.values() for t in scene.step()):
        raise SystemExit("a degenerate scene gave something that is not finite")
    programs: dict[str, Callable[[], object]] = {name: scene.step for name, scene in scenes.items()}
    programs |= {f"{name}, unseen": unseen(scene).step for name, scene in scenes.items()}
    times = in_turn(programs, 3 if quick else 30)
    count = {name: blocks(visited(scene)) for name, scene in scenes.items()}
    spent = {name: statistics.median(samples) for name, samples in times.items()}
    per_block = (spent["ordinary"] - spent["ordinary, unseen"]) / count["ordinary"]
    work = {name: spent[f"{name}, unseen"] + count[name] * per_block for name in scenes if name != "ordinary"}

    around = tuple(View(360.0 * k / 64, 15.0 + 30.0 * (k % 3)) for k in range(64))
    batch = replace(training_view(1000) if quick else scenes["ordinary"], views=around)
    alone = [replace(batch, views=(view,)) for view in around]
    contenders = {"one by one": lambda: [scene.step() for scene in alone], "at once": batch.step}
    views = in_turn(contenders, 1 if quick else 7)
    ratios: dict[str, Spread] = {}
    contenders_s: dict[str, tuple[float, float]] = {}
    for name, seconds in work.items():
        key = f"{name}: time / what as many blocks and Gaussians cost in the ordinary scene"
        ratios[key] = spread([sample / seconds for sample in times[name]])
        contenders_s[key] = spent[name], seconds
    key = "64 views: at once / one by one"
    ratios[key] = ratio(views["at once"], views["one by one"])
    contenders_s[key] = statistics.median(views["at once"]), statistics.median(views["one by one"])
    times |= {f"64 views {how}": samples for how, samples in views.items()}
    return {
        "ratios": ratios,
        "times": {name: spread(samples) for name, samples in times.items()},
        "contenders_s": contenders_s,
        "blocks": count,
    }
