"""What one training iteration costs, and where: engine forward and backward, loss, optimiser, rest.

Gaussians as they are halfway through the default T-72 reconstruction, 128 × 128 pixels, rays at half the pixel spacing;
one view and eight views to an iteration.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from clock import TURN, Clock, ratio, spread
from recipes import COUNT, halfway

from sarsplat.learning.losses import amplitude_loss
from sarsplat.learning.optimiser import Optimiser
from sarsplat.renderer import channel_of
from sarsplat.renderer.engines import cpu
from sarsplat.scenes import paper_grid, paper_views
from sarsplat.settings.presets import preset

COUNTS, VIEWS = (COUNT, 4 * COUNT), (1, 8)
PARTS = ("engine forward", "engine backward", "loss", "optimiser", "rest", "total")


def training(count: int, views_per_step: int, clock: Clock) -> Callable[[int], None]:
    """One iteration of the training loop, given its number."""
    model, grid, config = halfway(count), paper_grid(), preset("default")
    optimiser = Optimiser(model.parameters, model.learned, config.iterations)
    views = [view for view, split in paper_views() if split == "train"]
    truth = torch.rand(len(views), grid.rows, grid.columns, generator=torch.Generator().manual_seed(1)) * 0.1
    step = clock.wrap("optimiser", optimiser.step)

    def loss_gradient(images: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        leaf = images.detach().requires_grad_()
        return torch.autograd.grad(amplitude_loss(leaf, target, 1.0, config.ssim_weight), leaf)[0]

    loss = clock.wrap("loss", loss_gradient)

    def iterate(k: int) -> None:
        chosen = [(k * views_per_step + i) % len(views) for i in range(views_per_step)]
        images, _ = model.render([views[i] for i in chosen], grid, 3, numbers=torch.tensor(chosen))
        images = channel_of(images, model.power_channel)
        images.backward(loss(images, torch.stack([truth[i] for i in chosen])))
        step(0)

    return iterate


def measure(quick: bool) -> dict[str, Any]:
    """Seconds per view of every part, and what more views and more Gaussians cost."""
    clock = Clock()
    counts, rounds = ((1000, 4000), 2) if quick else (COUNTS, 9)
    kinds = {(count, views): training(count, views, clock) for count in counts for views in VIEWS}
    samples: dict[tuple[int, int], dict[str, list[float]]] = {kind: {part: [] for part in PARTS} for kind in kinds}
    with clock.watching(cpu.Pass, {"forward": "engine forward", "backward": "engine backward"}):
        for _ in range(rounds):
            for (count, views), iterate in kinds.items():
                for k in range(TURN):
                    clock.spent.clear()
                    begun = time.perf_counter()
                    iterate(k)
                    total = time.perf_counter() - begun
                    if k:
                        parts = clock.spent | {"rest": total - sum(clock.spent.values()), "total": total}
                        for part, seconds in parts.items():
                            samples[count, views][part].append(seconds / views)

    def title(count: int, views: int) -> str:
        return f"{count:,} Gaussians, {views} view{'s' if views > 1 else ''} a step"

    few, many = counts
    totals = {kind: parts["total"] for kind, parts in samples.items()}
    ratios = {
        "a view of 8 / a view alone": ratio(totals[few, 8], totals[few, 1]),
        f"{many:,} / {few:,} Gaussians, a view alone": ratio(totals[many, 1], totals[few, 1]),
    }
    for part in PARTS[:-1]:
        ratios[f"{part} / total, {title(few, 1)}"] = ratio(samples[few, 1][part], totals[few, 1])
    spreads = {kind: {part: spread(parts[part]) for part in PARTS} for kind, parts in samples.items()}
    return {
        "ratios": ratios,
        "times": {f"{title(*kind)}, per view: {part}": spreads[kind][part] for kind in kinds for part in PARTS},
        "split_s": {part: spreads[few, 1][part] for part in PARTS[:-1]},
        "view_s": {"one view": spreads[few, 1]["total"], "8 views": spreads[few, 8]["total"]},
        "view_s_many": {"one view": spreads[many, 1]["total"], "8 views": spreads[many, 8]["total"]},
        "gaussians": {"few": few, "many": many},
    }
