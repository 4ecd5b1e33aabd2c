"""The public steps project, attenuate and splat: the chain of them against `render`, four channels against one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from clock import in_turn, ratio, spread
from recipes import COUNT, halfway, training_view
from scene import Scene

from sarsplat.renderer import attenuate, project, splat
from sarsplat.scenes import paper_grid, paper_views

CHANNELS = 4


def chain(scene: Scene) -> Callable[[], object]:
    """Images step by step, and the gradients that `Scene.step` has."""

    def step() -> object:
        g = scene.leaves
        projection = project(g, scene.views, scene.grid, rays=scene.rays, engine="cpu")
        cross_sections = projection.gamma0 * attenuate(projection, scene.rays, engine="cpu").lit_area
        images = splat(projection.pixels, cross_sections[..., None], scene.grid, engine="cpu")[:, 0]
        return [images.detach(), *scene.gradients(images)]

    return step


def splatting(scene: Scene, channels: int) -> Callable[[], object]:
    """So many channels at once, forward and backward."""
    with torch.no_grad():
        pixels = project(scene.gaussians, scene.views, scene.grid, engine="cpu").pixels
    leaves = [pixels.centers.requires_grad_(), pixels.roots.requires_grad_()]
    generator = torch.Generator().manual_seed(channels)
    amplitudes = torch.rand(*leaves[0].shape[:2], channels, generator=generator).requires_grad_()
    cotangent = torch.rand(len(scene.views), channels, scene.grid.rows, scene.grid.columns, generator=generator)

    def step() -> object:
        images = splat(pixels, amplitudes, scene.grid, engine="cpu")
        return torch.autograd.grad(images, [*leaves, amplitudes], cotangent)

    return step


def measure(quick: bool) -> dict[str, Any]:
    """The chain's time over the fused pass's, and four channels' over one's."""
    count, repeats = (1000, 3) if quick else (COUNT, 40)
    one = training_view(count)
    several = Scene(halfway(count).target(3), tuple(view for view, _ in paper_views()[24:32]), paper_grid())
    found: dict[str, Any] = {"ratios": {}, "times": {}}
    for name, scene in (("one view", one), ("8 views", several)):
        samples = in_turn({"steps": chain(scene), "fused": lambda scene=scene: scene.step()}, repeats)
        found["ratios"][f"project, attenuate, splat / render, {name}"] = ratio(samples["steps"], samples["fused"])
        found["times"] |= {f"{who}, {name}": spread(seconds) for who, seconds in samples.items()}
        kinds = {f"C = {channels}": splatting(scene, channels) for channels in (CHANNELS, 1)}
        samples = in_turn(kinds, repeats)
        found["ratios"][f"splat of {CHANNELS} channels / one, {name}"] = ratio(*samples.values())
        found["times"] |= {f"splat, {who}, {name}": spread(seconds) for who, seconds in samples.items()}
    return found
