"""What one training iteration costs, and where: `python benchmarks/iteration.py [--threads N] [--repeats N]`.

15,000 Gaussians as they are halfway through the default T-72 reconstruction (a recipe, from a seed), 128 × 128 pixels,
rays at half the pixel spacing; one view and eight views to an iteration. Plain torch renders the same scene beside it.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import time
from collections.abc import Callable
from functools import wraps

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is loaded

import torch
from naive_torch import render_naive

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.initialise import Region, random_quaternions
from sarsplat.geometry import RayGrid
from sarsplat.reconstruct.config import preset
from sarsplat.reconstruct.losses import amplitude_loss
from sarsplat.reconstruct.model import SceneModel
from sarsplat.reconstruct.optimiser import Optimiser
from sarsplat.render import cpu, render
from sarsplat.scenes import paper_grid, paper_views

COUNT = 15_000
FLOPS_A, FLOPS_B = 25 + 40 + 2 * 15, 12 + 25 + 2 * 15  # per lane: forward, backward and two exponentials
CORE_RATE = 128e9  # flop/s of one AVX-512 core; the floor below is for such a core


def halfway() -> SceneModel:
    """The distributions of a default run's Gaussians halfway through."""
    generator = torch.Generator().manual_seed(0)
    region = Region.box((-3.4, -1.78, 0.1), (5.2, 1.78, 2.15))
    medians = torch.tensor([0.025, 0.053, 0.083])  # m, shortest to longest axis
    log_scales = medians.log() + torch.tensor([0.6, 0.5, 0.6]) * torch.randn(COUNT, 3, generator=generator)
    log_depth = math.log(0.18) + 2.1 * torch.randn(COUNT, generator=generator)
    parameters = {
        "means": torch.from_numpy(region.sample(COUNT, generator)).float(),
        "quaternions": random_quaternions(COUNT, generator),
        "log_scales": log_scales.clamp(math.log(0.01), math.log(0.3)),
        "log_optical_depth": log_depth.clamp(math.log(1e-3), math.log(10.0)),
        "harmonics": -2.6 + 2.2 * torch.randn(COUNT, 1, generator=generator),
        "higher_harmonics": 0.22 * torch.randn(COUNT, 15, generator=generator),
    }
    return SceneModel(preset("default"), region, 1.0, parameters)


class Clock:
    """Seconds spent inside wrapped functions."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}

    def wrap(self, name: str, function: Callable) -> Callable:
        """The function, its time added to `name`."""

        @wraps(function)
        def timed(*arguments: object) -> object:
            start = time.perf_counter()
            result = function(*arguments)
            self.spent[name] = self.spent.get(name, 0.0) + time.perf_counter() - start
            return result

        return timed


def measure(views_per_step: int, repeats: int, clock: Clock) -> None:
    """Print the iteration time and its parts, ms: median, and fastest to 90th percentile."""
    model, grid, config = halfway(), paper_grid(), preset("default")
    optimiser = Optimiser(model.parameters, model.bounds, config)
    views = [view for view, split in paper_views() if split == "train"]
    truth = torch.rand(len(views), grid.rows, grid.columns, generator=torch.Generator().manual_seed(1)) * 0.1
    step = clock.wrap("optimiser", optimiser.step)

    def loss_gradient(images: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        leaf = images.detach().requires_grad_()
        return torch.autograd.grad(amplitude_loss(leaf, target, 1.0, config.ssim_weight), leaf)[0]

    loss = clock.wrap("loss", loss_gradient)
    samples: dict[str, list[float]] = {}
    for k in range(repeats + 5):
        chosen = [(k * views_per_step + i) % len(views) for i in range(views_per_step)]
        clock.spent.clear()
        start = time.perf_counter()
        images, _ = model.render([views[i] for i in chosen], grid, 3, chips=chosen)
        images.backward(loss(images, truth[chosen]))
        step(0)
        total = time.perf_counter() - start
        if k >= 5:
            parts = dict(clock.spent) | {"rest": total - sum(clock.spent.values()), "total": total}
            for name, seconds in parts.items():
                samples.setdefault(name, []).append(1e3 * seconds)
    print(f"{views_per_step} view(s) an iteration, {repeats} iterations, ms: median (fastest .. 90 %)")
    for name in ("engine forward", "engine backward", "loss", "optimiser", "rest", "total"):
        deciles = statistics.quantiles(samples[name], n=10)
        print(f"  {name:16} {statistics.median(samples[name]):8.2f}  ({min(samples[name]):.2f} .. {deciles[-1]:.2f})")


def pair_work(threads: int) -> None:
    """Print what the engine's loops visit in one view, and the time their arithmetic alone would take."""
    model, grid = halfway(), paper_grid()
    kept = []
    forward = cpu.Pass.forward

    def spy(self: cpu.Pass, problem: object, outputs: object) -> object:
        kept.append((self, problem))
        return forward(self, problem, outputs)

    cpu.Pass.forward = spy
    model.render([paper_views()[24][0]], grid, 3)
    cpu.Pass.forward = forward
    found = kept[0][0].statistics(kept[0][1])
    for plane in ("attenuation", "imaging"):
        blocks, live = getattr(found, f"blocks_{plane}"), getattr(found, f"live_{plane}")
        print(f"  {plane}: {blocks} blocks of {found.lanes} lanes, {100 * live / (blocks * found.lanes):.0f} % live")
    flops = found.lanes * (found.blocks_attenuation * FLOPS_A + found.blocks_imaging * FLOPS_B)
    print(f"  floor of the visited pairs, {threads} × 128 GFlop/s: {1e3 * flops / CORE_RATE / threads:.2f} ms a view")


def naive(repeats: int) -> None:
    """Print engine and plain torch on one view, forward and backward to every Gaussian, and their ratio."""
    grid, views = paper_grid(), [paper_views()[24][0]]
    rays = RayGrid.for_image(grid)
    start = halfway().target(3)
    scene = Gaussians(*(t.detach().requires_grad_() for t in start.tensors().values()), p_min=start.p_min)
    programs: dict[str, Callable[[], torch.Tensor]] = {
        "engine": lambda: render(scene, views, grid, rays=rays, engine="cpu").images,
        "naive torch": lambda: render_naive(scene, views, grid, rays),
    }
    cotangent = torch.rand(1, grid.rows, grid.columns)
    times, results = {}, {}
    for name, program in programs.items():
        samples = []
        for _ in range(repeats + 2):
            begun = time.perf_counter()
            images = program()
            gradients = torch.autograd.grad(images, list(scene.tensors().values()), cotangent)
            samples.append(1e3 * (time.perf_counter() - begun))
        times[name], results[name] = samples[2:], [images.detach(), *gradients]
        print(f"  {name:12} {statistics.median(times[name]):8.2f} ms (fastest {min(times[name]):.2f})")
    for mine, theirs in zip(*results.values(), strict=True):
        difference = float((mine - theirs).norm() / mine.norm())
        if difference > 1e-4:
            raise SystemExit(f"the two programs differ by {difference:.1e}; the comparison is void")
    print(f"  ratio {statistics.median(times['naive torch']) / statistics.median(times['engine']):.1f}")


def main() -> None:
    """Run all of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=60)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print(f"{COUNT} Gaussians, 128 × 128 pixels, {arguments.threads} thread(s), {cpu.best_instruction_set()}")
    print("one view:")
    pair_work(arguments.threads)
    naive(max(3, arguments.repeats // 6))
    clock = Clock()
    cpu.Pass.forward = clock.wrap("engine forward", cpu.Pass.forward)
    cpu.Pass.backward = clock.wrap("engine backward", cpu.Pass.backward)
    for views_per_step in (1, 8):
        measure(views_per_step, arguments.repeats, clock)


if __name__ == "__main__":
    main()
